//! COLMAP's camera models.

use crate::camera::lens::Lens;
use crate::camera::pinhole::Camera;
use crate::dataset::formats::limits::{MOST_PIXELS, start};
use glam::DAffine3;
use std::f64::consts::PI;

/// Which lens the parameters are of.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Family {
    Pinhole,
    Brown,
    Fisheye,
    Fov,
}

/// A camera model: its number in binary files, its name in texts, and its parameters in the order of both.
#[derive(Debug, PartialEq)]
pub(super) struct Model {
    pub id: i32,
    pub name: &'static str,
    family: Family,
    pub params: &'static [&'static str],
}

const fn model(id: i32, name: &'static str, family: Family, params: &'static [&'static str]) -> Model {
    Model { id, name, family, params }
}

#[rustfmt::skip]
const MODELS: [Model; 11] = [
    model(0, "SIMPLE_PINHOLE", Family::Pinhole, &["f", "cx", "cy"]),
    model(1, "PINHOLE", Family::Pinhole, &["fx", "fy", "cx", "cy"]),
    model(2, "SIMPLE_RADIAL", Family::Brown, &["f", "cx", "cy", "k1"]),
    model(3, "RADIAL", Family::Brown, &["f", "cx", "cy", "k1", "k2"]),
    model(4, "OPENCV", Family::Brown, &["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"]),
    model(5, "OPENCV_FISHEYE", Family::Fisheye, &["fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"]),
    model(6, "FULL_OPENCV", Family::Brown, &["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"]),
    model(7, "FOV", Family::Fov, &["fx", "fy", "cx", "cy", "omega"]),
    model(8, "SIMPLE_RADIAL_FISHEYE", Family::Fisheye, &["f", "cx", "cy", "k1"]),
    model(9, "RADIAL_FISHEYE", Family::Fisheye, &["f", "cx", "cy", "k1", "k2"]),
    model(10, "THIN_PRISM_FISHEYE", Family::Fisheye, &["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1"]),
];

/// Models that COLMAP has and we have not, from number 11 on.
const OTHERS: [&str; 7] = [
    "RAD_TAN_THIN_PRISM_FISHEYE",
    "SIMPLE_DIVISION",
    "DIVISION",
    "SIMPLE_FISHEYE",
    "FISHEYE",
    "EUCM",
    "EQUIRECTANGULAR",
];

impl Model {
    /// The model of a number, or why there is none.
    pub fn by_id(id: i32) -> Result<&'static Model, String> {
        MODELS.iter().find(|model| model.id == id).ok_or_else(|| {
            let other = id.checked_sub(11).and_then(|i| usize::try_from(i).ok()).and_then(|i| OTHERS.get(i));
            unsupported(&other.map_or(id.to_string(), |name| format!("{name} ({id})")))
        })
    }

    /// The model of a name, or why there is none.
    pub fn by_name(name: &str) -> Result<&'static Model, String> {
        MODELS.iter().find(|model| model.name == name).ok_or_else(|| unsupported(&start(name)))
    }

    /// The camera with these parameters, its pose the identity; or which of them is wrong, and what with it.
    pub fn camera(&self, [width, height]: [u64; 2], params: &[f64]) -> Result<Camera, (&'static str, String)> {
        let find = |name: &str| self.params.iter().position(|param| *param == name).and_then(|i| params.get(i));
        let or_zero = |name: &str| find(name).copied().unwrap_or(0.0);
        let side = |name: &'static str, pixels: u64| match usize::try_from(pixels) {
            Ok(pixels) if (1..=MOST_PIXELS).contains(&pixels) => Ok(pixels),
            _ => Err((name, format!("must be 1 to {MOST_PIXELS} pixels, is {pixels}"))),
        };
        let (width, height) = (side("width", width)?, side("height", height)?);
        // Models with one focal length have it for both axes.
        let focal = ["fx", "fy"].map(|name| find(name).or_else(|| find("f")).copied().unwrap_or(0.0));
        if let Some(focal) = focal.iter().find(|focal| !(**focal > 0.0)) {
            return Err(("focal length", format!("must be more than 0, is {focal}")));
        }
        let centre = ["cx", "cy"].map(or_zero);
        let lens = match self.family {
            Family::Pinhole => Lens::Pinhole,
            Family::Brown => {
                Lens::Brown { k: ["k1", "k2", "k3", "k4", "k5", "k6"].map(or_zero), p: ["p1", "p2"].map(or_zero) }
            }
            Family::Fisheye => Lens::Fisheye {
                k: ["k1", "k2", "k3", "k4"].map(or_zero),
                p: ["p1", "p2"].map(or_zero),
                s: ["sx1", "sy1"].map(or_zero),
            },
            // COLMAP's formula has the same value for both signs.
            Family::Fov => Lens::Fov { omega: or_zero("omega").abs() },
        };
        if let Lens::Fov { omega } = lens
            && omega >= PI
        {
            return Err(("omega", format!("must be an angle of less than pi, is {omega}")));
        }
        Ok(Camera { width, height, focal, centre, lens: simplest(lens), pose: DAffine3::IDENTITY })
    }
}

fn unsupported(name: &str) -> String {
    let last = MODELS[MODELS.len() - 1].name;
    let remedy = "undistort the images with `colmap image_undistorter`";
    format!("{name} is not supported (those from SIMPLE_PINHOLE to {last} are): {remedy}")
}

/// The lens, or a pinhole where that bends light the same way: without coefficients.
fn simplest(lens: Lens) -> Lens {
    match lens {
        Lens::Brown { k, p } if k == [0.0; 6] && p == [0.0; 2] => Lens::Pinhole,
        Lens::Fov { omega: 0.0 } => Lens::Pinhole,
        lens => lens,
    }
}

/// The smallest model that holds a camera exactly, and its parameters; or why there is none.
pub(super) fn model_of(camera: &Camera) -> Result<(&'static Model, Vec<f64>), String> {
    let lens = simplest(camera.lens);
    let index = match lens {
        Lens::Pinhole => 1,
        Lens::Brown { k, .. } if k[2..] == [0.0; 4] => 4,
        Lens::Brown { .. } => 6,
        Lens::Fisheye { p, s, .. } if p == [0.0; 2] && s == [0.0; 2] => 5,
        Lens::Fisheye { .. } => 10,
        Lens::Fov { .. } => 7,
        Lens::Equirectangular => {
            return Err("is equirectangular, which COLMAP's models are not: cut it into pinhole views first".into());
        }
    };
    let (radial, p, s, omega): (&[f64], _, _, _) = match &lens {
        Lens::Brown { k, p } => (k, *p, [0.0; 2], 0.0),
        Lens::Fisheye { k, p, s } => (k, *p, *s, 0.0),
        Lens::Fov { omega } => (&[], [0.0; 2], [0.0; 2], *omega),
        Lens::Pinhole | Lens::Equirectangular => (&[], [0.0; 2], [0.0; 2], 0.0),
    };
    let value = |name: &&str| match *name {
        "fx" => camera.focal[0],
        "fy" => camera.focal[1],
        "cx" => camera.centre[0],
        "cy" => camera.centre[1],
        "p1" => p[0],
        "p2" => p[1],
        "sx1" => s[0],
        "sy1" => s[1],
        "omega" => omega,
        k => k.strip_prefix('k').and_then(|k| k.parse::<usize>().ok()).map_or(0.0, |k| radial[k - 1]),
    };
    let model = &MODELS[index];
    Ok((model, model.params.iter().map(value).collect()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn models_have_the_numbers_names_and_parameters_of_colmaps_list() {
        // docs of COLMAP, "Camera Models", and the numbers of sensor/models.h.
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
            let [by_id, by_name] = [Model::by_id(id), Model::by_name(name)].map(|model| model.ok().unwrap());
            assert_eq!((by_id.name, by_id.params.len(), by_name.id), (name, count, id));
        }
        assert!(Model::by_id(11).is_err() && Model::by_id(-1).is_err() && Model::by_name("OPENCV2").is_err());
    }
}
