//! The NeRF-synthetic format (Mildenhall et al. 2020): `transforms_<split>.json`, written by Blender.

mod intrinsics;

use std::f64::consts::PI;
use std::path::{Path, PathBuf};

use glam::{DAffine3, DMat3, DVec3};
use rayon::prelude::*;
use serde::Deserialize;
use serde_json::Value;

use super::{Dataset, Frame, Split, evenly_spaced};
use crate::camera::pinhole::Camera;
use crate::dataset::image::Image;
use crate::error::{Error, Result};
use intrinsics::{Intrinsics, field};

/// The format does not say where the scene lies: these are the values that all work on it uses.
const HALF_BOX: f64 = 1.5;
const NEAR: f64 = 2.0;
const FAR: f64 = 6.0;

/// How far an entry of a pose may be from that of a rigid motion. Files carry rounding of about 1e-6.
const RIGID_TOLERANCE: f64 = 1e-3;

/// Endings of image files: tried in this order where a name has none.
const EXTENSIONS: [&str; 3] = ["png", "jpg", "jpeg"];

/// The file that describes a split.
pub(super) fn transforms_file(folder: &Path, split: Split) -> PathBuf {
    folder.join(format!("transforms_{split}.json"))
}

/// As [`super::load_views`], for a folder in this format.
pub(super) fn load(folder: &Path, split: Split, downscale: usize, views: usize) -> Result<Dataset> {
    let file = transforms_file(folder, split);
    let transforms = Transforms::read(&file)?;
    let (mut present, mut skipped) = (Vec::new(), Vec::new());
    for entry in transforms.entries {
        match image_file(folder, &entry.file_path) {
            Some(path) => present.push((entry, path)),
            None => skipped.push(entry.name().to_owned()),
        }
    }
    if present.is_empty() {
        let what = format!("none of the images exists, not even that of the first, `{}`", skipped[0]);
        return Err(Error::field(&file, "frames", what));
    }
    let present = evenly_spaced(present, views);
    let [width, height] = common_size(&file, &present)?;
    transforms.intrinsics.check(&file, None, transforms.camera_angle_x, [width, height])?;
    for (entry, _) in &present {
        entry.intrinsics.check(&file, entry.index, transforms.camera_angle_x, [width, height])?;
    }
    if !width.is_multiple_of(downscale) || !height.is_multiple_of(downscale) {
        let what = format!("{downscale} does not divide the image size {width}x{height}");
        return Err(Error::setting("downscale", what));
    }
    let decode = |(entry, path): &(Entry, PathBuf)| {
        let image = Image::open(path).map_err(|e| Error::field(&file, entry.field("file_path"), e))?;
        let image = if downscale == 1 { image } else { image.downscaled(downscale) };
        let camera = Camera::from_angle(image.width, image.height, transforms.camera_angle_x, entry.pose);
        Ok(Frame { name: entry.name().to_owned(), camera, image, distances: None })
    };
    // All results first: which of several errors is reported must not depend on timing.
    let frames: Vec<Result<Frame>> = present.par_iter().map(decode).collect();
    let frames = frames.into_iter().collect::<Result<_>>()?;
    Ok(Dataset { frames, bounds: [DVec3::splat(-HALF_BOX), DVec3::splat(HALF_BOX)], near: NEAR, far: FAR, skipped })
}

/// Where the image of a frame is, if anywhere. The format leaves the extension out; many files do not.
fn image_file(folder: &Path, file_path: &str) -> Option<PathBuf> {
    let given = Path::new(file_path).extension().and_then(|e| e.to_str()).unwrap_or("");
    let complete = EXTENSIONS.iter().any(|e| e.eq_ignore_ascii_case(given));
    let names =
        if complete { vec![file_path.to_owned()] } else { EXTENSIONS.map(|e| format!("{file_path}.{e}")).into() };
    names.into_iter().map(|name| folder.join(name)).find(|path| path.is_file())
}

/// The one width and height of all images, of which there is at least one: from their headers, before any is decoded.
fn common_size(file: &Path, frames: &[(Entry, PathBuf)]) -> Result<[usize; 2]> {
    let bad = |entry: &Entry, what: String| Error::field(file, entry.field("file_path"), what);
    let size = |(entry, path): &(Entry, PathBuf)| Image::size_of_file(path).map_err(|e| bad(entry, e.to_string()));
    let [width, height] = size(&frames[0])?;
    for frame in &frames[1..] {
        let [w, h] = size(frame)?;
        if [w, h] != [width, height] {
            let (entry, path) = (&frame.0, frame.1.display());
            return Err(bad(
                entry,
                format!("{path} has {w}x{h} pixels, those before it {width}x{height}: they must agree"),
            ));
        }
    }
    Ok([width, height])
}

/// The contents of a transforms file, checked.
struct Transforms {
    camera_angle_x: f64,
    intrinsics: Intrinsics,
    entries: Vec<Entry>,
}

/// One element of `frames`.
struct Entry {
    index: usize,
    file_path: String,
    pose: DAffine3,
    intrinsics: Intrinsics,
}

impl Transforms {
    fn read(file: &Path) -> Result<Self> {
        let text = std::fs::read_to_string(file).map_err(|e| Error::file(file, format!("cannot be read: {e}")))?;
        let root = parse(&text).map_err(|e| Error::file(file, format!("is not valid JSON: {e}")))?;
        let camera_angle_x = match member(file, &root, "camera_angle_x", "camera_angle_x")?.as_f64() {
            Some(angle) if angle > 0.0 && angle < PI => angle,
            other => {
                let got = other.map_or("not a finite number".to_owned(), |angle| angle.to_string());
                let what = format!("must be an angle in radians between 0 and pi, is {got}");
                return Err(Error::field(file, "camera_angle_x", what));
            }
        };
        let frames = member(file, &root, "frames", "frames")?;
        let frames = frames.as_array().ok_or_else(|| Error::field(file, "frames", "must be a list"))?;
        if frames.is_empty() {
            return Err(Error::field(file, "frames", "is empty: there is nothing to load"));
        }
        let entries = frames.iter().enumerate().map(|(index, frame)| Entry::read(file, index, frame));
        Ok(Transforms { camera_angle_x, intrinsics: Intrinsics::read(&root), entries: entries.collect::<Result<_>>()? })
    }
}

impl Entry {
    fn read(file: &Path, index: usize, frame: &Value) -> Result<Self> {
        let field = field(index, "file_path");
        let file_path = member(file, frame, "file_path", &field)?;
        let file_path = file_path.as_str().ok_or_else(|| Error::field(file, field, "must be a string"))?.to_owned();
        let field = self::field(index, "transform_matrix");
        let matrix = member(file, frame, "transform_matrix", &field)?;
        let pose = rigid_pose(matrix).map_err(|what| Error::field(file, field, what))?;
        Ok(Entry { index, file_path, pose, intrinsics: Intrinsics::read(frame) })
    }

    fn field(&self, name: &str) -> String {
        field(self.index, name)
    }

    fn name(&self) -> &str {
        self.file_path.strip_prefix("./").unwrap_or(&self.file_path)
    }
}

/// The member `name` of a JSON object; `field` is its path in the document.
fn member<'a>(file: &Path, object: &'a Value, name: &str, field: &str) -> Result<&'a Value> {
    object.get(name).ok_or_else(|| Error::field(file, field, "is missing"))
}

/// Parses JSON. Python also writes NaN and Infinity, which JSON does not have: they are read as null, so that the
/// error can name the field instead of a line.
fn parse(text: &str) -> serde_json::Result<Value> {
    serde_json::from_str(text).or_else(|error| {
        let finite = text.replace("-Infinity", "null").replace("Infinity", "null").replace("NaN", "null");
        serde_json::from_str(&finite).map_err(|_| error)
    })
}

/// A 4x4 camera-to-world matrix in rows, which must be a rotation and a translation; or what is wrong with it.
fn rigid_pose(matrix: &Value) -> std::result::Result<DAffine3, String> {
    let rows = <[[Option<f64>; 4]; 4]>::deserialize(matrix).map_err(|e| format!("must be 4 rows of 4 numbers: {e}"))?;
    let mut m = [[0.0; 4]; 4];
    for (row, values) in rows.into_iter().enumerate() {
        for (column, value) in values.into_iter().enumerate() {
            m[row][column] = value.ok_or_else(|| format!("row {row}, column {column} is not a finite number"))?;
        }
    }
    if m[3].iter().zip([0.0, 0.0, 0.0, 1.0]).any(|(value, expected)| (value - expected).abs() > RIGID_TOLERANCE) {
        return Err(format!("the last row must be 0 0 0 1, is {} {} {} {}", m[3][0], m[3][1], m[3][2], m[3][3]));
    }
    let column = |c: usize| DVec3::new(m[0][c], m[1][c], m[2][c]);
    let rotation = DMat3::from_cols(column(0), column(1), column(2));
    let excess = rotation.transpose() * rotation - DMat3::IDENTITY;
    if excess.to_cols_array().iter().any(|value| value.abs() > RIGID_TOLERANCE) {
        return Err("the upper left 3x3 must be a rotation, but its columns are not orthonormal to 1e-3".to_owned());
    }
    if rotation.determinant() < 0.0 {
        return Err("the upper left 3x3 must be a rotation, but it mirrors: its determinant is -1".to_owned());
    }
    Ok(DAffine3 { matrix3: rotation, translation: column(3) })
}

#[cfg(test)]
mod tests;
