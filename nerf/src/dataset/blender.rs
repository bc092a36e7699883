//! The NeRF-synthetic format (Mildenhall et al. 2020): `transforms_<split>.json`, written by Blender.

use std::f64::consts::PI;
use std::path::{Path, PathBuf};

use glam::{DAffine3, DMat3, DVec3};
use rayon::prelude::*;
use serde::Deserialize;
use serde_json::Value;

use super::{Dataset, Frame, Split, evenly_spaced};
use crate::camera::Camera;
use crate::error::{Error, Result};
use crate::image::Image;

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
    transforms.lens.check(&file, None, transforms.camera_angle_x, [width, height])?;
    for (entry, _) in &present {
        entry.lens.check(&file, entry.index, transforms.camera_angle_x, [width, height])?;
    }
    if !width.is_multiple_of(downscale) || !height.is_multiple_of(downscale) {
        let what = format!("{downscale} does not divide the image size {width}x{height}");
        return Err(Error::setting("downscale", what));
    }
    let decode = |(entry, path): &(Entry, PathBuf)| {
        let image = Image::open(path).map_err(|e| Error::field(&file, entry.field("file_path"), e))?;
        let image = if downscale == 1 { image } else { image.downscaled(downscale) };
        let camera = Camera::from_angle(image.width, image.height, transforms.camera_angle_x, entry.pose);
        Ok(Frame { name: entry.name().to_owned(), camera, image })
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
    lens: Lens,
    entries: Vec<Entry>,
}

/// One element of `frames`.
struct Entry {
    index: usize,
    file_path: String,
    pose: DAffine3,
    lens: Lens,
}

/// What an object says of its camera in the fields that other programs write beside those of the format. Dropped without a
/// word they would change every picture, so they must say what the format says without them: a camera whose image is
/// centred and not distorted. (Boxes and scales of other programs, `aabb_scale`, `scale` and `offset`, leave the cameras
/// alone; so does Blender's `camera_angle_y`, which is that of its sensor and not of the image.)
struct Lens(Vec<(&'static str, Value)>);

impl Lens {
    const FIELDS: [&str; 22] = [
        "camera_angle_x",
        "fl_x",
        "fl_y",
        "cx",
        "cy",
        "w",
        "h",
        "k1",
        "k2",
        "k3",
        "k4",
        "k5",
        "k6",
        "p1",
        "p2",
        "camera_model",
        "is_fisheye",
        "x_fov",
        "y_fov",
        "latlong",
        "ftheta_p0",
        "rolling_shutter",
    ];

    fn read(object: &Value) -> Self {
        let given = |name| object.get(name).filter(|value| !value.is_null()).map(|value| (name, value.clone()));
        Lens(Self::FIELDS.into_iter().filter_map(given).collect())
    }

    /// The first field that says something else than a camera of this horizontal angle and this many pixels.
    fn other(&self, angle: f64, size: [usize; 2]) -> Option<(&'static str, String)> {
        let [w, h] = size.map(|n| n as f64);
        // Of images that were made smaller the numbers may be those from before.
        let given = |name: &str| self.0.iter().find(|(given, _)| *given == name).and_then(|(_, value)| value.as_f64());
        let scale = match (given("w"), given("h")) {
            (Some(width), Some(height)) if (width / w - height / h).abs() <= 2e-3 * (width / w) && width >= w => {
                width / w
            }
            _ => 1.0,
        };
        let focal = scale * 0.5 * w / (0.5 * angle).tan();
        let number = |expected: f64, value: &Value, tolerance: f64| {
            let close = value.as_f64().is_some_and(|x| (x - expected).abs() <= tolerance);
            (!close).then(|| format!("{}", (expected * 1e6).round() / 1e6))
        };
        let near = |expected: f64, value: &Value| number(expected, value, 1e-3 * expected);
        // Half a pixel is a matter of counting from the middle or the corner of the first.
        let middle = |size: f64, value: &Value| number(0.5 * size, value, f64::max(0.5, 1e-3 * size));
        let unless = |so: bool, expected: &str| (!so).then(|| expected.to_owned());
        self.0.iter().find_map(|(name, value)| {
            let expected = match *name {
                "camera_angle_x" => near(angle, value),
                "fl_x" | "fl_y" => near(focal, value),
                "cx" => middle(scale * w, value),
                "cy" => middle(scale * h, value),
                "w" => near(scale * w, value),
                "h" => number(scale * h, value, 2e-3 * scale * h),
                "camera_model" => {
                    let known = ["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"];
                    unless(value.as_str().is_some_and(|model| known.contains(&model)), "PINHOLE")
                }
                "is_fisheye" | "latlong" => {
                    unless(value == &Value::from(false) || value.as_f64() == Some(0.0), "false")
                }
                "x_fov" | "y_fov" | "ftheta_p0" => Some("absent".to_owned()),
                "rolling_shutter" => {
                    let zeros = |list: &Vec<Value>| list.iter().all(|x| x.as_f64() == Some(0.0));
                    unless(value.as_array().is_some_and(zeros), "zeros")
                }
                _ => number(0.0, value, 1e-6),
            };
            Some((*name, format!("is {value}, and must be {}", expected?)))
        })
    }

    /// # Errors
    /// If a field says something else, by its path.
    fn check(&self, file: &Path, index: impl Into<Option<usize>>, angle: f64, size: [usize; 2]) -> Result<()> {
        let Some((name, what)) = self.other(angle, size) else { return Ok(()) };
        let path = index.into().map_or(name.to_owned(), |index| field(index, name));
        let [width, height] = size;
        Err(Error::field(
            file,
            path,
            format!(
                "{what} for images of {width}x{height} and camera_angle_x {angle:.6}: cameras of a focal length of their own, \
                 off centre or distorted are not supported"
            ),
        ))
    }
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
        Ok(Transforms { camera_angle_x, lens: Lens::read(&root), entries: entries.collect::<Result<_>>()? })
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
        Ok(Entry { index, file_path, pose, lens: Lens::read(frame) })
    }

    fn field(&self, name: &str) -> String {
        field(self.index, name)
    }

    fn name(&self) -> &str {
        self.file_path.strip_prefix("./").unwrap_or(&self.file_path)
    }
}

fn field(index: usize, name: &str) -> String {
    format!("frames[{index}].{name}")
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
