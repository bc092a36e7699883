//! A ball of constant density.

use super::{Layer, Layers, Medium};
use crate::camera::pinhole::Ray;
use glam::DVec3;

/// A ball of constant density and colour.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ball {
    /// Centre, in scene units.
    pub centre: DVec3,
    /// Radius, in scene units.
    pub radius: f64,
    /// Density, above 0, in 1 / scene unit.
    pub sigma: f64,
    /// Colour, the same grey in all channels.
    pub color: f64,
}

impl Ball {
    /// Returns the ball along a ray with a unit direction: one layer, or none. The layer's `z` is the distance along
    /// the ray.
    pub fn along(&self, ray: &Ray) -> Layers {
        let to_centre = self.centre - ray.origin;
        let nearest = to_centre.dot(ray.direction);
        let half_chord = (self.radius.powi(2) - (to_centre - nearest * ray.direction).length_squared()).max(0.0).sqrt();
        let [from, to] = [nearest - half_chord, nearest + half_chord];
        let layer = Layer { from, to, sigma: self.sigma, color: [self.color, 0.0] };
        Layers::new(if half_chord > 0.0 { std::slice::from_ref(&layer) } else { &[] })
    }
}

impl Medium for Ball {
    fn amplitudes(&self) -> Vec<f64> {
        vec![self.sigma]
    }

    fn shapes(&self, position: [f64; 3], out: &mut [f64]) {
        out[0] = if DVec3::from(position).distance(self.centre) <= self.radius { 1.0 } else { 0.0 };
    }

    fn color(&self, _: [f64; 3]) -> f64 {
        self.color
    }
}
