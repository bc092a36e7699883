//! Camera models: COLMAP's names, which nerfstudio uses too, and what each of them holds.

use crate::camera::lens::Lens;

/// A camera model.
#[derive(Debug, PartialEq)]
pub(super) struct Model {
    /// COLMAP's number.
    pub id: i32,
    pub name: &'static str,
    /// True if both axes share one focal length.
    pub single: bool,
    /// A lens of the model without distortion.
    pub kind: Lens,
    /// The model's coefficients of that lens, in COLMAP's order.
    pub coefficients: &'static [&'static str],
}

const PINHOLE: Lens = Lens::Pinhole;
const BROWN: Lens = Lens::Brown { k: [0.0; 6], p: [0.0; 2] };
const FISHEYE: Lens = Lens::Fisheye { k: [0.0; 4], p: [0.0; 2], s: [0.0; 2] };
const FOV: Lens = Lens::Fov { omega: 0.0 };

const fn model(id: i32, name: &'static str, single: bool, kind: Lens, coefficients: &'static [&'static str]) -> Model {
    Model { id, name, single, kind, coefficients }
}

pub(super) const MODELS: [Model; 14] = [
    model(0, "SIMPLE_PINHOLE", true, PINHOLE, &[]),
    model(1, "PINHOLE", false, PINHOLE, &[]),
    model(2, "SIMPLE_RADIAL", true, BROWN, &["k1"]),
    model(3, "RADIAL", true, BROWN, &["k1", "k2"]),
    model(4, "OPENCV", false, BROWN, &["k1", "k2", "p1", "p2"]),
    model(6, "FULL_OPENCV", false, BROWN, &["k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"]),
    model(8, "SIMPLE_RADIAL_FISHEYE", true, FISHEYE, &["k1"]),
    model(9, "RADIAL_FISHEYE", true, FISHEYE, &["k1", "k2"]),
    model(5, "OPENCV_FISHEYE", false, FISHEYE, &["k1", "k2", "k3", "k4"]),
    model(10, "THIN_PRISM_FISHEYE", false, FISHEYE, &["k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1"]),
    model(7, "FOV", false, FOV, &["omega"]),
    model(14, "SIMPLE_FISHEYE", true, FISHEYE, &[]),
    model(15, "FISHEYE", false, FISHEYE, &[]),
    model(17, "EQUIRECTANGULAR", false, Lens::Equirectangular, &[]),
];

impl Model {
    /// The model of this name, in any case.
    pub fn named(name: &str) -> Option<&'static Model> {
        MODELS.iter().find(|model| model.name.eq_ignore_ascii_case(name))
    }

    /// The lens with these coefficients, by name.
    pub fn lens(&self, value: impl Fn(&str) -> f64) -> Lens {
        let values: Vec<f64> = self.kind.coefficient_names().iter().map(|name| value(name)).collect();
        self.kind.with_coefficients(&values)
    }
}

/// The name of the smallest model of a lens. Of Brown's models, OPENCV has `radial` radial coefficients.
pub(super) fn least(lens: &Lens, radial: usize) -> &'static str {
    match lens {
        Lens::Pinhole => "PINHOLE",
        Lens::Brown { k, .. } if k[radial..].iter().all(|k| *k == 0.0) => "OPENCV",
        Lens::Brown { .. } => "FULL_OPENCV",
        Lens::Fisheye { p: [0.0, 0.0], s: [0.0, 0.0], .. } => "OPENCV_FISHEYE",
        Lens::Fisheye { .. } => "THIN_PRISM_FISHEYE",
        Lens::Fov { .. } => "FOV",
        Lens::Equirectangular => "EQUIRECTANGULAR",
    }
}

/// A lens coefficient by name; 0 if the lens has none of that name.
pub(super) fn coefficient(lens: &Lens, name: &str) -> f64 {
    let index = lens.coefficient_names().iter().position(|own| *own == name);
    index.map_or(0.0, |index| lens.coefficients()[index])
}
