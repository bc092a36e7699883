//! Normalised device coordinates: what cameras see that all look the same way, as a cube.

use super::pinhole::Camera;
use crate::{Error, Result};
use glam::{DMat3, DVec2, DVec3, Vec3Swizzles};
use serde::{Deserialize, Serialize};

/// What cameras see that all look the same way, as the unit cube: across it lies as in a picture, and along it evenly in inverse
/// depth, from the near plane to infinity (Mildenhall et al. 2020, appendix C). Straight lines stay straight.
///
/// The paper's picture is that of one of the cameras, which leaves out what others see beside it. This one is taken from as far
/// behind them as it takes to have all that they see in it. [`Space::cube`](crate::Space::cube) is the map.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Ndc {
    /// Where the picture is taken from, in scene units.
    pub eye: DVec3,
    /// Its right, up and back, of length 1.
    pub axes: DMat3,
    /// Half of its width and height at depth 1: tangents of half of its angles.
    pub slopes: [f64; 2],
    /// Depth of the near plane, more than 0: what is nearer is seen at it.
    pub near: f64,
}

/// Half of the picture is at most so wide at depth 1: 63 degrees.
const WIDEST: f64 = 2.0;
/// How much wider it is than what cameras see: views are taken beside them, and refined cameras move.
const MARGIN: f64 = 1.05;
/// Pixels along each border of an image whose rays are asked how far it reaches.
const BORDER: usize = 8;

impl Ndc {
    /// All that cameras see beyond the depth `near` before each.
    ///
    /// # Errors
    /// If they do not all look the same way, or move more along it than across: the picture would show what is before the
    /// foremost from afar. If there is no near plane, because `near` is 0 and all stand in one place.
    pub fn around<'a>(cameras: impl IntoIterator<Item = &'a Camera>, near: f64) -> Result<Self> {
        let cameras: Vec<&Camera> = cameras.into_iter().collect();
        let mean = |of: fn(&Camera) -> DVec3| cameras.iter().map(|c| of(c)).sum::<DVec3>() / cameras.len() as f64;
        let bad = |what: String| Error::setting("scope", format!("forward: {what}; use unbounded"));
        let back = mean(|camera| camera.pose.matrix3.z_axis).normalize();
        let right = mean(|camera| camera.pose.matrix3.y_axis).cross(back).normalize();
        let (axes, middle) = (DMat3::from_cols(right, back.cross(right), back), mean(|camera| camera.pose.translation));
        if !(axes.is_finite() && middle.is_finite()) {
            return Err(bad("cameras look no way in common".into()));
        }
        let steepest = cameras.iter().flat_map(|camera| border(camera)).fold(DVec2::ZERO, |most, direction| {
            let local = axes.transpose() * direction;
            // What is level with the picture, or behind it, is infinitely wide.
            most.max(if local.z < 0.0 { local.xy().abs() / -local.z } else { DVec2::INFINITY })
        });
        if !(steepest.max_element() <= WIDEST) {
            let angle = steepest.max_element().atan().to_degrees();
            return Err(bad(format!(
                "photographs show what lies {angle:.0} degrees beside where they look on average"
            )));
        }
        let offsets: Vec<DVec3> = cameras.iter().map(|c| axes.transpose() * (c.pose.translation - middle)).collect();
        let low = offsets.iter().fold(DVec3::INFINITY, |low, offset| low.min(*offset));
        let high = offsets.iter().fold(DVec3::NEG_INFINITY, |high, offset| high.max(*offset));
        let moved = high - low;
        if moved.z > moved.xy().length() {
            return Err(bad("cameras move more along where they look than across it".into()));
        }
        let slopes = MARGIN * steepest;
        let behind = offsets.iter().map(|offset| (offset.xy().abs() / slopes).max_element() + offset.z);
        let behind = behind.fold(f64::NEG_INFINITY, f64::max);
        let near = near + behind - high.z;
        if !(near > 0.0 && near.is_finite()) {
            return Err(bad(format!("the near plane is {near} away, of cameras in one place")));
        }
        Ok(Ndc { eye: middle + behind * back, axes, slopes: slopes.to_array(), near })
    }

    /// Whether the numbers are usable.
    ///
    /// # Errors
    /// If one is not finite, or a length is not above 0.
    pub fn check(&self) -> Result<()> {
        let lengths = [self.slopes[0], self.slopes[1], self.near];
        if self.eye.is_finite() && self.axes.is_finite() && lengths.iter().all(|x| *x > 0.0 && x.is_finite()) {
            return Ok(());
        }
        Err(Error::setting("ndc", "holds a number that is out of range"))
    }

    /// How many pixels of a camera lie side by side across the picture.
    pub fn pixels(&self, camera: &Camera) -> f64 {
        (0..2).map(|axis| 2.0 * self.slopes[axis] * camera.focal[axis]).fold(0.0, f64::max)
    }
}

/// Directions of rays along the border of an image.
fn border(camera: &Camera) -> impl Iterator<Item = DVec3> {
    let [width, height] = [camera.width as f64, camera.height as f64];
    let shares = (0..=BORDER).map(|i| i as f64 / BORDER as f64);
    let places = shares.flat_map(|share| [[share, 0.0], [share, 1.0], [0.0, share], [1.0, share]]);
    places.map(move |[x, y]| camera.ray(x * width, y * height).direction)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::lens::Lens;

    /// Looks along +y from a place, turned by so many degrees to the left.
    fn camera(eye: [f64; 3], degrees: f64) -> Camera {
        let (eye, (sin, cos)) = (DVec3::from(eye), degrees.to_radians().sin_cos());
        let pose = Camera::look_at(eye, eye + DVec3::new(-sin, cos, 0.0), DVec3::Z);
        Camera { focal: [100.0, 50.0], ..Camera::from_angle(100, 40, 0.8, pose) }
    }

    #[test]
    fn all_that_cameras_see_lies_in_the_picture_and_little_else() {
        let cameras = [camera([-1.0, 0.1, 0.0], 5.0), camera([1.0, -0.2, 0.3], -8.0), camera([0.3, 0.0, -0.4], 0.0)];
        let ndc = Ndc::around(&cameras, 0.5).unwrap();
        ndc.check().unwrap();
        assert!((ndc.axes.transpose() * ndc.axes).abs_diff_eq(DMat3::IDENTITY, 1e-12) && ndc.axes.determinant() > 0.0);
        assert!(ndc.axes.z_axis.distance(DVec3::NEG_Y) < 0.05 && ndc.axes.y_axis.z > 0.999, "{ndc:?}");
        let (mut widest, mut nearest) = (DVec2::ZERO, f64::INFINITY);
        for camera in &cameras {
            for direction in border(camera) {
                for distance in [0.5, 1.0, 30.0, 1e6] {
                    // A place at that depth before the camera.
                    let along = direction * (distance / -direction.dot(camera.pose.matrix3.z_axis));
                    let local = ndc.axes.transpose() * (camera.pose.translation + along - ndc.eye);
                    widest = widest.max(local.xy().abs() / -local.z / DVec2::from(ndc.slopes));
                    nearest = nearest.min(-local.z);
                }
            }
        }
        assert!(widest.max_element() <= 1.0 && widest.min_element() > 0.8, "{widest}");
        // Corners are nearer than the middle of a picture that is turned.
        assert!(nearest > 0.8 * ndc.near && nearest < 1.1 * ndc.near, "{nearest} {}", ndc.near);
        // The widest is a margin wider than the border of the one that is turned most, about 8 degrees beside the others.
        let expected = 1.05 * (0.5_f64.atan() + 8.0_f64.to_radians()).tan();
        assert!((ndc.slopes[0] - expected).abs() < 0.03, "{} {expected}", ndc.slopes[0]);
        assert!((ndc.pixels(&cameras[0]) - 200.0 * ndc.slopes[0]).abs() < 1e-9);
        let tall = Camera { focal: [50.0, 100.0], ..cameras[0].clone() };
        assert!((ndc.pixels(&tall) - (100.0 * ndc.slopes[0]).max(200.0 * ndc.slopes[1])).abs() < 1e-9);
    }

    #[test]
    fn one_camera_sees_its_own_picture() {
        let ndc = Ndc::around(&[camera([1.0, 2.0, 3.0], 0.0)], 0.7).unwrap();
        assert!(ndc.eye.distance(DVec3::new(1.0, 2.0, 3.0)) < 1e-12 && (ndc.near - 0.7).abs() < 1e-12);
        assert!((ndc.slopes[0] - 1.05 * 0.5).abs() < 1e-12 && (ndc.slopes[1] - 1.05 * 0.4).abs() < 1e-12, "{ndc:?}");
        // Two, half a width beside the middle, have it as far behind them as it takes; the near plane is that of the hinder one.
        let pair = [camera([-0.42, 0.1, 0.0], 0.0), camera([0.42, 0.1, 0.0], 0.0), camera([0.0, 0.0, 0.0], 0.0)];
        let ndc = Ndc::around(&pair, 0.0).unwrap();
        assert!(ndc.eye.distance(DVec3::new(0.0, 0.1 - 0.8, 0.0)) < 1e-12, "{}", ndc.eye);
        assert!((ndc.near - 0.7).abs() < 1e-12, "{}", ndc.near);
        let eye = DVec3::new(0.0, f64::NAN, 0.0);
        for bad in [
            Ndc { eye, ..ndc },
            Ndc { axes: DMat3::from_diagonal(eye), ..ndc },
            Ndc { slopes: [0.0, 1.0], ..ndc },
            Ndc { slopes: [1.0, f64::INFINITY], ..ndc },
            Ndc { near: -1.0, ..ndc },
        ] {
            assert!(bad.check().unwrap_err().to_string().contains("`ndc`"), "{bad:?}");
        }
    }

    #[test]
    fn cameras_that_do_not_all_look_ahead_are_told_so() {
        let error = |cameras: &[Camera], near: f64| Ndc::around(cameras, near).unwrap_err().to_string();
        let turned = [camera([0.0; 3], 0.0), camera([1.0, 0.0, 0.0], 80.0)];
        assert!(error(&turned, 1.0).contains("67 degrees beside"), "{}", error(&turned, 1.0));
        let opposite = [camera([0.0; 3], 0.0), camera([1.0, 0.0, 0.0], 180.0)];
        assert!(error(&opposite, 1.0).ends_with("use unbounded"), "{}", error(&opposite, 1.0));
        let walk = [camera([0.0; 3], 0.0), camera([0.3, 0.6, 0.3], 0.0)];
        assert!(error(&walk, 1.0).contains("along"), "{}", error(&walk, 1.0));
        assert!(error(&[camera([0.0; 3], 0.0)], 0.0).contains("near plane is 0 away"));
        assert!(error(&[camera([0.0; 3], 0.0)], f64::NAN).contains("near plane"));
        assert!(error(&[], 1.0).contains("no way in common"));
        let panorama = Camera { lens: Lens::Equirectangular, focal: [16.0; 2], ..camera([0.0; 3], 0.0) };
        assert!(error(&[panorama], 1.0).contains("degrees beside"));
    }
}
