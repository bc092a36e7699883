//! Camera fields of other programs that raygrad does not read.

use super::json::{Object, shown, truth};
use crate::error::Result;
use serde_json::Value;

/// Unsupported camera fields of instant-ngp and nerfstudio. Ignoring them silently would spoil every image.
const NOT_READ: [&str; 18] = [
    "x_fov",
    "y_fov",
    "distortion_params",
    "fisheye_crop_radius",
    "ftheta_p0",
    "ftheta_p1",
    "ftheta_p2",
    "ftheta_p3",
    "ftheta_p4",
    "latlong",
    "equirectangular",
    "rolling_shutter",
    "rolling_shutter_time",
    "transform_matrix_start",
    "transform_matrix_end",
    "black_transparent",
    "normal_mts_args",
    "from_na",
];

/// Names of texts that state the axes or the direction of the matrices. Those that name others than OpenGL's count.
const CONVENTIONS: [&str; 9] = [
    "convention",
    "frame_convention",
    "camera_convention",
    "pose_convention",
    "axis_convention",
    "coordinate_convention",
    "coordinate_system",
    "coord_system",
    "pose_type",
];
const OTHER_CONVENTIONS: [&str; 6] = ["opencv", "colmap", "w2c", "world2cam", "world_to_cam", "world-to-cam"];

/// Lists of distortion coefficients in other programs. They count where none are given by name.
const DISTORTIONS: [&str; 9] = [
    "dist_coeffs",
    "dist_coefs",
    "distCoeffs",
    "D",
    "dist",
    "distortion",
    "distortion_coefficients",
    "radial_distortion",
    "tangential_distortion",
];

/// Texts in other programs that name a kind of camera. Those that name a wide one count.
const KINDS: [&str; 4] = ["camera_type", "projection", "fisheye", "distortion_model"];
const WIDE: [&str; 4] = ["fish", "equidistant", "equirect", "spherical"];

/// Checks that an object has no unsupported camera field, unless its value has no effect.
///
/// # Errors
/// If it has one.
pub(super) fn check_supported(object: &Object<'_>) -> Result<()> {
    fn nothing(value: &Value) -> bool {
        match value {
            Value::Array(values) => values.iter().all(nothing),
            Value::Object(members) => members.values().all(nothing),
            value => truth(value) == Some(false),
        }
    }
    // A number is a distance, and a text such as "none" no coefficient.
    let is_list = |value: &Value| value.is_array() || value.is_object();
    let lists = DISTORTIONS.iter().filter(|name| object.get("k1").is_none() && object.get(name).is_some_and(is_list));
    let has_one = |name: &str, words: &[&str]| {
        let text = object.get(name).and_then(Value::as_str).map(str::to_lowercase);
        text.is_some_and(|text| words.iter().any(|word| text.contains(word)))
    };
    let is_fisheye = object.get("fisheye").and_then(Value::as_bool) == Some(true);
    let is_wide = |name: &&&str| {
        object.get("camera_model").is_none() && (has_one(name, &WIDE) || **name == "fisheye" && is_fisheye)
    };
    let conventions = CONVENTIONS.iter().filter(|name| has_one(name, &OTHER_CONVENTIONS));
    let all = NOT_READ.iter().chain(lists).chain(KINDS.iter().filter(is_wide)).chain(conventions);
    let named = all.copied().find_map(|name| Some((name, object.get(name).filter(|value| !nothing(value))?)));
    let Some((name, value)) = named else { return Ok(()) };
    let what = match name {
        "x_fov" | "y_fov" => "write the field of view in radians as camera_angle_x and camera_angle_y",
        "latlong" | "equirectangular" => "write camera_model EQUIRECTANGULAR for such panoramas",
        "distortion_params" => "write the coefficients by name (k1, k2, p1, p2) with their camera_model",
        name if DISTORTIONS.contains(&name) => {
            "write the coefficients by name (k1, k2, p1, p2) with their camera_model; OpenCV lists k1, k2, p1, p2, k3"
        }
        "fisheye_crop_radius" => "write masks of the pixels to use, as mask_path",
        name if KINDS.contains(&name) => {
            "write camera_model OPENCV_FISHEYE, another fisheye model or EQUIRECTANGULAR, with its coefficients"
        }
        "rolling_shutter" | "rolling_shutter_time" | "transform_matrix_start" | "transform_matrix_end" => {
            "rolling shutter is not supported; remove it to ignore it"
        }
        "normal_mts_args" => {
            "it means axes of Mitsuba: negate the first and the third column of all matrices, and remove it"
        }
        "from_na" => {
            "it means axes of OpenCV (NeuS2): negate the second and the third column of all matrices, and remove it"
        }
        name if CONVENTIONS.contains(&name) => {
            "matrices are camera-to-world with OpenGL's axes (y up, looking along -z): convert them, and remove it"
        }
        "black_transparent" => "write the transparency into the images; remove it to ignore it",
        _ => "such cameras are not supported; remove it to ignore it",
    };
    Err(object.error(name, format!("is {}, which raygrad does not read: {what}", shown(value))))
}
