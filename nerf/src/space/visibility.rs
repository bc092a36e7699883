//! Cells outside of every training camera's view.

use crate::camera::pinhole::Camera;
use crate::dataset::Dataset;
use crate::space::occupancy::OccupancyGrid;
use glam::DVec3;

/// A cone around a camera's field of view.
struct Cone {
    eye: DVec3,
    axis: DVec3,
    /// The angle between the axis and the border, in radians.
    half_angle: f64,
}

impl Cone {
    fn new(camera: &Camera) -> Self {
        let [width, height] = [camera.width as f64, camera.height as f64];
        let axis = camera.ray(0.5 * width, 0.5 * height).direction;
        let half_angle = camera.border().map(|direction| direction.angle_between(axis)).fold(0.0, f64::max);
        Cone { eye: camera.pose.translation, axis, half_angle }
    }

    /// Returns true if a part of a ball may be visible beyond the distance `near`.
    fn sees(&self, centre: DVec3, radius: f64, near: f64) -> bool {
        let offset = centre - self.eye;
        let distance = offset.length();
        if distance + radius < near {
            return false;
        }
        distance <= radius || offset.angle_between(self.axis) <= self.half_angle + (radius / distance).asin()
    }
}

/// Permanently empties the cells outside of every camera's view: nothing is learned there, and floaters would be
/// visible from other cameras.
pub(crate) fn carve_unseen(grid: &mut OccupancyGrid, data: &Dataset) {
    let cones: Vec<Cone> = data.frames.iter().map(|frame| Cone::new(&frame.camera)).collect();
    grid.carve(&|centre, radius| !cones.iter().any(|cone| cone.sees(centre, radius, data.near)));
    grid.empty_carved();
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::{Split, sample::ball};
    use crate::space::occupancy::OccupancyConfig;

    #[test]
    fn carve_unseen_keeps_the_visible_cone_alone() {
        let mut data = ball(Split::Train, 8);
        data.frames.truncate(1);
        let pose = Camera::look_at(DVec3::new(0.0, 0.0, 3.0), DVec3::ZERO, DVec3::Y);
        data.frames[0].camera = Camera::from_angle(40, 30, 0.6, pose);
        data.near = 1.5;
        let config = OccupancyConfig { resolution: 32, cascades: 3, ..OccupancyConfig::default() };
        let mut grid = OccupancyGrid::new([DVec3::NEG_ONE, DVec3::ONE], &config).unwrap();
        let whole = grid.occupied_share();
        carve_unseen(&mut grid, &data);
        let share = grid.occupied_share();
        // The inner box has a third of all cells, and the camera sees nearly all of it.
        assert!(share > 0.35 && share < 0.5 * whole, "{share} of {whole}");
        // The camera looks down from 3, sees nothing nearer than 1.5, and sees the floor of the outermost box.
        let is_left = |x: f64, y: f64, z: f64| grid.is_occupied(DVec3::new(x, y, z));
        assert!(is_left(0.0, 0.0, 1.4) && !is_left(0.0, 0.0, 2.0) && is_left(0.0, 0.0, -3.99));
        // tan 0.3 at the distance 7, 3/4 of that, and the corner of the image, with a cell around.
        assert!(is_left(2.1, 0.0, -3.99) && !is_left(3.4, 0.0, -3.99));
        assert!(is_left(0.0, 1.6, -3.99) && !is_left(0.0, 3.4, -3.99));
        // Every point on a ray of the camera stays, also on its border.
        let mut rays = crate::Rays::new();
        for pixel in [[0, 0], [39, 29], [39, 0], [20, 15]] {
            rays.push_pixel(&data.frames[0].camera, pixel, grid.outer_bounds(), [1.5, 6.0]);
        }
        let count = |grid: &OccupancyGrid| {
            let mut found = crate::space::occupancy::MarchBuffer::default();
            let step = crate::space::occupancy::Step::uniform(0.01);
            grid.march(&rays, &step, &mut crate::Jitter::Middle, &mut found);
            found.t.len()
        };
        assert_eq!(count(&grid), count(&OccupancyGrid::new(grid.bounds(), &config).unwrap()));
        // A second camera that looks elsewhere carves nothing.
        let mut other = data.frames[0].clone();
        other.camera.pose = Camera::look_at(DVec3::splat(-3.0), DVec3::new(-3.0, 3.0, -3.0), DVec3::Z);
        data.frames.push(other);
        let mut both = OccupancyGrid::new(grid.bounds(), &config).unwrap();
        carve_unseen(&mut both, &data);
        assert!(both.occupied_share() > share && count(&both) == count(&grid));
    }

    /// The outermost directions lie between the places of the border that the lens sees.
    #[test]
    fn cones_reach_the_fold_of_a_lens() {
        let pose = Camera::look_at(DVec3::new(0.0, 0.0, 3.0), DVec3::ZERO, DVec3::Y);
        let mut camera = Camera::from_angle(192, 108, std::f64::consts::FRAC_PI_2, pose);
        camera.lens = crate::camera::lens::Lens::Brown { k: [-0.3, 0.0, 0.0, 0.0, 0.0, 0.0], p: [0.0; 2] };
        let cone = Cone::new(&camera);
        let seen = (0..192 * 108)
            .map(|pixel| camera.place_of(pixel))
            .filter(|[x, y]| camera.sees(*x as f64 + 0.5, *y as f64 + 0.5));
        let angles: Vec<f64> = seen.map(|[x, y]| camera.pixel_ray(x, y).direction.angle_between(cone.axis)).collect();
        assert!(angles.iter().all(|angle| *angle <= cone.half_angle) && angles.iter().any(|angle| *angle > 0.78));
    }
}
