//! Trigonometric and hyperbolic functions, and the inverse ones.

use crate::catalogue::Cases;
use crate::elementwise::{Binary, Map, Unary, Zip};
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

/// y = tan x; dx = g (1 + y^2).
#[derive(Clone, Copy)]
pub struct Tan;
impl Unary for Tan {
    const NAME: &'static str = "tan";
    const READS: Reads = Reads::OUTPUT;
    #[inline(always)]
    fn f<E: Real>(&self, x: E) -> E {
        x.tan()
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, _x: E, y: E) -> E {
        let one = y.like(1.0);
        g * (one + y.clone() * y)
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-1.2..1.2).at([0.0], 0.0, [1.0]).at([INF], f64::NAN, [f64::NAN]);
    }
}

/// y = arcsin x; dx = g / sqrt(1 - x^2), infinite at +-1.
#[derive(Clone, Copy)]
pub struct Asin;
impl Unary for Asin {
    const NAME: &'static str = "asin";
    const READS: Reads = Reads::only(&[0]);
    #[inline(always)]
    fn f<E: Real>(&self, x: E) -> E {
        x.asin()
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, x: E, _y: E) -> E {
        g / complement(x)
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-0.8..0.8).at([0.0], 0.0, [1.0]).at([1.0], 0.5 * PI, [INF]).at([-1.0], -0.5 * PI, [INF]);
        c.at([1.5], f64::NAN, [f64::NAN]);
    }
}

/// y = arccos x; dx = -g / sqrt(1 - x^2), infinite at +-1.
#[derive(Clone, Copy)]
pub struct Acos;
impl Unary for Acos {
    const NAME: &'static str = "acos";
    const READS: Reads = Reads::only(&[0]);
    #[inline(always)]
    fn f<E: Real>(&self, x: E) -> E {
        x.acos()
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, x: E, _y: E) -> E {
        -(g / complement(x))
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-0.8..0.8).at([0.0], 0.5 * PI, [-1.0]).at([1.0], 0.0, [-INF]).at([-1.0], PI, [-INF]);
        c.at([1.5], f64::NAN, [f64::NAN]);
    }
}

/// y = arctan x; dx = g / (1 + x^2).
#[derive(Clone, Copy)]
pub struct Atan;
impl Unary for Atan {
    const NAME: &'static str = "atan";
    const READS: Reads = Reads::only(&[0]);
    #[inline(always)]
    fn f<E: Real>(&self, x: E) -> E {
        x.atan()
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, x: E, _y: E) -> E {
        let one = x.like(1.0);
        g / (one + x.clone() * x)
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-3.0..3.0).at([0.0], 0.0, [1.0]).at([INF], 0.5 * PI, [0.0]).at([-INF], -0.5 * PI, [0.0]);
    }
}

/// y = the angle of the vector (b, a); da = g b / (a^2 + b^2), db = -g a / (a^2 + b^2). Both are 0 at the origin.
#[derive(Clone, Copy)]
pub struct Atan2;
impl Binary for Atan2 {
    const NAME: &'static str = "atan2";
    const READS: Reads = Reads::INPUTS;
    #[inline(always)]
    fn f<E: Real>(&self, a: E, b: E) -> E {
        a.atan2(b)
    }
    #[inline(always)]
    fn vjp_a<E: Real>(&self, g: E, a: E, b: E, _y: E) -> E {
        g * turn(b.clone(), a, b)
    }
    #[inline(always)]
    fn vjp_b<E: Real>(&self, g: E, a: E, b: E, _y: E) -> E {
        -(g * turn(a.clone(), a, b))
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(0.3..3.0).domain_also(-3.0..-0.3).domain(-3.0..3.0);
        c.at([0.0, 0.0], 0.0, [0.0, 0.0]).at([0.0, -2.0], PI, [-0.5, 0.0]).at(
            [3e-30, 4e-30],
            0.643_501_108_793_284_4,
            [1.6e29, -1.2e29],
        );
        c.at([3e30, 4e30], 0.643_501_108_793_284_4, [1.6e-31, -1.2e-31]);
    }
}

/// `sqrt(1 - x^2)`, as a product that keeps its digits near +-1.
#[inline(always)]
fn complement<E: Real>(x: E) -> E {
    let one = x.like(1.0);
    ((one.clone() - x.clone()) * (one + x)).sqrt()
}

/// `c / (a^2 + b^2)`, 0 at the origin; scaled, so that no square overflows or vanishes.
#[inline(always)]
fn turn<E: Real>(c: E, a: E, b: E) -> E {
    let scale = a.clone().abs().maximum(b.clone().abs());
    let one = a.like(1.0);
    // At the origin c is 0, and so is the result.
    let scale = scale.if_positive(scale.clone(), one.clone());
    let (a, b) = (a / scale.clone(), b / scale.clone());
    let square = a.clone() * a + b.clone() * b;
    let square = square.if_positive(square.clone(), one);
    c / scale.clone() / square / scale
}

/// y = sinh x; dx = g cosh x.
#[derive(Clone, Copy)]
pub struct Sinh;
impl Unary for Sinh {
    const NAME: &'static str = "sinh";
    const READS: Reads = Reads::only(&[0]);
    #[inline(always)]
    fn f<E: Real>(&self, x: E) -> E {
        x.sinh()
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, x: E, _y: E) -> E {
        g * x.cosh()
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-3.0..3.0).at([1e-20], 1e-20, [1.0]).at([-INF], -INF, [INF]).at([-0.0], 0.0, [1.0]);
    }
}

/// y = cosh x; dx = g sinh x.
#[derive(Clone, Copy)]
pub struct Cosh;
impl Unary for Cosh {
    const NAME: &'static str = "cosh";
    const READS: Reads = Reads::only(&[0]);
    #[inline(always)]
    fn f<E: Real>(&self, x: E) -> E {
        x.cosh()
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, x: E, _y: E) -> E {
        g * x.sinh()
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-3.0..3.0).at([0.0], 1.0, [0.0]).at([-INF], INF, [-INF]);
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

    /// Tangent of an angle in radians.
    #[track_caller]
    pub fn tan(&self) -> Self {
        self.tape().apply(Map(Tan), &[self])
    }

    /// The angle in -pi/2..=pi/2 whose sine this is; NaN outside -1..=1. The gradient is infinite at +-1.
    #[track_caller]
    pub fn asin(&self) -> Self {
        self.tape().apply(Map(Asin), &[self])
    }

    /// The angle in 0..=pi whose cosine this is; NaN outside -1..=1. The gradient is infinite at +-1.
    #[track_caller]
    pub fn acos(&self) -> Self {
        self.tape().apply(Map(Acos), &[self])
    }

    /// The angle in -pi/2..=pi/2 whose tangent this is.
    #[track_caller]
    pub fn atan(&self) -> Self {
        self.tape().apply(Map(Atan), &[self])
    }

    /// The angle in -pi..=pi of the vector (`x`, `self`); both gradients are 0 at the origin.
    ///
    /// # Panics
    /// If the shapes do not broadcast.
    #[track_caller]
    pub fn atan2(&self, x: &Self) -> Self {
        self.tape().apply(Zip(Atan2), &[self, x])
    }

    /// Hyperbolic sine, accurate near 0.
    #[track_caller]
    pub fn sinh(&self) -> Self {
        self.tape().apply(Map(Sinh), &[self])
    }

    /// Hyperbolic cosine.
    #[track_caller]
    pub fn cosh(&self) -> Self {
        self.tape().apply(Map(Cosh), &[self])
    }
}
