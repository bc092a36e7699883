//! Files of meshes and point clouds: PLY, OBJ and glTF. Start with [`write()`].

mod glb;
mod obj;
mod ply;
#[cfg(test)]
mod tests;

use super::colored_mesh::ColoredMesh;
use crate::files::write_atomic;
use crate::{Error, Result};
use std::path::Path;

/// A file format of meshes and point clouds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// PLY (Turk 1994), binary little-endian: positions as doubles, normals as floats, colours as bytes.
    Ply,
    /// Wavefront OBJ, text, with colours behind positions, a common extension.
    Obj,
    /// Binary glTF 2.0 (ISO/IEC 12113:2022), with unlit linear colours (KHR_materials_unlit). Positions are floats
    /// relative to the node's translation, which keeps precision far from the origin. Axes and units are the mesh's
    /// own, not glTF's convention (y up, metres).
    Glb,
}

impl Format {
    /// Returns the format of a file extension, in any case, or `None` if it is unknown.
    pub fn of(path: &Path) -> Option<Self> {
        Some(match path.extension()?.to_str()?.to_ascii_lowercase().as_str() {
            "ply" => Format::Ply,
            "obj" => Format::Obj,
            "glb" => Format::Glb,
            _ => return None,
        })
    }
}

/// Writes a mesh or point cloud in the format of the file extension, and returns the number of bytes.
///
/// `write(&mesh.into(), path)` writes a bare mesh.
///
/// # Errors
/// If the extension is not one of [`Format`]'s, there is not a normal and a colour per vertex, the file would be too
/// large, or it cannot be written.
pub fn write(shape: &ColoredMesh, path: impl AsRef<Path>) -> Result<u64> {
    write_with_comment(shape, path, "raygrad")
}

/// Writes as [`write()`], with a line of text in the header: a comment in PLY and OBJ, the generator in glTF. Line
/// breaks in it become spaces.
///
/// # Errors
/// As [`write()`].
pub fn write_with_comment(shape: &ColoredMesh, path: impl AsRef<Path>, comment: &str) -> Result<u64> {
    let comment = &comment.replace(char::is_control, " ");
    let path = path.as_ref();
    let [vertices, normals, colors] = [shape.mesh.positions.len(), shape.normals.len(), shape.colors.len()];
    if [normals, colors] != [vertices; 2] {
        return Err(Error::file(
            path,
            format!("has {normals} normals and {colors} colours for {vertices} vertices; give one each"),
        ));
    }
    let bytes = match Format::of(path) {
        Some(Format::Ply) => ply::to_bytes(shape, comment),
        Some(Format::Obj) => obj::to_text(shape, comment).into_bytes(),
        Some(Format::Glb) => glb::to_bytes(shape, comment).map_err(|what| Error::file(path, what))?,
        None => return Err(Error::file(path, "has an unknown extension; use .ply, .obj or .glb")),
    };
    write_atomic(path, &bytes)?;
    Ok(bytes.len() as u64)
}
