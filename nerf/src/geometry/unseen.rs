//! Space that no camera sees: the inside of solid objects, where the field was never trained.

use super::sight::{Seen, Sight};
use crate::camera::Camera;
use glam::DVec3;

/// The visible distance of each camera's pixels.
pub(super) struct Hidden {
    views: Vec<(Camera, Vec<f64>)>,
    /// Points up to this distance behind the visible surface are not hidden, in scene units.
    margin: f64,
}

impl Hidden {
    /// Space that these cameras do not see.
    pub fn new(views: &[(Camera, Seen)], margin: f64) -> Self {
        let distance = |sight: &Option<Sight>| sight.map_or(f64::INFINITY, |sight| sight.distance);
        let view = |(camera, seen): &(Camera, Seen)| (camera.clone(), seen.sights.iter().map(distance).collect());
        Hidden { views: views.iter().map(view).collect(), margin }
    }

    /// Returns true if a point is in the view of a camera, and hidden in every view that contains it.
    pub fn holds(&self, place: DVec3) -> bool {
        let mut behind = false;
        for (camera, distances) in &self.views {
            let Some([x, y]) = camera.pixel_of(place) else { continue };
            if !(x >= 0.0 && y >= 0.0 && x < camera.width as f64 && y < camera.height as f64) {
                continue;
            }
            let distance = distances[x as usize + camera.width * y as usize];
            if place.distance(camera.pose.translation) <= distance + self.margin {
                return false;
            }
            behind = true;
        }
        behind
    }
}

#[cfg(test)]
mod tests {
    use super::super::sight::Sight;
    use super::*;
    use crate::volume::render::Evaluations;

    /// A camera of 4 x 2 pixels with hits at a distance of 2, except in the upper right pixel.
    fn from(eye: DVec3, target: DVec3) -> (Camera, Seen) {
        let camera = Camera::from_angle(4, 2, 1.0, Camera::look_at(eye, target, DVec3::Z));
        let sight = Sight { place: DVec3::ZERO, distance: 2.0, sigma: 1.0 };
        let sights = (0..8).map(|pixel| (pixel != 3).then_some(sight)).collect();
        (camera, Seen { sights, evaluations: Evaluations::default() })
    }

    #[test]
    fn points_hidden_in_all_views_are_unseen() {
        // The camera looks along +y, with +x to the right.
        let first = || from(DVec3::ZERO, DVec3::Y);
        let alone = Hidden::new(&[first()], 0.5);
        for (place, hidden) in [
            ([0.1, 2.3, -0.1], false),
            ([0.1, 2.6, -0.1], true),
            ([-1.0, 2.6, 0.4], true),
            ([1.0, 2.6, -0.4], true),
            // The pixel without a hit.
            ([1.0, 2.6, 0.4], false),
            // Outside of the image, and behind the camera.
            ([3.0, 2.6, 0.0], false),
            ([-3.0, 2.6, 0.0], false),
            ([0.1, 2.6, -1.5], false),
            ([0.1, 2.6, 1.5], false),
            ([0.1, -2.6, 0.1], false),
        ] {
            assert_eq!(alone.holds(DVec3::from(place)), hidden, "{place:?}");
        }
        let place = DVec3::new(0.1, 2.6, -0.1);
        // A second camera sees the point at a distance of 1.
        let near = from(place - DVec3::X, place);
        assert!(!Hidden::new(&[first(), near], 0.5).holds(place));
        let far = from(place - 3.0 * DVec3::X, place + DVec3::new(0.0, 0.1, -0.1));
        assert!(Hidden::new(&[first(), far], 0.5).holds(place));
        assert!(!Hidden::new(&[], 0.5).holds(place), "in no picture");
    }
}
