//! Finds the values that a derivative reads, by evaluating the derivative on numbers that track them.

use raygrad_tensor::{Plain, Real};
use std::ops::{Add, Div, Mul, Neg, Sub};

/// A number without a value, which tracks the numbers that it was computed from.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Reading {
    /// A bit for each input, and the highest one for the output.
    pub(crate) of: u32,
    /// Whether this is the unchanged gradient of the output.
    pub(crate) is_gradient: bool,
}

impl Reading {
    /// The bit of the output.
    pub(crate) const OUTPUT: u32 = 1 << 31;

    /// A number that was computed from these.
    #[inline(always)]
    pub(crate) fn of(of: u32) -> Self {
        Reading { of, is_gradient: false }
    }

    /// The gradient of the output, which is always available.
    #[inline(always)]
    pub(crate) fn gradient() -> Self {
        Reading { of: 0, is_gradient: true }
    }
}

macro_rules! operator {
    ($($trait:ident $method:ident)*) => {
        $(
            impl $trait for Reading {
                type Output = Self;
                #[inline(always)]
                #[allow(clippy::suspicious_arithmetic_impl)] // operands are joined whatever the operator
                fn $method(self, other: Self) -> Self {
                    Reading::of(self.of | other.of)
                }
            }
        )*
    };
}

operator! { Add add Sub sub Mul mul Div div }

impl Neg for Reading {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        Reading::of(self.of)
    }
}

macro_rules! reading {
    (() unary $f:ident $doc:literal) => {
        #[inline(always)]
        fn $f(self) -> Self {
            Reading::of(self.of)
        }
    };
    (() binary $f:ident $doc:literal) => {
        #[inline(always)]
        fn $f(self, other: Self) -> Self {
            Reading::of(self.of | other.of)
        }
    };
}

impl Real for Reading {
    #[inline(always)]
    fn like(&self, _value: f64) -> Self {
        Reading::of(0)
    }
    #[inline(always)]
    fn if_positive(&self, yes: Self, no: Self) -> Self {
        Reading::of(self.of | yes.of | no.of)
    }
    #[inline(always)]
    fn powi(self, _exponent: i32) -> Self {
        Reading::of(self.of)
    }
    #[inline(always)]
    fn mul_add(self, factor: Self, summand: Self) -> Self {
        Reading::of(self.of | factor.of | summand.of)
    }
    #[inline(always)]
    fn checked<const K: usize, const M: usize>(
        quick: Self,
        _s: Self,
        _inputs: [Self; K],
        _factors: [Self; M],
        exact: impl FnOnce() -> Self,
    ) -> Self {
        Reading::of(quick.of | exact().of)
    }
    type Wide = Plain<Self>;
    raygrad_tensor::functions!(reading());
}
