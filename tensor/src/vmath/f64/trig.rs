//! Sine and cosine, of x and of pi x.

use super::{ROUND, round_product};
use crate::vmath::polynomial;
use std::f64::consts::{FRAC_2_PI, FRAC_PI_2, PI};

/// Largest argument of `sin_quick` and `cos_quick`. The quotient by pi/2 has at most 30 bits there, and its rounding
/// error stretches the reduced angle by 2^-22.
pub(crate) const QUICK: f64 = 1_073_741_824.0;

/// pi/2 in three parts of 53 bits each; the next would be 2^-164.
const HALF_PI: [f64; 3] = [FRAC_PI_2, 6.123_233_995_736_766e-17, -1.497_384_904_859_169_8e-33];

/// The binary digits of 2 / pi after 64 zeros.
const TWO_BY_PI: [u64; 20] = [
    0x0000_0000_0000_0000,
    0xa2f9_836e_4e44_1529,
    0xfc27_57d1_f534_ddc0,
    0xdb62_9599_3c43_9041,
    0xfe51_63ab_debb_c561,
    0xb724_6e3a_424d_d2e0,
    0x0649_2eea_09d1_921c,
    0xfe1d_eb1c_b129_a73e,
    0xe882_35f5_2ebb_4484,
    0xe99c_7026_b45f_7e41,
    0x3991_d639_8353_39f4,
    0x9c84_5f8b_bdf9_283b,
    0x1ff8_97ff_de05_980f,
    0xef2f_118b_5a0a_6d1f,
    0x6d36_7ecf_27cb_09b7,
    0x4f46_3f66_9e5f_ea2d,
    0x7527_bac7_ebe5_f17b,
    0x3d07_39f7_8a52_92ea,
    0x6bfb_5fb1_1f8d_5d08,
    0x5603_3046_fc7b_6bab,
];

/// Reduces `0 <= x <= QUICK` to `r + n pi/2` with |r| <= pi/4 and a little. Only the last two bits of n are valid.
///
/// This is Cody and Waite's reduction. The first difference is exact, since x and n pi/2 are close; the others round
/// once each.
#[inline(always)]
fn reduce_quick(x: f64) -> (f64, u64) {
    let t = x.mul_add(FRAC_2_PI, ROUND);
    let n = t - ROUND;
    let r = n.mul_add(-HALF_PI[0], x);
    let r = n.mul_add(-HALF_PI[1], r);
    (n.mul_add(-HALF_PI[2], r), t.to_bits())
}

/// Reduces `x > QUICK` to `r + n pi/2` with |r| <= pi/4; NaN for infinities and NaN.
///
/// This is Payne and Hanek's reduction in integers. It multiplies `x = m 2^e` by 192 digits of 2/pi; the digits before
/// them give only whole turns. No f64 is closer to a multiple of pi/2 than 2^-62, so at least 64 of the 126 fractional
/// digits of the product are significant.
#[cold]
fn reduce_far(x: f64) -> (f64, u64) {
    if !x.is_finite() {
        return (f64::NAN, 0);
    }
    let bits = x.to_bits();
    let m = (bits & 0x000f_ffff_ffff_ffff) | 0x0010_0000_0000_0000;
    let e = (bits >> 52) as usize + 64 - 1075; // 64 for the zeros ahead
    let (word, shift) = ((e - 2) / 64, (e - 2) % 64);
    let digits = |i: usize| {
        let pair = u128::from(TWO_BY_PI[word + i]) << 64 | u128::from(TWO_BY_PI[word + i + 1]);
        (pair << shift >> 64) as u64
    };
    let wide = |i| u128::from(m) * u128::from(digits(i));
    // The upper 128 of the product's last 192 bits: two of whole quarter turns, then the fraction.
    let product = (wide(0) << 64).wrapping_add(wide(1)).wrapping_add(wide(2) >> 64);
    let n = ((product >> 125) as u64 + 1) >> 1;
    let fraction = (product << 2) as i128; // minus one from 1/2 on, as n is rounded up there
    let high = fraction as f64;
    let low = (fraction - high as i128) as f64;
    let r = high * HALF_PI[0];
    let r_low = high.mul_add(HALF_PI[0], -r) + high.mul_add(HALF_PI[1], low * HALF_PI[0]);
    const SCALE: f64 = 1.0 / (1_u128 << 127) as f64 / 2.0;
    ((r + r_low) * SCALE, n)
}

/// The reduction for any x. It has a branch: only loops over the quick functions vectorise.
#[inline(always)]
fn reduce(x: f64) -> (f64, u64) {
    if x <= QUICK { reduce_quick(x) } else { reduce_far(x) }
}

/// `sin r = r + r^3 S(r^2)` for |r| <= pi/4, relative error 2^-58.
#[inline(always)]
fn sin_near(r: f64) -> f64 {
    const S: [f64; 6] = [
        -0.166_666_666_666_666_3,
        0.008_333_333_333_321_913_5,
        -0.000_198_412_698_294_531_84,
        2.755_731_358_034_778_1e-6,
        -2.505_074_202_909_683e-8,
        1.589_592_766_576_288_9e-10,
    ];
    let t = r * r;
    (t * r).mul_add(polynomial(t, S), r)
}

/// `cos r = 1 - r^2/2 + r^4 C(r^2)` for |r| <= pi/4, relative error 2^-64.
#[inline(always)]
fn cos_near(r: f64) -> f64 {
    const C: [f64; 7] = [
        -0.5,
        0.041_666_666_666_666_595,
        -0.001_388_888_888_887_334_4,
        2.480_158_728_900_364_5e-5,
        -2.755_731_421_741_563_7e-7,
        2.087_570_542_908_102_7e-9,
        -1.135_874_984_484_000_8e-11,
    ];
    let t = r * r;
    t.mul_add(polynomial(t, C), 1.0)
}

/// The sine of x radians, within 2 ULP for every finite x of any size; NaN for infinities.
#[inline(always)]
pub fn sin(x: f64) -> f64 {
    let (r, n) = reduce(x.abs());
    odd(quadrant(sin_near(r), cos_near(r), n), x)
}

/// The cosine of x radians, within 2 ULP for every finite x of any size; NaN for infinities.
#[inline(always)]
pub fn cos(x: f64) -> f64 {
    let (r, n) = reduce(x.abs());
    quadrant(sin_near(r), cos_near(r), n.wrapping_add(1))
}

/// The same bits as [`sin`] for |x| <= 2^30, and meaningless beyond. It has no branch, so that a loop vectorises.
/// [`map_real`](crate::map_real) uses it where it is valid.
#[inline(always)]
pub fn sin_quick(x: f64) -> f64 {
    let (r, n) = reduce_quick(x.abs());
    odd(quadrant(sin_near(r), cos_near(r), n), x)
}

/// The same bits as [`cos`] for |x| <= 2^30, and meaningless beyond. It has no branch, so that a loop vectorises.
#[inline(always)]
pub fn cos_quick(x: f64) -> f64 {
    let (r, n) = reduce_quick(x.abs());
    quadrant(sin_near(r), cos_near(r), n.wrapping_add(1))
}

/// Reduces `x >= 0` to `r + n/2` with |r| <= 1/4, exactly; returns sin(pi r), cos(pi r) and n modulo 4.
#[inline(always)]
fn reduce_pi(x: f64) -> (f64, f64, u64) {
    /// `sin(pi r) = pi r + r^3 S(r^2)` for |r| <= 1/4, relative error 2^-63.
    const S: [f64; 7] = [
        -5.167_712_780_049_97,
        2.550_164_039_877_408_6,
        -0.599_264_529_326_666_6,
        0.082_145_886_862_436_97,
        -0.007_370_436_290_347_385,
        0.000_466_354_885_085_279_7,
        -2.203_758_099_719_431_7e-5,
    ];
    /// `cos(pi r) = 1 + r^2 C(r^2)` for |r| <= 1/4, relative error 2^-61.
    const C: [f64; 8] = [
        -4.934_802_200_544_679,
        4.058_712_126_416_651,
        -1.335_262_768_839_688_8,
        0.235_330_629_450_163_03,
        -0.025_806_861_474_003_174,
        0.001_929_028_633_439_771_7,
        -9.944_338_609_402_793e-5,
        -1.585_598_500_953_840_5e-5,
    ];
    /// pi - PI.
    const PI_LOW: f64 = 1.224_646_799_147_353_2e-16;
    let y = (-2.0_f64).mul_add((0.5 * x).round_ties_even(), x);
    let (half_turns, n) = round_product(y, 2.0);
    let r = half_turns.mul_add(-0.5, y);
    let t = r * r;
    let sin = r.mul_add(PI, r.mul_add(PI_LOW, t * r * polynomial(t, S)));
    let cos = t.mul_add(polynomial(t, C), 1.0);
    (sin, cos, n as u64)
}

/// The sine of the angle n quarter turns further, from the sine and cosine of the reduced angle.
#[inline(always)]
fn quadrant(sin: f64, cos: f64, n: u64) -> f64 {
    let y = if n & 1 == 0 { sin } else { cos };
    f64::from_bits(y.to_bits() ^ (n & 2) << 62)
}

/// Flips the sign of y if x is negative.
#[inline(always)]
fn odd(y: f64, x: f64) -> f64 {
    f64::from_bits(y.to_bits() ^ (x.to_bits() & 1 << 63))
}

/// `sin(pi x)`, within 2 ULP, and exactly 0 at integers (of the sign of x); NaN for infinities.
///
/// The reduction `x - 2 round(x / 2)` is exact, so the error does not grow with x as that of `sin(PI * x)` does.
#[inline(always)]
pub fn sin_pi(x: f64) -> f64 {
    let (sin, cos, n) = reduce_pi(x.abs());
    odd(quadrant(sin, cos, n) + 0.0, x) // -0 + 0 is 0
}

/// `cos(pi x)`, within 2 ULP, and exactly 0 halfway between integers; NaN for infinities.
///
/// The reduction `x - 2 round(x / 2)` is exact, so the error does not grow with x as that of `cos(PI * x)` does.
#[inline(always)]
pub fn cos_pi(x: f64) -> f64 {
    let (sin, cos, n) = reduce_pi(x.abs());
    quadrant(sin, cos, n.wrapping_add(1)) + 0.0 // -0 + 0 is 0
}
