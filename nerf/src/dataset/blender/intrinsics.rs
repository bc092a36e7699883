//! What files say of their cameras beside the fields of the format.

use crate::error::{Error, Result};
use serde_json::Value;
use std::path::Path;

/// What an object says of its camera in the fields that other programs write beside those of the format. Dropped without a
/// word they would change every picture, so they must say what the format says without them: a camera whose image is
/// centred and not distorted. (Boxes and scales of other programs, `aabb_scale`, `scale` and `offset`, leave the cameras
/// alone; so does Blender's `camera_angle_y`, which is that of its sensor and not of the image.)
pub(super) struct Intrinsics(Vec<(&'static str, Value)>);

impl Intrinsics {
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

    pub(super) fn read(object: &Value) -> Self {
        let given = |name| object.get(name).filter(|value| !value.is_null()).map(|value| (name, value.clone()));
        Intrinsics(Self::FIELDS.into_iter().filter_map(given).collect())
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
    pub(super) fn check(
        &self,
        file: &Path,
        index: impl Into<Option<usize>>,
        angle: f64,
        size: [usize; 2],
    ) -> Result<()> {
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

/// The path of a field of a frame in the document.
pub(super) fn field(index: usize, name: &str) -> String {
    format!("frames[{index}].{name}")
}
