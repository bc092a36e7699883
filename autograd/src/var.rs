//! A variable: a value and its place on the tape.

use crate::{Tape, ops};
use raygrad_tensor::{Real, Scalar, Tensor};
use std::fmt;
use std::ops::{Add, Div, Mul, Neg, Sub};

/// A tensor on a tape. A clone is a reference count.
///
/// Arithmetic works on references and values, between variables (with NumPy's broadcasting) and with `f64` constants.
#[derive(Clone)]
pub struct Var<'t, T: Scalar> {
    pub(crate) tape: &'t Tape<T>,
    pub(crate) value: Tensor<T>,
    /// None for a constant.
    pub(crate) node: Option<u32>,
}

impl<'t, T: Scalar> Var<'t, T> {
    /// The value.
    pub fn value(&self) -> &Tensor<T> {
        &self.value
    }

    /// The value, without the place on the tape.
    pub fn into_value(self) -> Tensor<T> {
        self.value
    }

    /// The shape of the value.
    pub fn shape(&self) -> &[usize] {
        self.value.shape()
    }

    /// The one element of a one-element value.
    ///
    /// # Panics
    /// If there is another number of elements.
    #[track_caller]
    pub fn item(&self) -> T {
        self.value.item()
    }

    /// The tape that this variable lives on.
    pub fn tape(&self) -> &'t Tape<T> {
        self.tape
    }

    /// The same value as a constant: gradients do not flow through it.
    pub fn detach(&self) -> Self {
        self.tape.constant(self.value.clone())
    }

    /// This variable if gradients can flow to it, else a new leaf of the same value: what code begins with that takes
    /// gradients with respect to an argument which may be a constant ([`Tape::enable_grad`] shows it).
    #[track_caller]
    pub fn tracked(&self) -> Self {
        match self.node {
            Some(_) => self.clone(),
            None => self.tape.unchecked_leaf(self.value.clone(), self.tape.line()),
        }
    }

    /// A scalar constant on the same tape.
    pub fn constant(&self, value: f64) -> Self {
        self.tape.constant(self.tape.pool().full(&[], T::from_f64(value)))
    }

    /// Whether gradients can flow to this variable.
    pub fn is_on_graph(&self) -> bool {
        self.node.is_some()
    }
}

impl<T: Scalar> fmt::Debug for Var<'_, T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.node {
            Some(node) => write!(f, "Var #{node} {:?}", self.value),
            None => write!(f, "Var constant {:?}", self.value),
        }
    }
}

macro_rules! operator {
    ($trait:ident, $method:ident, $op:expr) => {
        impl<'t, T: Scalar> $trait<&Var<'t, T>> for &Var<'t, T> {
            type Output = Var<'t, T>;
            #[track_caller]
            fn $method(self, other: &Var<'t, T>) -> Var<'t, T> {
                $op(self, other)
            }
        }
        impl<'t, T: Scalar> $trait<Var<'t, T>> for &Var<'t, T> {
            type Output = Var<'t, T>;
            #[track_caller]
            fn $method(self, other: Var<'t, T>) -> Var<'t, T> {
                $op(self, &other)
            }
        }
        impl<'t, T: Scalar> $trait<&Var<'t, T>> for Var<'t, T> {
            type Output = Var<'t, T>;
            #[track_caller]
            fn $method(self, other: &Var<'t, T>) -> Var<'t, T> {
                $op(&self, other)
            }
        }
        impl<'t, T: Scalar> $trait<Var<'t, T>> for Var<'t, T> {
            type Output = Var<'t, T>;
            #[track_caller]
            fn $method(self, other: Var<'t, T>) -> Var<'t, T> {
                $op(&self, &other)
            }
        }
    };
}

operator!(Add, add, ops::add);
operator!(Sub, sub, ops::sub);
operator!(Mul, mul, ops::mul);
operator!(Div, div, ops::div);

/// An operator with an `f64` on either side. A product adds -0, which changes no number: +0 would turn -0 into +0.
macro_rules! constant_operator {
    ($trait:ident, $method:ident, |$x:ident, $c:ident| $right:expr, $left:expr) => {
        impl<'t, T: Scalar> $trait<f64> for &Var<'t, T> {
            type Output = Var<'t, T>;
            #[track_caller]
            fn $method(self, $c: f64) -> Var<'t, T> {
                let $x = self;
                $right
            }
        }
        impl<'t, T: Scalar> $trait<f64> for Var<'t, T> {
            type Output = Var<'t, T>;
            #[track_caller]
            fn $method(self, $c: f64) -> Var<'t, T> {
                let $x = &self;
                $right
            }
        }
        impl<'t, T: Scalar> $trait<&Var<'t, T>> for f64 {
            type Output = Var<'t, T>;
            #[track_caller]
            fn $method(self, $x: &Var<'t, T>) -> Var<'t, T> {
                let $c = self;
                $left
            }
        }
        impl<'t, T: Scalar> $trait<Var<'t, T>> for f64 {
            type Output = Var<'t, T>;
            #[track_caller]
            fn $method(self, $x: Var<'t, T>) -> Var<'t, T> {
                let ($x, $c) = (&$x, self);
                $left
            }
        }
    };
}

constant_operator!(Add, add, |x, c| x.affine(1.0, c), x.affine(1.0, c));
constant_operator!(Sub, sub, |x, c| x.affine(1.0, -c), x.affine(-1.0, c));
constant_operator!(Mul, mul, |x, c| x.affine(c, -0.0), x.affine(c, -0.0));
constant_operator!(Div, div, |x, c| x / x.constant(c), x.constant(c) / x);

impl<'t, T: Scalar> Neg for &Var<'t, T> {
    type Output = Var<'t, T>;
    #[track_caller]
    fn neg(self) -> Var<'t, T> {
        self.affine(-1.0, -0.0)
    }
}

impl<'t, T: Scalar> Neg for Var<'t, T> {
    type Output = Var<'t, T>;
    #[track_caller]
    fn neg(self) -> Var<'t, T> {
        -&self
    }
}

/// A formula read for variables records itself.
impl<T: Scalar> Real for Var<'_, T> {
    fn like(&self, value: f64) -> Self {
        self.constant(value)
    }
    fn if_positive(&self, yes: Self, no: Self) -> Self {
        Var::if_positive(self, &yes, &no)
    }
    fn exp(self) -> Self {
        Var::exp(&self)
    }
    fn expm1(self) -> Self {
        Var::expm1(&self)
    }
    fn ln(self) -> Self {
        Var::ln(&self)
    }
    fn ln1p(self) -> Self {
        Var::ln1p(&self)
    }
    fn sin(self) -> Self {
        Var::sin(&self)
    }
    fn cos(self) -> Self {
        Var::cos(&self)
    }
    fn sin_pi(self) -> Self {
        Var::sin_pi(&self)
    }
    fn cos_pi(self) -> Self {
        Var::cos_pi(&self)
    }
    fn tanh(self) -> Self {
        Var::tanh(&self)
    }
    fn sigmoid(self) -> Self {
        Var::sigmoid(&self)
    }
    fn softplus(self) -> Self {
        Var::softplus(&self)
    }
    fn sqrt(self) -> Self {
        Var::sqrt(&self)
    }
    fn exp2(self) -> Self {
        Var::exp2(&self)
    }
    fn log2(self) -> Self {
        Var::log2(&self)
    }
    fn erf(self) -> Self {
        Var::erf(&self)
    }
    fn tan(self) -> Self {
        Var::tan(&self)
    }
    fn asin(self) -> Self {
        Var::asin(&self)
    }
    fn acos(self) -> Self {
        Var::acos(&self)
    }
    fn atan(self) -> Self {
        Var::atan(&self)
    }
    fn sinh(self) -> Self {
        Var::sinh(&self)
    }
    fn cosh(self) -> Self {
        Var::cosh(&self)
    }
    fn abs(self) -> Self {
        Var::abs(&self)
    }
    fn sign(self) -> Self {
        Var::sign(&self)
    }
    fn floor(self) -> Self {
        Var::floor(&self)
    }
    fn ceil(self) -> Self {
        Var::ceil(&self)
    }
    fn round(self) -> Self {
        Var::round(&self)
    }
    fn atan2(self, x: Self) -> Self {
        Var::atan2(&self, &x)
    }
    fn pow(self, exponent: Self) -> Self {
        Var::pow(&self, &exponent)
    }
    fn maximum(self, other: Self) -> Self {
        Var::maximum(&self, &other)
    }
    fn minimum(self, other: Self) -> Self {
        Var::minimum(&self, &other)
    }
    fn powi(self, exponent: i32) -> Self {
        Var::powi(&self, exponent)
    }
}
