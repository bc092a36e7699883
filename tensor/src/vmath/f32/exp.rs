//! Exponentials, and tanh.
//!
//! All share one reduction, `x = n ln 2 + r` with integer n and |r| <= ln 2 / 2, and one polynomial for `e^r - 1`.

use super::{ROUND, power_of_two, round_product};
use crate::vmath::{clamp, polynomial};
use std::f32::consts::{LN_2, LOG2_E};

/// ln 2 in two parts. The first has 15 significant bits: times an integer below 2^8 it is exact.
pub(super) const LN_2_HIGH: f32 = 0.693_145_75;
pub(super) const LN_2_LOW: f32 = 1.428_606_8e-6;

/// `e^r - 1 = r + r^2 q(r)` for |r| <= ln 2 / 2, relative error 2^-31.
const EXPM1: [f32; 6] = [0.5, 0.166_666_66, 0.041_666_48, 0.008_333_564, 0.001_393_334_9, 0.000_197_458_07];

/// Splits `x = n ln 2 + r` and returns `(e^r - 1, n)`. It corrects for the rounding of r; otherwise `exp` would be off
/// by more than 1 ULP.
#[inline(always)]
fn reduce(x: f32) -> (f32, i32) {
    let (n, bits) = round_product(x, LOG2_E);
    (expm1_of_rest(x, n), bits)
}

/// `e^r - 1` for `r = x - n ln 2`.
#[inline(always)]
pub(in crate::vmath) fn expm1_of_rest(x: f32, n: f32) -> f32 {
    let high = n.mul_add(-LN_2_HIGH, x); // exact
    let r = n.mul_add(-LN_2_LOW, high);
    let r_low = n.mul_add(-LN_2_LOW, high - r);
    (r * r).mul_add(polynomial(r, EXPM1), r_low) + r
}

/// `p * 2^n` for -252 <= n <= 254 and rounded once: two factors, because 2^n alone may be out of range.
#[inline(always)]
fn scale(p: f32, n: i32) -> f32 {
    let half = n >> 1;
    p * power_of_two(half) * power_of_two(n.wrapping_sub(half))
}

/// `e^x`, within 1 ULP; 0 below -103.97, infinite above 88.72.
///
/// ```
/// use raygrad_tensor::vmath::f32::exp;
/// assert_eq!(exp(1.0), std::f32::consts::E);
/// assert_eq!(exp(-103.0), 1.4e-45); // the smallest positive number
/// ```
#[inline(always)]
pub fn exp(x: f32) -> f32 {
    let (p, n) = reduce(clamp(x, -104.0, 89.0));
    scale(1.0 + p, n)
}

/// `e^-x` for x >= 0, the same bits as `exp(-x)` in fewer steps. 2^n cannot overflow, so n + 64 is the exponent of one
/// factor, and the other is 2^-64. The rounding to n adds the exponent's bias too.
#[inline(always)]
pub(in crate::vmath) fn exp_minus(x: f32) -> f32 {
    const BIASED: f32 = ROUND + 191.0; // 127 + 64
    let x = if -x < -104.0 { -104.0 } else { -x };
    let t = x.mul_add(LOG2_E, BIASED);
    let p = expm1_of_rest(x, t - BIASED);
    (1.0 + p) * f32::from_bits(t.to_bits() << 23) * (1.0 / 18_446_744_073_709_551_616.0)
}

/// `2^x`, within 1 ULP and exact for integers; 0 below -150, infinite from 128.
///
/// The fraction `r = x - round(x)` is exact, and `2^r = 1 + r ln 2 + r^2 q(r)` with relative error 2^-28.
#[inline(always)]
pub fn exp2(x: f32) -> f32 {
    const Q: [f32; 5] = [0.240_226_48, 0.055_503_59, 0.009_618_496, 0.001_339_130_3, 0.000_153_310_28];
    let x = clamp(x, -151.0, 128.0);
    let (n, bits) = round_product(x, 1.0);
    let r = x - n;
    scale(1.0 + r.mul_add(LN_2, r * r * polynomial(r, Q)), bits)
}

/// `e^x - 1` without cancellation near 0, within 2 ULP; -1 below -17.4, infinite above 88.72.
///
/// It is `2^n (e^r - 1) + (2^n - 1)`, halved during the addition so that 2^128 does not overflow too early. For n = 0
/// it is the first term alone, since halving would lose a subnormal's last bit.
#[inline(always)]
pub fn expm1(x: f32) -> f32 {
    let (p, n) = reduce(clamp(x, -20.0, 89.0));
    let half = power_of_two(n.wrapping_sub(1));
    let y = if n == 0 { p } else { 2.0 * p.mul_add(half, half - 0.5) };
    y.copysign(x) // changes only the sign of zero
}

/// The hyperbolic tangent, within 2 ULP; exactly +-1 beyond 9.02.
///
/// Up to 0.55 it is `x + x^3 P(x^2)`, relative error 2^-30; beyond, `1 - 2 / (e^2|x| + 1)`.
#[inline(always)]
pub fn tanh(x: f32) -> f32 {
    const P: [f32; 5] = [-0.333_333_16, 0.133_325_56, -0.053_849_645, 0.021_062_01, -0.006_261_896_3];
    let a = x.abs();
    let a2 = a * a;
    let near = (a * a2).mul_add(polynomial(a2, P), a);
    let far = 1.0 - 2.0 / (exp(2.0 * a) + 1.0);
    if a < 0.55 { near } else { far }.copysign(x)
}
