//! The NeRF-synthetic format (Mildenhall et al. 2020): `transforms_train.json`, `transforms_val.json` and
//! `transforms_test.json`, written by Blender.
//!
//! Camera fields of [`transforms`](super::transforms) count here too, except `camera_angle_y`, which is that of
//! Blender's sensor.

use super::frames::{Dialect, Frames};
use super::json::{self, Object, unused};
use super::{masks, matrix, paths};
use crate::camera::lens::Lens;
use crate::camera::pinhole::Camera;
use crate::dataset::capture::{Capture, Format, View};
use crate::dataset::frames::Split;
use crate::error::{Error, Result};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

/// Relative tolerance for equal numbers of cameras.
const SAME: f64 = 1e-9;

/// The file that describes a split.
fn file_of(folder: &Path, split: Split) -> PathBuf {
    folder.join(name_of(split))
}

/// The name of that file.
pub(super) fn name_of(split: Split) -> String {
    format!("transforms_{split}.json")
}

/// The first existing file of a capture's folder.
pub(super) fn file(folder: &Path) -> Option<PathBuf> {
    Split::ALL.into_iter().map(|split| file_of(folder, split)).find(|file| file.is_file())
}

/// Reads the files of all splits, in the order train, val, test.
///
/// [`Capture::file`] is the first of them; views of the others name theirs in [`field`](View::field). Without a size in
/// the file, all images have that of the first existing one.
///
/// # Errors
/// If there is no file, or one cannot be read, lacks a field, or has a field that is wrong or unsupported.
pub fn read(folder: &Path) -> Result<Capture> {
    read_files(folder, folder, true)
}

/// [`read`] for files in the folder `place`, without those of held-out images that are no JSON, unless they are `needed`.
pub(super) fn read_files(place: &Path, folder: &Path, needed: bool) -> Result<Capture> {
    let (mut documents, mut notes) = (vec![], vec![]);
    for split in Split::ALL {
        let file = file_of(place, split);
        if !file.is_file() {
            continue;
        }
        match json::read(&file) {
            // Some programs write all three files.
            Ok(document) if !documents.is_empty() && document["frames"].as_array().is_some_and(Vec::is_empty) => {
                notes.push(format!("`{}` has no frames", name_of(split)));
            }
            Ok(document) => documents.push((split, document, file)),
            Err(error) if needed || documents.is_empty() => return Err(error),
            Err(error) => notes.push(format!("left out the frames of {error}")),
        }
    }
    let Some((_, _, first)) = documents.first() else {
        let what = "is not a Blender dataset: expected transforms_train.json, transforms_val.json or \
                    transforms_test.json";
        return Err(Error::file(place, what));
    };
    let tops = documents.iter().map(|(_, document, file)| Object::top(file, document)).collect::<Result<Vec<_>>>()?;
    let Frames { mut views, mut assumptions, .. } = Frames::read(&tops, folder, Dialect::Blender)?;
    assumptions.extend(notes);
    let mut aabb_scale = None;
    for (i, ((split, ..), views)) in documents.iter().zip(&mut views).enumerate() {
        views.iter_mut().for_each(|view| view.split = Some(*split));
        if i > 0 {
            views.iter_mut().for_each(|view| view.field = format!("{} {}", name_of(*split), view.field));
        }
        aabb_scale = aabb_scale.or(unused(tops[i].positive("aabb_scale"), &mut assumptions));
    }
    let views = views.into_iter().flatten().collect();
    let capture = Capture::new(folder, first.clone(), Format::Blender, views);
    let mut capture = Capture { aabb_scale, assumptions, ..capture };
    masks::attach_unlisted(&mut capture)?;
    Ok(capture)
}

/// Writes a file for each split that has views, or `transforms_train.json` if no view has a split.
///
/// The format has one size and one field of view for all images, and no points, depths or sharpness.
///
/// # Errors
/// If there are no views, some have masks, only some have splits, cameras differ, or cameras are not centred pinholes
/// with square pixels; or if a file cannot be written.
pub fn write(capture: &Capture, folder: &Path) -> Result<()> {
    let bad = |what: String| Err(Error::file(folder, format!("cannot be written in Blender's format: {what}")));
    let Some(first) = capture.views.first() else { return bad("there are no images".to_owned()) };
    for view in &capture.views {
        if let Some(what) = unfit(view, first) {
            return bad(format!("{} {what}", view.name));
        }
    }
    let angle = 2.0 * (0.5 * first.camera.width as f64 / first.camera.focal[0]).atan();
    for split in Split::ALL {
        let all = first.split.is_none() && split == Split::Train;
        let views = capture.views.iter().filter(|view| all || view.split == Some(split));
        let frames: Vec<Value> = views.map(frame).collect();
        if frames.is_empty() {
            continue;
        }
        let Camera { width, height, .. } = first.camera;
        let mut top = json!({ "camera_angle_x": angle, "w": width, "h": height, "frames": frames });
        if let Some(scale) = capture.aabb_scale {
            top["aabb_scale"] = scale.into();
        }
        json::write(&file_of(folder, split), &top)?;
    }
    Ok(())
}

/// The reason that the format cannot hold a view, or cannot hold it together with the first; `None` if it can.
fn unfit(view: &View, first: &View) -> Option<String> {
    let near = |a: f64, b: f64| (a - b).abs() <= SAME * b.abs();
    let camera = &view.camera;
    let ([fx, fy], [cx, cy], [w, h]) = (camera.focal, camera.centre, [camera.width as f64, camera.height as f64]);
    let undistort = "convert the original with `raygrad prepare --undistort --to blender`";
    if camera.lens != Lens::Pinhole {
        return Some(format!("has lens distortion: {undistort}"));
    }
    if !near(fx, fy) {
        return Some(format!("has the focal lengths {fx} and {fy}, so no square pixels: {undistort}"));
    }
    if !(near(2.0 * cx, w) && near(2.0 * cy, h)) {
        return Some(format!("has its principal point at {cx}, {cy}, not at the centre: {undistort}"));
    }
    let other = &first.camera;
    if (camera.width, camera.height) != (other.width, other.height) || !near(fx, other.focal[0]) {
        return Some(format!("differs in size or focal length from {}: {undistort}", first.name));
    }
    if !(w > 0.0 && h > 0.0 && fx > 0.0 && camera.pose.is_finite()) {
        return Some("has a camera without a size or with a non-finite number: correct it".to_owned());
    }
    if view.mask.is_some() {
        return Some("has a mask, which the format does not support: make its pixels transparent".to_owned());
    }
    (view.split.is_some() != first.split.is_some())
        .then(|| "has no split while others do, or the reverse: give all images a split or none".to_owned())
}

fn frame(view: &View) -> Value {
    let path = paths::written(&view.name, view.image.as_deref());
    // Programs for this format append the extension to the path.
    let path = path.strip_suffix(".png").unwrap_or(&path);
    let prefix = if Path::new(path).is_absolute() { "" } else { "./" };
    json!({ "file_path": format!("{prefix}{path}"), "transform_matrix": matrix::to_json(view.camera.pose, 4) })
}

#[cfg(test)]
mod tests;
