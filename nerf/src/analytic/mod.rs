//! Scenes with exact volume rendering integrals, to measure quadratures, renderers and gradients against.
//!
//! Start with [`scenes`] and [`integrate`]. A [`Medium`] defines density and colour; an [`AnalyticScene`] is a medium
//! along one ray, with the exact colour, depth and transmittance
//!
//! ```text
//! C = integral of T sigma c dt + T(D) background,   Z = integral of T sigma t dt,   T(t) = exp(-integral of sigma)
//! ```
//!
//! over `[0, D]`, and their derivatives. [`AnalyticField`] makes a medium a [`Field`](crate::Field) to render or train.

mod ball;
mod field;
mod layers;
mod measure;
mod smooth;
#[cfg(test)]
mod tests;

pub use ball::Ball;
pub use field::AnalyticField;
pub use layers::{Layer, Layers};
pub use measure::{Integral, integrate};
pub use smooth::{Exponential, Gaussian};

use crate::camera::pinhole::Ray;
use glam::DVec3;
use std::fmt::Debug;
use std::sync::Arc;

/// A medium: density and colour at every position.
///
/// The density is a sum of amplitudes times shapes; gradients are with respect to the amplitudes.
pub trait Medium: Debug + Send + Sync {
    /// Returns the amplitudes, in 1 / scene unit.
    fn amplitudes(&self) -> Vec<f64>;

    /// Writes each amplitude's shape at a position to `out`, one entry per amplitude.
    fn shapes(&self, position: [f64; 3], out: &mut [f64]);

    /// Returns the colour at a position, the same grey in all channels, 0 to 1. Without density it is that of a
    /// neighbour.
    fn color(&self, position: [f64; 3]) -> f64;

    /// Returns the density at a position, in 1 / scene unit.
    fn sigma(&self, position: [f64; 3]) -> f64 {
        let amplitudes = self.amplitudes();
        let mut shapes = vec![0.0; amplitudes.len()];
        self.shapes(position, &mut shapes);
        amplitudes.iter().zip(shapes).map(|(amplitude, shape)| amplitude * shape).sum()
    }
}

/// The exact integrals along a ray.
#[derive(Debug, Clone, PartialEq)]
pub struct Exact {
    /// Colour over the background.
    pub color: f64,
    /// Depth sum (integral of `T sigma t`), not divided by the opacity, in scene units.
    pub depth: f64,
    /// Transmittance at the end of the ray, 0 to 1.
    pub transmittance: f64,
    /// Derivative of the colour with respect to each amplitude.
    pub d_color: Vec<f64>,
    /// Derivative of the depth with respect to each amplitude.
    pub d_depth: Vec<f64>,
    /// Derivative of the transmittance with respect to each amplitude.
    pub d_transmittance: Vec<f64>,
}

/// A medium along one ray, with its exact integrals.
#[derive(Debug, Clone)]
pub struct AnalyticScene {
    /// A short name.
    pub name: &'static str,
    /// The medium.
    pub medium: Arc<dyn Medium>,
    /// The ray.
    pub ray: Ray,
    /// The length `D` of the ray, in scene units.
    pub length: f64,
    /// The background colour.
    pub background: f64,
    /// The exact integrals.
    pub exact: Exact,
}

impl AnalyticScene {
    /// Returns density and colour at distance `t`.
    pub fn at(&self, t: f64) -> [f64; 2] {
        let position = self.ray.at(t).to_array();
        [self.medium.sigma(position), self.medium.color(position)]
    }

    /// Returns a box of side `length` around the ray: lower and upper corner.
    pub fn bounds(&self) -> [DVec3; 2] {
        let middle = self.ray.at(0.5 * self.length);
        [middle - 0.5 * self.length, middle + 0.5 * self.length]
    }
}

/// Returns the scenes of the benchmark, each on a ray of length 4 over white.
///
/// They are constant density with constant and with linear colour, an exponential atmosphere, a wide and a narrow
/// Gaussian layer, two slabs, and a ball off its centre.
pub fn scenes() -> Vec<AnalyticScene> {
    const LENGTH: f64 = 4.0;
    const BACKGROUND: f64 = 1.0;
    let along_z = Ray { origin: DVec3::ZERO, direction: DVec3::Z };
    let scene = |name, medium: Arc<dyn Medium>, ray, exact| AnalyticScene {
        name,
        medium,
        ray,
        length: LENGTH,
        background: BACKGROUND,
        exact,
    };
    let layers = |name, layers: &[Layer]| {
        let layers = Layers::new(layers);
        let exact = layers.exact(LENGTH, BACKGROUND);
        scene(name, Arc::new(layers), along_z, exact)
    };
    let layer = |[from, to]: [f64; 2], sigma, color| Layer { from, to, sigma, color };
    let gaussian = |name, sigma, width| {
        let gaussian = Gaussian { sigma, mean: 2.1, width, color: [0.1, 0.7], length: LENGTH };
        let exact = gaussian.exact(BACKGROUND);
        scene(name, Arc::new(gaussian), along_z, exact)
    };
    let exponential = Exponential { sigma: 3.0, rate: 0.8, color: [0.2, 0.5] };
    let ball = Ball { centre: DVec3::new(0.0, 0.0, 2.0), radius: 0.5, sigma: 3.0, color: 0.6 };
    let beside = Ray { origin: DVec3::new(0.3, 0.0, 0.0), ..along_z };
    let through = ball.along(&beside).exact(LENGTH, BACKGROUND);
    vec![
        layers("constant", &[layer([0.0, LENGTH], 1.3, [0.8, 0.0])]),
        layers("linear colour", &[layer([0.0, LENGTH], 1.3, [0.2, 0.15])]),
        scene("exponential", Arc::new(exponential), along_z, exponential.exact(LENGTH, BACKGROUND)),
        gaussian("gaussian", 4.0, 0.4),
        gaussian("narrow gaussian", 100.0, 0.03),
        layers("slabs", &[layer([0.7, 1.3], 1.1, [0.9, 0.0]), layer([2.2, 2.9], 6.0, [0.2, 0.0])]),
        scene("sphere", Arc::new(ball), beside, through),
    ]
}
