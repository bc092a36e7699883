//! The exponential and what follows from it.
//!
//! All share one reduction, `x = n ln 2 + r` with integer n and |r| <= ln 2 / 2, and one polynomial for `e^r - 1`.

use super::{ROUND, clamp, polynomial, power_of_two, round_product};
use std::f64::consts::{LN_2, LOG2_E};

/// ln 2 in two parts. The first has 42 significant bits: times an integer below 2^11 it is exact.
const LN_2_HIGH: f64 = 0.693_147_180_559_890_3;
const LN_2_LOW: f64 = 5.497_923_018_708_371e-14;

/// `e^r - 1 = r + r^2 q(r)` for |r| <= ln 2 / 2, relative error 2^-64.
const EXPM1: [f64; 12] = [
    0.5,
    0.166_666_666_666_666_66,
    0.041_666_666_666_666_67,
    0.008_333_333_333_334_282,
    0.001_388_888_888_888_343_6,
    0.000_198_412_698_380_123_3,
    2.480_158_732_464_138_4e-5,
    2.755_732_418_785_565_3e-6,
    2.755_727_585_047_257e-7,
    2.504_862_960_935_101e-8,
    2.091_357_421_395_875_3e-9,
    1.698_469_329_502_118e-10,
];

/// `e^(r + low) - 1` for |r| <= ln 2 / 2 and a rounding error `low` of r.
#[inline(always)]
fn expm1_near(r: f64, low: f64) -> f64 {
    (r * r).mul_add(polynomial(r, EXPM1), low) + r
}

/// Splits `x = n ln 2 + r` and returns `(e^r - 1, n)`.
#[inline(always)]
fn reduce(x: f64) -> (f64, i32) {
    let (n, bits) = round_product(x, LOG2_E);
    (expm1_of_rest(x, n), bits)
}

/// `e^r - 1` for `r = x - n ln 2`.
#[inline(always)]
fn expm1_of_rest(x: f64, n: f64) -> f64 {
    let high = n.mul_add(-LN_2_HIGH, x); // exact
    let r = n.mul_add(-LN_2_LOW, high);
    expm1_near(r, n.mul_add(-LN_2_LOW, high - r))
}

/// `p * 2^n` for -2044 <= n <= 2046 and rounded once: two factors, because 2^n alone may be out of range.
#[inline(always)]
fn scale(p: f64, n: i32) -> f64 {
    let half = n >> 1;
    p * power_of_two(half) * power_of_two(n.wrapping_sub(half))
}

/// `e^x`, within 1 ULP; 0 below -745.14, infinite above 709.78.
#[inline(always)]
pub fn exp(x: f64) -> f64 {
    let (p, n) = reduce(clamp(x, -746.0, 710.0));
    scale(1.0 + p, n)
}

/// `e^-x` for x >= 0, the same bits as `exp(-x)` in fewer steps: 2^n cannot overflow, so n + 64 is the exponent of one
/// factor, and the other is 2^-64. The rounding to n adds the exponent's bias as well.
#[inline(always)]
pub(super) fn exp_minus(x: f64) -> f64 {
    const BIASED: f64 = ROUND + 1087.0; // 1023 + 64
    let x = if -x < -746.0 { -746.0 } else { -x };
    let t = x.mul_add(LOG2_E, BIASED);
    let p = expm1_of_rest(x, t - BIASED);
    (1.0 + p) * f64::from_bits(t.to_bits() << 52) * (1.0 / 18_446_744_073_709_551_616.0)
}

/// `2^x`, within 1 ULP and exact for integers; 0 below -1075, infinite from 1024.
#[inline(always)]
pub fn exp2(x: f64) -> f64 {
    /// ln 2 - LN_2.
    const LN_2_REST: f64 = 2.319_046_813_846_299_6e-17;
    let x = clamp(x, -1076.0, 1024.0);
    let (n, bits) = round_product(x, 1.0);
    let f = x - n; // exact
    let r = f * LN_2;
    let low = f.mul_add(LN_2_REST, f.mul_add(LN_2, -r));
    scale(1.0 + expm1_near(r, low), bits)
}

/// `e^x - 1` without cancellation near 0, within 2 ULP; -1 below -37.5, infinite above 709.78.
///
/// `2^n (e^r - 1) + (2^n - 1)`, halved while it is added so that 2^1024 does not overflow too early; for n = 0 just the
/// first term, since halving would cost a subnormal its last bit.
#[inline(always)]
pub fn expm1(x: f64) -> f64 {
    let (p, n) = reduce(clamp(x, -40.0, 710.0));
    let half = power_of_two(n.wrapping_sub(1));
    let y = if n == 0 { p } else { 2.0 * p.mul_add(half, half - 0.5) };
    y.copysign(x) // changes only the sign of zero
}

/// The hyperbolic tangent, within 2 ULP; exactly +-1 beyond 19.07.
///
/// Up to 0.55 it is `x + x^3 P(x^2)`, relative error 2^-60; beyond, `1 - 2 / (e^2|x| + 1)`.
#[inline(always)]
pub fn tanh(x: f64) -> f64 {
    const P: [f64; 11] = [
        -0.333_333_333_333_333,
        0.133_333_333_333_265_9,
        -0.053_968_253_963_746_896,
        0.021_869_488_385_524_76,
        -0.008_863_232_596_709_594,
        0.003_592_091_987_753_024_7,
        -0.001_455_542_596_044_563,
        0.000_588_443_540_453_028_8,
        -0.000_233_379_327_194_908_65,
        8.331_343_922_189_946e-5,
        -1.949_293_424_561_201_3e-5,
    ];
    let a = x.abs();
    let a2 = a * a;
    let near = (a * a2).mul_add(polynomial(a2, P), a);
    let far = 1.0 - 2.0 / (exp(2.0 * a) + 1.0);
    if a < 0.55 { near } else { far }.copysign(x)
}

/// The logistic function `1 / (1 + e^-x)`, within 2 ULP.
///
/// With `e = e^-|x|` it is `1 / (1 + e)` for x >= 0 and `e / (1 + e)` below, so nothing overflows and small results
/// keep all their digits. Below 1/4, one step of `y = e (1 - y)` makes up
/// for the rounding of `1 + e` and of the quotient.
#[inline(always)]
pub fn sigmoid(x: f64) -> f64 {
    let e = exp_minus(x.abs());
    let y = if x < 0.0 { e } else { 1.0 } / (1.0 + e);
    if y < 0.25 { (-e).mul_add(y, e) } else { y }
}
