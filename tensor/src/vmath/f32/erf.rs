//! The error function.

use super::exp_minus;
use crate::vmath::{clamp, polynomial};

/// The error function `2/sqrt(pi) * integral from 0 to x of e^-t^2 dt`, within 2 ULP; exactly +-1 beyond 3.92.
///
/// Up to 0.92 it is `x + x p(x^2)`, relative error 2^-30. Beyond, it is `1 - e^q(|x|)`, where the polynomial q
/// approximates the logarithm of the complement, error 2^-34 of the result.
#[inline(always)]
pub fn erf(x: f32) -> f32 {
    const Q: [f32; 8] = [
        0.000_174_491_84,
        -1.129_514,
        -0.633_348_9,
        -0.108_277_86,
        0.025_117_949,
        -0.004_170_49,
        0.000_434_342_74,
        -2.108_466_1e-5,
    ];
    let a = clamp(x.abs(), 0.0, 4.0);
    let far = (1.0 - exp_minus(-polynomial(a, Q))).copysign(x);
    if a < 0.92 { erf_near(x) } else { far }
}

/// The error function for |x| <= 0.92.
#[inline(always)]
pub(in crate::vmath) fn erf_near(x: f32) -> f32 {
    const P: [f32; 7] =
        [0.128_379_17, -0.376_126_32, 0.112_836_786, -0.026_858_734, 0.005_199_772, -0.000_813_124_7, 8.330_086e-5];
    x.mul_add(polynomial(x * x, P), x)
}
