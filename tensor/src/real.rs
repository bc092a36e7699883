//! The numbers that an elementwise formula is written for.

use crate::vmath;
use std::ops::{Add, Div, Mul, Neg, Sub};

/// A real number, as an elementwise formula sees it.
///
/// A formula that is generic over `Real` is read three ways: `f32` and `f64` compile to one vectorised loop,
/// a variable of a tape records it (gradients of gradients), and a dual number carries a derivative along, as an oracle
/// in tests. Formulas have no branches: they choose with [`if_positive`](Self::if_positive).
pub trait Real:
    Clone + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self> + Div<Output = Self> + Neg<Output = Self>
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
            #[inline(always)]
            fn sqrt(self) -> Self {
                $t::sqrt(self)
            }
        }
    };
}

real!(f32);
real!(f64);
