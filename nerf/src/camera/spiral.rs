//! The spiral camera path of LLFF (Mildenhall et al. 2019).

use super::pinhole::Camera;
use crate::numbers::mean;
use glam::{DAffine3, DVec3};
use std::f64::consts::TAU;

/// Turns of the spiral.
const TURNS: f64 = 2.0;
/// Oscillations along the optical axis for each turn.
const TO_AND_FRO: f64 = 0.5;
/// The smallest length of the mean of unit vectors with a common direction: a cone with a half angle of 66 degrees has
/// it.
const LEAST_MEAN: f64 = 0.7;
/// The quantile of the cameras' offsets along an axis that becomes the amplitude.
const WITHIN: f64 = 0.9;

/// A spiral path around a pose that looks at one point (LLFF, Mildenhall et al. 2019).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Spiral {
    /// The pose at its centre.
    pub pose: DAffine3,
    /// Amplitudes along the pose's axes (right, up, back), in scene units.
    pub radii: [f64; 3],
    /// Distance from the centre pose to the point that cameras look at, in scene units.
    pub focus: f64,
}

impl Spiral {
    /// Finds a spiral around the average of cameras, with amplitudes that hold nine in ten of them and a focus of 1.
    ///
    /// Returns `None` if there are no cameras, or they have no common viewing direction.
    pub fn around(cameras: &[Camera]) -> Option<Self> {
        let mean = |of: fn(&Camera) -> DVec3| mean(cameras.iter().map(of));
        let (back, up) = (mean(|camera| camera.pose.matrix3.z_axis), mean(|camera| camera.pose.matrix3.y_axis));
        let middle = mean(|camera| camera.pose.translation);
        if !(back.length() >= LEAST_MEAN && up.length() >= LEAST_MEAN) {
            return None;
        }
        let pose = Camera::look_at(middle, middle - back, up);
        let offsets = cameras.iter().map(|camera| pose.matrix3.transpose() * (camera.pose.translation - middle));
        let offsets: Vec<DVec3> = offsets.map(DVec3::abs).collect();
        let radii = [0, 1, 2].map(|axis| within(offsets.iter().map(|offset| offset[axis]).collect()));
        Some(Spiral { pose, radii, focus: 1.0 })
    }

    /// Returns `count` poses that look at the focus; the last leads back to the first.
    ///
    /// At the angle `a` the position is `(r0 cos a, -r1 sin a, -r2 sin(a / 2))` along the axes of the centre pose.
    pub fn poses(&self, count: usize) -> Vec<DAffine3> {
        let Spiral { pose, radii: [right, up, back], focus } = *self;
        let target = pose.transform_point3(DVec3::new(0.0, 0.0, -focus));
        let at = |i: usize| {
            let angle = TURNS * TAU * i as f64 / count as f64;
            let offset = DVec3::new(right * angle.cos(), -up * angle.sin(), -back * (TO_AND_FRO * angle).sin());
            Camera::look_at(pose.transform_point3(offset), target, pose.matrix3.y_axis)
        };
        (0..count).map(at).collect()
    }
}

/// The [`WITHIN`] quantile of the values, with linear interpolation.
fn within(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    let at = WITHIN * (values.len() - 1) as f64;
    let (below, above) = (values[at as usize], values[at.ceil() as usize]);
    below + (at - at.floor()) * (above - below)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spiral_matches_llff_code() {
        // `render_path_spiral` and `poses_avg` of LLFF's `load_llff.py`, evaluated by hand for a rotated centre pose.
        let pose = Camera::look_at(DVec3::new(1.0, -4.0, 2.0), DVec3::new(0.5, 3.0, 1.0), DVec3::Z);
        let spiral = Spiral { pose, radii: [0.5, 0.3, 0.2], focus: 6.0 };
        let poses = spiral.poses(8);
        let target = pose.translation - 6.0 * pose.matrix3.z_axis;
        let root = 0.5_f64.sqrt();
        // Angles are multiples of half a turn; the third coordinate uses half the angle.
        for (i, expected) in [
            (0, [0.5, 0.0, 0.0]),
            (1, [0.0, -0.3, -0.2 * root]),
            (2, [-0.5, 0.0, -0.2]),
            (3, [0.0, 0.3, -0.2 * root]),
            (5, [0.0, -0.3, 0.2 * root]),
            (6, [-0.5, 0.0, 0.2]),
        ] {
            let local = pose.inverse().transform_point3(poses[i].translation);
            assert!(local.distance(DVec3::from(expected)) < 1e-12, "{i}: {local}");
        }
        for pose in poses {
            let to = (target - pose.translation).normalize();
            assert!(to.distance(-pose.matrix3.z_axis) < 1e-12 && (pose.matrix3.determinant() - 1.0).abs() < 1e-12);
            assert!(pose.matrix3.x_axis.dot(spiral.pose.matrix3.y_axis).abs() < 1e-12, "its horizon is level");
        }
    }

    #[test]
    fn spiral_winds_around_the_average_camera() {
        // Eleven cameras in a row, 1 apart, all looking along -y. Heights and depths vary less.
        let camera = |i: usize| {
            let x = i as f64;
            let eye = DVec3::new(x, 2.0 + 0.01 * x, 5.0 - 0.1 * x);
            Camera::from_angle(40, 30, 0.8, Camera::look_at(eye, eye - DVec3::Y, DVec3::Z))
        };
        let cameras: Vec<Camera> = (0..11).map(camera).collect();
        let spiral = Spiral::around(&cameras).unwrap();
        assert!(spiral.pose.translation.distance(DVec3::new(5.0, 2.05, 4.5)) < 1e-12);
        assert!(spiral.pose.matrix3.z_axis.distance(DVec3::Y) < 1e-12);
        assert!(spiral.pose.matrix3.y_axis.distance(DVec3::Z) < 1e-12);
        // The distances are 0 and twice each of 1 to 5. The 0.9 quantile of these eleven is the tenth.
        for (radius, unit) in spiral.radii.iter().zip([1.0, 0.1, 0.01]) {
            assert!((radius - 5.0 * unit).abs() < 1e-12, "{:?}", spiral.radii);
        }
        let few = Spiral::around(&cameras[..3]).unwrap();
        // The quantile of 0, 1 and 1 is 1. A single camera has amplitudes of 0.
        assert!((few.radii[0] - 1.0).abs() < 1e-12);
        assert_eq!(Spiral::around(&cameras[..1]).unwrap().radii, [0.0; 3]);
        assert!((within(vec![3.0, 1.0]) - 2.8).abs() < 1e-12);
        assert!(Spiral::around(&[]).is_none());
        let opposite = Camera::look_at(DVec3::ZERO, DVec3::Y, DVec3::Z);
        assert!(Spiral::around(&[camera(0), Camera { pose: opposite, ..camera(0) }]).is_none());
    }
}
