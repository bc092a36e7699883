//! Sine and cosine, of x and of pi x.

use crate::vmath::f64::ROUND;
use crate::vmath::polynomial;
use std::f32::consts::{FRAC_2_PI, FRAC_PI_2, PI};

/// Largest argument of `sin_quick` and `cos_quick`. The quotient by pi/2 has at most 16 bits there, and its rounding
/// error stretches the reduced angle by a thousandth only.
pub(crate) const QUICK: f32 = 65_536.0;

/// pi/2 in three parts of 24 bits each; the next would be 2^-77.
const HALF_PI: [f32; 3] = [FRAC_PI_2, -4.371_138_83e-8, -1.715_124_51e-15];

const TWO_TO_MINUS_29: f64 = 1.0 / (1_u64 << 29) as f64;

/// 1 / (2 pi) in five chunks of 29 bits and the 53 bits after them. An f32 has 24 bits, so its product with a chunk has
/// 53 and is exact in f64. For arguments below 2^128 the rest of the expansion has no effect.
const TURNS: [f64; 6] = [
    0x0517_cc1b as f64 * TWO_TO_MINUS_29,
    0x0e4e_4415 as f64 * TWO_TO_MINUS_29 * TWO_TO_MINUS_29,
    0x053f_84ea as f64 * TWO_TO_MINUS_29 * TWO_TO_MINUS_29 * TWO_TO_MINUS_29,
    0x1f47_d4d3 as f64 * TWO_TO_MINUS_29 * TWO_TO_MINUS_29 * TWO_TO_MINUS_29 * TWO_TO_MINUS_29,
    0x0ee0_6db1 as f64 * TWO_TO_MINUS_29 * TWO_TO_MINUS_29 * TWO_TO_MINUS_29 * TWO_TO_MINUS_29 * TWO_TO_MINUS_29,
    6.551007954373285e-45,
];

/// Reduces `0 <= x <= QUICK` to `r + n pi/2` with |r| <= pi/4 and a little. Only the last two bits of n are valid.
///
/// This is Cody and Waite's reduction. The first difference is exact, since x and n pi/2 are close; the others round
/// once each.
#[inline(always)]
fn reduce_quick(x: f32) -> (f32, u32) {
    let t = x.mul_add(FRAC_2_PI, super::ROUND);
    let n = t - super::ROUND;
    let r = n.mul_add(-HALF_PI[0], x);
    let r = n.mul_add(-HALF_PI[1], r);
    (n.mul_add(-HALF_PI[2], r), t.to_bits())
}

/// `x * chunk` without its whole turns, exactly.
#[inline(always)]
fn fraction(x: f64, chunk: f64) -> f64 {
    let p = x * chunk;
    p - p.round_ties_even()
}

/// Reduces any `x >= 0` to `r + n pi/2` with |r| <= pi/4. Only the last two bits of n are valid.
///
/// It is Payne and Hanek's idea without integers or tables: the whole turns in each chunk's product are dropped at
/// once. The fractions that stay are summed twice: first to find n, then from the largest on with n subtracted. So
/// cancellation next to a multiple of pi/2 is exact too.
#[inline(always)]
fn reduce_far(x: f32) -> (f32, u32) {
    let x = f64::from(x);
    let f0 = fraction(x, TURNS[0]);
    let f1 = fraction(x, TURNS[1]);
    let f2 = fraction(x, TURNS[2]);
    let f3 = fraction(x, TURNS[3]);
    let f4 = fraction(x, TURNS[4]);
    let tail = f2 + (f3 + x.mul_add(TURNS[5], f4)); // the last product is below 2^-18: no whole turns to drop
    let quarters = (f0 + (f1 + tail)).mul_add(4.0, ROUND);
    let n = quarters.to_bits() as u32;
    let turns = (quarters - ROUND).mul_add(-0.25, f0) + f1 + tail;
    ((turns * std::f64::consts::TAU) as f32, n)
}

/// The reduction for any x. It computes both reductions and selects one, so that there is no branch.
#[inline(always)]
fn reduce(x: f32) -> (f32, u32) {
    let (quick, far) = (reduce_quick(x), reduce_far(x));
    if x <= QUICK { quick } else { far }
}

/// `sin r = r + r^3 S(r^2)` for |r| <= pi/4, relative error 2^-32.
#[inline(always)]
fn sin_near(r: f32) -> f32 {
    const S: [f32; 4] = [-0.166_666_67, 0.008_333_378, -0.000_198_521_29, 2.822_030_4e-6];
    let t = r * r;
    (t * r).mul_add(polynomial(t, S), r)
}

/// `cos r = 1 - r^2/2 + r^4 C(r^2)` for |r| <= pi/4, relative error 2^-33.
#[inline(always)]
fn cos_near(r: f32) -> f32 {
    const C: [f32; 4] = [-0.5, 0.041_666_646, -0.001_388_731_1, 2.443_256_6e-5];
    let t = r * r;
    t.mul_add(polynomial(t, C), 1.0)
}

/// The sine of the angle n quarter turns further, from the sine and cosine of the reduced angle.
#[inline(always)]
fn quadrant(sin: f32, cos: f32, n: u32) -> f32 {
    let y = if n & 1 == 0 { sin } else { cos };
    f32::from_bits(y.to_bits() ^ (n & 2) << 30)
}

/// Flips the sign of y if x is negative.
#[inline(always)]
fn odd(y: f32, x: f32) -> f32 {
    f32::from_bits(y.to_bits() ^ (x.to_bits() & 0x8000_0000))
}

/// The sine of x radians, within 2 ULP for every finite x of any size; NaN for infinities.
///
/// ```
/// use raygrad_tensor::vmath::f32::sin;
/// assert_eq!(sin(std::f32::consts::PI), -8.742278e-8); // the f32 next to pi is above it
/// ```
#[inline(always)]
pub fn sin(x: f32) -> f32 {
    let (r, n) = reduce(x.abs());
    odd(quadrant(sin_near(r), cos_near(r), n), x)
}

/// The cosine of x radians, within 2 ULP for every finite x of any size; NaN for infinities.
#[inline(always)]
pub fn cos(x: f32) -> f32 {
    let (r, n) = reduce(x.abs());
    quadrant(sin_near(r), cos_near(r), n.wrapping_add(1))
}

/// The same bits as [`sin`] in a third of the time for |x| <= 65536, and meaningless beyond.
/// [`map_real`](crate::map_real) uses it where it is valid.
#[inline(always)]
pub fn sin_quick(x: f32) -> f32 {
    let (r, n) = reduce_quick(x.abs());
    odd(quadrant(sin_near(r), cos_near(r), n), x)
}

/// The same bits as [`cos`] in a third of the time for |x| <= 65536, and meaningless beyond.
#[inline(always)]
pub fn cos_quick(x: f32) -> f32 {
    let (r, n) = reduce_quick(x.abs());
    quadrant(sin_near(r), cos_near(r), n.wrapping_add(1))
}

/// Reduces `x >= 0` to `r + n/2` with |r| <= 1/4, exactly; returns sin(pi r), cos(pi r) and n modulo 4.
#[inline(always)]
fn reduce_pi(x: f32) -> (f32, f32, u32) {
    /// `sin(pi r) = pi r + r^3 S(r^2)` for |r| <= 1/4, relative error 2^-33.
    const S: [f32; 4] = [-5.167_712_7, 2.550_155_4, -0.599_014_2, 0.079_510_71];
    /// `cos(pi r) = 1 + r^2 C(r^2)` for |r| <= 1/4, relative error 2^-31.
    const C: [f32; 4] = [-4.934_802, 4.058_697, -1.334_780_7, 0.229_223_8];
    /// pi - PI.
    const PI_LOW: f32 = -8.742_278e-8;
    let y = (-2.0_f32).mul_add((0.5 * x).round_ties_even(), x);
    let (half_turns, n) = super::round_product(y, 2.0);
    let r = half_turns.mul_add(-0.5, y);
    let t = r * r;
    let sin = r.mul_add(PI, r.mul_add(PI_LOW, t * r * polynomial(t, S)));
    let cos = t.mul_add(polynomial(t, C), 1.0);
    (sin, cos, n as u32)
}

/// `sin(pi x)`, within 2 ULP, and exactly 0 at integers (of the sign of x); NaN for infinities.
///
/// The reduction `x - 2 round(x / 2)` is exact, so the error does not grow with x as that of `sin(PI * x)` does.
#[inline(always)]
pub fn sin_pi(x: f32) -> f32 {
    let (sin, cos, n) = reduce_pi(x.abs());
    odd(quadrant(sin, cos, n) + 0.0, x) // -0 + 0 is 0
}

/// `cos(pi x)`, within 2 ULP, and exactly 0 halfway between integers; NaN for infinities.
///
/// The reduction `x - 2 round(x / 2)` is exact, so the error does not grow with x as that of `cos(PI * x)` does.
#[inline(always)]
pub fn cos_pi(x: f32) -> f32 {
    let (sin, cos, n) = reduce_pi(x.abs());
    quadrant(sin, cos, n.wrapping_add(1)) + 0.0 // -0 + 0 is 0
}
