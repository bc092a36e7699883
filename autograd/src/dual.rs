//! Dual numbers: forward-mode derivatives, which give the gradients of a formula.

use crate::ops::piecewise::share;
use crate::slopes::*;
use raygrad_tensor::{Plain, Real};
use std::f64::consts::{FRAC_1_SQRT_2, FRAC_2_SQRT_PI, LOG2_E, PI};
use std::ops::{Add, Div, Mul, Neg, Sub};

/// A number and its derivatives in `N` directions: `value + sum of slopes[i] e_i`, with `e_i e_j = 0`.
///
/// A slope of `None` means that the number does not depend on that direction. It is an exact 0: it takes no arithmetic,
/// and infinity times it is not NaN. A formula evaluated on dual numbers has the derivatives of its operations.
/// [`conventions`](crate::conventions) lists those at ties and kinks.
///
/// ```
/// use raygrad_autograd::{Dual, Real};
/// let x = Dual { value: 2.0, slopes: [Some(1.0)] };
/// let y = x * x * x.like(5.0);
/// assert_eq!((y.value, y.slopes), (20.0, [Some(20.0)]));
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Dual<E, const N: usize> {
    /// The number.
    pub value: E,
    /// Its derivatives.
    pub slopes: [Option<E>; N],
}

// The loops of this file are written out, since calls of closures by `std::array` end vectorisation.
impl<E: Real, const N: usize> Dual<E, N> {
    /// A constant: a number that depends on no direction.
    #[inline(always)]
    fn constant(value: E) -> Self {
        Dual { value, slopes: [None; N] }
    }

    /// The function with value `y`. `slope` maps a slope of the argument to one of the result.
    #[inline(always)]
    fn map(self, y: E, slope: impl Fn(E) -> E) -> Self {
        let (mut slopes, mut k) = (self.slopes, 0);
        while k < N {
            if let Some(s) = slopes[k] {
                slopes[k] = Some(slope(s));
            }
            k += 1;
        }
        Dual { value: y, slopes }
    }

    /// A function of two numbers with value `y`, from the slope in either argument alone, and in both.
    #[inline(always)]
    fn join(
        self,
        other: Self,
        y: E,
        first: impl Fn(E) -> E,
        second: impl Fn(E) -> E,
        both: impl Fn(E, E) -> E,
    ) -> Self {
        let (mut slopes, mut k) = ([None; N], 0);
        while k < N {
            slopes[k] = match (self.slopes[k], other.slopes[k]) {
                (None, None) => None,
                (Some(s), None) => Some(first(s)),
                (None, Some(t)) => Some(second(t)),
                (Some(s), Some(t)) => Some(both(s, t)),
            };
            k += 1;
        }
        Dual { value: y, slopes }
    }

    /// As [`join`](Self::join), where the two slopes are added.
    #[inline(always)]
    fn sum(self, other: Self, y: E, first: impl Fn(E) -> E, second: impl Fn(E) -> E) -> Self {
        self.join(
            other,
            y,
            &first,
            &second,
            #[inline(always)]
            |s, t| first(s) + second(t),
        )
    }
}

impl<E: Real, const N: usize> Add for Dual<E, N> {
    type Output = Self;
    #[inline(always)]
    fn add(self, b: Self) -> Self {
        self.sum(
            b,
            self.value + b.value,
            #[inline(always)]
            |s| s,
            #[inline(always)]
            |t| t,
        )
    }
}

impl<E: Real, const N: usize> Sub for Dual<E, N> {
    type Output = Self;
    #[inline(always)]
    fn sub(self, b: Self) -> Self {
        self.join(
            b,
            self.value - b.value,
            #[inline(always)]
            |s| s,
            #[inline(always)]
            |t| -t,
            #[inline(always)]
            |s, t| s - t,
        )
    }
}

impl<E: Real, const N: usize> Mul for Dual<E, N> {
    type Output = Self;
    #[inline(always)]
    fn mul(self, b: Self) -> Self {
        self.sum(
            b,
            self.value * b.value,
            #[inline(always)]
            |s| s * b.value,
            #[inline(always)]
            |t| t * self.value,
        )
    }
}

impl<E: Real, const N: usize> Div for Dual<E, N> {
    type Output = Self;
    #[inline(always)]
    #[allow(clippy::suspicious_arithmetic_impl)] // the quotient rule
    fn div(self, b: Self) -> Self {
        let y = self.value / b.value;
        self.join(
            b,
            y,
            #[inline(always)]
            |s| s / b.value,
            #[inline(always)]
            |t| -over_square(t, self.value, b.value),
            #[inline(always)]
            |s, t| (s - t * y) / b.value,
        )
    }
}

impl<E: Real, const N: usize> Neg for Dual<E, N> {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        self.map(
            -self.value,
            #[inline(always)]
            |s| -s,
        )
    }
}

/// Functions of one number, by the slope of the result for a slope `s` of the argument `x`.
macro_rules! slopes {
    ($($f:ident: |$s:ident, $x:ident| $slope:expr;)*) => {
        $(
            #[inline(always)]
            fn $f(self) -> Self {
                let $x = self.value;
                self.map(
                    $x.$f(),
                    #[inline(always)]
                    |$s| $slope,
                )
            }
        )*
    };
}

/// Functions that are constant but for steps.
macro_rules! steps {
    ($($f:ident)*) => {
        $(
            #[inline(always)]
            fn $f(self) -> Self {
                Dual::constant(self.value.$f())
            }
        )*
    };
}

impl<E: Real, const N: usize> Real for Dual<E, N> {
    #[inline(always)]
    fn like(&self, value: f64) -> Self {
        Dual::constant(self.value.like(value))
    }
    #[inline(always)]
    fn if_positive(&self, yes: Self, no: Self) -> Self {
        let (x, zero) = (self.value, self.value.like(0.0));
        yes.join(
            no,
            x.if_positive(yes.value, no.value),
            #[inline(always)]
            |s| x.if_positive(s, zero),
            #[inline(always)]
            |t| x.if_positive(zero, t),
            #[inline(always)]
            |s, t| x.if_positive(s, t),
        )
    }
    slopes! {
        exp: |s, x| exp_slope(s, x, x.exp());
        expm1: |s, x| exp_slope(s, x, x.exp());
        sin: |s, x| s * x.cos();
        cos: |s, x| -(s * x.sin());
        sin_pi: |s, x| s * (x.like(PI) * x.cos_pi());
        cos_pi: |s, x| cos_pi_slope(s, x);
        tanh: |s, x| tanh_slope(s, x);
        sigmoid: |s, x| sigmoid_slope(s, x);
        softplus: |s, x| softplus_slope(s, x);
        exp2: |s, x| exp2_slope(s, x, x.exp2());
        erf: |s, x| bell(s, within(x, FAR), -1.0) * x.like(FRAC_2_SQRT_PI);
        normal_cdf: |s, x| bell(s, within(x, FAR), -0.5) * x.like(0.5 * FRAC_2_SQRT_PI * FRAC_1_SQRT_2);
        tan: |s, x| s * (x.like(1.0) + x.tan() * x.tan());
        sinh: |s, x| sinh_slope(s, x);
        cosh: |s, x| cosh_slope(s, x);
        abs: |s, x| s * x.sign();
        ln: |s, x| s / x;
        ln1p: |s, x| s / (x.like(1.0) + x);
        log2: |s, x| s / x * x.like(LOG2_E);
        sqrt: |s, x| sqrt_slope(s, x.sqrt());
        asin: |s, x| s / complement(x);
        acos: |s, x| -(s / complement(x));
        atan: |s, x| atan_slope(s, x);
    }
    steps! { sign floor ceil round }
    #[inline(always)]
    fn atan2(self, x: Self) -> Self {
        let (a, b) = (self.value, x.value);
        self.sum(
            x,
            a.atan2(b),
            #[inline(always)]
            |s| turn(s, b, a, b),
            #[inline(always)]
            |t| -turn(t, a, a, b),
        )
    }
    #[inline(always)]
    fn hypot(self, other: Self) -> Self {
        let (a, b) = (self.value, other.value);
        let y = a.hypot(b);
        self.sum(
            other,
            y,
            #[inline(always)]
            |s| length_slope(s, a, b, y),
            #[inline(always)]
            |t| length_slope(t, b, a, y),
        )
    }
    #[inline(always)]
    fn remainder(self, other: Self) -> Self {
        let (a, b) = (self.value, other.value);
        let y = a.remainder(b);
        self.sum(
            other,
            y,
            #[inline(always)]
            |s| s,
            #[inline(always)]
            |t| -multiple(t, a, b, y),
        )
    }
    #[inline(always)]
    fn mul_add(self, factor: Self, summand: Self) -> Self {
        let (a, b) = (self.value, factor.value);
        Dual { value: a.mul_add(b, summand.value), ..self * factor + summand }
    }
    type Wide = Plain<Self>;
    #[inline(always)]
    fn powi(self, exponent: i32) -> Self {
        let (x, y) = (self.value, self.value.powi(exponent));
        if exponent == 0 {
            return Dual::constant(y);
        }
        self.map(
            y,
            #[inline(always)]
            |s| powi_slope(s, x, exponent),
        )
    }
    #[inline(always)]
    fn pow(self, exponent: Self) -> Self {
        let (a, b) = (self.value, exponent.value);
        let y = a.pow(b);
        self.sum(
            exponent,
            y,
            #[inline(always)]
            |s| base_slope(s, a, factor_of(y, b), y),
            #[inline(always)]
            |t| exponent_slope(t, a, b, y),
        )
    }
    #[inline(always)]
    fn maximum(self, other: Self) -> Self {
        let lead = self.value - other.value;
        self.sum(
            other,
            self.value.maximum(other.value),
            #[inline(always)]
            |s| share(s, lead),
            #[inline(always)]
            |t| share(t, -lead),
        )
    }
    #[inline(always)]
    fn minimum(self, other: Self) -> Self {
        let lead = other.value - self.value;
        self.sum(
            other,
            self.value.minimum(other.value),
            #[inline(always)]
            |s| share(s, lead),
            #[inline(always)]
            |t| share(t, -lead),
        )
    }
}
