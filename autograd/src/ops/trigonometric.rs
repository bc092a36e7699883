//! Trigonometric and hyperbolic functions, and inverse ones.

use crate::cases::{INF, PI};
use crate::slopes::{atan_slope, complement, length_slope, turn, unless_zero};
use crate::{Cases, Formula};
use raygrad_tensor::Real;

/// y = sin x; dx = g cos x.
#[derive(Clone, Copy)]
pub struct Sin;
impl Formula<1> for Sin {
    const NAME: &'static str = "sin";
    const ANGLES: bool = true;
    #[inline(always)]
    fn f<E: Real>(&self, [x]: [E; 1]) -> E {
        x.sin()
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-3.0..3.0).at([0.0], 0.0, [1.0]).at([INF], f64::NAN, [f64::NAN]);
    }
}

/// y = cos x; dx = -g sin x.
#[derive(Clone, Copy)]
pub struct Cos;
impl Formula<1> for Cos {
    const NAME: &'static str = "cos";
    const ANGLES: bool = true;
    #[inline(always)]
    fn f<E: Real>(&self, [x]: [E; 1]) -> E {
        x.cos()
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-3.0..3.0).at([0.0], 1.0, [0.0]).at([INF], f64::NAN, [f64::NAN]);
    }
}

/// y = sin(pi x); dx = g pi cos(pi x). Zeros and extremes are exact at every whole and half number.
#[derive(Clone, Copy)]
pub struct SinPi;
impl Formula<1> for SinPi {
    const NAME: &'static str = "sin_pi";
    #[inline(always)]
    fn f<E: Real>(&self, [x]: [E; 1]) -> E {
        x.sin_pi()
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-3.0..3.0).at([0.0], 0.0, [PI]).at([0.5], 1.0, [0.0]).at([-1e6], 0.0, [PI]);
        c.at([INF], f64::NAN, [f64::NAN]);
    }
}

/// y = cos(pi x); dx = -g pi sin(pi x). Zeros and extremes are exact at every whole and half number.
#[derive(Clone, Copy)]
pub struct CosPi;
impl Formula<1> for CosPi {
    const NAME: &'static str = "cos_pi";
    const WIDE_GRADIENT: bool = true;
    #[inline(always)]
    fn f<E: Real>(&self, [x]: [E; 1]) -> E {
        x.cos_pi()
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-3.0..3.0).at([0.0], 1.0, [0.0]).at([0.5], 0.0, [-PI]).at([1e6 + 1.0], -1.0, [0.0]);
        c.at([INF], f64::NAN, [f64::NAN]);
    }
}

/// y = tanh x; dx = g / cosh^2 x. Saturates: the gradient is 0 at +-inf.
#[derive(Clone, Copy)]
pub struct Tanh;
impl Formula<1> for Tanh {
    const NAME: &'static str = "tanh";
    const WIDE_GRADIENT: bool = true;
    #[inline(always)]
    fn f<E: Real>(&self, [x]: [E; 1]) -> E {
        x.tanh()
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-3.0..3.0).at([INF], 1.0, [0.0]).at([-INF], -1.0, [0.0]).at([300.0], 1.0, [1.060158621202e-260]).at(
            [0.0],
            0.0,
            [1.0],
        );
    }
}

/// y = tan x; dx = g (1 + y^2).
#[derive(Clone, Copy)]
pub struct Tan;
impl Formula<1> for Tan {
    const NAME: &'static str = "tan";
    #[inline(always)]
    fn f<E: Real>(&self, [x]: [E; 1]) -> E {
        x.tan()
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, [_x]: [E; 1], y: E) -> [E; 1] {
        let one = y.like(1.0);
        [g * (one + y * y)]
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-1.2..1.2).at([0.0], 0.0, [1.0]).at([INF], f64::NAN, [f64::NAN]);
    }
}

/// y = arcsin x; dx = g / sqrt(1 - x^2), infinite at +-1.
#[derive(Clone, Copy)]
pub struct Asin;
impl Formula<1> for Asin {
    const NAME: &'static str = "asin";
    #[inline(always)]
    fn f<E: Real>(&self, [x]: [E; 1]) -> E {
        x.asin()
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, [x]: [E; 1], _y: E) -> [E; 1] {
        [g / complement(x)]
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-0.8..0.8).at([0.0], 0.0, [1.0]).at([1.0], 0.5 * PI, [INF]).at([-1.0], -0.5 * PI, [INF]);
        c.at([1.5], f64::NAN, [f64::NAN]);
    }
}

/// y = arccos x; dx = -g / sqrt(1 - x^2), infinite at +-1.
#[derive(Clone, Copy)]
pub struct Acos;
impl Formula<1> for Acos {
    const NAME: &'static str = "acos";
    #[inline(always)]
    fn f<E: Real>(&self, [x]: [E; 1]) -> E {
        x.acos()
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, [x]: [E; 1], _y: E) -> [E; 1] {
        [-(g / complement(x))]
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-0.8..0.8).at([0.0], 0.5 * PI, [-1.0]).at([1.0], 0.0, [-INF]).at([-1.0], PI, [-INF]);
        c.at([1.5], f64::NAN, [f64::NAN]);
    }
}

/// y = arctan x; dx = g / (1 + x^2).
#[derive(Clone, Copy)]
pub struct Atan;
impl Formula<1> for Atan {
    const NAME: &'static str = "atan";
    #[inline(always)]
    fn f<E: Real>(&self, [x]: [E; 1]) -> E {
        x.atan()
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, [x]: [E; 1], _y: E) -> [E; 1] {
        [atan_slope(g, x)]
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-3.0..3.0).at([0.0], 0.0, [1.0]).at([INF], 0.5 * PI, [0.0]).at([-INF], -0.5 * PI, [0.0]);
    }
}

/// y = the angle of the vector (b, a); da = g b / (a^2 + b^2), db = -g a / (a^2 + b^2). Both are 0 at the origin.
#[derive(Clone, Copy)]
pub struct Atan2;
impl Formula<2> for Atan2 {
    const NAME: &'static str = "atan2";
    const WIDE_GRADIENT: bool = true;
    #[inline(always)]
    fn f<E: Real>(&self, [a, b]: [E; 2]) -> E {
        a.atan2(b)
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, [a, b]: [E; 2], _y: E) -> [E; 2] {
        [turn(g, b, a, b), -turn(g, a, a, b)]
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

/// y = sqrt(a^2 + b^2); da = g a / y, db = g b / y. Both are 0 at the origin.
#[derive(Clone, Copy)]
pub struct Hypot;
impl Formula<2> for Hypot {
    const NAME: &'static str = "hypot";
    const WIDE_GRADIENT: bool = true;
    #[inline(always)]
    fn f<E: Real>(&self, [a, b]: [E; 2]) -> E {
        a.hypot(b)
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, [a, b]: [E; 2], y: E) -> [E; 2] {
        [length_slope(g, a, b, y), length_slope(g, b, a, y)]
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(0.3..3.0).domain_also(-3.0..-0.3).domain(-3.0..3.0);
        c.at([0.0, 0.0], 0.0, [0.0, 0.0]).at([3e30, 4e30], 5e30, [0.6, 0.8]).at([-3e-30, 4e-30], 5e-30, [-0.6, 0.8]);
    }
}

/// y = a / |(a, b)|, the derivative of the length by a; with z = b / |(a, b)|, da = g z^2 / |(a, b)| and
/// db = -g y z / |(a, b)|, products that keep their digits where b is small. 0 at the origin.
#[derive(Clone, Copy)]
pub struct Cosine;
impl Formula<2> for Cosine {
    const NAME: &'static str = "cosine";
    #[inline(always)]
    fn f<E: Real>(&self, [a, b]: [E; 2]) -> E {
        a / unless_zero(a.hypot(b))
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, [a, b]: [E; 2], y: E) -> [E; 2] {
        let length = unless_zero(a.hypot(b));
        let across = g.along(b, a, length) / length;
        [across.along(b, a, length), -(across * y)]
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(0.5..3.0).domain(-3.0..3.0).at([0.0, 0.0], 0.0, [0.0, 0.0]).at([3.0, 4.0], 0.6, [0.128, -0.096]);
        c.at([1.0, 1e-10], 1.0, [1e-20, -1e-10]);
    }
}

/// y = sinh x; dx = g cosh x.
#[derive(Clone, Copy)]
pub struct Sinh;
impl Formula<1> for Sinh {
    const NAME: &'static str = "sinh";
    const WIDE_GRADIENT: bool = true;
    #[inline(always)]
    fn f<E: Real>(&self, [x]: [E; 1]) -> E {
        x.sinh()
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-3.0..3.0).at([1e-20], 1e-20, [1.0]).at([-INF], -INF, [INF]).at([-0.0], 0.0, [1.0]);
    }
}

/// y = cosh x; dx = g sinh x.
#[derive(Clone, Copy)]
pub struct Cosh;
impl Formula<1> for Cosh {
    const NAME: &'static str = "cosh";
    const WIDE_GRADIENT: bool = true;
    #[inline(always)]
    fn f<E: Real>(&self, [x]: [E; 1]) -> E {
        x.cosh()
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-3.0..3.0).at([0.0], 1.0, [0.0]).at([-INF], INF, [-INF]);
    }
}

elementwise! {
    /// Sine of an angle in radians.
    sin() = Sin;
    /// Cosine of an angle in radians.
    cos() = Cos;
    /// `sin(pi self)`. The reduction is exact, so it is accurate for arguments of any size.
    sin_pi() = SinPi;
    /// `cos(pi self)`. The reduction is exact, so it is accurate for arguments of any size.
    cos_pi() = CosPi;
    /// Hyperbolic tangent.
    tanh() = Tanh;
    /// Tangent of an angle in radians.
    tan() = Tan;
    /// Arcsine: the angle in -pi/2..=pi/2; NaN outside -1..=1. The gradient is infinite at +-1.
    asin() = Asin;
    /// Arccosine: the angle in 0..=pi; NaN outside -1..=1. The gradient is infinite at +-1.
    acos() = Acos;
    /// Arctangent: the angle in -pi/2..=pi/2.
    atan() = Atan;
    /// The angle in -pi..=pi of the vector (`x`, `self`). Shapes broadcast. Both gradients are 0 at the origin.
    ///
    /// # Panics
    /// If the shapes do not broadcast.
    atan2(x) = Atan2;
    /// The length of the vector (`self`, `other`): no square overflows or underflows. Shapes broadcast. Both gradients
    /// are 0 at the origin.
    ///
    /// # Panics
    /// If the shapes do not broadcast.
    hypot(other) = Hypot;
    /// Hyperbolic sine, accurate near 0.
    sinh() = Sinh;
    /// Hyperbolic cosine.
    cosh() = Cosh;
    also examined: Cosine;
}
