//! Intervals whose optical depth and colour come from two nodes each.

use crate::field::Density;
use crate::field::MOST_LOG_DENSITY;
use crate::volume::render::{Weighted, weights};
use crate::volume::weights::Weights;
use raygrad_autograd::{Scalar, Segments, Tensor, Var};
use std::sync::Arc;

/// How much of an interval's colour comes from its second node; the rest comes from its first.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Share {
    /// Half, for nodes at both ends.
    Mean,
    /// What is exact for colour linear in optical depth, for the nodes of two-point Gauss quadrature: at `1/2 -+ sqrt(3)/6`
    /// of the interval, see [`gauss_share`].
    Gauss,
}

/// Intervals, and the nodes where the field is asked.
///
/// Interval k of length h with nodes a and b has the optical depth `x_k = h (sigma_a + sigma_b) / 2` and the features
/// `(1 - f) c_a + f c_b` with a [`Share`] f. So its [weight](Weights) is that of its nodes, divided among the two.
#[derive(Debug, Clone)]
pub struct Intervals<T: Scalar> {
    /// The first and the second node of each interval, as rows of the samples.
    pub nodes: [Arc<[u32]>; 2],
    /// Length of each interval, `[intervals]`, at least 0 and finite.
    pub length: Tensor<T>,
    /// The intervals of each ray.
    pub segments: Segments,
    /// How colours are weighted.
    pub share: Share,
}

/// Densities at the ends of intervals, and the optical depth between them, each `[intervals]`.
struct Ends<'t, T: Scalar> {
    sigma: [Var<'t, T>; 2],
    depth: Var<'t, T>,
}

impl<T: Scalar> Intervals<T> {
    #[track_caller]
    fn ends<'t>(&self, density: &Density<'t, T>) -> Ends<'t, T> {
        // Cut where one interval is opaque, and its square still finite.
        let sigma = match density.log {
            true => density.value.minimum(MOST_LOG_DENSITY).exp(),
            false => density.value.clone(),
        };
        let sigma = self.nodes.each_ref().map(|nodes| sigma.gather_rows(nodes.clone()));
        let half = sigma[0].tape().constant(self.length.clone()) * 0.5;
        // Not the sum first, which may overflow.
        let depth = &sigma[0] * &half + &sigma[1] * &half;
        Ends { sigma, depth }
    }

    /// The transmittance in front of each interval, `[intervals]`, as numbers.
    ///
    /// # Panics
    /// If a node is not a sample.
    #[track_caller]
    pub fn transmittance(&self, density: &Density<'_, T>) -> Tensor<T> {
        let depth = self.ends(density).depth;
        Weights::new(self.segments.clone()).transmittance(depth.value(), depth.tape().pool())
    }

    /// The weights of the nodes.
    ///
    /// # Panics
    /// If a node is not a sample.
    #[track_caller]
    pub fn weighted<'t>(&self, density: &Density<'t, T>) -> Weighted<'t, T> {
        let (samples, Ends { sigma: [a, b], depth }) = (density.value.shape()[0], self.ends(density));
        let weights = weights(&depth, &self.segments);
        let second = match self.share {
            Share::Mean => &weights * 0.5,
            Share::Gauss => &weights * gauss_shares(&a, &b, &depth),
        };
        let [first, second] = [weights - &second, second];
        let [a, b] = &self.nodes;
        let weights = first.scatter_rows(a.clone(), samples) + second.scatter_rows(b.clone(), samples);
        Weighted { weights, optical_depth: depth.segment_sum(&self.segments) }
    }
}

const SQRT_3: f64 = 1.732_050_807_568_877_3;
/// Below this optical depth [`lead`] is a series.
const SERIES_BELOW: f64 = 0.5;
/// `B_(2n) / (2n)!`.
const LEAD_SERIES: [f64; 6] =
    [1.0 / 12.0, -1.0 / 720.0, 1.0 / 30240.0, -1.0 / 1_209_600.0, 1.0 / 47_900_160.0, -691.0 / 1_307_674_368_000.0];

/// `1/2 - 1/x + 1/(e^x - 1)`: how far in front of the middle of an interval of optical depth x the light that leaves it
/// comes from on average, as a share of the interval's optical depth.
fn lead(x: f64) -> f64 {
    if x < SERIES_BELOW {
        let square = x * x;
        return x * LEAD_SERIES.iter().rev().fold(0.0, |sum, c| sum * square + c);
    }
    0.5 - 1.0 / x + 1.0 / x.exp_m1()
}

/// The share of the second node for densities a and b of the two and optical depth x of the interval, in 0..=1.
///
/// With the nodes at optical depths `tau_a = h (a/4 + b (1/4 - s/6))` and `tau_b = h (a (1/4 + s/6) + b/4)`, s the root of
/// 3, colour linear in optical depth gives `f = (m - tau_a) / (tau_b - tau_a)` with the mean optical depth
/// `m = 1 - x / (e^x - 1)` from which light comes. That is `b / (a + b) - s (1/2 - 1/x + 1/(e^x - 1))`. Beyond a depth of
/// about 5 that would extrapolate: it is cut at 0.
pub fn gauss_share(a: f64, b: f64, x: f64) -> f64 {
    let ratio = if a + b > 0.0 { b / (a + b) } else { 0.5 };
    (ratio - SQRT_3 * lead(x)).clamp(0.0, 1.0)
}

/// [`gauss_share`] of variables, each `[intervals]`. Where it is cut, and where both densities are 0, it counts as a
/// constant.
fn gauss_shares<'t, T: Scalar>(a: &Var<'t, T>, b: &Var<'t, T>, x: &Var<'t, T>) -> Var<'t, T> {
    let sum = a + b;
    // In this order nothing overflows where the sum is tiny.
    let ratio = (b / sum.maximum(1e-37)).where_(&sum.gt(0.0), 0.5);
    // Beyond 80 nothing changes any more, and further on the exponential has no derivative.
    let (near, far) = (x.minimum(SERIES_BELOW), x.clamp(SERIES_BELOW, 80.0));
    let square = near.square();
    let series = LEAD_SERIES.iter().rev().fold(x.constant(0.0), |sum, &c| sum * &square + c) * near;
    let closed = far.expm1().reciprocal() - far.reciprocal() + 0.5;
    let lead = series.where_(&x.lt(SERIES_BELOW), &closed);
    (ratio - lead * SQRT_3).clamp(0.0, 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use raygrad_autograd::Tape;

    #[test]
    fn shares_of_variables_are_those_of_numbers() {
        let tape = Tape::<f64>::new();
        for (a, b) in [(1.0, 0.0), (0.0, 1.0), (3.0, 5.0), (0.0, 0.0), (1e-30, 1e30), (2.0, 2.0)] {
            for x in [0.0, 1e-6, 0.3, 0.499, 0.5, 0.7, 5.0, 100.0, 1e30] {
                let one = |value: f64| tape.constant(Tensor::full(&[1], value));
                let found = gauss_shares(&one(a), &one(b), &one(x)).item();
                let error = (found - gauss_share(a, b, x)).abs();
                assert!(error <= if x > 80.0 { 0.03 } else { 1e-15 }, "{a} {b} {x}: {found}");
                let depth = tape.leaf(Tensor::full(&[1], x));
                let slope = gauss_shares(&one(a), &one(b), &depth).sum().grad(&[&depth]).remove(0);
                assert!(slope.is_finite(), "{a} {b} {x}: {slope:?}");
            }
        }
    }
}
