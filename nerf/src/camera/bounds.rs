//! Intersection of rays with boxes.

use crate::camera::pinhole::{Camera, Ray};
use glam::DVec3;

/// Returns the distances at which a ray enters and leaves a box (lower and upper corner), or `None` if it misses.
///
/// A ray that starts inside enters at 0. For a direction component of 0 the origin must lie between the faces, faces
/// included. NaN misses.
pub fn intersect_box(ray: &Ray, [low, high]: [DVec3; 2]) -> Option<[f64; 2]> {
    let (mut enter, mut leave) = (0.0, f64::INFINITY);
    for axis in 0..3 {
        let (origin, direction) = (ray.origin[axis], ray.direction[axis]);
        if direction == 0.0 {
            if !(low[axis]..=high[axis]).contains(&origin) {
                return None;
            }
            continue;
        }
        let (a, b) = ((low[axis] - origin) / direction, (high[axis] - origin) / direction);
        if a.is_nan() || b.is_nan() {
            return None;
        }
        (enter, leave) = (f64::max(enter, a.min(b)), f64::min(leave, a.max(b)));
    }
    (enter <= leave).then_some([enter, leave])
}

/// Returns the part of `[near, far]` of a ray that lies in the box; empty, at near, if it misses.
pub fn clip_near_far(ray: &Ray, bounds: [DVec3; 2], [near, far]: [f64; 2]) -> [f64; 2] {
    match intersect_box(ray, bounds) {
        Some([enter, leave]) if enter.max(near) < leave.min(far) => [enter.max(near), leave.min(far)],
        _ => [near, near],
    }
}

impl Camera {
    /// Returns true if one of `columns` x `rows` rays, evenly spaced over the image, intersects a box within the
    /// distances `span`.
    pub(crate) fn meets(&self, bounds: [DVec3; 2], span: [f64; 2], [columns, rows]: [usize; 2]) -> bool {
        let place = |i: usize, count: usize, size: usize| (i as f64 + 0.5) / count as f64 * size as f64;
        (0..columns * rows).any(|i| {
            let ray = self.ray(place(i % columns, columns, self.width), place(i / columns, rows, self.height));
            let [enter, leave] = clip_near_far(&ray, bounds, span);
            enter < leave
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const UNIT: [DVec3; 2] = [DVec3::NEG_ONE, DVec3::ONE];

    #[test]
    fn box_hits_rays_along_axes_faces_and_edges() {
        for zero in [0.0, -0.0] {
            let ray = |x: f64| Ray { origin: DVec3::new(x, 0.0, -3.0), direction: DVec3::new(zero, zero, 1.0) };
            for x in [0.0, 1.0, -1.0] {
                assert_eq!(intersect_box(&ray(x), UNIT), Some([2.0, 4.0]), "x = {x}");
            }
            assert_eq!(intersect_box(&ray(1.0 + 1e-12), UNIT), None);
        }
        let inside = Ray { origin: DVec3::ZERO, direction: DVec3::Y };
        assert_eq!(intersect_box(&inside, UNIT), Some([0.0, 1.0]));
        let behind = Ray { origin: DVec3::new(0.0, 3.0, 0.0), direction: DVec3::Y };
        assert_eq!(intersect_box(&behind, UNIT), None);
        let nan = Ray { origin: DVec3::new(f64::NAN, 0.0, 0.0), direction: DVec3::Y };
        assert_eq!(intersect_box(&nan, UNIT), None);
        let tiny = Ray { origin: DVec3::new(0.0, 0.0, -3.0), direction: DVec3::new(1e-40, 0.0, 1.0) };
        assert_eq!(intersect_box(&tiny, UNIT), Some([2.0, 4.0]));
    }

    proptest! {
        #[test]
        fn box_interval_ends_on_the_surface(
            o in prop::array::uniform3(-3.0..3.0f64), d in prop::array::uniform3(-1.0..1.0f64)
        ) {
            let direction = DVec3::from(d);
            prop_assume!(direction.length() > 1e-3);
            let ray = Ray { origin: DVec3::from(o), direction: direction.normalize() };
            let inside = |p: DVec3, slack: f64| p.abs().max_element() <= 1.0 + slack;
            match intersect_box(&ray, UNIT) {
                Some([enter, leave]) => {
                    prop_assert!(inside(ray.at(0.5 * (enter + leave)), 1e-9));
                    prop_assert!((ray.at(leave).abs().max_element() - 1.0).abs() < 1e-9);
                    prop_assert!(!inside(ray.at(leave + 1e-6), -1e-12));
                }
                None => for i in 0..1000 {
                    prop_assert!(!inside(ray.at(f64::from(i) * 0.01), -1e-9));
                }
            }
        }
    }
}
