//! Single precision: at most 1 ULP for `exp`, `exp2` and `ln`, and 2 ULP for the others, over all 2^32 arguments.
//! `sinh`, `cosh` and `hypot` are within 2 ULP on samples, `normal_cdf` within 6. Functions that
//! [call the standard library](super) have no bound here.

mod erf;
mod exp;
mod log;
mod trig;

pub use super::plain::f32::*;
pub use erf::erf;
pub(in crate::vmath) use erf::erf_near;
pub(in crate::vmath) use exp::exp_minus;
pub(in crate::vmath) use exp::expm1_of_rest;
pub use exp::{exp, exp2, expm1, tanh};
pub use log::{ln, ln1p, log2, softplus};
pub(crate) use trig::QUICK;
pub use trig::{cos, cos_pi, cos_quick, sin, sin_pi, sin_quick};

/// Adding and subtracting this number rounds to the nearest integer (ties to even) for |x| < 2^22, because an ULP is 1
/// there. After the addition, the low bits of the sum hold that integer.
pub(in crate::vmath) const ROUND: f32 = 12_582_912.0; // 1.5 * 2^23

/// The nearest integer to `a * b`, |a b| < 2^22, as a number and as an integer. Meaningless, but harmless, on NaN.
#[inline(always)]
pub(in crate::vmath) fn round_product(a: f32, b: f32) -> (f32, i32) {
    let t = a.mul_add(b, ROUND);
    (t - ROUND, (t.to_bits() as i32).wrapping_sub(ROUND.to_bits() as i32))
}

/// 2^n for -126 <= n <= 127, made from its bits.
#[inline(always)]
fn power_of_two(n: i32) -> f32 {
    f32::from_bits((n.wrapping_add(127) as u32) << 23)
}
