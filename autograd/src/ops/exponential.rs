//! Exponentials, logarithms, square roots and the error function.

use crate::cases::INF;
use crate::{Cases, Formula};
use raygrad_tensor::Real;
use std::f64::consts::LN_2;
use std::f64::consts::{FRAC_2_SQRT_PI, LOG2_E};

/// y = e^x; dx = g y.
#[derive(Clone, Copy)]
pub struct Exp;
impl Formula<1> for Exp {
    const NAME: &'static str = "exp";
    #[inline(always)]
    fn f<E: Real>(&self, [x]: [E; 1]) -> E {
        x.exp()
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, [_x]: [E; 1], y: E) -> [E; 1] {
        [g * y]
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-3.0..3.0).at([-INF], 0.0, [0.0]).at([-1000.0], 0.0, [0.0]).at([INF], INF, [INF]);
    }
}

/// y = e^x - 1; dx = g e^x.
#[derive(Clone, Copy)]
pub struct Expm1;
impl Formula<1> for Expm1 {
    const NAME: &'static str = "expm1";
    #[inline(always)]
    fn f<E: Real>(&self, [x]: [E; 1]) -> E {
        x.expm1()
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-3.0..3.0).at([1e-20], 1e-20, [1.0]).at([-INF], -1.0, [0.0]).at([INF], INF, [INF]);
    }
}

/// y = ln x; dx = g / x.
#[derive(Clone, Copy)]
pub struct Ln;
impl Formula<1> for Ln {
    const NAME: &'static str = "ln";
    #[inline(always)]
    fn f<E: Real>(&self, [x]: [E; 1]) -> E {
        x.ln()
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(0.5..3.0).at([0.0], -INF, [INF]).at([1.0], 0.0, [1.0]).at([INF], INF, [0.0]);
    }
}

/// y = ln(1 + x); dx = g / (1 + x).
#[derive(Clone, Copy)]
pub struct Ln1p;
impl Formula<1> for Ln1p {
    const NAME: &'static str = "ln1p";
    #[inline(always)]
    fn f<E: Real>(&self, [x]: [E; 1]) -> E {
        x.ln1p()
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-0.5..3.0).at([1e-20], 1e-20, [1.0]).at([-1.0], -INF, [INF]).at([INF], INF, [0.0]);
    }
}

/// y = sqrt x; dx = g / (2 y). The gradient at 0 is infinite.
#[derive(Clone, Copy)]
pub struct Sqrt;
impl Formula<1> for Sqrt {
    const NAME: &'static str = "sqrt";
    #[inline(always)]
    fn f<E: Real>(&self, [x]: [E; 1]) -> E {
        x.sqrt()
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, [_x]: [E; 1], y: E) -> [E; 1] {
        let half = g.like(0.5);
        [g * half / y]
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(0.5..3.0).at([0.0], 0.0, [INF]).at([4.0], 2.0, [0.25]).at([INF], INF, [0.0]);
    }
}

/// y = 2^x; dx = g y ln 2.
#[derive(Clone, Copy)]
pub struct Exp2;
impl Formula<1> for Exp2 {
    const NAME: &'static str = "exp2";
    #[inline(always)]
    fn f<E: Real>(&self, [x]: [E; 1]) -> E {
        x.exp2()
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, [_x]: [E; 1], y: E) -> [E; 1] {
        let ln_2 = g.like(LN_2);
        [g * (y * ln_2)]
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-3.0..3.0).at([3.0], 8.0, [8.0 * LN_2]).at([-INF], 0.0, [0.0]).at([INF], INF, [INF]);
    }
}

/// y = log2 x; dx = g / (x ln 2).
#[derive(Clone, Copy)]
pub struct Log2;
impl Formula<1> for Log2 {
    const NAME: &'static str = "log2";
    #[inline(always)]
    fn f<E: Real>(&self, [x]: [E; 1]) -> E {
        x.log2()
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(0.5..3.0).at([0.0], -INF, [INF]).at([8.0], 3.0, [0.125 * LOG2_E]).at([INF], INF, [0.0]);
    }
}

/// y = 1 / sqrt x; dx = -g y^3 / 2.
#[derive(Clone, Copy)]
pub struct Rsqrt;
impl Formula<1> for Rsqrt {
    const NAME: &'static str = "rsqrt";
    #[inline(always)]
    fn f<E: Real>(&self, [x]: [E; 1]) -> E {
        let one = x.like(1.0);
        one / x.sqrt()
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, [_x]: [E; 1], y: E) -> [E; 1] {
        let half = g.like(-0.5);
        [g * half * (y * y * y)]
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(0.5..3.0).at([0.0], INF, [-INF]).at([4.0], 0.5, [-0.0625]).at([INF], 0.0, [0.0]);
        c.at([-1.0], f64::NAN, [f64::NAN]);
    }
}

/// y = erf x; dx = g 2/sqrt(pi) e^(-x^2).
#[derive(Clone, Copy)]
pub struct Erf;
impl Formula<1> for Erf {
    const NAME: &'static str = "erf";
    #[inline(always)]
    fn f<E: Real>(&self, [x]: [E; 1]) -> E {
        x.erf()
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-3.0..3.0).at([0.0], 0.0, [FRAC_2_SQRT_PI]).at([-INF], -1.0, [0.0]).at([30.0], 1.0, [0.0]);
    }
}

elementwise! {
    /// The exponential, `e^self`.
    exp() = Exp;
    /// `e^self - 1`, accurate near 0.
    expm1() = Expm1;
    /// The natural logarithm: -inf at 0, NaN below.
    #[doc(alias = "log")]
    ln() = Ln;
    /// `ln(1 + self)`, accurate near 0.
    #[doc(alias = "log1p")]
    ln1p() = Ln1p;
    /// The square root: NaN below 0, infinite gradient at 0.
    sqrt() = Sqrt;
    /// `2^self`.
    exp2() = Exp2;
    /// The logarithm to base 2: -inf at 0, NaN below.
    log2() = Log2;
    /// `1 / sqrt(self)`: inf at 0, where the gradient is -inf; NaN below.
    rsqrt() = Rsqrt;
    /// The error function, `2/sqrt(pi) * integral from 0 to self of e^-t^2 dt`.
    erf() = Erf;
}
