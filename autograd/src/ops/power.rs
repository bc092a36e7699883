//! Powers, reciprocals, and x ln y.

use crate::cases::{INF, NAN};
use crate::slopes::{any_powi_slope, base_slope, exponent_slope, factor_of, powi_slope, product_over};
use crate::{Cases, Formula, Var};
use raygrad_tensor::{Real, Scalar};

/// y = 1 / x; dx = -g / x^2.
#[derive(Clone, Copy)]
pub struct Reciprocal;
impl Formula<1> for Reciprocal {
    const NAME: &'static str = "reciprocal";
    const WIDE_GRADIENT: bool = true;
    #[inline(always)]
    fn f<E: Real>(&self, [x]: [E; 1]) -> E {
        let one = x.like(1.0);
        one / x
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, [x]: [E; 1], _y: E) -> [E; 1] {
        [powi_slope(g, x, -1)]
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(0.5..3.0).domain_also(-3.0..-0.5).at([0.0], INF, [-INF]).at([-INF], 0.0, [0.0]).at(
            [-4.0],
            -0.25,
            [-0.0625],
        );
    }
}

/// y = x^n for a whole n, 1 for n = 0; dx = g n x^(n - 1), 0 for n = 0.
#[derive(Clone, Copy)]
pub struct Powi {
    /// The exponent.
    pub exponent: i32,
}
impl Formula<1> for Powi {
    const NAME: &'static str = "powi";
    const WIDE_GRADIENT: bool = true;
    #[inline(always)]
    fn f<E: Real>(&self, [x]: [E; 1]) -> E {
        x.powi(self.exponent)
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, [x]: [E; 1], _y: E) -> [E; 1] {
        // Compared outside of the loop, since the exponent is none of its numbers.
        [if self.exponent == 0 { g.like(0.0) } else { any_powi_slope(g, x, self.exponent) }]
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(0.5..2.0).domain_also(-2.0..-0.5);
        match self.exponent {
            0 => c.at([0.0], 1.0, [0.0]).at([NAN], 1.0, [0.0]),
            1 => c.at([0.0], 0.0, [1.0]).at([-INF], -INF, [1.0]),
            n if n > 0 => {
                c.at([0.0], 0.0, [0.0]).at([-1.0], (-1.0_f64).powi(n), [f64::from(n) * (-1.0_f64).powi(n - 1)])
            }
            n => c.at([0.0], INF, [f64::from(n) * INF]).at([INF], 0.0, [0.0]),
        };
    }
}

/// [`Powi`] with an exponent known at compile time: for small exponents, a few products that vectorise.
#[derive(Clone, Copy)]
pub struct ConstPowi<const N: i32>;
impl<const N: i32> Formula<1> for ConstPowi<N> {
    const NAME: &'static str = "powi";
    const WIDE_GRADIENT: bool = true;
    #[inline(always)]
    fn f<E: Real>(&self, [x]: [E; 1]) -> E {
        Powi { exponent: N }.f([x])
    }
    fn cases(&self, c: &mut Cases) {
        Powi { exponent: N }.cases(c);
    }
}

/// y = x^p, NaN for a negative x and a fractional p; dx = g p x^(p - 1), 0 for p = 0.
#[derive(Clone, Copy)]
pub struct Powf {
    /// The exponent.
    pub exponent: f64,
}
impl Formula<1> for Powf {
    const NAME: &'static str = "powf";
    const WIDE_GRADIENT: bool = true;
    #[inline(always)]
    fn f<E: Real>(&self, [x]: [E; 1]) -> E {
        if self.exponent == 0.0 { x.like(1.0) } else { x.pow(x.like(self.exponent)) }
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, [x]: [E; 1], y: E) -> [E; 1] {
        [if self.exponent == 0.0 { g.like(0.0) } else { base_slope(g, x, x.like(self.exponent), y) }]
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(0.5..2.0);
        match self.exponent {
            0.0 => c.at([0.0], 1.0, [0.0]).at([NAN], 1.0, [0.0]),
            p if p < 0.0 => c.at([0.0], INF, [-INF]).at([INF], 0.0, [0.0]),
            p if p < 1.0 => c.at([0.0], 0.0, [INF]).at([INF], INF, [0.0]),
            _ => c.at([0.0], 0.0, [0.0]).at([INF], INF, [INF]),
        };
        c.at([1.0], 1.0, [self.exponent]);
    }
}

/// y = a^b; da = g b a^(b - 1), db = g y ln a. At a = 0, da is 0 for b = 0, and db is 0 for b >= 0. NaN for a negative
/// a and a fractional b.
#[derive(Clone, Copy)]
pub struct Pow;
impl Formula<2> for Pow {
    const NAME: &'static str = "pow";
    const WIDE_GRADIENT: bool = true;
    #[inline(always)]
    fn f<E: Real>(&self, [a, b]: [E; 2]) -> E {
        a.pow(b)
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, [a, b]: [E; 2], y: E) -> [E; 2] {
        [base_slope(g, a, factor_of(y, b), y), exponent_slope(g, a, b, y)]
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(0.5..2.0).domain(-2.0..2.0);
        c.at([0.0, 0.0], 1.0, [0.0, 0.0]).at([0.0, 2.0], 0.0, [0.0, 0.0]).at([0.0, 1.0], 0.0, [1.0, 0.0]);
        c.at([0.0, 0.5], 0.0, [INF, 0.0]).at([0.0, -1.0], INF, [-INF, -INF]).at([-2.0, 3.0], -8.0, [12.0, NAN]);
        c.at([5.0, 0.0], 1.0, [0.0, 5.0_f64.ln()]).at([-2.0, 0.5], NAN, [NAN, NAN]);
    }
}

/// y = a ln b, 0 for a = 0 unless b is NaN. da = g ln b, but 0 where a = 0 and b <= 0. db = g a / b, but 0 where a = 0.
#[derive(Clone, Copy)]
pub struct Xlogy;
impl Formula<2> for Xlogy {
    const NAME: &'static str = "xlogy";
    const WIDE_GRADIENT: bool = true;
    #[inline(always)]
    fn f<E: Real>(&self, [a, b]: [E; 2]) -> E {
        let ln = b.ln();
        let zero = a.like(0.0) * (a + b.sign());
        a.abs().if_positive(a * ln, zero)
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, [a, b]: [E; 2], _y: E) -> [E; 2] {
        // Where a is 0 and b has no logarithm, that of 1, and a division by 1: the next derivative is not NaN there.
        let divisor = b.if_positive(b, a.abs().if_positive(b, b.like(1.0)));
        [g * divisor.ln(), product_over(g, a, divisor)]
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-3.0..3.0).domain(0.5..3.0);
        c.at([0.0, 0.0], 0.0, [0.0, 0.0]).at([0.0, 2.0], 0.0, [2.0_f64.ln(), 0.0]).at([0.0, -1.0], 0.0, [0.0, 0.0]);
        c.at([2.0, 0.0], -INF, [-INF, INF]).at([1.0, -1.0], NAN, [NAN, -1.0]).at([0.0, NAN], NAN, [0.0, 0.0]);
        c.at([0.0, INF], 0.0, [INF, 0.0]);
    }
}

impl<'t, T: Scalar> Var<'t, T> {
    /// `self` to an integer power. Exponent 0 gives 1, with gradient 0, for any base.
    #[track_caller]
    pub fn powi(&self, exponent: i32) -> Self {
        match exponent {
            -1 => self.reciprocal(),
            2 => ConstPowi::<2>.on([self]),
            3 => ConstPowi::<3>.on([self]),
            4 => ConstPowi::<4>.on([self]),
            _ => Powi { exponent }.on([self]),
        }
    }

    /// `self` to a constant real power; NaN for a negative base and a fractional exponent. Exponent 0 gives 1, with
    /// gradient 0.
    #[track_caller]
    pub fn powf(&self, exponent: f64) -> Self {
        match exponent {
            1.0 => self.powi(1),
            // The exponent may be infinite, and `Powf` has none of those limits.
            _ if exponent.abs() > 1e30 => self.pow(self.constant(exponent)),
            _ => Powf { exponent }.on([self]),
        }
    }
}

elementwise! {
    /// The reciprocal, `1 / self`.
    reciprocal() = Reciprocal;
    /// `self` to the power of `exponent`. Shapes broadcast. At base 0 the gradient of the exponent is 0, unless the
    /// exponent is negative. For a negative base it is NaN.
    ///
    /// # Panics
    /// If the shapes do not broadcast.
    pow(exponent) = Pow;
    /// `self * ln(y)`, which is 0 where `self` is 0, even if `y` is 0 or negative. Shapes broadcast. An entropy is
    /// `-p.xlogy(&p)`.
    ///
    /// # Panics
    /// If the shapes do not broadcast.
    xlogy(y) = Xlogy;
    // Powers of both signs, of 0 and of 1 have conventions of their own.
    also examined: Powi { exponent: 0 }, Powi { exponent: 1 }, Powi { exponent: 5 }, Powi { exponent: -4 },
        ConstPowi::<2>, ConstPowi::<3>, ConstPowi::<4>,
        Powf { exponent: 0.0 }, Powf { exponent: 0.5 }, Powf { exponent: 1.5 },
        Powf { exponent: 2.0 }, Powf { exponent: 2.5 }, Powf { exponent: -0.5 };
}
