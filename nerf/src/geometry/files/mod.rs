//! Files of meshes and point clouds.

mod glb;
mod obj;
mod ply;
#[cfg(test)]
mod tests;

use super::colored_mesh::ColoredMesh;
use crate::files::write_atomic;
use crate::{Error, Result};
use std::path::Path;

/// The forms that a shape can be written in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// Stanford's polygon format (Turk 1994), binary with the least byte first: places as doubles, normals as floats, colours as
    /// bytes.
    Ply,
    /// Wavefront's OBJ, text: colours stand behind places, as many programs read them.
    Obj,
    /// Binary glTF 2.0 (ISO/IEC 12113:2022). Colours are light there, which do not answer to any other light
    /// (KHR_materials_unlit). Places are floats around a middle that the node has, so that they keep their digits far from
    /// the origin. By glTF's convention y is up and a unit is a metre: this file has the shape's own axes and units, as the
    /// others do.
    Glb,
}

impl Format {
    /// By the ending of a file's name, large or small; `None` if it is that of no such file.
    pub fn of(path: &Path) -> Option<Self> {
        Some(match path.extension()?.to_str()?.to_ascii_lowercase().as_str() {
            "ply" => Format::Ply,
            "obj" => Format::Obj,
            "glb" => Format::Glb,
            _ => return None,
        })
    }
}

/// Writes a shape, in the form that the ending of the file's name says, and says how many bytes that takes. A bare mesh is written
/// by `write(&mesh.into(), path)`.
///
/// # Errors
/// If the ending is none of [`Format`]'s, there is not a normal and a colour for each vertex, the shape is too large or the file
/// cannot be written.
pub fn write(shape: &ColoredMesh, path: impl AsRef<Path>) -> Result<u64> {
    write_with_comment(shape, path, "raygrad")
}

/// As [`write()`], with a line of text about the file in its header: a comment in PLY and OBJ, the generator in glTF. Line breaks
/// in it become spaces.
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
            format!("would have {normals} normals and {colors} colours for {vertices} vertices"),
        ));
    }
    let bytes = match Format::of(path) {
        Some(Format::Ply) => ply::to_bytes(shape, comment),
        Some(Format::Obj) => obj::to_text(shape, comment).into_bytes(),
        Some(Format::Glb) => glb::to_bytes(shape, comment).map_err(|what| Error::file(path, what))?,
        None => return Err(Error::file(path, "has an ending that is none of .ply, .obj and .glb")),
    };
    write_atomic(path, &bytes)?;
    Ok(bytes.len() as u64)
}
