//! A ball of constant density.

use super::{Layer, Layers, Medium};
use crate::camera::pinhole::Ray;
use glam::DVec3;

/// A ball of one density and one colour.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ball {
    /// Its centre, in scene units.
    pub centre: DVec3,
    /// Its radius.
    pub radius: f64,
    /// Its density, more than 0.
    pub sigma: f64,
    /// Its colour.
    pub color: f64,
}

impl Ball {
    /// The ball as a ray sees it: one layer, or none. `z` of the layer is the distance along the ray, whose direction has
    /// length 1.
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
