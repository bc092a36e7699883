//! Exponentials, and tanh.
//!
//! All share one reduction, `x = n ln 2 + r` with integer n and |r| <= ln 2 / 2, and one polynomial for `e^r - 1`.

use super::{ROUND, power_of_two, round_product};
use crate::vmath::{clamp, polynomial};
use std::f64::consts::{LN_2, LOG2_E};

/// ln 2 in two parts. The first has 42 significant bits: times an integer below 2^11 it is exact.
pub(super) const LN_2_HIGH: f64 = 0.693_147_180_559_890_3;
pub(super) const LN_2_LOW: f64 = 5.497_923_018_708_371e-14;

/// `e^r - 1 = r + r^2 q(r)` for |r| <= ln 2 / 2, relative error 2^-60.
const EXPM1: [f64; 11] = [
    0.5,
    0.166_666_666_666_666_7,
    0.041_666_666_666_666_67,
    0.008_333_333_333_326_141,
    0.001_388_888_888_888_375_2,
    0.000_198_412_698_748_004_93,
    2.480_158_732_553_336_3e-5,
    2.755_725_542_574_643_5e-6,
    2.755_727_366_134_863_7e-7,
    2.510_520_637_395_701e-8,
    2.091_467_937_658_393_5e-9,
];

/// `e^r` for `r = x - n ln 2`.
#[inline(always)]
fn exp_of_rest(x: f64, n: f64) -> f64 {
    let r = n.mul_add(-LN_2_LOW, n.mul_add(-LN_2_HIGH, x));
    1.0 + (r * r).mul_add(polynomial(r, EXPM1), r)
}

/// `e^r - 1` for `r = x - n ln 2`.
#[inline(always)]
pub(in crate::vmath) fn expm1_of_rest(x: f64, n: f64) -> f64 {
    let high = n.mul_add(-LN_2_HIGH, x); // exact
    let r = n.mul_add(-LN_2_LOW, high);
    let r_low = n.mul_add(-LN_2_LOW, high - r);
    (r * r).mul_add(polynomial(r, EXPM1), r_low) + r
}

/// 2^64, the last scaling factor of results: 2^n alone may be out of range, 2^(n - 64) or 2^(n + 64) is not.
const FAR: f64 = 18_446_744_073_709_551_616.0;

/// A number to add to one of the sign of `x`. Its rounding to an integer n then adds the exponent's bias too, and moves
/// it by 64 towards 0. The low bits of the sum are the exponent field of 2^(n - 64) or 2^(n + 64).
#[inline(always)]
fn bias(x: f64) -> f64 {
    if x > 0.0 { ROUND + (1023.0 - 64.0) } else { ROUND + (1023.0 + 64.0) }
}

/// `p * 2^n` rounded once, for -1076 <= n <= 1024 and `t = n + bias(x)`.
#[inline(always)]
fn scale(p: f64, t: f64, x: f64) -> f64 {
    p * f64::from_bits(t.to_bits() << 52) * if x > 0.0 { FAR } else { 1.0 / FAR }
}

/// `e^x`, within 1 ULP; 0 below -745.14, infinite above 709.78.
#[inline(always)]
pub fn exp(x: f64) -> f64 {
    let x = clamp(x, -746.0, 710.0);
    let t = x.mul_add(LOG2_E, bias(x));
    scale(exp_of_rest(x, t - bias(x)), t, x)
}

/// `e^-x` for x >= 0, the same bits as `exp(-x)` in fewer steps.
#[inline(always)]
pub(in crate::vmath) fn exp_minus(x: f64) -> f64 {
    let x = if -x < -746.0 { -746.0 } else { -x };
    let t = x.mul_add(LOG2_E, bias(-1.0));
    scale(exp_of_rest(x, t - bias(-1.0)), t, -1.0)
}

/// `2^x`, within 1 ULP and exact for integers; 0 below -1075, infinite from 1024.
#[inline(always)]
pub fn exp2(x: f64) -> f64 {
    /// `2^f = 1 + f ln 2 + f^2 q(f)` for |f| <= 1/2, relative error 2^-60; with the rounding of ln 2, 2^-55.
    const Q: [f64; 11] = [
        0.240_226_506_959_100_72,
        0.055_504_108_664_821_6,
        0.009_618_129_107_628_479,
        0.001_333_355_814_641_693_6,
        0.000_154_035_303_933_759_14,
        1.525_273_382_983_612e-5,
        1.321_548_680_290_393_1e-6,
        1.017_806_244_584_577_4e-7,
        7.054_899_956_372_649e-9,
        4.454_960_598_186_518_6e-10,
        2.572_508_057_683_636e-11,
    ];
    let x = clamp(x, -1076.0, 1024.0);
    let t = x + bias(x);
    let f = x - (t - bias(x)); // exact
    scale(1.0 + f.mul_add(LN_2, f * f * polynomial(f, Q)), t, x)
}

/// `e^x - 1` without cancellation near 0, within 2 ULP; -1 below -37.5, infinite above 709.78.
///
/// It is `2^n (e^r - 1) + (2^n - 1)`, halved during the addition so that 2^1024 does not overflow too early. For n = 0
/// it is the first term alone, since halving would lose a subnormal's last bit.
#[inline(always)]
pub fn expm1(x: f64) -> f64 {
    let x = clamp(x, -40.0, 710.0);
    let (n, bits) = round_product(x, LOG2_E);
    let p = expm1_of_rest(x, n);
    let half = power_of_two(bits.wrapping_sub(1));
    let y = if bits == 0 { p } else { 2.0 * p.mul_add(half, half - 0.5) };
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
