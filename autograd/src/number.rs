//! The numbers inside a [`formula!`](crate::formula), which mix with constants.

use raygrad_tensor::Real;
use std::ops::{Add, Div, Mul, Neg, Sub};

/// A number inside a [`formula!`](crate::formula). It has the functions of [`Real`] as methods, and arithmetic with
/// `f64` on either side.
#[derive(Debug, Clone, Copy)]
pub struct Number<E>(pub E);

/// An operand of arithmetic with a [`Number`]: another [`Number`], or an `f64`.
pub trait Term<E> {
    /// Converts to the number type of `x`.
    fn term(self, x: E) -> E;
}

impl<E: Real> Term<E> for Number<E> {
    #[inline(always)]
    fn term(self, _x: E) -> E {
        self.0
    }
}

impl<E: Real> Term<E> for f64 {
    #[inline(always)]
    fn term(self, x: E) -> E {
        x.like(self)
    }
}

macro_rules! operator {
    ($($trait:ident $method:ident)*) => {
        $(
            impl<E: Real, R: Term<E>> $trait<R> for Number<E> {
                type Output = Self;
                #[inline(always)]
                fn $method(self, other: R) -> Self {
                    Number(self.0.$method(other.term(self.0)))
                }
            }

            impl<E: Real> $trait<Number<E>> for f64 {
                type Output = Number<E>;
                #[inline(always)]
                fn $method(self, other: Number<E>) -> Number<E> {
                    Number(other.0.like(self).$method(other.0))
                }
            }
        )*
    };
}

operator! { Add add Sub sub Mul mul Div div }

impl<E: Real> Neg for Number<E> {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        Number(-self.0)
    }
}

macro_rules! number {
    (() unary $f:ident $doc:literal) => {
        #[doc = $doc]
        #[inline(always)]
        pub fn $f(self) -> Self {
            Number(self.0.$f())
        }
    };
    (() binary $f:ident $doc:literal) => {
        #[doc = $doc]
        #[inline(always)]
        pub fn $f(self, other: impl Term<E>) -> Self {
            Number(self.0.$f(other.term(self.0)))
        }
    };
}

impl<E: Real> Number<E> {
    raygrad_tensor::functions!(number());

    /// See [`Real::powi`].
    #[inline(always)]
    pub fn powi(self, exponent: i32) -> Self {
        Number(self.0.powi(exponent))
    }

    /// See [`Real::if_positive`].
    #[inline(always)]
    pub fn if_positive(self, yes: impl Term<E>, no: impl Term<E>) -> Self {
        Number(self.0.if_positive(yes.term(self.0), no.term(self.0)))
    }
}
