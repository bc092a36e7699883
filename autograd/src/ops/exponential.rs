//! Exponentials, logarithms, square roots and the error function.

use crate::cases::INF;
use crate::slopes::{checked, corrected_sigmoid, exp_slope, exp2_slope, sqrt_slope};
use crate::{Cases, Formula};
use raygrad_tensor::{Real, Wide};
use std::f64::consts::{FRAC_1_SQRT_2, FRAC_2_SQRT_PI, LN_2, LOG2_E};

/// y = e^x; dx = g e^x.
#[derive(Clone, Copy)]
pub struct Exp;
impl Formula<1> for Exp {
    const NAME: &'static str = "exp";
    const WIDE_GRADIENT: bool = true;
    #[inline(always)]
    fn f<E: Real>(&self, [x]: [E; 1]) -> E {
        x.exp()
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, [x]: [E; 1], y: E) -> [E; 1] {
        [exp_slope(g, x, y)]
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
    const WIDE_GRADIENT: bool = true;
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
        [sqrt_slope(g, y)]
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(0.5..3.0).at([0.0], 0.0, [INF]).at([4.0], 2.0, [0.25]).at([INF], INF, [0.0]);
    }
}

/// y = 2^x; dx = g 2^x ln 2.
#[derive(Clone, Copy)]
pub struct Exp2;
impl Formula<1> for Exp2 {
    const NAME: &'static str = "exp2";
    const WIDE_GRADIENT: bool = true;
    #[inline(always)]
    fn f<E: Real>(&self, [x]: [E; 1]) -> E {
        x.exp2()
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, [x]: [E; 1], y: E) -> [E; 1] {
        [exp2_slope(g, x, y)]
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
    const WIDE_GRADIENT: bool = true;
    #[inline(always)]
    fn f<E: Real>(&self, [x]: [E; 1]) -> E {
        let one = x.like(1.0);
        one / x.sqrt()
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, [_x]: [E; 1], y: E) -> [E; 1] {
        let half = y.like(-0.5);
        [checked!(
            g * y * y * (y * half),
            g,
            [g],
            [],
            (g.wide() * y.wide() * y.wide() * (y.wide() * half.wide())).narrow()
        )]
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
    const WIDE_GRADIENT: bool = true;
    #[inline(always)]
    fn f<E: Real>(&self, [x]: [E; 1]) -> E {
        x.erf()
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-3.0..3.0).at([0.0], 0.0, [FRAC_2_SQRT_PI]).at([-INF], -1.0, [0.0]).at([30.0], 1.0, [0.0]);
    }
}

/// y = (1 + erf(x / sqrt 2)) / 2; dx = g e^(-x^2 / 2) / sqrt(2 pi).
#[derive(Clone, Copy)]
pub struct NormalCdf;
impl Formula<1> for NormalCdf {
    const NAME: &'static str = "normal_cdf";
    const WIDE_GRADIENT: bool = true;
    #[inline(always)]
    fn f<E: Real>(&self, [x]: [E; 1]) -> E {
        x.normal_cdf()
    }
    fn cases(&self, c: &mut Cases) {
        let peak = 0.5 * FRAC_2_SQRT_PI * FRAC_1_SQRT_2;
        c.domain(-3.0..3.0).at([0.0], 0.5, [peak]).at([-INF], 0.0, [0.0]).at([INF], 1.0, [0.0]);
        c.at([-8.0], 6.220_960_574_271_785e-16, [5.052_271_083_536_893e-15]);
    }
}

/// y = ln(e^a + e^b); da = g s(a - b), db = g s(b - a). Of equal infinities it is their value, and each gets half.
#[derive(Clone, Copy)]
pub struct LogAddExp;
impl LogAddExp {
    /// a - b, where equal infinities are no distance apart, and its rounding error (Knuth's two-sum).
    #[inline(always)]
    fn difference<E: Real>(a: E, b: E) -> [E; 2] {
        let (zero, one, difference) = (a.like(0.0), a.like(1.0), a - b);
        let of_infinities = difference.abs().if_positive(difference, a.sign() - b.sign());
        let difference = (one + (a + b) * zero).if_positive(difference, of_infinities);
        let back = difference + b;
        let low = (a - back) + ((back - difference) - b);
        // That of an infinity is no number.
        [difference, (one - low.abs()).if_positive(low, zero)]
    }
}
impl Formula<2> for LogAddExp {
    const NAME: &'static str = "logaddexp";
    const WIDE_GRADIENT: bool = true;
    #[inline(always)]
    fn f<E: Real>(&self, [a, b]: [E; 2]) -> E {
        let [difference, low] = LogAddExp::difference(a, b);
        let (tail, low) = ((-difference.abs()).exp(), difference.if_positive(-low, low));
        a.maximum(b) + tail.mul_add(low, tail).ln1p()
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, [a, b]: [E; 2], _y: E) -> [E; 2] {
        let [difference, low] = LogAddExp::difference(a, b);
        [corrected_sigmoid(g, difference, low), corrected_sigmoid(g, -difference, -low)]
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-3.0..3.0).domain(-3.0..3.0).at([0.0, 0.0], LN_2, [0.5, 0.5]).at([1e4, 1e4], 1e4 + LN_2, [0.5, 0.5]);
        c.at([-INF, 2.0], 2.0, [0.0, 1.0]).at([-INF, -INF], -INF, [0.5, 0.5]).at([INF, INF], INF, [0.5, 0.5]);
        c.at([-100.0, 0.0], 3.720_075_976_020_836e-44, [3.720_075_976_020_836e-44, 1.0]);
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
    /// The distribution function of the standard normal distribution, accurate in both tails.
    #[doc(alias = "ndtr")]
    normal_cdf() = NormalCdf;
    /// `ln(e^self + e^other)`, without overflow. Shapes broadcast. Of two equal infinities each gets half of the gradient.
    ///
    /// # Panics
    /// If the shapes do not broadcast.
    logaddexp(other) = LogAddExp;
}
