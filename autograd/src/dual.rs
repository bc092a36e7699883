//! Dual numbers: forward-mode derivatives, which give the gradients of a formula.

use crate::ops::piecewise::share;
use crate::ops::power::{slope_of_base, slope_of_exponent};
use crate::ops::trigonometric::{complement, turn};
use raygrad_tensor::Real;
use std::f64::consts::{FRAC_2_SQRT_PI, LN_2, PI};
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

    /// A function with value `y` and derivative `dy`.
    #[inline(always)]
    fn chain(self, y: E, dy: E) -> Self {
        self.map(
            y,
            #[inline(always)]
            |s| s * dy,
        )
    }

    /// A function with value `y` and derivative `1 / x`.
    #[inline(always)]
    fn over(self, y: E, x: E) -> Self {
        self.map(
            y,
            #[inline(always)]
            |s| s / x,
        )
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
            |t| -(t * y / b.value),
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

/// Functions of one number, by value and derivative at `x`.
macro_rules! chain {
    ($($f:ident: |$x:ident| $y:expr, $dy:expr;)*) => {
        $(
            #[inline(always)]
            fn $f(self) -> Self {
                let $x = self.value;
                self.chain($y, $dy)
            }
        )*
    };
}

/// Functions of one number, by value and the reciprocal of the derivative at `x`.
macro_rules! over {
    ($($f:ident: |$x:ident| $y:expr, $over:expr;)*) => {
        $(
            #[inline(always)]
            fn $f(self) -> Self {
                let $x = self.value;
                self.over($y, $over)
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
    chain! {
        exp: |x| x.exp(), x.exp();
        expm1: |x| x.expm1(), x.exp();
        sin: |x| x.sin(), x.cos();
        cos: |x| x.cos(), -x.sin();
        sin_pi: |x| x.sin_pi(), x.like(PI) * x.cos_pi();
        cos_pi: |x| x.cos_pi(), x.like(-PI) * x.sin_pi();
        // As products that keep their digits where the value is near 1.
        tanh: |x| x.tanh(), (x.like(1.0) - x.tanh()) * (x.like(1.0) + x.tanh());
        sigmoid: |x| x.sigmoid(), x.sigmoid() * (-x).sigmoid();
        softplus: |x| x.softplus(), x.sigmoid();
        exp2: |x| x.exp2(), x.exp2() * x.like(LN_2);
        erf: |x| x.erf(), x.like(FRAC_2_SQRT_PI) * (-(x * x)).exp();
        tan: |x| x.tan(), x.like(1.0) + x.tan() * x.tan();
        sinh: |x| x.sinh(), x.cosh();
        cosh: |x| x.cosh(), x.sinh();
        abs: |x| x.abs(), x.sign();
    }
    over! {
        ln: |x| x.ln(), x;
        ln1p: |x| x.ln1p(), x.like(1.0) + x;
        log2: |x| x.log2(), x.like(LN_2) * x;
        sqrt: |x| x.sqrt(), x.like(2.0) * x.sqrt();
        asin: |x| x.asin(), complement(x);
        acos: |x| x.acos(), -complement(x);
        atan: |x| x.atan(), x.like(1.0) + x * x;
    }
    steps! { sign floor ceil round }
    #[inline(always)]
    fn atan2(self, x: Self) -> Self {
        let (a, b) = (self.value, x.value);
        self.sum(
            x,
            a.atan2(b),
            #[inline(always)]
            |s| s * turn(b, a, b),
            #[inline(always)]
            |t| -(t * turn(a, a, b)),
        )
    }
    #[inline(always)]
    fn powi(self, exponent: i32) -> Self {
        let (x, y) = (self.value, self.value.powi(exponent));
        if exponent == 0 {
            return Dual::constant(y);
        }
        self.map(
            y,
            #[inline(always)]
            |s| s * (x.like(f64::from(exponent)) * x.powi(exponent.saturating_sub(1))),
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
            |s| s * slope_of_base(a, b),
            #[inline(always)]
            |t| t * slope_of_exponent(a, b, y),
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
