//! Media that vary smoothly along z.

use super::{Exact, Medium};
use raygrad_tensor::vmath::f64::erf;
use std::f64::consts::{FRAC_PI_2, SQRT_2};

/// An exponential atmosphere: density `sigma e^(-rate z)`, colour `color[0] + color[1] e^(-rate z)`. The amplitude is
/// `sigma`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Exponential {
    /// Density at z = 0, more than 0; at most 500 times the rate.
    pub sigma: f64,
    /// Rate of decay, above 0: a factor of e in `1 / rate` scene units.
    pub rate: f64,
    /// The colour at infinity, and its increase at z = 0.
    pub color: [f64; 2],
}

impl Exponential {
    /// Computes the exact integrals from z = 0 along the z axis up to `length`, over a background.
    ///
    /// In optical depth tau the colour is linear: `color[0] + color[1] (1 - rate tau / sigma)`. The depth contains the
    /// integral of the transmittance, a difference of exponential integrals Ei.
    pub fn exact(&self, length: f64, background: f64) -> Exact {
        let Exponential { sigma, rate, color: [far, near] } = *self;
        let per_sigma = -(-rate * length).exp_m1() / rate;
        let tau = sigma * per_sigma;
        let left = (-tau).exp();
        let moment = -(-tau).exp_m1() - tau * left;
        let d_tau = (far + near) * left - near * (rate / sigma) * tau * left - background * left;
        // T = e^(u - whole) with u = whole e^(-rate t).
        let whole = sigma / rate;
        let end = whole * (-rate * length).exp();
        let lit = (-whole).exp() / rate * (exponential_integral(whole) - exponential_integral(end));
        let lit_tau = whole * lit + (end - whole).exp_m1() / rate;
        Exact {
            color: -(-tau).exp_m1() * (far + near) - near * rate / sigma * moment + background * left,
            depth: lit - length * left,
            transmittance: left,
            d_color: vec![per_sigma * d_tau + near * rate / (sigma * sigma) * moment],
            d_depth: vec![length * per_sigma * left - lit_tau / sigma],
            d_transmittance: vec![-per_sigma * left],
        }
    }
}

/// Ei(x) for x > 0 by its series of positive terms (Abramowitz and Stegun 5.1.10).
fn exponential_integral(x: f64) -> f64 {
    const EULER: f64 = 0.577_215_664_901_532_9;
    let (mut sum, mut power, mut n) = (0.0, 1.0, 1.0);
    loop {
        power *= x / n;
        let term = power / n;
        sum += term;
        if !(term > 1e-17 * sum) {
            return EULER + x.ln() + sum;
        }
        n += 1.0;
    }
}

impl Medium for Exponential {
    fn amplitudes(&self) -> Vec<f64> {
        vec![self.sigma]
    }

    fn shapes(&self, [_, _, z]: [f64; 3], out: &mut [f64]) {
        out[0] = (-self.rate * z).exp();
    }

    fn color(&self, [_, _, z]: [f64; 3]) -> f64 {
        self.color[0] + self.color[1] * (-self.rate * z).exp()
    }
}

/// A Gaussian layer: density `sigma e^(-(z - mean)^2 / (2 width^2))`, and a colour that rises with the optical depth,
/// from `color[0]` at z = 0 to `color[0] + color[1]` at `length`. The amplitude is `sigma`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Gaussian {
    /// The maximum density, in 1 / scene unit.
    pub sigma: f64,
    /// The position of the maximum along z.
    pub mean: f64,
    /// The standard deviation, in scene units.
    pub width: f64,
    /// The colour at z = 0, and its increase up to `length`.
    pub color: [f64; 2],
    /// The end of the increase along z, in scene units.
    pub length: f64,
}

impl Gaussian {
    /// The optical depth from 0 to z for an amplitude of 1.
    fn unit_depth(&self, z: f64) -> f64 {
        let at = |z: f64| erf(z / (SQRT_2 * self.width));
        self.width * FRAC_PI_2.sqrt() * (at(z - self.mean) + at(self.mean))
    }

    /// Computes the exact integrals from z = 0 along the z axis up to `length`, over a background.
    ///
    /// The depth has no closed form; it is integrated numerically to 1e-12.
    pub fn exact(&self, background: f64) -> Exact {
        let per_sigma = self.unit_depth(self.length);
        let tau = self.sigma * per_sigma;
        let [first, rise] = self.color;
        let left = (-tau).exp();
        let moment = -(-tau).exp_m1() - tau * left;
        let d_tau = first * left - rise * moment / (tau * tau) + rise * left - background * left;
        let mut lit = [0.0; 2];
        integrate([0.0, self.length], self.width / 8.0, |t, weight| {
            let depth = self.unit_depth(t);
            let transmittance = weight * (-self.sigma * depth).exp();
            lit = [lit[0] + transmittance, lit[1] + depth * transmittance];
        });
        Exact {
            color: -first * (-tau).exp_m1() + rise * moment / tau + background * left,
            depth: lit[0] - self.length * left,
            transmittance: left,
            d_color: vec![per_sigma * d_tau],
            d_depth: vec![self.length * per_sigma * left - lit[1]],
            d_transmittance: vec![-per_sigma * left],
        }
    }
}

/// Calls `add` with the nodes and weights of five-point Gauss-Legendre quadrature on panels of at most this width.
fn integrate([from, to]: [f64; 2], panel: f64, mut add: impl FnMut(f64, f64)) {
    const POINTS: [[f64; 2]; 5] = [
        [-0.906_179_845_938_664, 0.236_926_885_056_189_1],
        [-0.538_469_310_105_683_1, 0.478_628_670_499_366_5],
        [0.0, 0.568_888_888_888_888_9],
        [0.538_469_310_105_683_1, 0.478_628_670_499_366_5],
        [0.906_179_845_938_664, 0.236_926_885_056_189_1],
    ];
    let panels = ((to - from) / panel).ceil().max(1.0);
    let half = 0.5 * (to - from) / panels;
    for i in 0..panels as usize {
        let middle = from + half * (2 * i + 1) as f64;
        POINTS.iter().for_each(|[place, weight]| add(middle + half * place, half * weight));
    }
}

impl Medium for Gaussian {
    fn amplitudes(&self) -> Vec<f64> {
        vec![self.sigma]
    }

    fn shapes(&self, [_, _, z]: [f64; 3], out: &mut [f64]) {
        out[0] = (-0.5 * ((z - self.mean) / self.width).powi(2)).exp();
    }

    fn color(&self, [_, _, z]: [f64; 3]) -> f64 {
        self.color[0] + self.color[1] * self.unit_depth(z) / self.unit_depth(self.length)
    }
}
