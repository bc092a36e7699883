//! The NeRF-synthetic format (Mildenhall et al. 2020): `transforms_train.json`, `transforms_val.json` and
//! `transforms_test.json`, written by Blender.
//!
//! Programs that write it beside others give cameras in the fields of [`transforms`](super::transforms), which count here
//! too; but `camera_angle_y` is that of Blender's sensor and not of the image, and passes.

use super::frames::{Dialect, views};
use super::json::{self, Object};
use super::{matrix, paths};
use crate::camera::lens::Lens;
use crate::camera::pinhole::Camera;
use crate::dataset::capture::{Capture, Format, View};
use crate::dataset::frames::Split;
use crate::error::{Error, Result};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

/// How far numbers of cameras may be apart that are the same, as a share of them.
const SAME: f64 = 1e-9;

/// The file that describes a split.
fn file_of(folder: &Path, split: Split) -> PathBuf {
    folder.join(name_of(split))
}

fn name_of(split: Split) -> String {
    format!("transforms_{split}.json")
}

/// Whether the folder holds a file of this format.
pub(crate) fn detect(folder: &Path) -> bool {
    Split::ALL.into_iter().any(|split| file_of(folder, split).is_file())
}

/// Reads the files of all splits that there are, in the order train, val, test. The capture names the first of them;
/// views of the others have the name of theirs in [`field`](View::field). A file that gives no size has images of the size
/// of the first that exists.
///
/// # Errors
/// If there is no file, or one cannot be read, lacks a field or has one that is wrong or cannot be followed.
pub fn read(folder: &Path) -> Result<Capture> {
    let mut capture: Option<Capture> = None;
    for split in Split::ALL {
        let file = file_of(folder, split);
        if !file.is_file() {
            continue;
        }
        let document = json::read(&file)?;
        let top = Object::top(&file, &document)?;
        let mut views = views(&top, folder, Dialect::Blender)?;
        views.iter_mut().for_each(|view| view.split = Some(split));
        let aabb_scale = top.positive("aabb_scale")?;
        match &mut capture {
            Some(capture) => {
                views.iter_mut().for_each(|view| view.field = format!("{} {}", name_of(split), view.field));
                capture.views.append(&mut views);
                capture.aabb_scale = capture.aabb_scale.or(aabb_scale);
            }
            None => capture = Some(Capture { aabb_scale, ..Capture::new(folder, file, Format::Blender, views) }),
        }
    }
    let what = "is not a dataset in this format: expected a file transforms_train.json, transforms_val.json or \
                transforms_test.json";
    capture.ok_or_else(|| Error::file(folder, what))
}

/// Writes a file for each split that has views, or `transforms_train.json` if no view has a split. The format has a size and
/// a field of view for all images; points, depths and sharpness have no place in it.
///
/// # Errors
/// If there are no views; if they have masks, or splits only some; if cameras differ, or are not pinholes with square
/// pixels whose image is centred; or if a file cannot be written.
pub fn write(capture: &Capture, folder: &Path) -> Result<()> {
    let bad = |what: String| Err(Error::file(folder, format!("cannot be written in the format of Blender: {what}")));
    let Some(first) = capture.views.first() else { return bad("there are no photographs".to_owned()) };
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

/// Why a view has no place in the format beside the first, if it has none.
fn unfit(view: &View, first: &View) -> Option<String> {
    let near = |a: f64, b: f64| (a - b).abs() <= SAME * b.abs();
    let camera = &view.camera;
    let ([fx, fy], [cx, cy], [w, h]) = (camera.focal, camera.centre, [camera.width as f64, camera.height as f64]);
    let undistort = "undistort the images first (`raygrad prepare --undistort`)";
    if camera.lens != Lens::Pinhole {
        return Some(format!("has a lens that distorts: {undistort}"));
    }
    if !near(fx, fy) {
        return Some(format!("has pixels that are not square, with focal lengths of {fx} and {fy}: {undistort}"));
    }
    if !(near(2.0 * cx, w) && near(2.0 * cy, h)) {
        return Some(format!("has its principal point at {cx}, {cy} and not in the middle: {undistort}"));
    }
    let other = &first.camera;
    if (camera.width, camera.height) != (other.width, other.height) || !near(fx, other.focal[0]) {
        return Some(format!("has another size or focal length than {}: {undistort}", first.name));
    }
    if !(w > 0.0 && h > 0.0 && fx > 0.0 && camera.pose.is_finite()) {
        return Some("has a camera that is not whole: without a size, or with a number that is not finite".to_owned());
    }
    if view.mask.is_some() {
        return Some("has a mask, which the format has no place for: make what it hides transparent".to_owned());
    }
    (view.split.is_some() != first.split.is_some()).then(|| "is in no split, or alone is in one".to_owned())
}

fn frame(view: &View) -> Value {
    let path = paths::written(&view.name, view.image.as_deref());
    // Programs for this format put the ending behind the path.
    let path = path.strip_suffix(".png").unwrap_or(&path);
    let prefix = if Path::new(path).is_absolute() { "" } else { "./" };
    json!({ "file_path": format!("{prefix}{path}"), "transform_matrix": matrix::to_json(view.camera.pose, 4) })
}

#[cfg(test)]
mod tests;
