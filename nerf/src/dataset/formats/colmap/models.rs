//! Cameras by COLMAP's models and their parameters.

use super::super::models::{MODELS, Model, coefficient, least};
use crate::camera::lens::Lens;
use crate::camera::pinhole::Camera;
use crate::dataset::formats::limits::{MOST_PIXELS, start};
use glam::DAffine3;
use std::f64::consts::PI;

/// COLMAP's unsupported models, from number 11 on.
const OTHERS: [&str; 7] = [
    "RAD_TAN_THIN_PRISM_FISHEYE",
    "SIMPLE_DIVISION",
    "DIVISION",
    "SIMPLE_FISHEYE",
    "FISHEYE",
    "EUCM",
    "EQUIRECTANGULAR",
];

/// The model with a number, or an error message.
pub(super) fn by_id(id: i32) -> Result<&'static Model, String> {
    MODELS.iter().find(|model| model.id == Some(id)).ok_or_else(|| {
        let other = id.checked_sub(11).and_then(|i| usize::try_from(i).ok()).and_then(|i| OTHERS.get(i));
        unsupported(&other.map_or(id.to_string(), |name| format!("{name} ({id})")))
    })
}

/// The model with a name, or an error message.
pub(super) fn by_name(name: &str) -> Result<&'static Model, String> {
    Model::named(name).filter(|model| model.id.is_some()).ok_or_else(|| unsupported(&start(name)))
}

/// The names of a model's parameters, in the order of the files.
pub(super) fn params(model: &Model) -> impl Iterator<Item = &'static str> {
    let focal: &[&str] = if model.single { &["f"] } else { &["fx", "fy"] };
    focal.iter().chain(&["cx", "cy"]).chain(model.coefficients).copied()
}

/// The camera with these parameters and the identity as its pose; as an error, the wrong parameter and a message.
pub(super) fn camera(
    model: &Model,
    [width, height]: [u64; 2],
    values: &[f64],
) -> Result<Camera, (&'static str, String)> {
    let find = |name: &str| params(model).zip(values).find(|(param, _)| *param == name).map(|(_, value)| *value);
    let or_zero = |name: &str| find(name).unwrap_or(0.0);
    let side = |name: &'static str, pixels: u64| match usize::try_from(pixels) {
        Ok(pixels) if (1..=MOST_PIXELS).contains(&pixels) => Ok(pixels),
        _ => Err((name, format!("must be 1 to {MOST_PIXELS} pixels, is {pixels}"))),
    };
    let (width, height) = (side("width", width)?, side("height", height)?);
    let focal = ["fx", "fy"].map(|name| or_zero(if model.single { "f" } else { name }));
    if let Some(focal) = focal.iter().find(|focal| !(**focal > 0.0)) {
        return Err(("focal length", format!("must be more than 0, is {focal}")));
    }
    let lens = match model.lens(or_zero) {
        Lens::Fov { omega } if omega.abs() >= PI => {
            return Err(("omega", format!("must be below pi (radians), is {}", omega.abs())));
        }
        // COLMAP's formula is even in omega.
        Lens::Fov { omega } => Lens::Fov { omega: omega.abs() },
        lens => lens,
    };
    let centre = ["cx", "cy"].map(or_zero);
    Ok(Camera { width, height, focal, centre, lens: simplest(lens), pose: DAffine3::IDENTITY })
}

fn unsupported(name: &str) -> String {
    let remedy = "undistort the images with `colmap image_undistorter`";
    format!("{name} is not supported (those from SIMPLE_PINHOLE to THIN_PRISM_FISHEYE are): {remedy}")
}

/// Replaces a lens without distortion by an equal pinhole.
fn simplest(lens: Lens) -> Lens {
    match lens {
        Lens::Brown { .. } | Lens::Fov { .. } if lens.coefficients().iter().all(|x| *x == 0.0) => Lens::Pinhole,
        lens => lens,
    }
}

/// The smallest model that holds a camera exactly, and its parameters; or an error message.
pub(super) fn model_of(camera: &Camera) -> Result<(&'static Model, Vec<f64>), String> {
    let lens = simplest(camera.lens);
    let Ok(model) = by_name(least(&lens, 2)) else {
        return Err("is equirectangular, which COLMAP does not support: cut it into pinhole views first".into());
    };
    let value = |name| match name {
        "fx" => camera.focal[0],
        "fy" => camera.focal[1],
        "cx" => camera.centre[0],
        "cy" => camera.centre[1],
        name => coefficient(&lens, name),
    };
    Ok((model, params(model).map(value).collect()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colmap_models_match_colmaps_list() {
        // COLMAP's documentation, "Camera Models", and the numbers in sensor/models.h.
        let list = [
            (0, "SIMPLE_PINHOLE", 3),
            (1, "PINHOLE", 4),
            (2, "SIMPLE_RADIAL", 4),
            (3, "RADIAL", 5),
            (4, "OPENCV", 8),
            (5, "OPENCV_FISHEYE", 8),
            (6, "FULL_OPENCV", 12),
            (7, "FOV", 5),
            (8, "SIMPLE_RADIAL_FISHEYE", 4),
            (9, "RADIAL_FISHEYE", 5),
            (10, "THIN_PRISM_FISHEYE", 12),
        ];
        for (id, name, count) in list {
            let [by_id, by_name] = [by_id(id), by_name(name)].map(|model| model.ok().unwrap());
            assert_eq!((by_id.name, params(by_id).count(), by_name.id), (name, count, Some(id)));
        }
        assert!(["OPENCV2", "EQUIRECTANGULAR"].iter().all(|name| by_name(name).is_err()));
        assert!(by_id(11).is_err() && by_id(-1).is_err());
    }
}
