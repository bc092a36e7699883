//! Lens models: projection of directions to the image plane and back.

pub(crate) mod fold;
pub(crate) mod inverse;
pub(crate) mod maps;
pub(crate) mod recorded;
#[cfg(test)]
mod tests;

use crate::camera::lens::inverse::Distortion;
use crate::{Error, Result};
use glam::DVec3;
use raygrad_autograd::Real;
use serde::{Deserialize, Serialize};
use std::f64::consts::{FRAC_PI_2, PI};

/// A lens model: the map between directions and places in the image plane.
///
/// Directions and places use image axes: `x` right, `y` down, `z` into the scene. A place is relative to the principal
/// point in units of the focal length: `[(column - cx) / fx, (row - cy) / fy]`.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Lens {
    /// No distortion.
    #[default]
    Pinhole,
    /// OpenCV's rational model with radial coefficients `k1 .. k6` (the last three in the denominator) and tangential
    /// `p1, p2` (Brown 1966): COLMAP's SIMPLE_RADIAL, RADIAL, OPENCV and FULL_OPENCV.
    Brown {
        /// Radial coefficients `k1 .. k6`.
        k: [f64; 6],
        /// Tangential coefficients `p1, p2`.
        p: [f64; 2],
    },
    /// The equidistant fisheye (Kannala and Brandt 2006): an angle `a` to the axis maps to the radius
    /// `a (1 + k1 a^2 + k2 a^4 + k3 a^6 + k4 a^8)`; then tangential and thin-prism terms. OpenCV's `fisheye`; COLMAP's
    /// SIMPLE_RADIAL_FISHEYE, RADIAL_FISHEYE, OPENCV_FISHEYE and THIN_PRISM_FISHEYE.
    Fisheye {
        /// Radial coefficients `k1 .. k4`.
        k: [f64; 4],
        /// Tangential coefficients `p1, p2` (thin prism alone).
        p: [f64; 2],
        /// Thin-prism coefficients `sx1, sy1`.
        s: [f64; 2],
    },
    /// The FOV model with one parameter, `omega` in radians (Devernay and Faugeras 2001): COLMAP's FOV.
    Fov {
        /// The field of view in radians, below pi.
        omega: f64,
    },
    /// All directions: columns are longitudes, rows latitudes. Focal lengths are in pixels per radian.
    Equirectangular,
}

impl Lens {
    /// Returns the unit direction that projects to `place`, or `None` if there is none.
    ///
    /// The inverse covers the image up to the first fold, seen from the axis.
    ///
    /// ```
    /// use raygrad_nerf::Lens;
    /// let barrel = Lens::Brown { k: [-0.5, 0.0, 0.0, 0.0, 0.0, 0.0], p: [0.0; 2] };
    /// let direction = barrel.direction([0.54, 0.0]).unwrap();
    /// assert!((direction.x / direction.z - 0.7562852).abs() < 1e-7);
    /// assert!(barrel.direction([0.6, 0.0]).is_none(), "beyond the fold");
    /// ```
    pub fn direction(&self, place: [f64; 2]) -> Option<DVec3> {
        self.solve(place).ok().filter(|direction| direction.is_finite())
    }

    /// Returns [`direction`](Self::direction) or, if there is none, the outermost direction towards `place`. It is
    /// finite for every finite place.
    pub fn nearest(&self, place: [f64; 2]) -> DVec3 {
        let (Ok(direction) | Err(direction)) = self.solve(place);
        // Overflow leaves no finite direction; only extreme coefficients and points cause it.
        if direction.is_finite() { direction } else { DVec3::Z }
    }

    /// Projects a direction, of any length but 0, to the image plane.
    ///
    /// Returns `None` for directions beyond the first fold of the image, and for those behind the image plane unless
    /// the lens is a fisheye or equirectangular.
    pub fn place(&self, direction: DVec3) -> Option<[f64; 2]> {
        // Normalised first: squares of the components neither overflow nor underflow.
        let [x, y, z] = (direction / direction.abs().max_element()).to_array();
        let place = match self.distortion() {
            Some(distortion) => {
                let before = match distortion {
                    Distortion::Rational(_) => (z > 0.0).then(|| maps::perspective([x, y, z])),
                    // The direction straight behind is the limit of all azimuths, so it has no point.
                    Distortion::ThinPrism(_) => (z > 0.0 || x != 0.0 || y != 0.0).then(|| maps::equidistant([x, y, z])),
                }?;
                distortion.domain().holds(before).then(|| distortion.of(before))?
            }
            None => match self {
                Lens::Fov { omega } => (z > 0.0).then(|| maps::field_of_view(*omega, [x, y, z]))?,
                Lens::Equirectangular => maps::longitude_and_latitude([x, y, z]),
                _ => (z > 0.0).then(|| maps::perspective([x, y, z]))?,
            },
        };
        place.iter().all(|x| x.is_finite()).then_some(place)
    }

    /// Evaluates the formula of [`place`](Self::place) for any number type, with these
    /// [`coefficients`](Self::coefficients).
    ///
    /// With variables it is differentiable with respect to all arguments. It does not check for folds or for directions
    /// behind the lens.
    ///
    /// # Panics
    /// If there is another number of coefficients than the lens has.
    pub fn project<E: Real>(&self, coefficients: &[E], direction: [E; 3]) -> [E; 2] {
        match (self, coefficients) {
            (Lens::Pinhole, []) => maps::perspective(direction),
            (Lens::Brown { .. }, &[a, b, c, d, e, f, g, h]) => {
                maps::rational([a, b, c, d, e, f, g, h], maps::perspective(direction))
            }
            (Lens::Fisheye { .. }, &[a, b, c, d, e, f, g, h]) => {
                maps::thin_prism([a, b, c, d, e, f, g, h], maps::equidistant(direction))
            }
            (Lens::Fov { .. }, &[omega]) => maps::field_of_view(omega, direction),
            (Lens::Equirectangular, []) => maps::longitude_and_latitude(direction),
            _ => panic!("{self:?} has {} coefficients, not {}", self.coefficients().len(), coefficients.len()),
        }
    }

    /// Returns the coefficients, in order: `k1 .. k6, p1, p2`; `k1 .. k4, p1, p2, sx1, sy1`; `omega`; or none.
    pub fn coefficients(&self) -> Vec<f64> {
        match self {
            Lens::Pinhole | Lens::Equirectangular => vec![],
            Lens::Brown { k, p } => [&k[..], p].concat(),
            Lens::Fisheye { k, p, s } => [&k[..], p, s].concat(),
            Lens::Fov { omega } => vec![*omega],
        }
    }

    /// Returns the names of the [`coefficients`](Self::coefficients), as in COLMAP.
    pub fn coefficient_names(&self) -> &'static [&'static str] {
        match self {
            Lens::Pinhole | Lens::Equirectangular => &[],
            Lens::Brown { .. } => &["k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2"],
            Lens::Fisheye { .. } => &["k1", "k2", "k3", "k4", "p1", "p2", "sx1", "sy1"],
            Lens::Fov { .. } => &["omega"],
        }
    }

    /// Returns a lens of the same model with other [`coefficients`](Self::coefficients).
    ///
    /// # Panics
    /// If there is another number of coefficients than the lens has.
    #[must_use]
    pub fn with_coefficients(&self, coefficients: &[f64]) -> Lens {
        match (self, coefficients) {
            (Lens::Pinhole | Lens::Equirectangular, []) => *self,
            (Lens::Brown { .. }, &[k1, k2, k3, k4, k5, k6, p1, p2]) => {
                Lens::Brown { k: [k1, k2, k3, k4, k5, k6], p: [p1, p2] }
            }
            (Lens::Fisheye { .. }, &[k1, k2, k3, k4, p1, p2, sx1, sy1]) => {
                Lens::Fisheye { k: [k1, k2, k3, k4], p: [p1, p2], s: [sx1, sy1] }
            }
            (Lens::Fov { .. }, &[omega]) => Lens::Fov { omega },
            _ => panic!("{self:?} has {} coefficients, not {}", self.coefficients().len(), coefficients.len()),
        }
    }

    /// Checks that all coefficients are in range.
    ///
    /// # Errors
    /// If a coefficient is not finite, or a field of view is not below pi.
    pub fn check(&self) -> Result<()> {
        if let Some(bad) = self.coefficients().iter().find(|x| !x.is_finite()) {
            return Err(Error::setting("lens", format!("has the coefficient {bad}; use finite numbers, is {self:?}")));
        }
        match self {
            Lens::Fov { omega } if !(omega.abs() < PI) => {
                Err(Error::setting("lens", format!("has a field of view of {omega}; use radians, below pi")))
            }
            _ => Ok(()),
        }
    }

    /// The image-plane distortion of Brown and fisheye lenses.
    fn distortion(&self) -> Option<Distortion> {
        match *self {
            Lens::Brown { k: [k1, k2, k3, k4, k5, k6], p: [p1, p2] } => {
                Some(Distortion::Rational([k1, k2, k3, k4, k5, k6, p1, p2]))
            }
            Lens::Fisheye { k: [k1, k2, k3, k4], p: [p1, p2], s: [sx1, sy1] } => {
                Some(Distortion::ThinPrism([k1, k2, k3, k4, p1, p2, sx1, sy1]))
            }
            _ => None,
        }
    }

    /// The direction of a point; as an error, the outermost direction towards it.
    fn solve(&self, [x, y]: [f64; 2]) -> std::result::Result<DVec3, DVec3> {
        if let Some(distortion) = self.distortion() {
            let direction = |place: [f64; 2]| match distortion {
                Distortion::Rational(_) => before(place),
                Distortion::ThinPrism(_) => at_angle(place),
            };
            return distortion.undo([x, y]).map(direction).map_err(direction);
        }
        match *self {
            Lens::Fov { omega } => {
                // The argument of the arc tangent in the formula. The outermost direction is at a right angle to the
                // axis.
                let angle = x.hypot(y) * omega.abs();
                let side = |angle: f64| sinc(angle) / maps::twice_tangent_of_half_over(omega);
                let direction = |angle: f64, k: f64| unit(DVec3::new(x * k, y * k, angle.cos()));
                if angle < FRAC_PI_2 {
                    Ok(direction(angle, side(angle)))
                } else {
                    Err(direction(FRAC_PI_2, side(FRAC_PI_2) * (FRAC_PI_2 / angle)))
                }
            }
            Lens::Equirectangular => {
                let (longitude, latitude) = (x.clamp(-PI, PI), y.clamp(-FRAC_PI_2, FRAC_PI_2));
                let (sin, cos) = latitude.sin_cos();
                let direction = DVec3::new(cos * longitude.sin(), sin, cos * longitude.cos());
                if [longitude, latitude] == [x, y] { Ok(direction) } else { Err(direction) }
            }
            _ => Ok(before([x, y])),
        }
    }
}

/// `sin(angle) / angle`.
fn sinc(angle: f64) -> f64 {
    if angle == 0.0 { 1.0 } else { angle.sin() / angle }
}

/// A vector scaled to length 1, without overflow or underflow.
fn unit(v: DVec3) -> DVec3 {
    (v / v.abs().max_element()).normalize()
}

/// The direction through a point of the plane at distance 1.
fn before([x, y]: [f64; 2]) -> DVec3 {
    unit(DVec3::new(x, y, 1.0))
}

/// The direction at an angle to the axis, which is given by its components.
fn at_angle([x, y]: [f64; 2]) -> DVec3 {
    let angle = x.hypot(y);
    let k = sinc(angle);
    DVec3::new(x * k, y * k, angle.cos())
}
