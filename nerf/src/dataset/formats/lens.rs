//! Camera models by name, and their coefficients.

use super::layers::Layers;
use crate::camera::lens::Lens;
use crate::error::Result;
use serde_json::{Map, Value};

/// The coefficients that files give, by name.
const COEFFICIENTS: [&str; 11] = ["k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "sx1", "sy1", "omega"];

/// A coefficient below this is rounding of one that is 0: it moves nothing by as much as a millionth of a pixel.
const NOTHING: f64 = 1e-12;

#[derive(Debug, Clone, Copy, PartialEq)]
enum Family {
    Brown,
    Fisheye,
    Fov,
    Equirectangular,
}

/// COLMAP's names, which nerfstudio uses too, and the coefficients of each. OPENCV has `k3` as nerfstudio has it.
const MODELS: [(&str, Family, &[&str]); 12] = [
    ("SIMPLE_PINHOLE", Family::Brown, &[]),
    ("PINHOLE", Family::Brown, &[]),
    ("SIMPLE_RADIAL", Family::Brown, &["k1"]),
    ("RADIAL", Family::Brown, &["k1", "k2"]),
    ("OPENCV", Family::Brown, &["k1", "k2", "k3", "p1", "p2"]),
    ("FULL_OPENCV", Family::Brown, &["k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2"]),
    ("SIMPLE_RADIAL_FISHEYE", Family::Fisheye, &["k1"]),
    ("RADIAL_FISHEYE", Family::Fisheye, &["k1", "k2"]),
    ("OPENCV_FISHEYE", Family::Fisheye, &["k1", "k2", "k3", "k4"]),
    ("THIN_PRISM_FISHEYE", Family::Fisheye, &["k1", "k2", "k3", "k4", "p1", "p2", "sx1", "sy1"]),
    ("FOV", Family::Fov, &["omega"]),
    ("EQUIRECTANGULAR", Family::Equirectangular, &[]),
];

/// The lens that a file describes. Where it names no camera model, that is OPENCV, or OPENCV_FISHEYE if it says
/// `is_fisheye`, as instant-ngp has it. One of Brown's without any distortion is a pinhole.
pub(super) fn read(layers: &Layers<'_, '_>) -> Result<Lens> {
    let fisheye = layers.find("is_fisheye", |object, name| object.flag(name))?;
    let named = layers.find("camera_model", |object, name| object.text(name))?;
    let default = if fisheye == Some(true) { "OPENCV_FISHEYE" } else { "OPENCV" };
    let Some((model, family, own)) = MODELS.into_iter().find(|(name, ..)| *name == named.unwrap_or(default)) else {
        let known = MODELS.map(|(name, ..)| name).join(", ");
        let what = format!("is {:.40}, which is not one of {known}", named.unwrap_or(default).escape_debug());
        return Err(layers.error("camera_model", what));
    };
    if fisheye.is_some_and(|fisheye| fisheye != (family == Family::Fisheye)) {
        let what = format!("contradicts `camera_model`, which is {model}: remove one of them");
        return Err(layers.error("is_fisheye", what));
    }
    let mut values = [0.0; COEFFICIENTS.len()];
    for (value, name) in values.iter_mut().zip(COEFFICIENTS) {
        *value = layers.number(name)?.unwrap_or(0.0);
        if own.contains(&name) {
            continue;
        }
        if value.abs() > NOTHING {
            let what = match (name, model) {
                ("k4", "OPENCV") => format!(
                    "is {value}, which nerfstudio multiplies by the eighth power of the radius and OpenCV divides by: set it \
                     to 0, or name the camera_model FULL_OPENCV if it is OpenCV's"
                ),
                _ => format!(
                    "is {value}, but the camera model {model} has no such coefficient: set it to 0 or name another model"
                ),
            };
            return Err(layers.error(name, what));
        }
        *value = 0.0;
    }
    let [k1, k2, k3, k4, k5, k6, p1, p2, sx1, sy1, omega] = values;
    Ok(match family {
        Family::Brown if values.iter().all(|x| x.abs() <= NOTHING) => Lens::Pinhole,
        Family::Brown => Lens::Brown { k: [k1, k2, k3, k4, k5, k6], p: [p1, p2] },
        Family::Fisheye => Lens::Fisheye { k: [k1, k2, k3, k4], p: [p1, p2], s: [sx1, sy1] },
        Family::Fov if omega > 0.0 && omega < std::f64::consts::PI => Lens::Fov { omega },
        Family::Fov => {
            let what = format!("must be the field of view in radians, between 0 and pi, is {omega}");
            return Err(layers.error("omega", what));
        }
        Family::Equirectangular => Lens::Equirectangular,
    })
}

/// The name of the least model that has this lens and that nerfstudio knows, if it knows any.
pub(super) fn model(lens: &Lens) -> &'static str {
    match lens {
        Lens::Pinhole => "PINHOLE",
        Lens::Brown { k: [_, _, _, 0.0, 0.0, 0.0], .. } => "OPENCV",
        Lens::Brown { .. } => "FULL_OPENCV",
        Lens::Fisheye { p: [0.0, 0.0], s: [0.0, 0.0], .. } => "OPENCV_FISHEYE",
        Lens::Fisheye { .. } => "THIN_PRISM_FISHEYE",
        Lens::Fov { .. } => "FOV",
        Lens::Equirectangular => "EQUIRECTANGULAR",
    }
}

/// Writes the coefficients that the model of this name has.
pub(super) fn write(lens: &Lens, model: &str, out: &mut Map<String, Value>) {
    let values = match *lens {
        Lens::Pinhole | Lens::Equirectangular => [0.0; 11],
        Lens::Brown { k: [k1, k2, k3, k4, k5, k6], p: [p1, p2] } => [k1, k2, k3, k4, k5, k6, p1, p2, 0.0, 0.0, 0.0],
        Lens::Fisheye { k: [k1, k2, k3, k4], p: [p1, p2], s: [sx1, sy1] } => {
            [k1, k2, k3, k4, 0.0, 0.0, p1, p2, sx1, sy1, 0.0]
        }
        Lens::Fov { omega } => [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, omega],
    };
    let own = MODELS.into_iter().find(|(name, ..)| *name == model).map_or(&[][..], |(.., own)| own);
    let named = COEFFICIENTS.into_iter().zip(values).filter(|(name, _)| own.contains(name));
    out.extend(named.map(|(name, value)| (name.to_owned(), value.into())));
    if model == "OPENCV_FISHEYE" {
        // For instant-ngp, which reads no camera model.
        out.insert("is_fisheye".to_owned(), true.into());
    }
}
