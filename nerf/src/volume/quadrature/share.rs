//! The share of the second node of Gauss's rule in an interval's colour.

use raygrad_autograd::{Scalar, Var};

const SQRT_3: f64 = 1.732_050_807_568_877_3;
/// Below this optical depth the mean depth of emission is a series.
const SERIES_BELOW: f64 = 0.5;
/// `B_(2n) / (2n)!`.
const LEAD_SERIES: [f64; 6] =
    [1.0 / 12.0, -1.0 / 720.0, 1.0 / 30240.0, -1.0 / 1_209_600.0, 1.0 / 47_900_160.0, -691.0 / 1_307_674_368_000.0];

/// Computes the share of the second Gauss node in an interval's colour, `[intervals]`, 0 to 1.
///
/// `a` and `b` are the densities of the two nodes and `x` the optical depth of the interval, each `[intervals]`. Where
/// the share is clamped, and where both densities are 0, it is a constant.
///
/// The nodes are at optical depths `tau_a = h (a/4 + b (1/4 - s/6))` and `tau_b = h (a (1/4 + s/6) + b/4)`, with s the
/// root of 3. Light comes from the mean optical depth `m = 1 - x / (e^x - 1)`. Colour linear in optical depth gives
/// `f = (m - tau_a) / (tau_b - tau_a)`. That is `b / (a + b) - s (1/2 - 1/x + 1/(e^x - 1))`. Beyond a depth of about
/// 5 that would extrapolate: it is clamped at 0.
pub fn gauss_share<'t, T: Scalar>(a: &Var<'t, T>, b: &Var<'t, T>, x: &Var<'t, T>) -> Var<'t, T> {
    let sum = a + b;
    // In this order tiny sums do not overflow.
    let ratio = (b / sum.maximum(1e-37)).where_(&sum.gt(0.0), 0.5);
    // Beyond 80 the result is constant; farther on the derivative of the exponential overflows.
    let (near, far) = (x.minimum(SERIES_BELOW), x.clamp(SERIES_BELOW, 80.0));
    let square = near.square();
    // `1/2 - 1/x + 1/(e^x - 1)`: the mean distance of emission from the middle of the interval, towards the viewer, as
    // a share of its optical depth.
    let series = LEAD_SERIES.iter().rev().fold(x.constant(0.0), |sum, &c| sum * &square + c) * near;
    let closed = far.expm1().reciprocal() - far.reciprocal() + 0.5;
    let lead = series.where_(&x.lt(SERIES_BELOW), &closed);
    (ratio - lead * SQRT_3).clamp(0.0, 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use raygrad_autograd::{Tape, Tensor};

    #[test]
    fn gauss_share_equals_formula_and_slope() {
        let tape = Tape::<f64>::new();
        for (a, b) in [(1.0, 0.0), (0.0, 1.0), (3.0, 5.0), (0.0, 0.0), (1e-30, 1e30), (2.0, 2.0)] {
            for x in [0.0, 1e-6, 0.3, 0.499, 0.5, 0.7, 5.0, 100.0, 1e30_f64] {
                let one = |value: f64| tape.constant(Tensor::full(&[1], value));
                let found = gauss_share(&one(a), &one(b), &one(x)).item();
                // For small x the formula loses its digits, so the first term of its series is used.
                let lead = if x < 1e-3 { x / 12.0 } else { 0.5 - 1.0 / x + 1.0 / x.exp_m1() };
                let ratio = if a + b > 0.0 { b / (a + b) } else { 0.5 };
                let error = (found - (ratio - 3.0_f64.sqrt() * lead).clamp(0.0, 1.0)).abs();
                assert!(error <= if x > 80.0 { 0.03 } else { 1e-14 }, "{a} {b} {x}: {found}");
                let depth = tape.leaf(Tensor::full(&[1], x));
                let slope = gauss_share(&one(a), &one(b), &depth).sum().grad(&[&depth]).remove(0);
                assert!(slope.is_finite(), "{a} {b} {x}: {slope:?}");
            }
        }
    }
}
