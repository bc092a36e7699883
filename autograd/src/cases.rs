//! Test cases of an elementwise formula: sampling ranges and exact values.

use std::ops::Range;

/// Numbers of cases.
pub(crate) const INF: f64 = f64::INFINITY;
pub(crate) const NAN: f64 = f64::NAN;
pub(crate) const PI: f64 = std::f64::consts::PI;

/// Test cases of a [`Formula`](crate::Formula): sampling ranges, and exact values at extremes.
#[derive(Debug, Clone, Default)]
pub struct Cases {
    pub(crate) linear: bool,
    /// For each input, the ranges that samples are drawn from.
    pub(crate) domains: Vec<Vec<Range<f64>>>,
    pub(crate) extremes: Vec<Extreme>,
}

/// The exact value and gradients at one point, chosen because naive formulas fail there.
#[derive(Debug, Clone)]
pub struct Extreme {
    /// The inputs.
    pub x: Vec<f64>,
    /// The value. NaN expects a NaN.
    pub y: f64,
    /// The gradient of each input for an output gradient of 1.
    pub grads: Vec<f64>,
}

impl Cases {
    /// Marks the function as linear. The checks then verify linearity too.
    pub fn linear(&mut self) -> &mut Self {
        self.linear = true;
        self
    }

    /// Adds the range of the next input.
    pub fn domain(&mut self, range: Range<f64>) -> &mut Self {
        self.domains.push(vec![range]);
        self
    }

    /// Adds a further range of the last input, for a function with a gap. Samples alternate between the ranges.
    pub fn domain_also(&mut self, range: Range<f64>) -> &mut Self {
        if let Some(last) = self.domains.last_mut() {
            last.push(range);
        }
        self
    }

    /// Adds the exact value `y` and gradients `grads` at `x`.
    pub fn at<const N: usize>(&mut self, x: [f64; N], y: f64, grads: [f64; N]) -> &mut Self {
        self.extremes.push(Extreme { x: x.into(), y, grads: grads.into() });
        self
    }
}
