//! The number types that an elementwise formula can be evaluated on.

use crate::{Scalar, vmath};
use std::ops::{Add, Div, Mul, Neg, Sub};

/// The list of functions of [`Real`]. `functions!(each(arguments))` expands to
/// `each! { (arguments) unary exp "`e^x`." }` for each function, with its kind (`unary` or `binary`), name and
/// documentation.
#[doc(hidden)]
#[macro_export]
macro_rules! functions {
    ($each:ident $arguments:tt) => {
        $crate::functions! {
            $each $arguments
            unary exp "`e^x`.";
            unary expm1 "`e^x - 1`, accurate near 0.";
            unary ln "The natural logarithm: -inf at 0, NaN below.";
            unary ln1p "`ln(1 + x)`, accurate near 0.";
            unary sin "Sine of an angle in radians.";
            unary cos "Cosine of an angle in radians.";
            unary sin_pi "`sin(pi x)`, with `x` reduced exactly first.";
            unary cos_pi "`cos(pi x)`, with `x` reduced exactly first.";
            unary tanh "Hyperbolic tangent.";
            unary sigmoid "`1 / (1 + e^-x)`.";
            unary softplus "`ln(1 + e^x)`, without overflow.";
            unary sqrt "Square root: NaN below 0.";
            unary exp2 "`2^x`.";
            unary log2 "The logarithm to base 2: -inf at 0, NaN below.";
            unary erf "The error function.";
            unary normal_cdf "The distribution function of the standard normal distribution, accurate in both tails.";
            unary tan "Tangent of an angle in radians.";
            unary asin "The angle in -pi/2..=pi/2 of this sine; NaN outside -1..=1.";
            unary acos "The angle in 0..=pi of this cosine; NaN outside -1..=1.";
            unary atan "The angle in -pi/2..=pi/2 of this tangent.";
            unary sinh "Hyperbolic sine.";
            unary cosh "Hyperbolic cosine.";
            unary abs "The absolute value.";
            unary sign "1 for positive numbers, -1 for negative ones; zeros and NaN stay what they are.";
            unary floor "The next whole number below.";
            unary ceil "The next whole number above.";
            unary round "The nearest whole number, the even one of two.";
            binary atan2 "The angle in -pi..=pi of the vector (`other`, `self`).";
            binary hypot "The length of the vector (`self`, `other`), without overflow or underflow of the squares.";
            binary remainder "`self` modulo `other`, with the sign of `other`; NaN for 0 or an infinite `self`.";
            binary pow "`self` to a real power; NaN for a negative base and a fractional exponent.";
            binary maximum "The greater of two numbers; NaN if one of them is.";
            binary minimum "The smaller of two numbers; NaN if one of them is.";
        }
    };
    ($each:ident $arguments:tt $($kind:ident $f:ident $doc:literal;)+) => {
        $($each! { $arguments $kind $f $doc })+
    };
}

macro_rules! declared {
    (() unary $f:ident $doc:literal) => {
        #[doc = $doc]
        fn $f(self) -> Self;
    };
    (() binary $f:ident $doc:literal) => {
        #[doc = $doc]
        fn $f(self, other: Self) -> Self;
    };
}

/// A real number in an elementwise formula: a float, a dual number, or a variable on a tape.
///
/// A formula that is generic over `Real` is evaluated in several ways. Floats compile to one vectorised loop, and dual
/// numbers carry derivatives along. Numbers that stand for variables record the formula on a tape, for gradients of
/// gradients. Formulas have no branches: they select with [`if_positive`](Self::if_positive). The derivative of steps
/// (`sign`, `floor`, `ceil`, `round`) is 0.
pub trait Real:
    Copy + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self> + Div<Output = Self> + Neg<Output = Self>
{
    /// The constant `value` in the type of this number.
    fn like(&self, value: f64) -> Self;
    /// `yes` where this number is greater than 0, else `no`; also `no` where it is NaN. The selection itself has
    /// derivative 0.
    fn if_positive(&self, yes: Self, no: Self) -> Self;
    crate::functions!(declared());
    /// `self` to an integer power. Exponent 0 gives 1 for any base.
    fn powi(self, exponent: i32) -> Self;
    /// `self * factor + summand`, rounded once on floats.
    fn mul_add(self, factor: Self, summand: Self) -> Self;

    /// The derivative of the sigmoid, an even function, by one exponential and one division.
    #[doc(hidden)]
    #[inline(always)]
    fn logistic_density(self) -> Self {
        // A choice and no absolute value, which has no derivative at 0.
        let (one, e) = (self.like(1.0), self.if_positive(-self, self).exp());
        let share = one / (one + e);
        e * (share * share)
    }
    /// `self` times a / `length`, where (a, b) has this length: `self` times the derivative of the length by a.
    #[doc(hidden)]
    #[inline(always)]
    fn along(self, a: Self, _b: Self, length: Self) -> Self {
        self * a / length
    }

    /// `quick`, or `exact` where `quick` may have left the range of the type on the way:
    ///
    /// * where one of the `inputs` is not 0, infinite or within 2^-63 and 2^63 (2^-511 and 2^511 for f64);
    /// * where one of the `factors`, rounded results of which `quick` is a product with `s`, is infinite, or below the
    ///   normal numbers while |s| > 1.
    ///
    /// The default, of dual numbers and of those that stand for variables, is `quick`.
    #[inline(always)]
    fn checked<const K: usize, const M: usize>(
        quick: Self,
        _s: Self,
        _inputs: [Self; K],
        _factors: [Self; M],
        _exact: impl FnOnce() -> Self,
    ) -> Self {
        quick
    }

    /// Products and quotients of numbers of this type, of which no part overflows or underflows.
    type Wide: Wide<Self>;

    /// This number as a factor of a [`Wide`] product.
    #[inline(always)]
    fn wide(self) -> Self::Wide {
        Self::Wide::new(self)
    }
}

/// A product of numbers with more range than their type: no part of it overflows or underflows. Dual numbers and those
/// that stand for variables use ordinary products, [`Plain`].
///
/// ```
/// use raygrad_tensor::{Real, Wide};
/// let product = 1e30_f32.wide() * Wide::exp(-100.0, 0.0);
/// assert_eq!(product.narrow(), 3.7200759e-14);
/// assert_eq!(1e30 * f32::exp(-100.0), 3.7835059e-14);
/// ```
pub trait Wide<E>: Copy + Mul<Output = Self> + Div<Output = Self> {
    /// The number `x`.
    fn new(x: E) -> Self;
    /// `e^(x + low)`, for a rounding error `low` of x.
    fn exp(x: E, low: E) -> Self;
    /// `1 / (1 + e^-(x + low))`, for a rounding error `low` of x.
    fn sigmoid(x: E, low: E) -> Self;
    /// The distribution function of the standard normal distribution.
    fn normal_cdf(x: E) -> Self;
    /// `base` to a real power, of which `y` is the rounded value.
    fn pow(base: E, exponent: E, y: E) -> Self;
    /// `base` to an integer power.
    fn powi(base: E, exponent: i32) -> Self;
    /// The product, rounded to the number type.
    fn narrow(self) -> E;
}

/// A [`Wide`] number by ordinary arithmetic.
#[derive(Debug, Clone, Copy)]
pub struct Plain<E>(E);

impl<E: Mul<Output = E>> Mul for Plain<E> {
    type Output = Self;
    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        Plain(self.0 * other.0)
    }
}

impl<E: Div<Output = E>> Div for Plain<E> {
    type Output = Self;
    #[inline(always)]
    fn div(self, other: Self) -> Self {
        Plain(self.0 / other.0)
    }
}

impl<E: Real> Wide<E> for Plain<E> {
    #[inline(always)]
    fn new(x: E) -> Self {
        Plain(x)
    }
    #[inline(always)]
    fn exp(x: E, _low: E) -> Self {
        Plain(x.exp())
    }
    #[inline(always)]
    fn sigmoid(x: E, _low: E) -> Self {
        Plain(x.sigmoid())
    }
    #[inline(always)]
    fn normal_cdf(x: E) -> Self {
        Plain(x.normal_cdf())
    }
    #[inline(always)]
    fn pow(_base: E, _exponent: E, y: E) -> Self {
        Plain(y)
    }
    #[inline(always)]
    fn powi(base: E, exponent: i32) -> Self {
        Plain(base.powi(exponent))
    }
    #[inline(always)]
    fn narrow(self) -> E {
        self.0
    }
}

/// The flags of [`Real::checked`].
#[inline(always)]
pub(crate) fn any_flag<T: Scalar, const K: usize, const M: usize>(s: T, inputs: [T; K], factors: [T; M]) -> T::Flags {
    let (mut flags, mut k) = (T::Flags::default(), 0);
    while k < K {
        flags = flags | inputs[k].is_extreme();
        k += 1;
    }
    k = 0;
    while k < M {
        flags = flags | factors[k].is_lost(s);
        k += 1;
    }
    flags
}

macro_rules! number {
    (($t:ident) unary $f:ident $doc:literal) => {
        #[inline(always)]
        fn $f(self) -> Self {
            vmath::$t::$f(self)
        }
    };
    (($t:ident) binary $f:ident $doc:literal) => {
        #[inline(always)]
        fn $f(self, other: Self) -> Self {
            vmath::$t::$f(self, other)
        }
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
            crate::functions!(number($t));
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
            fn mul_add(self, factor: Self, summand: Self) -> Self {
                $t::mul_add(self, factor, summand)
            }
            #[inline(always)]
            fn checked<const K: usize, const M: usize>(
                quick: Self,
                s: Self,
                inputs: [Self; K],
                factors: [Self; M],
                exact: impl FnOnce() -> Self,
            ) -> Self {
                if $t::is_set(any_flag(s, inputs, factors)) { exact() } else { quick }
            }
            type Wide = vmath::wide::$t::Wide;
        }
    };
}

real!(f32);
real!(f64);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hyperbolics_at_both_ends_keep_digits() {
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
