//! What no camera sees: the inside of solid things, which no photograph has judged.

use super::sight::{Seen, Sight};
use crate::camera::Camera;
use glam::DVec3;

/// How far cameras see, pixel by pixel.
pub(super) struct Hidden {
    views: Vec<(Camera, Vec<f64>)>,
    /// Places up to so far behind what is seen are not hidden, in scene units.
    margin: f64,
}

impl Hidden {
    /// What these cameras do not see; each has what its pixels see, row by row.
    pub fn new(views: &[(Camera, Seen)], margin: f64) -> Self {
        let distance = |sight: &Option<Sight>| sight.map_or(f64::INFINITY, |sight| sight.distance);
        let view = |(camera, seen): &(Camera, Seen)| (camera.clone(), seen.sights.iter().map(distance).collect());
        Hidden { views: views.iter().map(view).collect(), margin }
    }

    /// Whether a place is in the picture of a camera, and behind what is seen in every picture that it is in.
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
