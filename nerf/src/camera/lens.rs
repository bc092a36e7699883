//! Radial lens distortion, and how to undo it.

use crate::{Error, Result};
use glam::DVec3;
use serde::{Deserialize, Serialize};

/// How a camera's glass bends light: the map between directions and places in the image plane.
///
/// Directions and places have the axes of images here: `x` right, `y` down, `z` into the scene. A place is in units of the
/// focal length from the principal point, `[(column - cx) / fx, (row - cy) / fy]`.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Lens {
    /// None: straight lines stay straight.
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
    /// The equidistant fisheye (Kannala and Brandt 2006): an angle `a` to the axis is put at
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
    /// One parameter, the field of view `omega` in radians (Devernay and Faugeras 2001): COLMAP's FOV.
    Fov {
        /// The field of view in radians.
        omega: f64,
    },
    /// All directions: columns are longitudes, rows latitudes. A focal length is in pixels for each radian.
    Equirectangular,
}

impl Lens {
    /// The direction, of length 1, of the light that reaches this place; `None` where the lens puts nothing.
    pub fn direction(&self, [x, y]: [f64; 2]) -> Option<DVec3> {
        match self {
            Lens::Pinhole => Some(DVec3::new(x, y, 1.0).normalize()),
            Lens::Brown { k, p } => {
                let (mut a, mut b) = (x, y);
                for _ in 0..30 {
                    let r = a * a + b * b;
                    let radial = 1.0 + r * (k[0] + r * k[1]);
                    let (dx, dy) =
                        (2.0 * p[0] * a * b + p[1] * (r + 2.0 * a * a), p[0] * (r + 2.0 * b * b) + 2.0 * p[1] * a * b);
                    (a, b) = ((x - dx) / radial, (y - dy) / radial);
                }
                Some(DVec3::new(a, b, 1.0).normalize())
            }
            _ => unimplemented!(),
        }
    }

    /// As [`direction`](Self::direction); where the lens puts nothing, the outermost direction towards there.
    pub fn nearest(&self, place: [f64; 2]) -> DVec3 {
        self.direction(place).unwrap_or(DVec3::Z)
    }

    /// Where light from this direction, of any length but 0, reaches the image plane; `None` if it does not.
    pub fn place(&self, direction: DVec3) -> Option<[f64; 2]> {
        match self {
            Lens::Pinhole => (direction.z > 0.0).then(|| [direction.x / direction.z, direction.y / direction.z]),
            _ => unimplemented!(),
        }
    }
}

/// A lens that moves the point at distance `r` from the optical axis, in units of the focal length, to
/// `r (1 + k1 r^2 + k2 r^4)` (Brown 1966; OpenCV's first two coefficients).
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct RadialLens {
    /// Coefficient of `r^2`; negative for a barrel.
    pub k1: f64,
    /// Coefficient of `r^4`.
    pub k2: f64,
}

/// Newton steps, each at least as good as halving an interval of doubles.
const MOST_STEPS: usize = 1100;

impl RadialLens {
    /// Where the lens puts the point at distance `r`.
    pub fn distort(&self, r: f64) -> f64 {
        let s = r * r;
        r * (1.0 + s * (self.k1 + s * self.k2))
    }

    /// The derivative of [`distort`](Self::distort).
    fn slope(&self, r: f64) -> f64 {
        let s = r * r;
        1.0 + s * (3.0 * self.k1 + s * 5.0 * self.k2)
    }

    /// The distance from the axis up to which points keep their order: beyond, the image folds back. Infinite for most
    /// lenses; `1 / sqrt(3 |k1|)` for `k1 < 0` and `k2 = 0`.
    pub fn fold(&self) -> f64 {
        // The least positive root s of 1 + b s + a s^2.
        let (a, b) = (5.0 * self.k2, 3.0 * self.k1);
        let discriminant = b * b - 4.0 * a;
        if discriminant < 0.0 {
            return f64::INFINITY;
        }
        // Both roots from sums of equal signs: 1 / s = (-b +- root) / 2, and a positive s is least for the plus.
        let root = discriminant.sqrt();
        let inverse = if b <= 0.0 { 0.5 * (root - b) } else { -2.0 * a / (b + root) };
        if inverse > 0.0 { inverse.recip().sqrt() } else { f64::INFINITY }
    }

    /// The distance at which a point was that the lens has put at `distorted`, at least 0 and up to the
    /// [`fold`](Self::fold): by Newton's method, kept between bounds that hold the root.
    ///
    /// ```
    /// use raygrad_nerf::RadialLens;
    /// let barrel = RadialLens { k1: -0.5, k2: 0.0 };
    /// assert!((barrel.undistort(0.54)? - 0.7562852).abs() < 1e-7);
    /// assert!(barrel.undistort(0.6).is_err(), "this lens puts nothing there");
    /// # Ok::<(), raygrad_nerf::Error>(())
    /// ```
    ///
    /// # Errors
    /// If the lens puts no point there, or a number is negative or not finite.
    pub fn undistort(&self, distorted: f64) -> Result<f64> {
        if !(distorted >= 0.0 && distorted.is_finite() && self.k1.is_finite() && self.k2.is_finite()) {
            let RadialLens { k1, k2 } = self;
            return Err(Error::setting("lens", format!("no distance {distorted} for k1 = {k1}, k2 = {k2}")));
        }
        let mut high = self.fold();
        if high.is_infinite() {
            high = distorted.max(f64::MIN_POSITIVE);
            while self.distort(high) < distorted {
                high *= 2.0;
            }
        } else if self.distort(high) < distorted {
            let most = self.distort(high);
            let what = format!("puts nothing at {distorted} from the axis, only up to {most:.7}; crop the image");
            return Err(Error::setting("lens", what));
        }
        let (mut low, mut r) = (0.0, distorted.min(high));
        for _ in 0..MOST_STEPS {
            let excess = self.distort(r) - distorted;
            if excess > 0.0 {
                high = r
            } else {
                low = r
            }
            let newton = r - excess / self.slope(r);
            let next = if newton > low && newton < high { newton } else { 0.5 * (low + high) };
            if excess == 0.0 || next == r || !(low < next && next < high) {
                break;
            }
            r = next;
        }
        Ok(r)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn the_fold_is_where_the_slope_is_zero() {
        for (k1, k2) in [(-0.5, 0.0), (-0.3, 0.01), (0.2, -0.1), (0.0, -0.5), (-1e-9, 0.0), (5.0, -1e-6)] {
            let lens = RadialLens { k1, k2 };
            let (fold, scale) = (lens.fold(), 1.0 + 3.0 * k1.abs() * lens.fold().powi(2));
            assert!(lens.slope(fold).abs() < 1e-9 * scale, "{lens:?}: {fold}, slope {}", lens.slope(fold));
            assert!((1..100).all(|i| lens.slope(fold * f64::from(i) / 100.0) > 0.0), "{lens:?}: not the first");
        }
        for (k1, k2) in [(0.0, 0.0), (0.5, 0.0), (0.5, 0.5), (-0.1, 0.5)] {
            assert_eq!(RadialLens { k1, k2 }.fold(), f64::INFINITY, "{k1} {k2}");
        }
    }

    proptest! {
        #[test]
        fn undoes_what_the_lens_does(k1 in -1.0..1.0_f64, k2 in -1.0..1.0_f64, share in 0.0..0.999_f64) {
            let lens = RadialLens { k1, k2 };
            let r = share * lens.fold().min(10.0);
            let again = lens.undistort(lens.distort(r)).unwrap();
            // Near the fold many distances have nearly one image.
            prop_assert!((again - r).abs() <= 1e-13 * r / lens.slope(r).min(1.0) + 1e-15, "{} {}", again, r);
        }
    }
}
