//! Lenses in JSON: the name of a camera model, and its coefficients by name.

use super::layers::Layers;
use super::models::{MODELS, Model, coefficient, least};
use crate::camera::lens::Lens;
use crate::error::Result;
use serde_json::{Map, Value};
use std::collections::HashMap;

/// The names of coefficients in files.
const COEFFICIENTS: [&str; 11] = ["k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "sx1", "sy1", "omega"];

/// The largest coefficient that counts as 0: its effect is below a millionth of a pixel.
const NOTHING: f64 = 1e-12;

/// Returns true if a model has a coefficient. nerfstudio's OPENCV has a third radial one.
fn has(model: &Model, coefficient: &str) -> bool {
    model.coefficients.contains(&coefficient) || (model.name, coefficient) == ("OPENCV", "k3")
}

/// The lens of a file.
///
/// Without a camera model it is OPENCV, or OPENCV_FISHEYE if `is_fisheye` is true, as in instant-ngp. "Perspective" is
/// OPENCV. A Brown lens without distortion becomes a pinhole.
pub(super) fn read(layers: &Layers<'_, '_>) -> Result<Lens> {
    let fisheye = layers.find("is_fisheye", |object, name| object.flag(name))?;
    let named = layers.find("camera_model", |object, name| object.text(name))?;
    let default = if fisheye == Some(true) { "OPENCV_FISHEYE" } else { "OPENCV" };
    let name = named.map_or(default, str::trim);
    let name = if name.eq_ignore_ascii_case("perspective") { "OPENCV" } else { name };
    let Some(model) = Model::named(name) else {
        let known = MODELS.map(|model| model.name).join(", ");
        return Err(layers.error("camera_model", format!("is {:.40}; use one of {known}", name.escape_debug())));
    };
    let name = model.name;
    if fisheye.is_some_and(|fisheye| fisheye != matches!(model.kind, Lens::Fisheye { .. })) {
        let what = format!("contradicts `camera_model`, which is {name}: remove one of them");
        return Err(layers.error("is_fisheye", what));
    }
    let mut values = HashMap::new();
    for coefficient in COEFFICIENTS {
        let value = layers.number(coefficient)?.unwrap_or(0.0);
        if has(model, coefficient) {
            values.insert(coefficient, value);
        } else if value.abs() > NOTHING {
            let what = match (coefficient, name) {
                ("k4", "OPENCV") => format!(
                    "is {value}, a numerator term r^8 in nerfstudio and a denominator term in OpenCV: set it \
                     to 0, or name the camera_model FULL_OPENCV if it is OpenCV's"
                ),
                _ => format!(
                    "is {value}, but the camera model {name} has no such coefficient: set it to 0 or name another model"
                ),
            };
            return Err(layers.error(coefficient, what));
        }
    }
    match model.lens(|name| values.get(name).copied().unwrap_or(0.0)) {
        Lens::Brown { .. } if values.values().all(|x| x.abs() <= NOTHING) => Ok(Lens::Pinhole),
        Lens::Fov { omega } if !(omega > 0.0 && omega < std::f64::consts::PI) => {
            let what = format!("must be the field of view in radians, between 0 and pi, is {omega}");
            Err(layers.error("omega", what))
        }
        lens => Ok(lens),
    }
}

/// The name of the smallest model of nerfstudio for a lens, or a name it does not know if there is none.
pub(super) fn model(lens: &Lens) -> &'static str {
    least(lens, 3)
}

/// Writes the coefficients of the model.
pub(super) fn write(lens: &Lens, model: &str, out: &mut Map<String, Value>) {
    let own = |name: &&str| Model::named(model).is_some_and(|model| has(model, name));
    out.extend(COEFFICIENTS.into_iter().filter(own).map(|name| (name.to_owned(), coefficient(lens, name).into())));
    if model == "OPENCV_FISHEYE" {
        // instant-ngp reads this field and no camera model.
        out.insert("is_fisheye".to_owned(), true.into());
    }
}
