//! Sine, cosine, hyperbolic tangent.

use crate::catalogue::Cases;
use crate::elementwise::{Map, Unary};
use crate::{Reads, Var};
use raygrad_tensor::{Real, Scalar};

const INF: f64 = f64::INFINITY;
const PI: f64 = std::f64::consts::PI;

/// y = sin x; dx = g cos x.
#[derive(Clone, Copy)]
pub struct Sin;
impl Unary for Sin {
    const NAME: &'static str = "sin";
    const READS: Reads = Reads::only(&[0]);
    #[inline(always)]
    fn f<E: Real>(&self, x: E) -> E {
        x.sin()
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, x: E, _y: E) -> E {
        g * x.cos()
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-3.0..3.0).at([0.0], 0.0, [1.0]).at([INF], f64::NAN, [f64::NAN]);
    }
}

/// y = cos x; dx = -g sin x.
#[derive(Clone, Copy)]
pub struct Cos;
impl Unary for Cos {
    const NAME: &'static str = "cos";
    const READS: Reads = Reads::only(&[0]);
    #[inline(always)]
    fn f<E: Real>(&self, x: E) -> E {
        x.cos()
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, x: E, _y: E) -> E {
        -(g * x.sin())
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-3.0..3.0).at([0.0], 1.0, [0.0]).at([INF], f64::NAN, [f64::NAN]);
    }
}

/// y = sin(pi x); dx = g pi cos(pi x). Zero and extreme values are exact at every whole and half number.
#[derive(Clone, Copy)]
pub struct SinPi;
impl Unary for SinPi {
    const NAME: &'static str = "sin_pi";
    const READS: Reads = Reads::only(&[0]);
    #[inline(always)]
    fn f<E: Real>(&self, x: E) -> E {
        x.sin_pi()
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, x: E, _y: E) -> E {
        let pi = g.like(PI);
        g * pi * x.cos_pi()
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-3.0..3.0).at([0.0], 0.0, [PI]).at([0.5], 1.0, [0.0]).at([-1e6], 0.0, [PI]);
        c.at([INF], f64::NAN, [f64::NAN]);
    }
}

/// y = cos(pi x); dx = -g pi sin(pi x). Zero and extreme values are exact at every whole and half number.
#[derive(Clone, Copy)]
pub struct CosPi;
impl Unary for CosPi {
    const NAME: &'static str = "cos_pi";
    const READS: Reads = Reads::only(&[0]);
    #[inline(always)]
    fn f<E: Real>(&self, x: E) -> E {
        x.cos_pi()
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, x: E, _y: E) -> E {
        let pi = g.like(-PI);
        g * pi * x.sin_pi()
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-3.0..3.0).at([0.0], 1.0, [0.0]).at([0.5], 0.0, [-PI]).at([1e6 + 1.0], -1.0, [0.0]);
        c.at([INF], f64::NAN, [f64::NAN]);
    }
}

/// y = tanh x; dx = g (1 - y^2). Saturates: the gradient is 0 at +-inf.
#[derive(Clone, Copy)]
pub struct Tanh;
impl Unary for Tanh {
    const NAME: &'static str = "tanh";
    const READS: Reads = Reads::OUTPUT;
    #[inline(always)]
    fn f<E: Real>(&self, x: E) -> E {
        x.tanh()
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, _x: E, y: E) -> E {
        let one = y.like(1.0);
        // (1 - y)(1 + y) keeps digits where y is near +-1.
        g * ((one.clone() - y.clone()) * (one + y))
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-3.0..3.0).at([INF], 1.0, [0.0]).at([-INF], -1.0, [0.0]).at([300.0], 1.0, [0.0]).at([0.0], 0.0, [1.0]);
    }
}

impl<'t, T: Scalar> Var<'t, T> {
    /// Sine of an angle in radians.
    #[track_caller]
    pub fn sin(&self) -> Self {
        self.tape().apply(Map(Sin), &[self])
    }

    /// Cosine of an angle in radians.
    #[track_caller]
    pub fn cos(&self) -> Self {
        self.tape().apply(Map(Cos), &[self])
    }

    /// `sin(pi self)`: exact reduction, so it is accurate however large the argument.
    #[track_caller]
    pub fn sin_pi(&self) -> Self {
        self.tape().apply(Map(SinPi), &[self])
    }

    /// `cos(pi self)`: exact reduction, so it is accurate however large the argument.
    #[track_caller]
    pub fn cos_pi(&self) -> Self {
        self.tape().apply(Map(CosPi), &[self])
    }

    /// Hyperbolic tangent.
    #[track_caller]
    pub fn tanh(&self) -> Self {
        self.tape().apply(Map(Tanh), &[self])
    }
}
