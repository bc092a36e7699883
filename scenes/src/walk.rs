//! Cameras of a walk around the bulldozer with a phone.

use std::f64::consts::{PI, TAU};

use glam::{DMat3, DVec2, DVec3};

use super::scenery::GROUND;
use raygrad_nerf::Camera;
use raygrad_nerf::dataset::Split;

/// Horizontal field of view in radians.
const ANGLE_X: f64 = PI / 3.0;
/// The laps around the bulldozer, in scene units. Each has the camera's height above the ground, its distance from the
/// vertical axis, and the height of the point on that axis at which it looks.
const LAPS: [[f64; 3]; 3] = [[0.65, 3.75, 0.7], [1.45, 4.1, 0.85], [2.4, 4.2, 1.0]];
/// Number of training images.
const TRAIN: usize = 100;

/// Returns the cameras of a split of the landscape: 100 training, 10 validation or 20 test cameras.
///
/// Images are `width` pixels wide and three quarters of that high. All show the bulldozer and the landscape behind it.
/// Training cameras are evenly spaced on three laps; the others lie half way between them.
pub fn walk_cameras(split: Split, width: usize) -> Vec<Camera> {
    let ways: Vec<f64> = match split {
        Split::Train => (0..TRAIN).map(|i| i as f64 + 0.5).collect(),
        Split::Val => (0..10).map(|i| 10.0 * i as f64 + 6.0).collect(),
        Split::Test => (0..20).map(|i| 5.0 * i as f64 + 3.0).collect(),
    };
    ways.into_iter().map(|way| camera(way / TRAIN as f64, width)).collect()
}

/// The camera at a share of the way, 0..1. The sway of the hand is a sum of sines with unrelated periods, in views.
fn camera(way: f64, width: usize) -> Camera {
    let laps = LAPS.len() as f64 * way;
    let lap = (laps as usize).min(LAPS.len() - 1);
    let [from, to] = [lap, (lap + 1).min(LAPS.len() - 1)].map(|lap| DVec3::from(LAPS[lap]));
    // Towards the end of a lap the camera moves to the next one.
    let [height, distance, aim] = from.lerp(to, ((laps.fract() - 0.8) / 0.2).max(0.0)).to_array();
    let sway = |period: f64| (TAU * way * TRAIN as f64 / period).sin();
    let azimuth = TAU * laps;
    let ground = GROUND * DVec3::Z;
    let place = (distance + 0.2 * sway(4.3)) * DVec2::from_angle(azimuth);
    let eye = ground + place.extend(height + 0.1 * sway(2.7));
    let side = 0.12 * sway(3.1) * DVec2::from_angle(azimuth).perp();
    let mut pose = Camera::look_at(eye, ground + side.extend(aim + 0.08 * sway(5.9)), DVec3::Z);
    pose.matrix3 *= DMat3::from_rotation_z(0.05 * sway(3.7));
    Camera::from_angle(width, width / 4 * 3, ANGLE_X, pose)
}

#[cfg(test)]
mod tests {
    use super::super::Landscape;
    use super::*;
    use raygrad_nerf::Ray;

    fn all(width: usize) -> Vec<Camera> {
        Split::ALL.into_iter().flat_map(|split| walk_cameras(split, width)).collect()
    }

    #[test]
    fn landscape_cameras_walk_around_the_bulldozer() {
        assert_eq!(Split::ALL.map(|split| walk_cameras(split, 8).len()), [100, 10, 20]);
        for camera in all(400) {
            let eye = camera.pose.translation;
            let (height, distance) = (eye.z - GROUND, eye.distance(DVec3::ZERO));
            assert!((0.5..=3.0).contains(&height) && (3.5..=5.0).contains(&distance), "{height} {distance}");
            assert_eq!([camera.width, camera.height], [400, 300]);
            // Three quarters of the half angle; upright except for some roll.
            assert!((camera.focal[0] - 200.0 / (PI / 6.0).tan()).abs() < 1e-9 && camera.focal[0] == camera.focal[1]);
            assert!(camera.pose.matrix3.x_axis.z.abs() < 0.06 && camera.pose.matrix3.y_axis.z > 0.9);
        }
    }

    #[test]
    fn landscape_cameras_see_whole_bulldozer() {
        let landscape = Landscape::new();
        let [min, max] = landscape.bulldozer_bounds();
        for camera in all(400) {
            let eye = camera.pose.translation;
            for corner in 0..8 {
                let pick = |i: usize| if corner >> i & 1 == 0 { min[i] } else { max[i] };
                let point = DVec3::new(pick(0), pick(1), pick(2));
                let [x, y] = camera.pixel_of(point).unwrap();
                assert!((0.0..400.0).contains(&x) && (0.0..300.0).contains(&y), "{x} {y} of {point}");
                // On the way to the box's corners the first hit is the box, or it is missed closely.
                let way = point - eye;
                let hit = landscape.trace(&Ray { origin: eye, direction: way.normalize() });
                assert!(hit.is_none_or(|hit| hit.distance > way.length() - 2.9), "{hit:?} on the way to {point}");
            }
        }
    }

    #[test]
    fn landscape_test_views_lie_between_train_views() {
        let cameras = all(8);
        for (i, a) in cameras.iter().enumerate() {
            assert!(cameras[..i].iter().all(|b| a.pose.translation.distance(b.pose.translation) > 0.01), "view {i}");
        }
        let train = walk_cameras(Split::Train, 8);
        for camera in [walk_cameras(Split::Val, 8), walk_cameras(Split::Test, 8)].concat() {
            let near = train.iter().filter(|b| b.pose.translation.distance(camera.pose.translation) < 0.6).count();
            assert!(near >= 2, "{} has {near} neighbours", camera.pose.translation);
        }
    }
}
