//! Normalised device coordinates: for cameras that all look forward along -z, space in front of them as a cube.

use crate::{Error, Result};
use raygrad_autograd::Scalar;

/// The projection of cameras that look along -z (Mildenhall et al. 2020, appendix C): what they see of the half space
/// behind the near plane `z = -near` becomes the cube of -1..=1, even in disparity along z.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ndc {
    /// Focal lengths over half the width and half the height of the image.
    pub focal: [f64; 2],
    /// Distance of the near plane, more than 0.
    pub near: f64,
}

/// A ray in normalised device coordinates: `origin + t direction` is on the near plane for `t = 0` and infinitely far away
/// for `t = 1`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct NdcRay<T> {
    /// Where the ray meets the near plane: its last coordinate is exactly -1.
    pub origin: [T; 3],
    /// Not of length 1. The last coordinate is exactly 2.
    pub direction: [T; 3],
    /// Whether the ray points away from what the cameras see (`d_z > 0`): it then meets the near plane backwards, and
    /// `t` from 0 to 1 is what lies behind its back.
    pub backwards: bool,
}

/// Directions flatter than this, as a share of their length, have no meeting point to speak of.
const FLATTEST: f64 = 1e-6;

impl Ndc {
    /// For an image of this size and these focal lengths in pixels, and a near plane at this distance.
    ///
    /// # Errors
    /// If a number is not positive and finite.
    pub fn new(size: [usize; 2], focal: [f64; 2], near: f64) -> Result<Self> {
        let focal = [0, 1].map(|axis| 2.0 * focal[axis] / size[axis] as f64);
        let good = |x: f64| x > 0.0 && x.is_finite();
        if !good(near) {
            return Err(Error::setting("near", format!("is {near}; use the distance of the near plane, more than 0")));
        }
        if !focal.into_iter().all(good) {
            return Err(Error::setting("focal", "the focal lengths and the size of the image must be more than 0"));
        }
        Ok(Ndc { focal, near })
    }

    /// The ray in normalised device coordinates. Computed in f64, and exact where the result is exact: an origin on the
    /// near plane stays where it is.
    ///
    /// # Errors
    /// If the ray is parallel to the image (`|d_z|` below 1e-6 of the direction's length), so that it never meets the near
    /// plane, or holds a number that is not finite.
    pub fn ray<T: Scalar>(&self, origin: [T; 3], direction: [T; 3]) -> Result<NdcRay<T>> {
        let (o, d) = (origin.map(Scalar::to_f64), direction.map(Scalar::to_f64));
        if !o.iter().chain(&d).all(|x| x.is_finite()) {
            return Err(Error::setting("ray", "holds a number that is not finite"));
        }
        let largest = d.iter().fold(0.0, |most: f64, x| most.max(x.abs()));
        let d = d.map(|x| x / largest);
        // Rounding to T may take a little off 1e-6.
        let least = FLATTEST * (1.0 - 4.0 * T::EPSILON) * d.iter().map(|x| x * x).sum::<f64>().sqrt();
        if !(d[2].abs() >= least) {
            let what = "is parallel to the image: normalised device coordinates are for cameras that look along -z";
            return Err(Error::setting("ray", what));
        }
        // The meeting point with z = -near, and how x/z and y/z change from there to infinity.
        let t = -(self.near + o[2]) / d[2];
        let at = [0, 1].map(|axis| (o[axis] + t * d[axis]) / -self.near);
        let out = |axis: usize| T::from_f64(-self.focal[axis] * at[axis]);
        let towards = |axis: usize| T::from_f64(-self.focal[axis] * (d[axis] / d[2] - at[axis]));
        Ok(NdcRay {
            origin: [out(0), out(1), T::from_f64(-1.0)],
            direction: [towards(0), towards(1), T::from_f64(2.0)],
            backwards: d[2] > 0.0,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn points_on_the_ray_are_projected_points() {
        let ndc = Ndc::new([400, 300], [380.0, 360.0], 0.5).unwrap();
        let (o, d) = ([0.3, -0.2, 0.1], [0.2, 0.1, -0.9]);
        let ray = ndc.ray::<f64>(o, d).unwrap();
        assert!(!ray.backwards);
        for t in [1.0, 3.0, 40.0, 1e6] {
            let p: [f64; 3] = std::array::from_fn(|axis| o[axis] + t * d[axis]);
            let z = 1.0 + 2.0 * 0.5 / p[2];
            let s = (z + 1.0) / 2.0;
            let expected = [-1.9 * p[0] / p[2], -2.4 * p[1] / p[2], z];
            for axis in 0..3 {
                let got = ray.origin[axis] + s * ray.direction[axis];
                assert!((got - expected[axis]).abs() < 1e-12, "axis {axis} at {t}: {got} {expected:?}");
            }
        }
    }

    #[test]
    fn settings_are_checked() {
        for (size, focal, near) in
            [([0, 3], 1.0, 1.0), ([4, 3], -1.0, 1.0), ([4, 3], f64::NAN, 1.0), ([4, 3], 1.0, 0.0)]
        {
            assert!(Ndc::new(size, [focal; 2], near).is_err(), "{size:?} {focal} {near}");
        }
    }
}
