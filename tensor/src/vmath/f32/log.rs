//! Logarithms, and softplus.
//!
//! All write the argument as `2^k m` with m between sqrt(1/2) and sqrt(2), and share one polynomial for `ln(1 + f)`,
//! `f = m - 1`.

use super::exp::{LN_2_HIGH, LN_2_LOW, exp_minus};
use crate::vmath::polynomial;
use std::f32::consts::{FRAC_1_SQRT_2, LN_2, LOG2_E, SQRT_2};

/// log2(e) - LOG2_E.
const LOG2_E_LOW: f32 = 1.925_963e-8;

/// `ln(1 + f) = f - f^2/2 + f^3 P(f)` for sqrt(1/2) <= 1 + f <= sqrt(2), relative error 2^-30.
const LN1P: [f32; 9] = [
    0.333_333_13,
    -0.250_000_12,
    0.200_020_73,
    -0.166_678_55,
    0.142_202_33,
    -0.124_081_97,
    0.118_862_04,
    -0.116_606_6,
    0.067_330_09,
];

/// Splits a positive normal number into `(m, k)` with `x = 2^k m`.
#[inline(always)]
fn split(x: f32) -> (f32, i32) {
    // Relative to sqrt(1/2), the exponent field is k and the rest is what m has beyond sqrt(1/2).
    let origin = FRAC_1_SQRT_2.to_bits();
    let bits = x.to_bits().wrapping_sub(origin);
    (f32::from_bits((bits & 0x007f_ffff).wrapping_add(origin)), (bits as i32) >> 23)
}

/// `ln(1 + f) - f` for sqrt(1/2) <= 1 + f <= sqrt(2).
#[inline(always)]
fn ln1p_tail(f: f32) -> f32 {
    let f2 = f * f;
    f2 * f.mul_add(polynomial(f, LN1P), -0.5)
}

/// Splits any positive number into `(m, k)`; subnormals are scaled into the normal range first.
#[inline(always)]
fn split_any(x: f32) -> (f32, i32) {
    let tiny = x < f32::MIN_POSITIVE;
    let (m, k) = split(if tiny { x * 8_388_608.0 } else { x });
    (m, if tiny { k.wrapping_sub(23) } else { k })
}

/// Replaces the results outside 0 < x < infinity, where y, the computed logarithm of x, is meaningless.
#[inline(always)]
fn specials(x: f32, y: f32) -> f32 {
    let y = if x < f32::INFINITY { y } else { x };
    let outside = if x == 0.0 { f32::NEG_INFINITY } else { f32::NAN };
    if x > 0.0 { y } else { outside }
}

/// The natural logarithm, within 1 ULP; negative infinity at 0, NaN below.
///
/// ```
/// use raygrad_tensor::vmath::f32::ln;
/// assert_eq!(ln(10.0), std::f32::consts::LN_10);
/// assert_eq!(ln(1.4e-45), -103.27893); // the smallest positive number
/// ```
#[inline(always)]
pub fn ln(x: f32) -> f32 {
    let (m, k) = split_any(x);
    let k = k as f32;
    let f = m - 1.0; // exact
    let y = k.mul_add(LN_2_HIGH, k.mul_add(LN_2_LOW, ln1p_tail(f)) + f);
    specials(x, y)
}

/// The logarithm to base 2, within 2 ULP and exact for powers of two; negative infinity at 0, NaN below.
///
/// It is `k + log2(e) ln(m)`, with log2(e) in two parts in the leading product.
#[inline(always)]
pub fn log2(x: f32) -> f32 {
    let (m, k) = split_any(x);
    let f = m - 1.0;
    let tail = ln1p_tail(f).mul_add(LOG2_E, f * LOG2_E_LOW);
    specials(x, k as f32 + f.mul_add(LOG2_E, tail))
}

/// `ln(1 + x)` without cancellation near 0, within 2 ULP; negative infinity at -1, NaN below.
///
/// u is `1 + x` rounded, and `c = (1 + x) - u` is its rounding error. Both are scaled by the same power of two.
#[inline(always)]
pub fn ln1p(x: f32) -> f32 {
    let u = 1.0 + x;
    let back = u - 1.0;
    let c = (1.0 - (u - back)) + (x - back); // exact
    let (m, k) = split(u);
    // 2^-k by its bits; from k = 127 on that is 0, and c does not matter any more since x is an integer by far.
    let shrink = f32::from_bits((127_i32.wrapping_sub(k).max(0) as u32) << 23);
    let k = k as f32;
    let f = c.mul_add(shrink, m - 1.0);
    let y = k.mul_add(LN_2_HIGH, k.mul_add(LN_2_LOW, ln1p_tail(f)) + f);
    specials(u, y).copysign(x)
}

/// `ln(1 + e^x)`, within 2 ULP.
///
/// It is `max(x, 0) + ln(1 + e^-|x|)`: large x does not overflow, and far below 0 `e^x` has all its digits.
///
/// ```
/// use raygrad_tensor::vmath::f32::softplus;
/// assert_eq!(softplus(0.0), std::f32::consts::LN_2);
/// assert_eq!(softplus(-20.0), 2.0611536e-9);
/// assert_eq!(softplus(89.0), 89.0);
/// ```
#[inline(always)]
pub fn softplus(x: f32) -> f32 {
    let e = exp_minus(x.abs());
    // ln(1 + e) for e in [0, 1]: above sqrt(2), 1 + e is halved. The choice is arithmetic, because LLVM would make two
    // copies of the polynomial out of an `if`.
    let k = f32::from(u8::from(e > SQRT_2 - 1.0));
    let f = (e - k) * k.mul_add(-0.5, 1.0);
    let y = k.mul_add(LN_2, ln1p_tail(f) + f);
    y + if x > 0.0 { x } else { 0.0 }
}
