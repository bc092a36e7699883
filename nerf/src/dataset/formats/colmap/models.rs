//! Cameras by COLMAP's models and their parameters.

use super::super::models::{MODELS, Model, coefficient, least};
use crate::camera::lens::Lens;
use crate::camera::pinhole::Camera;
use crate::dataset::formats::limits::{MOST_PIXELS, start, unfit_focal};
use glam::DAffine3;
use std::f64::consts::PI;

/// COLMAP's unsupported models: the number, the name and the number of parameters.
const OTHERS: [(i32, &str, usize); 4] =
    [(11, "RAD_TAN_THIN_PRISM_FISHEYE", 16), (12, "SIMPLE_DIVISION", 4), (13, "DIVISION", 5), (16, "EUCM", 6)];

/// The model with a number; or its number of parameters, if it is known, and an error message.
pub(super) fn by_id(id: i32) -> Result<&'static Model, (Option<usize>, String)> {
    MODELS.iter().find(|model| model.id == id).ok_or_else(|| match OTHERS.iter().find(|other| other.0 == id) {
        Some((_, name, count)) => (Some(*count), unsupported(&format!("{name} ({id})"))),
        None => (None, unsupported(&id.to_string())),
    })
}

/// The model with a name in any case, or an error message.
pub(super) fn by_name(name: &str) -> Result<&'static Model, String> {
    let name = name.to_ascii_uppercase();
    let is_other = OTHERS.iter().any(|other| other.1 == name);
    let what = "is no known camera model: write the name of one, such as PINHOLE, or undistort the images with \
                `colmap image_undistorter`";
    Model::named(&name).ok_or_else(|| if is_other { unsupported(&name) } else { format!("`{}` {what}", start(&name)) })
}

/// The names of a model's parameters, in the order of the files.
pub(super) fn params(model: &Model) -> impl Iterator<Item = &'static str> {
    let own: &[&str] = match model.kind {
        Lens::Equirectangular => &["w", "h"],
        _ if model.single => &["f", "cx", "cy"],
        _ => &["fx", "fy", "cx", "cy"],
    };
    own.iter().chain(model.coefficients).copied()
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
    if let Some((name, value)) = params(model).zip(values).find(|(_, value)| !value.is_finite()) {
        return Err((name, format!("must be a finite number, is {value}")));
    }
    if model.kind == Lens::Equirectangular {
        let [w, h] = [width as f64, height as f64];
        if [or_zero("w"), or_zero("h")] != [w, h] {
            let what = format!("must be those of the image, {w} and {h}, are {} and {}", or_zero("w"), or_zero("h"));
            return Err(("w and h", what));
        }
        let (focal, centre) = ([w / (2.0 * PI), h / PI], [0.5 * w, 0.5 * h]);
        return Ok(Camera { width, height, focal, centre, lens: Lens::Equirectangular, pose: DAffine3::IDENTITY });
    }
    let focal = ["fx", "fy"].map(|name| or_zero(if model.single { "f" } else { name }));
    if let Some(what) = focal.into_iter().find_map(unfit_focal) {
        return Err(("focal length", what));
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
    let others = OTHERS.map(|(_, name, _)| name).join(", ");
    format!("{name} is not supported (all COLMAP models but {others} are): {remedy}")
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
    let model = by_name(least(&lens, 2))?;
    let value = |name| match name {
        "fx" => camera.focal[0],
        "fy" => camera.focal[1],
        "cx" => camera.centre[0],
        "cy" => camera.centre[1],
        "w" => camera.width as f64,
        "h" => camera.height as f64,
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
            (14, "SIMPLE_FISHEYE", 3),
            (15, "FISHEYE", 4),
            (17, "EQUIRECTANGULAR", 2),
        ];
        for (id, name, count) in list {
            let [by_id, by_name] = [by_id(id).ok(), by_name(name).ok()].map(Option::unwrap);
            assert_eq!((by_id.name, params(by_id).count(), by_name.id), (name, count, id));
        }
        assert_eq!(by_name("opencv").unwrap(), by_name("OPENCV").unwrap());
        assert!(by_name("eucm").unwrap_err().starts_with("EUCM is not supported"));
        assert!(by_name("OPENCV2").unwrap_err().starts_with("`OPENCV2` is no known camera model"));
        assert_eq!(
            [11, 12, 13, 16, 18, -1].map(|id| by_id(id).unwrap_err().0),
            [Some(16), Some(4), Some(5), Some(6), None, None]
        );
    }
}
