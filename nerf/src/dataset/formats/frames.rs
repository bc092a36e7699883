//! The frames of a JSON file as views.

use super::intrinsics::check_known;
use super::json::Object;
use super::layers::Layers;
use super::{matrix, paths};
use crate::dataset::capture::View;
use crate::dataset::photo::Photo;
use crate::error::{Error, Result};
use std::path::{Path, PathBuf};

/// The unit of integer depth images in nerfstudio: a millimetre in scenes in metres.
const DEPTH_UNIT: f64 = 1e-3;

/// The programs that a file is for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Dialect {
    /// instant-ngp and nerfstudio. Images may differ in size unless the file gives one.
    Transforms,
    /// Blender. All images have one size, and `camera_angle_y` is not that of the images.
    Blender,
}

/// All frames, in the order of the file. No image is decoded; headers are read if the file gives no size.
pub(super) fn views(top: &Object<'_>, folder: &Path, dialect: Dialect) -> Result<Vec<View>> {
    check_known(top)?;
    let frames = top.frames()?;
    let mut places = Vec::with_capacity(frames.len());
    for frame in &frames {
        let name = paths::normal(frame, "file_path", frame.required("file_path")?)?;
        let image = paths::find(folder, &name);
        places.push((name, image));
    }
    let first = frames.iter().zip(&places).find_map(|(frame, (_, image))| Some((frame, image.as_deref()?)));
    let mut common = None;
    let mut views = Vec::with_capacity(frames.len());
    for (frame, (name, image)) in frames.iter().zip(&places) {
        check_known(frame)?;
        let pose = matrix::pose(frame, "transform_matrix")?;
        let header = || {
            // An absent image is assumed to be as large as the first.
            let own = image.as_deref().filter(|_| dialect == Dialect::Transforms).map(|image| (frame, image));
            match (own, first) {
                (Some(own), _) => size(own),
                (None, Some(first)) => common.map_or_else(|| size(first), Ok).inspect(|size| common = Some(*size)),
                (None, None) => Ok([0, 0]),
            }
        };
        let camera = Layers { top, frame }.camera(pose, header, dialect == Dialect::Transforms)?;
        views.push(View {
            image: image.clone(),
            mask: beside(frame, folder, "mask_path", image.is_some())?,
            depth: depth(top, frame, folder, image.is_some())?,
            sharpness: frame.number("sharpness")?,
            ..View::new(name, &frame.path, camera)
        });
    }
    Ok(views)
}

/// The size of a frame's image, from its header.
fn size((frame, image): (&Object<'_>, &Path)) -> Result<[usize; 2]> {
    Photo::size_of_file(image).map(|[_, shown]| shown).map_err(|e| match e {
        Error::File { path, what } => frame.error("file_path", format!("{}: {what}", path.display())),
        other => other,
    })
}

/// A file that accompanies an image. It must exist if the image does.
fn beside(frame: &Object<'_>, folder: &Path, name: &str, needed: bool) -> Result<Option<PathBuf>> {
    let Some(value) = frame.get(name) else { return Ok(None) };
    let path = paths::normal(frame, name, value)?;
    match paths::find(folder, &path) {
        None if needed => {
            let what =
                format!("there is no file {path}: copy it there, or remove the field to use the image without it");
            Err(frame.error(name, what))
        }
        found => Ok(found),
    }
}

/// The depth file and its unit: nerfstudio's `depth_file_path`, or instant-ngp's `depth_path`, which needs an
/// `integer_depth_scale`.
fn depth(top: &Object<'_>, frame: &Object<'_>, folder: &Path, needed: bool) -> Result<Option<(PathBuf, f64)>> {
    let layers = Layers { top, frame };
    let unit = layers.find("depth_unit_scale_factor", |object, name| object.positive(name))?;
    if let Some(path) = beside(frame, folder, "depth_file_path", needed)? {
        // Float arrays are in scene units.
        let floats = path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("npy"));
        let default = if floats { 1.0 } else { DEPTH_UNIT };
        return Ok(Some((path, unit.unwrap_or(default))));
    }
    let Some(scale) = top.number("integer_depth_scale")?.filter(|scale| *scale > 0.0) else { return Ok(None) };
    if top.flag("enable_depth_loading")? == Some(false) {
        return Ok(None);
    }
    Ok(beside(frame, folder, "depth_path", needed)?.map(|path| (path, scale)))
}
