//! PLY files, as the points of datasets are written: places are doubles.

use super::super::colored_mesh::ColoredMesh;

pub(super) fn to_bytes(shape: &ColoredMesh, comment: &str) -> Vec<u8> {
    let ColoredMesh { mesh, normals, colors } = shape;
    let mut header = format!("ply\nformat binary_little_endian 1.0\ncomment {comment}\n");
    header += &format!("element vertex {}\n", mesh.positions.len());
    for property in ["double x", "double y", "double z", "float nx", "float ny", "float nz"] {
        header += &format!("property {property}\n");
    }
    for color in ["red", "green", "blue"] {
        header += &format!("property uchar {color}\n");
    }
    if !mesh.triangles.is_empty() {
        let count = mesh.triangles.len();
        header += &format!("element face {count}\nproperty list uchar int vertex_indices\n");
    }
    let mut out = (header + "end_header\n").into_bytes();
    for ((place, normal), color) in mesh.positions.iter().zip(normals).zip(colors) {
        place.to_array().into_iter().for_each(|x| out.extend(x.to_le_bytes()));
        normal.to_array().into_iter().for_each(|x| out.extend((x as f32).to_le_bytes()));
        out.extend(color);
    }
    for triangle in &mesh.triangles {
        out.push(3);
        triangle.iter().for_each(|vertex| out.extend(vertex.to_le_bytes()));
    }
    out
}
