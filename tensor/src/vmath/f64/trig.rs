//! Sine and cosine, of x and of pi x.

use super::{polynomial, round_product};
use std::f64::consts::PI;

/// The sine of x radians, by the platform's libm: within 1 ULP on the usual ones, but not vectorised and not
/// necessarily the same to the last bit on all. A reduction for arguments up to 2^1024 is not worth a vector version.
#[inline(always)]
pub fn sin(x: f64) -> f64 {
    x.sin()
}

/// The cosine of x radians, by the platform's libm; see [`sin`].
#[inline(always)]
pub fn cos(x: f64) -> f64 {
    x.cos()
}

/// Reduces `x >= 0` to `r + n/2` with |r| <= 1/4, exactly; returns sin(pi r), cos(pi r) and n modulo 4.
#[inline(always)]
fn reduce_pi(x: f64) -> (f64, f64, u32) {
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
    (sin, cos, n as u32)
}

/// From the sine and cosine of the reduced angle, the sine of the angle n quarter turns further.
#[inline(always)]
fn quadrant(sin: f64, cos: f64, n: u32) -> f64 {
    let y = if n & 1 == 0 { sin } else { cos };
    f64::from_bits(y.to_bits() ^ (u64::from(n & 2) << 62))
}

/// `sin(pi x)`, within 2 ULP, and exactly 0 at integers (of the sign of x); NaN for infinities.
///
/// The reduction `x - 2 round(x / 2)` is exact, so the error does not grow with x as that of `sin(PI * x)` does.
#[inline(always)]
pub fn sin_pi(x: f64) -> f64 {
    let (sin, cos, n) = reduce_pi(x.abs());
    let y = quadrant(sin, cos, n) + 0.0; // -0 + 0 is 0
    f64::from_bits(y.to_bits() ^ (x.to_bits() & (1 << 63)))
}

/// `cos(pi x)`, within 2 ULP, and exactly 0 halfway between integers; NaN for infinities.
///
/// The reduction `x - 2 round(x / 2)` is exact, so the error does not grow with x as that of `cos(PI * x)` does.
#[inline(always)]
pub fn cos_pi(x: f64) -> f64 {
    let (sin, cos, n) = reduce_pi(x.abs());
    quadrant(sin, cos, n.wrapping_add(1)) + 0.0 // -0 + 0 is 0
}
