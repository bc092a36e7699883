//! Cameras around a scene at the origin, placed as in the synthetic scenes of the NeRF paper.

use std::f64::consts::{PI, TAU};

use glam::DVec3;

use super::golden::GOLDEN_ANGLE;
use raygrad_nerf::Camera;

/// Distance from the origin to every camera, in scene units.
pub const DISTANCE: f64 = 4.0;
/// Horizontal field of view in radians.
pub const ANGLE_X: f64 = 0.6911112;
/// Elevation of the [`test_cameras`] above the horizon, in radians.
const ORBIT_ELEVATION: f64 = PI / 6.0;

/// Returns `count` training cameras, spread evenly over the upper hemisphere, for square images of `size` pixels a
/// side.
pub fn train_cameras(count: usize, size: usize) -> Vec<Camera> {
    spiral(count, size, 0.5, 0.5)
}

/// Returns `count` validation cameras, as [`train_cameras`] from other points.
pub fn val_cameras(count: usize, size: usize) -> Vec<Camera> {
    spiral(count, size, 0.3, 1.0)
}

/// Returns `count` test cameras on a circle around the scene, evenly spaced and in order, as for a turntable video.
pub fn test_cameras(count: usize, size: usize) -> Vec<Camera> {
    (0..count).map(|i| camera(i as f64 / count as f64 * TAU, ORBIT_ELEVATION.sin(), size)).collect()
}

/// Points on a golden-angle spiral: bands of equal height have equal area on a sphere.
///
/// `shift` in 0..1 places each point within its band, and `turn` rotates the spiral, in radians.
fn spiral(count: usize, size: usize, shift: f64, turn: f64) -> Vec<Camera> {
    (0..count).map(|i| camera(turn + i as f64 * GOLDEN_ANGLE, (i as f64 + shift) / count as f64, size)).collect()
}

/// The camera at an azimuth in radians and a height in 0..1 on the unit hemisphere.
fn camera(azimuth: f64, height: f64, size: usize) -> Camera {
    let radius = (1.0 - height * height).sqrt();
    let eye = DISTANCE * DVec3::new(radius * azimuth.cos(), radius * azimuth.sin(), height);
    Camera::from_angle(size, size, ANGLE_X, Camera::look_at(eye, DVec3::ZERO, DVec3::Z))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cameras_on_hemisphere_look_at_origin() {
        for camera in [train_cameras(60, 20), val_cameras(10, 20), test_cameras(20, 20)].concat() {
            let eye = camera.pose.translation;
            assert!((eye.length() - DISTANCE).abs() < 1e-12 && eye.z > 0.0);
            assert!((camera.ray(10.0, 10.0).at(DISTANCE)).length() < 1e-12);
            assert!((camera.pose.matrix3.determinant() - 1.0).abs() < 1e-12);
            // The horizon is level.
            assert!(camera.pose.matrix3.x_axis.z.abs() < 1e-12);
        }
    }

    #[test]
    fn views_are_distinct() {
        for [train, val, test] in (1..60).map(|n| [n; 3]).chain([[60, 10, 20], [100, 100, 200]]) {
            let cameras = [train_cameras(train, 8), val_cameras(val, 8), test_cameras(test, 8)].concat();
            for (i, a) in cameras.iter().enumerate() {
                let distances = cameras[..i].iter().map(|b| a.pose.translation.distance(b.pose.translation));
                let nearest = distances.fold(f64::INFINITY, f64::min);
                assert!(nearest > 0.005, "{nearest} from view {i} of {train} + {val} + {test}");
            }
        }
    }

    #[test]
    fn train_views_leave_no_gap() {
        let cameras = train_cameras(60, 8);
        for direction in train_cameras(2000, 8).iter().map(|camera| camera.pose.translation) {
            let angles = cameras.iter().map(|camera| camera.pose.translation.angle_between(direction));
            assert!(angles.fold(f64::INFINITY, f64::min) < 0.35);
        }
    }
}
