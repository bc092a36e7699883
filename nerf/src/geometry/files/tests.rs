//! Written files, read back by other libraries.

use super::super::mesh::Mesh;
use super::*;
use crate::dataset::{SceneTransform, SrgbDecode};
use glam::{DMat3, DQuat, DVec3};
use ply_rs_bw::parser::Parser;
use ply_rs_bw::ply::{DefaultElement, Property};
use raygrad_autograd::Formula;
use std::f64::consts::FRAC_PI_2;

/// Four vertices and three triangles far from the origin; all numbers differ.
fn shape() -> ColoredMesh {
    let at = DVec3::new(500_000.25, -37.5, 12.0);
    let positions = [[0.0, 0.125, 0.25], [1.5, 0.375, 0.5], [0.625, 2.0, 0.75], [0.875, 1.0, 3.25]];
    let positions = positions.map(|x| at + DVec3::from(x)).to_vec();
    let normals = [[0.6, 0.0, 0.8], [-0.28, 0.96, 0.0], [0.0, -0.6, 0.8], [0.36, 0.48, -0.8]].map(DVec3::from).to_vec();
    let colors = vec![[255, 128, 0], [1, 2, 3], [90, 200, 40], [10, 20, 250]];
    ColoredMesh { mesh: Mesh { positions, triangles: vec![[0, 1, 2], [2, 1, 3], [3, 0, 2]] }, normals, colors }
}

fn points() -> ColoredMesh {
    let mut shape = shape();
    shape.mesh.triangles.clear();
    shape
}

/// The bytes of a written file.
fn written(shape: &ColoredMesh, name: &str) -> Vec<u8> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    let count = write(shape, &path).unwrap();
    let bytes = std::fs::read(path).unwrap();
    assert_eq!(count, bytes.len() as u64);
    bytes
}

#[test]
fn ply_files_are_read_by_another_library() {
    for shape in [shape(), points()] {
        let bytes = written(&shape, "a.ply");
        let ply = Parser::<DefaultElement>::new().read_ply(&mut &bytes[..]).unwrap();
        let vertices = &ply.payload["vertex"];
        assert_eq!(vertices.len(), 4);
        for (i, vertex) in vertices.iter().enumerate() {
            let double = |name: &str| match vertex[name] {
                Property::Double(x) => x,
                _ => panic!("{name} is no double"),
            };
            let float = |name: &str| match vertex[name] {
                Property::Float(x) => x,
                _ => panic!("{name} is no float"),
            };
            let byte = |name: &str| match vertex[name] {
                Property::UChar(x) => x,
                _ => panic!("{name} is no byte"),
            };
            assert_eq!(["x", "y", "z"].map(double), shape.mesh.positions[i].to_array());
            assert_eq!(["nx", "ny", "nz"].map(float), shape.normals[i].as_vec3().to_array());
            assert_eq!(["red", "green", "blue"].map(byte), shape.colors[i]);
        }
        let faces = ply.payload.get("face").map_or(&[][..], |faces| faces);
        let triangles: Vec<Vec<i32>> = faces
            .iter()
            .map(|face| match &face["vertex_indices"] {
                Property::ListInt(list) => list.clone(),
                _ => panic!("no list"),
            })
            .collect();
        let expected: Vec<Vec<i32>> =
            shape.mesh.triangles.iter().map(|triangle| triangle.map(|i| i as i32).to_vec()).collect();
        assert_eq!(triangles, expected);
        assert_eq!(ply.payload.contains_key("face"), !shape.mesh.triangles.is_empty());
    }
}

#[test]
fn obj_files_are_read_by_another_library() {
    // The reader uses f32, which has too few digits far from the origin.
    let near = |mut shape: ColoredMesh| {
        shape.mesh.positions.iter_mut().for_each(|x| *x -= DVec3::new(500_000.0, 0.0, 0.0));
        shape
    };
    let shape = near(shape());
    let text = written(&shape, "a.OBJ");
    let (models, _) = tobj::load_obj_buf(&mut &text[..], &tobj::LoadOptions::default(), |_| unreachable!()).unwrap();
    let mesh = &models[0].mesh;
    assert_eq!(models.len(), 1);
    assert_eq!(mesh.indices, shape.mesh.triangles.as_flattened());
    assert_eq!(mesh.normal_indices, mesh.indices);
    let close = |found: &[f32], expected: Vec<f64>, slack: f64| {
        let pairs = found.iter().zip(&expected);
        found.len() == expected.len() && pairs.clone().all(|(a, b)| (f64::from(*a) - b).abs() <= slack)
    };
    let flat = |rows: &[DVec3]| rows.iter().flat_map(|x| x.to_array()).collect::<Vec<_>>();
    assert!(close(&mesh.positions, flat(&shape.mesh.positions), 1e-5));
    assert!(close(&mesh.normals, flat(&shape.normals), 1e-5));
    let colors = shape.colors.as_flattened().iter().map(|&byte| f64::from(byte) / 255.0).collect();
    assert!(close(&mesh.vertex_color, colors, 5.1e-5));
    // Points have no faces, and the reader returns no model without faces.
    let text = String::from_utf8(written(&points(), "a.obj")).unwrap();
    let places: Vec<Vec<f64>> = text
        .lines()
        .filter_map(|line| line.strip_prefix("v "))
        .map(|line| line.split(' ').map(|word| word.parse().unwrap()).collect())
        .collect();
    assert_eq!(places.len(), 4);
    for (found, place) in places.iter().zip(&points().mesh.positions) {
        assert!(DVec3::from_slice(found).abs_diff_eq(*place, 1e-6) && found.len() == 6, "{found:?}");
    }
    assert_eq!(text.lines().filter(|line| line.starts_with("vn ")).count(), 4);
    assert!(!text.contains("\nf "));
}

#[test]
fn glb_files_are_read_by_another_library() {
    for shape in [shape(), points()] {
        let bytes = written(&shape, "a.glb");
        // `from_slice` checks the document against the specification.
        let gltf::Gltf { document, blob } = gltf::Gltf::from_slice(&bytes).unwrap();
        let blob = blob.unwrap();
        let node = document.default_scene().unwrap().nodes().next().unwrap();
        let offset = DVec3::from(node.transform().decomposed().0.map(f64::from));
        let primitive = node.mesh().unwrap().primitives().next().unwrap();
        let reader = primitive.reader(|_| Some(&blob));
        let places: Vec<[f32; 3]> = reader.read_positions().unwrap().collect();
        assert_eq!(places.len(), 4);
        for (found, place) in places.iter().zip(&shape.mesh.positions) {
            // The reader returns the offset as a float; readers of doubles would keep its digits.
            assert!((offset + DVec3::from(found.map(f64::from))).abs_diff_eq(*place, 0.04), "{found:?} {place}");
        }
        // Relative positions are precise.
        let difference =
            |a: usize, b: usize| DVec3::from(places[a].map(f64::from)) - DVec3::from(places[b].map(f64::from));
        assert!(difference(3, 0).abs_diff_eq(shape.mesh.positions[3] - shape.mesh.positions[0], 1e-6));
        let json: serde_json::Value =
            serde_json::from_slice(&bytes[20..][..bytes[12] as usize + 256 * bytes[13] as usize]).unwrap();
        let middle: [f64; 3] = serde_json::from_value(json["nodes"][0]["translation"].clone()).unwrap();
        let [low, high] = shape.mesh.bounds().unwrap();
        assert_eq!(DVec3::from(middle), 0.5 * (low + high));
        let bounds = primitive.bounding_box();
        let extremes =
            |pick: fn(f32, f32) -> f32| places.iter().copied().reduce(|a, b| [0, 1, 2].map(|k| pick(a[k], b[k])));
        assert_eq!((Some(bounds.min), Some(bounds.max)), (extremes(f32::min), extremes(f32::max)));
        let normals: Vec<[f32; 3]> = reader.read_normals().unwrap().collect();
        assert_eq!(normals, shape.normals.iter().map(|normal| normal.as_vec3().to_array()).collect::<Vec<_>>());
        // Colours are linear light.
        let colors: Vec<[f32; 4]> = reader.read_colors(0).unwrap().into_rgba_f32().collect();
        for (found, bytes) in colors.iter().zip(&shape.colors) {
            let light = bytes.map(|byte| SrgbDecode.f([f64::from(byte) / 255.0]));
            assert!((0..3).all(|k| (f64::from(found[k]) - light[k]).abs() < 1e-5) && found[3] == 1.0, "{found:?}");
        }
        assert!((colors[0][1] - 0.2159).abs() < 1e-4, "128 of 255 is a fifth of the light");
        let material = primitive.material();
        assert!(material.unlit() && !material.double_sided());
        let indices: Option<Vec<u32>> = reader.read_indices().map(|indices| indices.into_u32().collect());
        if shape.mesh.triangles.is_empty() {
            assert_eq!((primitive.mode(), indices), (gltf::mesh::Mode::Points, None));
        } else {
            assert_eq!(primitive.mode(), gltf::mesh::Mode::Triangles);
            assert_eq!(indices.unwrap(), shape.mesh.triangles.as_flattened());
        }
        assert_eq!(bytes.len() % 4, 0);
    }
    let nothing = write(&ColoredMesh::default(), std::env::temp_dir().join("nothing.glb")).unwrap_err().to_string();
    assert!(nothing.contains("nothing.glb: needs at least one vertex in glTF"), "{nothing}");
}

#[test]
fn shapes_are_written_in_capture_coordinates() {
    // A quarter turn about z maps x of the capture to y of the scene. Half a scene unit is a unit of the capture.
    let transform = SceneTransform {
        rotation: DMat3::from_quat(DQuat::from_rotation_z(FRAC_PI_2)),
        scale: 0.5,
        origin: DVec3::new(10.0, 20.0, 30.0),
    };
    let mut shape = points();
    shape.mesh.positions[0] = DVec3::new(1.0, 2.0, 3.0);
    shape.normals[0] = DVec3::Y;
    let (place, back) = (shape.mesh.positions[1], shape.into_capture(&transform));
    assert!(back.mesh.positions[0].abs_diff_eq(DVec3::new(10.0 + 4.0, 20.0 - 2.0, 30.0 + 6.0), 1e-12));
    assert!(back.normals[0].abs_diff_eq(DVec3::X, 1e-12), "a direction has no length to scale: {}", back.normals[0]);
    assert!(transform.point(back.mesh.positions[1]).abs_diff_eq(place, 1e-9));
}

#[test]
fn comments_stay_on_one_line() {
    let folder = tempfile::tempdir().unwrap();
    // Line ends and terminators of the formats, which could add to the header or the shape.
    let comment = "by me\nend_header\rv 1 2 3\r\n\0\u{85}\"}\\";
    for name in ["a.ply", "a.obj", "a.glb"] {
        let [plain, path] = ["plain-", ""].map(|before| folder.path().join(format!("{before}{name}")));
        let count = write_with_comment(&shape(), &path, comment).unwrap();
        let bytes = std::fs::read(&path).unwrap();
        assert_eq!(count, bytes.len() as u64);
        let text = String::from_utf8_lossy(&bytes);
        assert!(text.contains("by me end_header v 1 2 3"), "{name}");
        write_with_comment(&shape(), &plain, "by me").unwrap();
        let plain = std::fs::read(&plain).unwrap();
        let lines = |bytes: &[u8]| bytes.iter().filter(|byte| [b'\n', b'\r', 0].contains(byte)).count();
        // The binary format pads its chunks.
        if name != "a.glb" {
            assert_eq!(lines(&bytes), lines(&plain), "{name}");
        }
    }
    let bytes = std::fs::read(folder.path().join("a.ply")).unwrap();
    assert_eq!(Parser::<DefaultElement>::new().read_ply(&mut &bytes[..]).unwrap().payload["vertex"].len(), 4);
    let bytes = std::fs::read(folder.path().join("a.glb")).unwrap();
    assert!(gltf::Gltf::from_slice(&bytes).is_ok());
}

#[test]
fn unknown_extension_is_an_error() {
    for name in ["a.stl", "ply", "a", "a.glb.txt"] {
        let message = write(&shape(), name).unwrap_err().to_string();
        assert!(message.contains("has an unknown extension; use .ply, .obj or .glb"), "{message}");
        assert_eq!(Format::of(Path::new(name)), None);
    }
    assert_eq!(Format::of(Path::new("x/y.GlB")), Some(Format::Glb));
}

#[test]
fn bare_mesh_is_written_white_half_mesh_refused() {
    let bare = ColoredMesh::from(shape().mesh);
    assert!(bare.normals == bare.mesh.normals() && bare.colors == [[255; 3]; 4]);
    assert!(written(&bare, "a.ply").len() > 4 * 39);
    for half in [ColoredMesh { normals: vec![], ..shape() }, ColoredMesh { colors: vec![[0; 3]; 3], ..shape() }] {
        let error = write(&half, "never.ply").unwrap_err().to_string();
        assert!(error.starts_with("never.ply: has ") && error.ends_with("for 4 vertices; give one each"), "{error}");
    }
}
