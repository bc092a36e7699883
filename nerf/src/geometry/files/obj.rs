//! OBJ files: text, vertices from 1.

use super::super::colored_mesh::ColoredMesh;
use std::fmt::Write;

/// Significant digits of positions, relative to the largest.
const DIGITS: i32 = 8;

pub(super) fn to_text(shape: &ColoredMesh, comment: &str) -> String {
    let ColoredMesh { mesh, normals, colors } = shape;
    let largest = mesh.bounds().map_or(1.0, |[low, high]| (high - low).max_element());
    // A single point has no extent.
    let largest = if largest > 0.0 { largest } else { 1.0 };
    let decimals = (DIGITS - largest.log10().ceil() as i32).clamp(0, 17) as usize;
    let mut out = format!("# x y z red green blue, colours in sRGB\n# {comment}\n");
    // Writing to a string cannot fail.
    for (place, color) in mesh.positions.iter().zip(colors) {
        let [x, y, z] = place.to_array();
        let [r, g, b] = color.map(|byte| f64::from(byte) / 255.0);
        let _ = writeln!(out, "v {x:.decimals$} {y:.decimals$} {z:.decimals$} {r:.4} {g:.4} {b:.4}");
    }
    for normal in normals {
        let [x, y, z] = normal.to_array();
        let _ = writeln!(out, "vn {x:.5} {y:.5} {z:.5}");
    }
    for [a, b, c] in mesh.triangles.iter().map(|triangle| triangle.map(|vertex| u64::from(vertex) + 1)) {
        let _ = writeln!(out, "f {a}//{a} {b}//{b} {c}//{c}");
    }
    out
}
