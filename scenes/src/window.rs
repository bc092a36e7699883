//! Forward-facing cameras in front of the bulldozer in the landscape.

use std::f64::consts::PI;

use glam::{DMat3, DVec3};

use super::scenery::GROUND;
use raygrad_nerf::Camera;
use raygrad_nerf::dataset::Split;

/// Horizontal field of view in radians.
const ANGLE_X: f64 = PI / 3.0;
/// Training images, from left to right and from bottom to top.
const TRAIN: [usize; 2] = [6, 5];
/// The distance between neighbouring cameras, in scene units.
const APART: [f64; 2] = [0.3, 0.25];

/// Returns the cameras of a split of [`landscape_ahead`](crate::landscape_ahead): 30 training, 3 validation or 6 test
/// cameras.
///
/// Images are `width` pixels wide and three quarters of that high. All look over the bulldozer to the hills, with a
/// little shake. Held-out cameras stand between the training cameras.
pub fn window_cameras(split: Split, width: usize) -> Vec<Camera> {
    let [columns, rows] = TRAIN;
    let places: Vec<[f64; 2]> = match split {
        Split::Train => (0..columns * rows).map(|i| [(i % columns) as f64, (i / columns) as f64]).collect(),
        Split::Val => (0..3).map(|i| [1.0 + 1.5 * f64::from(i), 1.5]).collect(),
        Split::Test => (0..6).map(|i| [0.6 + 1.4 * f64::from(i % 3), 1.4 + f64::from(i / 3)]).collect(),
    };
    places.into_iter().map(|place| camera(place, width)).collect()
}

/// The camera at a position of the lattice.
fn camera([column, row]: [f64; 2], width: usize) -> Camera {
    let shake = |a: f64, b: f64| (a * column + b * row + a * b).sin();
    let side = (column - 0.5 * (TRAIN[0] - 1) as f64) * APART[0] + 0.1 * shake(1.7, 2.3);
    let height = 0.4 + row * APART[1] + 0.08 * shake(3.1, 1.3);
    let eye = DVec3::new(3.9 + 0.1 * shake(2.9, 4.1), side, GROUND + height);
    let ahead = DVec3::new(-1.0, 0.06 * shake(4.7, 3.7), -0.1 + 0.06 * shake(5.3, 2.1));
    let mut pose = Camera::look_at(eye, eye + ahead, DVec3::Z);
    pose.matrix3 *= DMat3::from_rotation_z(0.03 * shake(7.7, 1.1));
    Camera::from_angle(width, width / 4 * 3, ANGLE_X, pose)
}

#[cfg(test)]
mod tests {
    use super::super::Landscape;
    use super::*;
    use raygrad_nerf::Ndc;

    #[test]
    fn window_test_cameras_are_between_train_cameras() {
        assert_eq!(Split::ALL.map(|split| window_cameras(split, 8).len()), [30, 3, 6]);
        let [low, high] = Landscape::new().bulldozer_bounds();
        let train = window_cameras(Split::Train, 400);
        for camera in Split::ALL.into_iter().flat_map(|split| window_cameras(split, 400)) {
            assert_eq!([camera.width, camera.height], [400, 300]);
            let [x, y] = camera.pixel_of(0.5 * (low + high)).unwrap();
            assert!((0.0..400.0).contains(&x) && (0.0..300.0).contains(&y), "{x} {y}");
            let near = |other: &&Camera| other.pose.translation.distance(camera.pose.translation) < 0.45;
            assert!(train.iter().filter(near).count() >= 3, "{}", camera.pose.translation);
        }
        // The cameras look ahead and are close to the frustum's eye.
        let near = Ndc::around(&train, 0.5).unwrap().near;
        assert!((1.0..3.0).contains(&near), "{near}");
    }
}
