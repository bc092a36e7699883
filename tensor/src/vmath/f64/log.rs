//! Logarithms, and softplus.
//!
//! All write the argument as `2^k m` with m between sqrt(1/2) and sqrt(2), and share one rational function for
//! `ln(1 + f)`, `f = m - 1`.

use super::exp::{LN_2_HIGH, LN_2_LOW, exp_minus};
use crate::vmath::polynomial;
use std::f64::consts::{FRAC_1_SQRT_2, LN_2, LOG2_E, SQRT_2};

/// log2(e) - LOG2_E.
const LOG2_E_LOW: f64 = 2.035_527_374_093_103_3e-17;

/// `ln((1 + s) / (1 - s)) = 2 s + s z R(z)`, `z = s^2`, for |s| <= (sqrt(2) - 1) / (sqrt(2) + 1), relative error 2^-59.
const R: [f64; 7] = [
    0.666_666_666_666_673_4,
    0.399_999_999_994_169_85,
    0.285_714_287_419_182_26,
    0.222_221_986_178_973_15,
    0.181_835_621_513_325_25,
    0.153_141_028_950_237_98,
    0.147_954_552_965_288_7,
];

/// Bits below the exponent field.
const FRACTION: u64 = 0x000f_ffff_ffff_ffff;
/// The bits of an integer below 2^52, combined with these, are the bits of 2^52 plus the integer.
const INTEGER: f64 = 4_503_599_627_370_496.0;

/// Splits a positive normal number into `(m, k)` with `x = 2^k m`, and returns `k + 1023` in place of k, as an integer.
#[inline(always)]
fn split(x: f64) -> (f64, u64) {
    // Relative to sqrt(1/2), the exponent field is k and the rest is what m has beyond sqrt(1/2).
    let origin = FRAC_1_SQRT_2.to_bits();
    let bits = x.to_bits().wrapping_sub(origin.wrapping_sub(1023 << 52));
    (f64::from_bits((bits & FRACTION).wrapping_add(origin)), bits >> 52)
}

/// Splits any positive number into `(m, k)`; subnormals are scaled into the normal range first.
#[inline(always)]
fn split_any(x: f64) -> (f64, f64) {
    let tiny = x < f64::MIN_POSITIVE;
    let (m, biased) = split(x * if tiny { INTEGER } else { 1.0 });
    let bias = if tiny { INTEGER + (1023.0 + 52.0) } else { INTEGER + 1023.0 };
    (m, f64::from_bits(biased | INTEGER.to_bits()) - bias)
}

/// `ln(1 + f) - f` for sqrt(1/2) <= 1 + f <= sqrt(2).
///
/// With `s = f / (2 + f)`, 1 + f is (1 + s) / (1 - s). `2 s = f - s f` removes the quotient's rounding error from the
/// leading term.
#[inline(always)]
fn ln1p_tail(f: f64) -> f64 {
    let s = f / (2.0 + f);
    let z = s * s;
    s * z.mul_add(polynomial(z, R), -f)
}

/// Replaces the results outside 0 < x < infinity, where y, the computed logarithm of x, is meaningless.
#[inline(always)]
fn specials(x: f64, y: f64) -> f64 {
    let y = if x < f64::INFINITY { y } else { x };
    let outside = if x == 0.0 { f64::NEG_INFINITY } else { f64::NAN };
    if x > 0.0 { y } else { outside }
}

/// The natural logarithm, within 1 ULP; negative infinity at 0, NaN below.
#[inline(always)]
pub fn ln(x: f64) -> f64 {
    let (m, k) = split_any(x);
    let f = m - 1.0; // exact
    let y = k.mul_add(LN_2_HIGH, k.mul_add(LN_2_LOW, ln1p_tail(f)) + f);
    specials(x, y)
}

/// The logarithm to base 2, within 2 ULP and exact for powers of two; negative infinity at 0, NaN below.
#[inline(always)]
pub fn log2(x: f64) -> f64 {
    let (m, k) = split_any(x);
    let f = m - 1.0;
    let tail = ln1p_tail(f).mul_add(LOG2_E, f * LOG2_E_LOW);
    specials(x, k + f.mul_add(LOG2_E, tail))
}

/// `ln(1 + x)` without cancellation near 0, within 2 ULP; negative infinity at -1, NaN below.
///
/// u is `1 + x` rounded, and `c = (1 + x) - u` is its rounding error. Both are scaled by the same power of two.
#[inline(always)]
pub fn ln1p(x: f64) -> f64 {
    let u = 1.0 + x;
    let back = u - 1.0;
    let c = (1.0 - (u - back)) + (x - back); // exact
    let (m, biased) = split(u);
    // 2^-k by its bits; from k = 1023 on that is 0, and c does not matter any more since x is an integer by far.
    let shrink = f64::from_bits(2046_u64.saturating_sub(biased) << 52);
    let k = f64::from_bits(biased | INTEGER.to_bits()) - (INTEGER + 1023.0);
    let f = c.mul_add(shrink, m - 1.0);
    let y = k.mul_add(LN_2_HIGH, k.mul_add(LN_2_LOW, ln1p_tail(f)) + f);
    specials(u, y).copysign(x)
}

/// `ln(1 + e^x)`, within 2 ULP.
///
/// It is `max(x, 0) + ln(1 + e^-|x|)`: large x does not overflow, and far below 0 `e^x` has all its digits.
#[inline(always)]
pub fn softplus(x: f64) -> f64 {
    let e = exp_minus(x.abs());
    // ln(1 + e) for e in [0, 1]: above sqrt(2), 1 + e is halved. The choice is arithmetic, because LLVM would make two
    // copies of the polynomial out of an `if`.
    let k = f64::from(u8::from(e > SQRT_2 - 1.0));
    let f = (e - k) * k.mul_add(-0.5, 1.0);
    let y = k.mul_add(LN_2, ln1p_tail(f) + f);
    y + if x > 0.0 { x } else { 0.0 }
}
