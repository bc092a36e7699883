//! `transforms.json` of instant-ngp (Mueller et al. 2022) and nerfstudio (Tancik et al. 2023).
//!
//! Camera parameters stand at the top of the file or in its frames; those of a frame take precedence. Poses are read
//! unchanged: instant-ngp's `scale` and `offset`, and other fields that do not affect cameras, are ignored.

use super::frames::{Dialect, Frames};
use super::json::{self, Object, first_of, shown, unused};
use super::locate::{fitting, stem};
use super::{intrinsics, lens, masks, matrix, paths, ply};
use crate::camera::lens::Lens;
use crate::camera::pinhole::Camera;
use crate::dataset::capture::{Capture, Format, View};
use crate::dataset::frames::{CHOOSE, Split};
use crate::error::{Error, Result};
use crate::files::write_atomic;
use glam::DAffine3;
use serde_json::{Map, Value};
use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};
use std::path::{Path, PathBuf};

const FILE: &str = "transforms.json";

/// The points file, with nerfstudio's name.
const POINTS: &str = "sparse_pc.ply";

/// The file of a capture's folder.
pub(super) fn file(folder: &Path) -> PathBuf {
    folder.join(FILE)
}

/// Reads `transforms.json`, without decoding images.
///
/// Splits come from `train_filenames`, `val_filenames` and `test_filenames`; an image in both of the latter, as
/// nerfstudio writes for a single held-out set, is a test image. Absent and damaged points are left out, which
/// [`Capture::assumptions`] says. So are absent depth files. If no frame lists a mask, those of a folder `masks` are used.
///
/// # Errors
/// If the file cannot be read, lacks a field, or has a field that is wrong or unsupported. If a listed mask is absent.
pub fn read(folder: &Path) -> Result<Capture> {
    read_file(folder, &file(folder), true)
}

/// [`read`] for a file of any name; its paths are relative to `folder`. Splits are read only if they are `needed`.
pub(super) fn read_file(folder: &Path, file: &Path, needed: bool) -> Result<Capture> {
    let document = json::read(file)?;
    let top = Object::top(file, &document)?;
    let Frames { views, left_out, mut assumptions, .. } =
        Frames::read(std::slice::from_ref(&top), folder, Dialect::Transforms)?;
    let mut views: Vec<View> = views.into_iter().flatten().collect();
    if needed {
        assumptions.extend(read_splits(&top, &mut views, &left_out)?);
    }
    if let Some(frames) = top.get("test_frames").and_then(Value::as_array).filter(|frames| !frames.is_empty()) {
        assumptions.push(format!("the {} frames of `test_frames` are not read, only those of `frames`", frames.len()));
    }
    let notes = &mut assumptions;
    let scale = unused(top.positive("applied_scale"), notes).unwrap_or(1.0);
    let transform = unused(matrix::affine(&top, "applied_transform"), notes).unwrap_or(DAffine3::IDENTITY);
    // nerfstudio scales after the transform.
    let applied = DAffine3 { matrix3: scale * transform.matrix3, translation: scale * transform.translation };
    let aabb_scale = unused(top.positive("aabb_scale"), notes);
    let points = top.get("ply_file_path").map(|path| paths::normal(&top, "ply_file_path", path)).transpose();
    let points = unused(points, notes);
    let capture = Capture::new(folder, file.to_owned(), Format::Transforms, views);
    let mut capture = Capture { aabb_scale, applied, assumptions, ..capture };
    if let Some(path) = points {
        // The points are in the coordinates of the file: nerfstudio transforms them together with the cameras.
        let beside = file.with_file_name(&path);
        let file = if beside.exists() { beside } else { folder.join(path) };
        ply::read(&file).attach(&mut capture, &file);
    }
    masks::attach_unlisted(&mut capture)?;
    Ok(capture)
}

/// The field with the images of a split.
fn list(split: Split) -> String {
    format!("{split}_filenames")
}

/// Sets the splits of the views; lists may also name frames that were `left_out`. Returns a note on a name that is not
/// exactly that of a frame.
fn read_splits(top: &Object<'_>, views: &mut [View], left_out: &HashSet<String>) -> Result<Option<String>> {
    let mut named: BTreeMap<&str, Vec<usize>> = BTreeMap::new();
    views.iter().enumerate().for_each(|(i, view)| named.entry(&view.name).or_default().push(i));
    // All names by the stem of their last part, which those that fit a listed name share.
    let last = |name: &str| stem(name.rsplit('/').next().unwrap_or_default());
    let mut stems: HashMap<String, BTreeSet<&str>> = HashMap::new();
    for name in named.keys().copied().chain(left_out.iter().map(String::as_str)) {
        stems.entry(last(name)).or_default().insert(name);
    }
    let mut splits: Vec<Option<Split>> = vec![None; views.len()];
    let mut notes = vec![];
    for split in Split::ALL {
        let field = list(split);
        let Some(value) = top.get(&field) else { continue };
        let what = || top.error(&field, format!("must be a list of file paths, is {}", shown(value)));
        for (i, name) in value.as_array().ok_or_else(what)?.iter().enumerate() {
            let field = format!("{field}[{i}]");
            let name = paths::normal(top, &field, name)?;
            let names = stems.get(&last(&name)).map_or(vec![], |names| fitting(names.iter().copied(), &name));
            let [one] = names[..] else {
                let what = match names[..] {
                    [one, two, ..] => {
                        format!("lists {name}, which fits `{one}` and `{two}`: write more of the path; {CHOOSE}")
                    }
                    _ => format!("lists {name}, but no frame has this file_path: remove it; {CHOOSE}"),
                };
                return Err(top.error(&field, what));
            };
            // Other names are those of frames that were left out.
            let Some(places) = named.get(one) else { continue };
            if one != name {
                notes.push(format!("`{field}` lists {name}, which no frame has: used `{one}`"));
            }
            for &place in places {
                if split != Split::Train && splits[place] == Some(Split::Train) {
                    let what =
                        format!("lists {name}, which train_filenames has too: remove it from one of them; {CHOOSE}");
                    return Err(top.error(&field, what));
                }
                splits[place] = Some(split);
            }
        }
    }
    views.iter_mut().zip(splits).for_each(|(view, split)| view.split = split);
    Ok(first_of(&notes))
}

/// Writes `transforms.json` into `folder`, as nerfstudio reads it, and `sparse_pc.ply` if there are points.
///
/// The caller copies images, masks and depths to the same relative paths. The format has no [bounds](View::bounds) of
/// views.
///
/// # Errors
/// If there are no views, a camera has no size or a non-finite number, or a file cannot be written.
pub fn write(capture: &Capture, folder: &Path) -> Result<()> {
    let file = file(folder);
    if capture.views.is_empty() {
        return Err(Error::file(&file, "cannot be written: there are no images"));
    }
    for view in &capture.views {
        check(view, &file)?;
    }
    let whole = capture.applied.is_finite() && capture.aabb_scale.is_none_or(f64::is_finite);
    if !whole || capture.points.iter().any(|point| !point.position.is_finite()) {
        let what = "cannot be written: `applied`, `aabb_scale` or a point has a non-finite number";
        return Err(Error::file(&file, what));
    }
    let models = models(&capture.views);
    let intrinsics = capture.views.iter().zip(&models).map(|(view, model)| {
        let mut out = Map::new();
        intrinsics::write(&view.camera, model, &mut out);
        out
    });
    let intrinsics: Vec<_> = intrinsics.collect();
    let shared = intrinsics.iter().all(|other| *other == intrinsics[0]);
    let mut top = if shared { intrinsics[0].clone() } else { Map::new() };
    // nerfstudio reads the lens model at the top alone, and instant-ngp reads it beside the coefficients.
    for name in ["camera_model", "is_fisheye"] {
        let value = intrinsics[0].get(name).cloned();
        if let Some(value) = value.filter(|value| intrinsics.iter().all(|other| other.get(name) == Some(value))) {
            top.insert(name.to_owned(), value);
        }
    }
    let unit = shared_unit(&capture.views);
    if let Some(unit) = unit {
        top.insert("depth_unit_scale_factor".into(), unit.into());
    }
    let mut frames = vec![];
    for (view, own) in capture.views.iter().zip(intrinsics) {
        let mut frame = if shared { Map::new() } else { own };
        frame.insert("file_path".into(), file_path(view).into());
        frame.insert("transform_matrix".into(), matrix::to_json(view.camera.pose, 4));
        // Readers find dynamic masks beside the images.
        if let Some(mask) = view.mask.as_ref().filter(|_| !view.mask_is_dynamic) {
            frame.insert("mask_path".into(), relative(capture, folder, mask, &file)?.into());
        }
        if let Some((depth, own)) = &view.depth {
            frame.insert("depth_file_path".into(), relative(capture, folder, depth, &file)?.into());
            if unit.is_none() {
                frame.insert("depth_unit_scale_factor".into(), (*own).into());
            }
        }
        if let Some(sharpness) = view.sharpness.filter(|sharpness| sharpness.is_finite()) {
            frame.insert("sharpness".into(), sharpness.into());
        }
        frames.push(Value::Object(frame));
    }
    top.insert("frames".into(), frames.into());
    write_splits(&capture.views, &mut top);
    if capture.applied != DAffine3::IDENTITY {
        // The scale is part of the matrix, since it applies to poses and points alike. nerfstudio's `applied_scale`
        // does not say so.
        top.insert("applied_transform".into(), matrix::to_json(capture.applied, 3));
    }
    if let Some(scale) = capture.aabb_scale {
        top.insert("aabb_scale".into(), scale.into());
    }
    if !capture.points.is_empty() {
        write_atomic(folder.join(POINTS), &ply::to_bytes(&capture.points))?;
        top.insert("ply_file_path".into(), POINTS.into());
    }
    json::write(&file, &top.into())
}

/// Checks the numbers of a view's camera.
///
/// # Errors
/// If one is not finite, the camera has no size, or it is a partial panorama.
fn check(view: &View, file: &Path) -> Result<()> {
    let Camera { width, height, focal, centre, lens, pose } = &view.camera;
    let coefficients = lens.coefficients();
    let numbers = focal.iter().chain(centre).chain(&coefficients).all(|x| x.is_finite()) && pose.is_finite();
    let unit = view.depth.as_ref().is_none_or(|(_, unit)| unit.is_finite());
    // JSON has finite numbers only; others would become null.
    if !numbers || !unit || *width == 0 || *height == 0 {
        let what = format!("cannot be written: the camera of {} has no size or a non-finite number", view.name);
        return Err(Error::file(file, what));
    }
    let [w, h] = [*width as f64, *height as f64];
    let whole = [w / (2.0 * std::f64::consts::PI), h / std::f64::consts::PI];
    if *lens == Lens::Equirectangular && (*focal != whole || *centre != [0.5 * w, 0.5 * h]) {
        let what =
            format!("cannot be written: the equirectangular camera of {} does not cover all directions", view.name);
        return Err(Error::file(file, what));
    }
    Ok(())
}

/// The camera model of each view. nerfstudio reads one model for the whole file, so pinholes beside OPENCV become
/// OPENCV without distortion.
fn models(views: &[View]) -> Vec<&'static str> {
    let mut models: Vec<_> = views.iter().map(|view| lens::model(&view.camera.lens)).collect();
    if models.contains(&"OPENCV") {
        models.iter_mut().filter(|model| **model == "PINHOLE").for_each(|model| *model = "OPENCV");
    }
    models
}

/// The common unit of all depths; `None` if they differ or there are none.
fn shared_unit(views: &[View]) -> Option<f64> {
    let mut units = views.iter().filter_map(|view| Some(view.depth.as_ref()?.1));
    let first = units.next()?;
    units.all(|unit| unit == first).then_some(first)
}

fn file_path(view: &View) -> String {
    paths::written(&view.name, view.image.as_deref())
}

/// The written path of a file of the capture.
fn relative(capture: &Capture, folder: &Path, path: &Path, file: &Path) -> Result<String> {
    let inside = path.strip_prefix(&capture.folder).or_else(|_| path.strip_prefix(folder)).unwrap_or(path);
    let text = inside.to_str().ok_or_else(|| {
        Error::file(file, format!("cannot be written: the path {} is not Unicode; rename the file", path.display()))
    })?;
    Ok(if cfg!(windows) { text.replace('\\', "/") } else { text.to_owned() })
}

/// Writes the lists of the splits, if there are any. nerfstudio then requires all three: without validation images that
/// list equals the test list, as [`read`] knows.
fn write_splits(views: &[View], top: &mut Map<String, Value>) {
    if views.iter().all(|view| view.split.is_none()) {
        return;
    }
    let of = |split: Split| -> Vec<String> {
        views.iter().filter(|view| view.split == Some(split)).map(file_path).collect()
    };
    for split in Split::ALL {
        let mut names = of(split);
        if names.is_empty() && split == Split::Val {
            names = of(Split::Test);
        }
        top.insert(list(split), names.into());
    }
}

#[cfg(test)]
mod tests;
