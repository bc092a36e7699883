//! Normalised device coordinates (NDC) for forward-facing scenes.

use super::pinhole::Camera;
use crate::numbers::{mean, median};
use crate::{Error, Result};
use glam::{DMat3, DVec2, DVec3, Vec3Swizzles};
use serde::{Deserialize, Serialize};

/// The NDC frustum of a forward-facing scene (Mildenhall et al. 2020, appendix C).
///
/// [`Space::cube`](crate::Space::cube) maps it to the unit cube: x and y are image coordinates, z is even in inverse
/// depth, from the near plane to infinity. Straight lines stay straight. The paper uses the frustum of one camera,
/// which crops what other cameras see. This frustum starts far enough behind the cameras to hold all of theirs.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Ndc {
    /// Centre of projection, behind the cameras. Unit: scene units.
    pub eye: DVec3,
    /// Right, up and back axis of the projection, each of length 1.
    pub axes: DMat3,
    /// Half of the width and height of the projection at depth 1: the tangents of half its angles of view. Range:
    /// more than 0.
    pub slopes: [f64; 2],
    /// Depth of the near plane. Nearer points are moved onto it. Unit: scene units. Range: more than 0.
    pub near: f64,
}

/// The factor by which the frustum exceeds the cameras' views. Renders come from poses beside the cameras, and pose
/// refinement moves cameras.
const MARGIN: f64 = 1.1;
/// The largest width of the frustum, as a multiple of the median camera's. It allows rotations of 15 degrees to either
/// side at a width of 60 degrees.
const TURNED: f64 = 1.75;
/// The largest distance of a camera from the mean position, as a multiple of the median distance.
const LOST: f64 = 5.0;

impl Ndc {
    /// Finds the frustum of everything that cameras see beyond the distance `near` from each.
    ///
    /// # Errors
    /// If there is no camera, or the scene is not forward-facing. In such a scene cameras look in one direction, move
    /// more across their axes than along them, and none is far from all others.
    pub fn around<'a>(cameras: impl IntoIterator<Item = &'a Camera>, near: f64) -> Result<Self> {
        let cameras: Vec<&Camera> = cameras.into_iter().collect();
        let mean = |of: fn(&Camera) -> DVec3| mean(cameras.iter().map(|camera| of(camera)));
        let bad =
            |what: &str| Err(Error::setting("scene-type", format!("cannot be forward-facing: {what}; use unbounded")));
        let back = mean(|camera| camera.pose.matrix3.z_axis).normalize();
        // The mean of a flight to and fro has no up direction.
        let up = mean(|camera| camera.pose.matrix3.y_axis);
        let up = if up.length() < 0.1 { cameras.first().map_or(up, |camera| camera.pose.matrix3.y_axis) } else { up };
        let right = up.cross(back).normalize();
        let (axes, middle) = (DMat3::from_cols(right, back.cross(right), back), mean(|camera| camera.pose.translation));
        if !(axes.is_finite() && middle.is_finite()) {
            return bad("cameras have no common viewing direction");
        }
        let slopes = |camera: &Camera, axes: DMat3| {
            camera.border().fold(DVec2::ZERO, |most, direction| {
                let local = axes.transpose() * direction;
                // Directions parallel to the image plane or behind it make the frustum infinitely wide.
                most.max(if local.z < 0.0 { local.xy().abs() / -local.z } else { DVec2::INFINITY })
            })
        };
        let steepest = cameras.iter().fold(DVec2::ZERO, |most, camera| most.max(slopes(camera, axes)));
        let usual = median(cameras.iter().map(|camera| slopes(camera, camera.pose.matrix3).max_element()));
        if !(steepest.max_element() <= TURNED * usual && usual.is_finite()) {
            return bad("cameras look in different directions");
        }
        let offsets: Vec<DVec3> = cameras.iter().map(|c| axes.transpose() * (c.pose.translation - middle)).collect();
        let low = offsets.iter().fold(DVec3::INFINITY, |low, offset| low.min(*offset));
        let high = offsets.iter().fold(DVec3::NEG_INFINITY, |high, offset| high.max(*offset));
        let moved = high - low;
        if moved.z > moved.xy().length() {
            return bad("cameras move more along their viewing direction than across it");
        }
        let farthest = offsets.iter().fold(0.0, |most: f64, offset| most.max(offset.length()));
        if farthest > LOST * median(offsets.iter().map(|offset| offset.length())) {
            return bad("a camera is far from all others");
        }
        let slopes = MARGIN * steepest;
        let behind = offsets.iter().map(|offset| (offset.xy().abs() / slopes).max_element() + offset.z);
        let behind = behind.fold(f64::NEG_INFINITY, f64::max);
        let ndc = Ndc { eye: middle + behind * back, axes, slopes: slopes.to_array(), near: behind - high.z };
        let ndc = ndc.with_near(0.0, near);
        ndc.check()?;
        Ok(ndc)
    }

    /// Returns the frustum for a near plane of `to`, where that of [`around`](Self::around) was `from`.
    #[must_use]
    pub fn with_near(self, from: f64, to: f64) -> Self {
        // `near` is a distance along rays, and the rays through the corners are longer than their depth.
        let depth = 1.0 / (1.0 + self.slopes[0].powi(2) + self.slopes[1].powi(2)).sqrt();
        Ndc { near: self.near + depth * (to - from), ..self }
    }

    /// Checks that all values are in range.
    ///
    /// # Errors
    /// If a number is not finite, a length is not above 0, or the axes are not a rotation.
    pub fn check(&self) -> Result<()> {
        let lengths = [self.slopes[0], self.slopes[1], self.near];
        let turns = (self.axes.transpose() * self.axes).abs_diff_eq(DMat3::IDENTITY, 1e-6);
        if self.eye.is_finite() && turns && lengths.iter().all(|x| *x > 0.0 && x.is_finite()) {
            return Ok(());
        }
        Err(Error::setting("ndc", "needs a near plane and slopes above 0, a finite eye, and axes that are a rotation"))
    }

    /// Returns whether a point (scene units) is in the frustum, beyond its near plane.
    pub fn contains(&self, place: DVec3) -> bool {
        let local = self.axes.transpose() * (place - self.eye);
        let widths = -local.z * DVec2::from(self.slopes);
        -local.z >= self.near && local.xy().abs().cmple(widths).all()
    }

    /// Returns the number of a camera's pixels across the frustum at the depth of `place`.
    pub fn pixels(&self, camera: &Camera, place: DVec3) -> f64 {
        let depth = self.axes.z_axis.dot(self.eye - place).max(self.near);
        let ahead = self.axes.z_axis.dot(self.eye - camera.pose.translation);
        let wide = (0..2).map(|axis| 2.0 * self.slopes[axis] * camera.focal[axis]).fold(0.0, f64::max);
        // A camera may be at the point, or beyond it.
        wide * depth / (depth - ahead).max(1e-3 * depth)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::lens::Lens;

    /// A camera that looks along +y from `eye`, turned to the left by `degrees`, with a view 53 degrees wide and 44
    /// high.
    fn camera(eye: [f64; 3], degrees: f64) -> Camera {
        let (eye, (sin, cos)) = (DVec3::from(eye), degrees.to_radians().sin_cos());
        let pose = Camera::look_at(eye, eye + DVec3::new(-sin, cos, 0.0), DVec3::Z);
        Camera { focal: [100.0, 50.0], ..Camera::from_angle(100, 40, 0.8, pose) }
    }

    #[test]
    fn ndc_contains_the_views_of_all_cameras() {
        let cameras = [camera([-1.0, 0.1, 0.0], 5.0), camera([1.0, -0.2, 0.3], 12.0), camera([0.3, 0.0, -0.4], 1.0)];
        let ndc = Ndc::around(&cameras, 0.5).unwrap();
        ndc.check().unwrap();
        assert!(ndc.axes.determinant() > 0.0 && ndc.axes.y_axis.z > 0.999, "{ndc:?}");
        let (sin, cos) = 6.0_f64.to_radians().sin_cos();
        assert!(ndc.axes.z_axis.distance(DVec3::new(sin, -cos, 0.0)) < 1e-3, "the mean of where they look: {ndc:?}");
        let (mut widest, mut nearest) = (DVec2::ZERO, f64::INFINITY);
        for camera in &cameras {
            for i in 0..=40 {
                let [x, y] = [(i % 8) as f64 / 7.0 * 100.0, (i / 8) as f64 / 5.0 * 40.0];
                for distance in [0.5, 1.0, 30.0, 1e6] {
                    let local = ndc.axes.transpose() * (camera.ray(x, y).at(distance) - ndc.eye);
                    assert!(local.is_finite() && local.z < 0.0, "{local}");
                    widest = widest.max(local.xy().abs() / -local.z / DVec2::from(ndc.slopes));
                    nearest = nearest.min(-local.z);
                }
            }
        }
        assert!(widest.max_element() <= 1.0 && widest.min_element() > 0.8, "{widest}");
        let inside = |x: f64, y: f64, depth: f64| {
            let local = DVec3::new(x * ndc.slopes[0], y * ndc.slopes[1], -1.0) * depth * ndc.near;
            ndc.contains(ndc.eye + ndc.axes * local)
        };
        assert!(inside(0.99, -0.99, 1.01) && inside(-0.99, 0.99, 50.0));
        assert!(
            !inside(0.0, 0.0, 0.99) && !inside(1.01, 0.0, 2.0) && !inside(0.0, -1.01, 2.0) && !inside(0.0, 0.0, -2.0)
        );
        assert!(nearest >= ndc.near && nearest < ndc.near + 0.1, "{nearest} {}", ndc.near);
        // The margin is added to the camera that is turned most: by 6 degrees from the mean, towards negative x.
        let expected = 1.1 * (0.5_f64.atan() + 6.0_f64.to_radians()).tan();
        assert!((ndc.slopes[0] - expected).abs() < 0.01, "{} {expected}", ndc.slopes[0]);
        let mirrored =
            cameras.map(|c| Camera { pose: glam::DAffine3::from_scale(DVec3::new(-1.0, 1.0, 1.0)) * c.pose, ..c });
        let mirrored = mirrored.map(|mut c| {
            c.pose.matrix3.x_axis *= -1.0;
            c
        });
        let other = Ndc::around(&mirrored, 0.5).unwrap();
        assert!(
            (DVec2::from(other.slopes) - DVec2::from(ndc.slopes)).length() < 1e-9
                && (other.near - ndc.near).abs() < 1e-9
        );
    }

    #[test]
    fn ndc_of_one_camera_is_its_view() {
        let alone = camera([1.0, 2.0, 3.0], 0.0);
        let ndc = Ndc::around([&alone], 0.7).unwrap();
        assert!(ndc.eye.distance(DVec3::new(1.0, 2.0, 3.0)) < 1e-12, "{}", ndc.eye);
        assert!((ndc.slopes[0] - 1.1 * 0.5).abs() < 1e-12 && (ndc.slopes[1] - 1.1 * 0.4).abs() < 1e-12, "{ndc:?}");
        // The near plane is at the depth of corners at the distance 0.7.
        let depth = 0.7 / (1.0 + 0.55_f64.powi(2) + 0.44_f64.powi(2)).sqrt();
        assert!((ndc.near - depth).abs() < 1e-12, "{}", ndc.near);
        assert!((ndc.with_near(0.7, 1.4).near - 2.0 * depth).abs() < 1e-12);
        // The pixels are counted at the depth of the point, which is at least the near plane.
        assert!((ndc.pixels(&alone, DVec3::new(9.0, 5.0, 1.0)) - 110.0).abs() < 1e-9);
        let tall = Camera { focal: [50.0, 200.0], ..alone.clone() };
        assert!((ndc.pixels(&tall, DVec3::new(9.0, 5.0, 1.0)) - 176.0).abs() < 1e-9);
        // Of three cameras, half a width beside the middle, the eye is behind all; the rearmost sets the near plane.
        let row = [camera([-0.44, 0.1, 0.0], 0.0), camera([0.44, 0.1, 0.0], 0.0), camera([0.0, 0.0, 0.0], 0.0)];
        let ndc = Ndc::around(&row, 0.0).unwrap();
        assert!(ndc.eye.distance(DVec3::new(0.0, 0.1 - 0.8, 0.0)) < 1e-12, "{}", ndc.eye);
        assert!((ndc.near - 0.7).abs() < 1e-12, "{}", ndc.near);
        assert!((ndc.pixels(&row[2], DVec3::Y) - 110.0 * 1.7).abs() < 1e-9, "farther from the eye");
        assert!(
            (ndc.pixels(&row[2], 0.2 * DVec3::Y) - 110.0 * 4.5).abs() < 1e-9,
            "and nearer than the near plane is to it"
        );
        assert!((ndc.pixels(&row[2], DVec3::ZERO) - 110.0 * 1e3).abs() < 1e-6);
        let eye = DVec3::new(0.0, f64::NAN, 0.0);
        for bad in [
            Ndc { eye, ..ndc },
            Ndc { axes: DMat3::ZERO, ..ndc },
            Ndc { axes: DMat3::from_diagonal(eye), ..ndc },
            Ndc { slopes: [0.0, 1.0], ..ndc },
            Ndc { slopes: [1.0, f64::INFINITY], ..ndc },
            Ndc { near: -1.0, ..ndc },
        ] {
            assert!(bad.check().unwrap_err().to_string().contains("`ndc`"), "{bad:?}");
        }
    }

    #[test]
    fn ndc_of_flight_to_and_fro_has_an_up_axis() {
        // Cameras look down; every other strip is turned by half a turn.
        let strip = |i: usize| {
            let eye = DVec3::new(i as f64, 0.1 * i as f64, 9.0);
            let up = if i.is_multiple_of(2) { DVec3::Y } else { DVec3::NEG_Y };
            Camera::from_angle(40, 30, 0.8, Camera::look_at(eye, eye - DVec3::Z, up))
        };
        let flight: Vec<Camera> = (0..4).map(strip).collect();
        let ndc = Ndc::around(&flight, 1.0).unwrap();
        assert!(ndc.axes.abs_diff_eq(DMat3::IDENTITY, 1e-12), "{ndc:?}");
    }

    #[test]
    fn ndc_of_other_scenes_is_an_error() {
        let error = |cameras: &[Camera], near: f64| Ndc::around(cameras, near).unwrap_err().to_string();
        // Half of the median width is 27 degrees; the tangent of 41 degrees is 1.75 times as large.
        let turned = |degrees: f64| [camera([0.0; 3], -degrees), camera([1.0, 0.0, 0.0], degrees)];
        assert!(Ndc::around(&turned(14.0), 1.0).is_ok());
        assert!(
            error(&turned(15.0), 1.0).contains("cameras look in different directions"),
            "{}",
            error(&turned(15.0), 1.0)
        );
        // An arc of 60 degrees around an object is not forward-facing either.
        let arc = |degrees: f64| {
            let (sin, cos) = degrees.to_radians().sin_cos();
            camera([4.0 * sin, -4.0 * cos, 0.0], degrees)
        };
        assert!(error(&[-30.0, -10.0, 10.0, 30.0].map(arc), 1.0).contains("cameras look in different directions"));
        let opposite = [camera([0.0; 3], 0.0), camera([1.0, 0.0, 0.0], 180.0)];
        assert!(error(&opposite, 1.0).ends_with("use unbounded"), "{}", error(&opposite, 1.0));
        let walk = |ahead: f64| [camera([0.0; 3], 0.0), camera([0.3, ahead, 0.3], 0.0)];
        assert!(Ndc::around(&walk(0.4), 1.0).is_ok());
        assert!(error(&walk(0.45), 1.0).contains("along"), "{}", error(&walk(0.45), 1.0));
        let mut row: Vec<Camera> = (0..9).map(|i| camera([f64::from(i), 0.0, 0.0], 0.0)).collect();
        assert!(Ndc::around(&row, 1.0).is_ok());
        row.push(camera([300.0, 0.0, 0.0], 0.0));
        assert!(error(&row, 1.0).contains("far from all others"), "{}", error(&row, 1.0));
        assert!(error(&[camera([0.0; 3], 0.0)], 0.0).contains("near plane"));
        assert!(error(&[camera([0.0; 3], 0.0)], f64::NAN).contains("near plane"));
        assert!(error(&[], 1.0).contains("cameras have no common viewing direction"));
        let panorama = Camera { lens: Lens::Equirectangular, focal: [16.0; 2], ..camera([0.0; 3], 0.0) };
        assert!(error(&[panorama], 1.0).contains("cameras look in different directions"));
    }
}
