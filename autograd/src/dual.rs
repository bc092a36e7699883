//! Dual numbers: forward-mode derivatives, the oracle of elementwise formulas.

use raygrad_tensor::Real;
use std::f64::consts::{FRAC_2_SQRT_PI, LN_2, PI};
use std::ops::{Add, Div, Mul, Neg, Sub};

/// `value + slope * e` with `e^2 = 0`: a number and its derivative.
///
/// ```
/// use raygrad_autograd::{Dual, Real};
/// let x = Dual { value: 2.0, slope: 1.0 };
/// let y = x * x * x.like(5.0);
/// assert_eq!((y.value, y.slope), (20.0, 20.0));
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Dual {
    /// The number.
    pub value: f64,
    /// Its derivative.
    pub slope: f64,
}

impl Dual {
    /// `f(x)` for an `f` with value `y` and derivative `dy` there. A slope of 0 stays 0 even where `dy` is infinite.
    fn chain(self, y: f64, dy: f64) -> Dual {
        Dual { value: y, slope: if self.slope == 0.0 { 0.0 } else { self.slope * dy } }
    }
}

impl Add for Dual {
    type Output = Dual;
    fn add(self, b: Dual) -> Dual {
        Dual { value: self.value + b.value, slope: self.slope + b.slope }
    }
}

impl Sub for Dual {
    type Output = Dual;
    fn sub(self, b: Dual) -> Dual {
        self + -b
    }
}

impl Mul for Dual {
    type Output = Dual;
    fn mul(self, b: Dual) -> Dual {
        Dual { value: self.value * b.value, slope: self.slope * b.value + self.value * b.slope }
    }
}

impl Div for Dual {
    type Output = Dual;
    fn div(self, b: Dual) -> Dual {
        let slope = (self.slope * b.value - self.value * b.slope) / (b.value * b.value);
        Dual { value: self.value / b.value, slope }
    }
}

impl Neg for Dual {
    type Output = Dual;
    fn neg(self) -> Dual {
        Dual { value: -self.value, slope: -self.slope }
    }
}

impl Real for Dual {
    fn like(&self, value: f64) -> Self {
        Dual { value, slope: 0.0 }
    }
    fn if_positive(&self, yes: Self, no: Self) -> Self {
        if self.value > 0.0 { yes } else { no }
    }
    fn exp(self) -> Self {
        self.chain(self.value.exp(), self.value.exp())
    }
    fn expm1(self) -> Self {
        self.chain(self.value.exp_m1(), self.value.exp())
    }
    fn ln(self) -> Self {
        self.chain(self.value.ln(), 1.0 / self.value)
    }
    fn ln1p(self) -> Self {
        self.chain(self.value.ln_1p(), 1.0 / (1.0 + self.value))
    }
    fn sin(self) -> Self {
        self.chain(self.value.sin(), self.value.cos())
    }
    fn cos(self) -> Self {
        self.chain(self.value.cos(), -self.value.sin())
    }
    fn sin_pi(self) -> Self {
        let (sin, cos) = sin_cos_pi(self.value);
        self.chain(sin, PI * cos)
    }
    fn cos_pi(self) -> Self {
        let (sin, cos) = sin_cos_pi(self.value);
        self.chain(cos, -PI * sin)
    }
    fn tanh(self) -> Self {
        self.chain(self.value.tanh(), self.value.cosh().powi(-2))
    }
    fn sigmoid(self) -> Self {
        let half = 0.5 * self.value;
        self.chain(0.5 + 0.5 * half.tanh(), 0.25 * half.cosh().powi(-2))
    }
    fn softplus(self) -> Self {
        let value = self.value.max(0.0) + (-self.value.abs()).exp().ln_1p();
        self.chain(value, 0.5 + 0.5 * (0.5 * self.value).tanh())
    }
    fn sqrt(self) -> Self {
        self.chain(self.value.sqrt(), 0.5 / self.value.sqrt())
    }
    fn exp2(self) -> Self {
        self.chain(self.value.exp2(), LN_2 * self.value.exp2())
    }
    fn log2(self) -> Self {
        self.chain(self.value.log2(), 1.0 / (LN_2 * self.value))
    }
    fn erf(self) -> Self {
        let slope = FRAC_2_SQRT_PI * (-self.value * self.value).exp();
        self.chain(raygrad_tensor::vmath::f64::erf(self.value), slope)
    }
    fn tan(self) -> Self {
        self.chain(self.value.tan(), self.value.cos().powi(-2))
    }
    fn asin(self) -> Self {
        self.chain(self.value.asin(), 1.0 / (1.0 - self.value * self.value).sqrt())
    }
    fn acos(self) -> Self {
        self.chain(self.value.acos(), -1.0 / (1.0 - self.value * self.value).sqrt())
    }
    fn atan(self) -> Self {
        self.chain(self.value.atan(), 1.0 / (1.0 + self.value * self.value))
    }
    fn atan2(self, x: Self) -> Self {
        let square = self.value * self.value + x.value * x.value;
        let slope = (self.slope * x.value - self.value * x.slope) / square;
        Dual { value: self.value.atan2(x.value), slope }
    }
    fn sinh(self) -> Self {
        self.chain(self.value.sinh(), self.value.cosh())
    }
    fn cosh(self) -> Self {
        self.chain(self.value.cosh(), self.value.sinh())
    }
    fn powi(self, exponent: i32) -> Self {
        let slope = if exponent == 0 { 0.0 } else { f64::from(exponent) * self.value.powi(exponent - 1) };
        self.chain(self.value.powi(exponent), slope)
    }
    fn pow(self, exponent: Self) -> Self {
        let value = self.value.powf(exponent.value);
        let base = self.chain(value, exponent.value * self.value.powf(exponent.value - 1.0));
        base + Dual { value: 0.0, slope: exponent.chain(value, value * self.value.ln()).slope }
    }
    fn abs(self) -> Self {
        if self.value < 0.0 { -self } else { self }
    }
    fn sign(self) -> Self {
        self.like(if self.value == 0.0 { 0.0 } else { self.value.signum() })
    }
    fn maximum(self, other: Self) -> Self {
        if self.value > other.value { self } else { other }
    }
    fn minimum(self, other: Self) -> Self {
        if self.value < other.value { self } else { other }
    }
    fn floor(self) -> Self {
        self.like(self.value.floor())
    }
    fn ceil(self) -> Self {
        self.like(self.value.ceil())
    }
    fn round(self) -> Self {
        self.like(self.value.round_ties_even())
    }
}

/// Sine and cosine of `pi x`, from the distance to the nearest whole number.
fn sin_cos_pi(x: f64) -> (f64, f64) {
    let (sin, cos) = (PI * (x - x.round())).sin_cos();
    if x.round() % 2.0 == 0.0 { (sin, cos) } else { (-sin, -cos) }
}
