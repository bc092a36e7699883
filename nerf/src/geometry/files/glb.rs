//! Binary glTF: a JSON description and one buffer.

use super::super::colored_mesh::ColoredMesh;
use crate::dataset::SrgbDecode;
use glam::DVec3;
use raygrad_autograd::Formula;
use serde_json::{Value, json};

/// Numbers of the specification: component types, buffer view targets, primitive modes and chunk types.
const UNSIGNED_SHORT: u32 = 5123;
const UNSIGNED_INT: u32 = 5125;
const FLOAT: u32 = 5126;
const ARRAY_BUFFER: u32 = 34962;
const ELEMENT_ARRAY_BUFFER: u32 = 34963;
const POINTS: u32 = 0;
const TRIANGLES: u32 = 4;
const JSON: &[u8; 4] = b"JSON";
const BIN: &[u8; 4] = b"BIN\0";

/// The contents of the file, or an error message.
pub(super) fn to_bytes(shape: &ColoredMesh, generator: &str) -> Result<Vec<u8>, String> {
    let ColoredMesh { mesh, normals, colors } = shape;
    let [low, high] = mesh.bounds().ok_or("needs at least one vertex in glTF")?;
    let middle = 0.5 * (low + high);
    let near = |place: &DVec3| (*place - middle).as_vec3().to_array();
    let places: Vec<[f32; 3]> = mesh.positions.iter().map(near).collect();
    let range = |pick: fn(f32, f32) -> f32| places.iter().copied().reduce(|a, b| [0, 1, 2].map(|k| pick(a[k], b[k])));
    let [least, most] = [range(f32::min), range(f32::max)];

    let mut buffer = Buffer::default();
    let vertices = mesh.positions.len();
    let position = buffer.add(places.iter().flatten().flat_map(|x| x.to_le_bytes()), ARRAY_BUFFER);
    let normal = normals.iter().flat_map(|normal| normal.as_vec3().to_array()).flat_map(f32::to_le_bytes);
    let normal = buffer.add(normal, ARRAY_BUFFER);
    // Sixteen bits, since eight bits of linear light would merge dark colours. The fourth number aligns vertices to 4
    // bytes.
    let light = |byte: u8| (SrgbDecode.f([f64::from(byte) / 255.0]) * f64::from(u16::MAX)).round() as u16;
    let color = colors.iter().flat_map(|&[r, g, b]| [light(r), light(g), light(b), u16::MAX]);
    let color = buffer.add(color.flat_map(u16::to_le_bytes), ARRAY_BUFFER);
    let mut accessors = vec![
        json!({ "bufferView": position, "componentType": FLOAT, "count": vertices, "type": "VEC3", "min": least, "max": most }),
        json!({ "bufferView": normal, "componentType": FLOAT, "count": vertices, "type": "VEC3" }),
        json!({ "bufferView": color, "componentType": UNSIGNED_SHORT, "normalized": true, "count": vertices, "type": "VEC4" }),
    ];
    let mut primitive =
        json!({ "attributes": { "POSITION": 0, "NORMAL": 1, "COLOR_0": 2 }, "material": 0, "mode": POINTS });
    if !mesh.triangles.is_empty() {
        let indices = mesh.triangles.iter().flatten();
        let view = buffer.add(indices.flat_map(|vertex| vertex.to_le_bytes()), ELEMENT_ARRAY_BUFFER);
        let count = 3 * mesh.triangles.len();
        accessors.push(json!({ "bufferView": view, "componentType": UNSIGNED_INT, "count": count, "type": "SCALAR" }));
        primitive["indices"] = json!(3);
        primitive["mode"] = json!(TRIANGLES);
    }
    let plain = json!({ "metallicFactor": 0, "roughnessFactor": 1 });
    let description = json!({
        "asset": { "version": "2.0", "generator": generator },
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{ "nodes": [0] }],
        "nodes": [{ "mesh": 0, "translation": middle.to_array() }],
        "meshes": [{ "primitives": [primitive] }],
        "materials": [{ "pbrMetallicRoughness": plain, "extensions": { "KHR_materials_unlit": {} } }],
        "accessors": accessors,
        "bufferViews": buffer.views,
        "buffers": [{ "byteLength": buffer.bytes.len() }],
    });
    let mut text = description.to_string().into_bytes();
    text.resize(text.len().next_multiple_of(4), b' ');
    let length = 12 + 8 + text.len() + 8 + buffer.bytes.len();
    let number = |length: usize| u32::try_from(length).map(u32::to_le_bytes);
    let [whole, first, second] = [length, text.len(), buffer.bytes.len()].map(number);
    let too_large = |_| "would exceed glTF's limit of 4 GiB: use fewer triangles, or .ply";
    let mut out = Vec::with_capacity(length);
    out.extend(b"glTF");
    out.extend(2_u32.to_le_bytes());
    out.extend(whole.map_err(too_large)?);
    for (length, kind, bytes) in [(first, JSON, text), (second, BIN, buffer.bytes)] {
        out.extend(length.map_err(too_large)?);
        out.extend(kind);
        out.extend(bytes);
    }
    Ok(out)
}

/// The buffer and its views.
#[derive(Default)]
struct Buffer {
    bytes: Vec<u8>,
    views: Vec<Value>,
}

impl Buffer {
    /// Adds a view, whose size is a multiple of 4 bytes, and returns its index.
    fn add(&mut self, numbers: impl Iterator<Item = u8>, target: u32) -> usize {
        let offset = self.bytes.len();
        self.bytes.extend(numbers);
        let length = self.bytes.len() - offset;
        self.views.push(json!({ "buffer": 0, "byteOffset": offset, "byteLength": length, "target": target }));
        self.views.len() - 1
    }
}
