//! The numbers that an elementwise formula is written for.

use crate::vmath;
use std::ops::{Add, Div, Mul, Neg, Sub};

/// A real number, as an elementwise formula sees it.
///
/// A formula that is generic over `Real` is read in several ways: numbers compile to one vectorised loop, dual numbers
/// carry derivatives along, and what stands for a variable of a tape writes the formula down there (gradients of
/// gradients). Formulas have no branches: they choose with [`if_positive`](Self::if_positive).
pub trait Real:
    Copy + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self> + Div<Output = Self> + Neg<Output = Self>
{
    /// The constant `value`, of this number's kind.
    fn like(&self, value: f64) -> Self;
    /// `yes` where this number is greater than 0, else `no`; `no` where it is NaN. The choice itself has derivative 0.
    fn if_positive(&self, yes: Self, no: Self) -> Self;
    /// `e^x`.
    fn exp(self) -> Self;
    /// `e^x - 1`, accurate near 0.
    fn expm1(self) -> Self;
    /// The natural logarithm.
    fn ln(self) -> Self;
    /// `ln(1 + x)`, accurate near 0.
    fn ln1p(self) -> Self;
    /// Sine of an angle in radians.
    fn sin(self) -> Self;
    /// Cosine of an angle in radians.
    fn cos(self) -> Self;
    /// `sin(pi x)`, with `x` reduced exactly first.
    fn sin_pi(self) -> Self;
    /// `cos(pi x)`, with `x` reduced exactly first.
    fn cos_pi(self) -> Self;
    /// Hyperbolic tangent.
    fn tanh(self) -> Self;
    /// `1 / (1 + e^-x)`.
    fn sigmoid(self) -> Self;
    /// `ln(1 + e^x)`.
    fn softplus(self) -> Self;
    /// Square root.
    fn sqrt(self) -> Self;
    /// `2^x`.
    fn exp2(self) -> Self;
    /// The logarithm to base 2.
    fn log2(self) -> Self;
    /// The error function.
    fn erf(self) -> Self;
    /// Tangent of an angle in radians.
    fn tan(self) -> Self;
    /// The angle in -pi/2..=pi/2 of this sine; NaN outside -1..=1.
    fn asin(self) -> Self;
    /// The angle in 0..=pi of this cosine; NaN outside -1..=1.
    fn acos(self) -> Self;
    /// The angle in -pi/2..=pi/2 of this tangent.
    fn atan(self) -> Self;
    /// The angle in -pi..=pi of the vector (`x`, `self`).
    fn atan2(self, x: Self) -> Self;
    /// Hyperbolic sine.
    fn sinh(self) -> Self;
    /// Hyperbolic cosine.
    fn cosh(self) -> Self;
    /// The power with a whole exponent; 1 for exponent 0, whatever the base.
    fn powi(self, exponent: i32) -> Self;
    /// The power with a real exponent; NaN for a negative base and a broken exponent.
    fn pow(self, exponent: Self) -> Self;
    /// The absolute value.
    fn abs(self) -> Self;
    /// 1 for positive numbers, -1 for negative ones; zeros and NaN stay what they are. Its derivative is 0.
    fn sign(self) -> Self;
    /// The greater of two numbers; NaN if one of them is.
    fn maximum(self, other: Self) -> Self;
    /// The smaller of two numbers; NaN if one of them is.
    fn minimum(self, other: Self) -> Self;
    /// The next whole number below. Its derivative is 0.
    fn floor(self) -> Self;
    /// The next whole number above. Its derivative is 0.
    fn ceil(self) -> Self;
    /// The nearest whole number, the even one of two. Its derivative is 0.
    fn round(self) -> Self;
}

/// The functions whose vector version is not worth its while are the standard library's: right to an ULP or so on the
/// usual platforms, but calls, which end vectorisation.
macro_rules! from_std {
    ($t:ident: $($f:ident)*) => {
        $(
            #[inline(always)]
            fn $f(self) -> Self {
                $t::$f(self)
            }
        )*
    };
}

macro_rules! real {
    ($t:ident) => {
        impl Real for $t {
            #[inline(always)]
            fn like(&self, value: f64) -> Self {
                value as $t
            }
            #[inline(always)]
            fn if_positive(&self, yes: Self, no: Self) -> Self {
                if *self > 0.0 { yes } else { no }
            }
            #[inline(always)]
            fn exp(self) -> Self {
                vmath::$t::exp(self)
            }
            #[inline(always)]
            fn expm1(self) -> Self {
                vmath::$t::expm1(self)
            }
            #[inline(always)]
            fn ln(self) -> Self {
                vmath::$t::ln(self)
            }
            #[inline(always)]
            fn ln1p(self) -> Self {
                vmath::$t::ln1p(self)
            }
            #[inline(always)]
            fn sin(self) -> Self {
                vmath::$t::sin(self)
            }
            #[inline(always)]
            fn cos(self) -> Self {
                vmath::$t::cos(self)
            }
            #[inline(always)]
            fn sin_pi(self) -> Self {
                vmath::$t::sin_pi(self)
            }
            #[inline(always)]
            fn cos_pi(self) -> Self {
                vmath::$t::cos_pi(self)
            }
            #[inline(always)]
            fn tanh(self) -> Self {
                vmath::$t::tanh(self)
            }
            #[inline(always)]
            fn sigmoid(self) -> Self {
                vmath::$t::sigmoid(self)
            }
            #[inline(always)]
            fn softplus(self) -> Self {
                vmath::$t::softplus(self)
            }
            from_std!($t: sqrt tan asin acos atan abs floor ceil);
            #[inline(always)]
            fn exp2(self) -> Self {
                vmath::$t::exp2(self)
            }
            #[inline(always)]
            fn log2(self) -> Self {
                vmath::$t::log2(self)
            }
            #[inline(always)]
            fn erf(self) -> Self {
                vmath::$t::erf(self)
            }
            #[inline(always)]
            fn atan2(self, x: Self) -> Self {
                $t::atan2(self, x)
            }
            /// Within 4 ULP: from `expm1` near 0, and from the square of `e^(x/2)` where `e^-x` does not matter, so
            /// that it overflows only where it must.
            #[inline(always)]
            fn sinh(self) -> Self {
                let a = $t::abs(self);
                let t = vmath::$t::expm1(a);
                let half = vmath::$t::exp(0.5 * a);
                let y = if a < 20.0 { 0.5 * (t + t / (t + 1.0)) } else { 0.5 * half * half };
                $t::copysign(y, self)
            }
            /// Within 4 ULP; see `sinh`.
            #[inline(always)]
            fn cosh(self) -> Self {
                let a = $t::abs(self);
                let t = vmath::$t::exp(a);
                let half = vmath::$t::exp(0.5 * a);
                if a < 20.0 { 0.5 * (t + 1.0 / t) } else { 0.5 * half * half }
            }
            #[inline(always)]
            fn powi(self, exponent: i32) -> Self {
                match exponent {
                    0 => 1.0,
                    1 => self,
                    2 => self * self,
                    3 => self * self * self,
                    4 => (self * self) * (self * self),
                    -1 => 1.0 / self,
                    // f64 holds every exponent, and its rounding does not show in f32.
                    _ => f64::powf(self as f64, f64::from(exponent)) as $t,
                }
            }
            #[inline(always)]
            fn pow(self, exponent: Self) -> Self {
                $t::powf(self, exponent)
            }
            #[inline(always)]
            fn sign(self) -> Self {
                let negative = if self < 0.0 { -1.0 } else { self };
                if self > 0.0 { 1.0 } else { negative }
            }
            #[inline(always)]
            fn maximum(self, other: Self) -> Self {
                if self > other || $t::is_nan(self) { self } else { other }
            }
            #[inline(always)]
            fn minimum(self, other: Self) -> Self {
                if self < other || $t::is_nan(self) { self } else { other }
            }
            #[inline(always)]
            fn round(self) -> Self {
                $t::round_ties_even(self)
            }
        }
    };
}

real!(f32);
real!(f64);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hyperbolic_functions_keep_their_digits_at_both_ends() {
        for i in 0..4000 {
            for x in [1e-9 * 1.01_f64.powi(i), -1e-6 * 1.01_f64.powi(i)] {
                let single = x as f32;
                let wide = f64::from(single);
                if f64::cosh(wide) < f64::from(f32::MAX) {
                    assert!((f64::from(Real::sinh(single)) / f64::sinh(wide) - 1.0).abs() < 4.0 * 1.2e-7, "sinh {x}");
                    assert!((f64::from(Real::cosh(single)) / f64::cosh(wide) - 1.0).abs() < 4.0 * 1.2e-7, "cosh {x}");
                }
                if f64::cosh(x).is_finite() {
                    assert!((Real::sinh(x) / f64::sinh(x) - 1.0).abs() < 4.0 * 2.3e-16, "sinh {x}");
                    assert!((Real::cosh(x) / f64::cosh(x) - 1.0).abs() < 4.0 * 2.3e-16, "cosh {x}");
                }
            }
        }
        assert_eq!((Real::sinh(f32::NEG_INFINITY), Real::cosh(f32::NEG_INFINITY)), (f32::NEG_INFINITY, f32::INFINITY));
        assert!(Real::sinh(f32::NAN).is_nan() && Real::cosh(f64::NAN).is_nan());
        assert!(Real::sinh(-0.0_f32).is_sign_negative());
        // The last f32 whose hyperbolic sine is finite: e^x itself is not.
        assert!(Real::sinh(89.41_f32).is_finite() && !f32::exp(89.41).is_finite());
    }

    #[test]
    fn the_greater_and_the_smaller_number_let_nan_through() {
        for (a, b) in [(f32::NAN, 1.0), (1.0, f32::NAN), (f32::NAN, f32::INFINITY)] {
            assert!(Real::maximum(a, b).is_nan() && Real::minimum(a, b).is_nan());
        }
        assert_eq!((Real::maximum(1.0, 2.0), Real::minimum(1.0, 2.0)), (2.0, 1.0));
        assert_eq!((Real::maximum(-f64::INFINITY, -1.0), Real::minimum(f64::INFINITY, 1.0)), (-1.0, 1.0));
    }

    #[test]
    fn whole_powers_agree_with_repeated_products() {
        for n in 0..12 {
            let product = (0..n).fold(1.0_f64, |y, _| y * -1.25);
            assert!((Real::powi(-1.25_f64, n) / product - 1.0).abs() < 1e-15);
            assert!((f64::from(Real::powi(-1.25_f32, -n)) * product - 1.0).abs() < 1.2e-7);
        }
        assert_eq!(
            (Real::powi(0.0_f32, 0), Real::powi(f32::NAN, 0), Real::powi(0.0_f32, -3)),
            (1.0, 1.0, f32::INFINITY)
        );
        assert_eq!(Real::powi(-1.0_f32, i32::MAX), -1.0);
    }
}
