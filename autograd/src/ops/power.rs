//! Powers, reciprocals, and x ln y.

use crate::catalogue::Cases;
use crate::elementwise::{Binary, Map, Unary, Zip};
use crate::{Reads, Var};
use raygrad_tensor::{Real, Scalar};

const INF: f64 = f64::INFINITY;
const NAN: f64 = f64::NAN;

/// y = 1 / x; dx = -g y^2.
#[derive(Clone, Copy)]
pub struct Reciprocal;
impl Unary for Reciprocal {
    const NAME: &'static str = "reciprocal";
    const READS: Reads = Reads::OUTPUT;
    #[inline(always)]
    fn f<E: Real>(&self, x: E) -> E {
        let one = x.like(1.0);
        one / x
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, _x: E, y: E) -> E {
        -(g * (y.clone() * y))
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
impl Unary for Powi {
    const NAME: &'static str = "powi";
    const READS: Reads = Reads::only(&[0]);
    #[inline(always)]
    fn f<E: Real>(&self, x: E) -> E {
        x.powi(self.exponent)
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, x: E, _y: E) -> E {
        if self.exponent == 0 {
            return g.like(0.0);
        }
        let factor = g.like(f64::from(self.exponent));
        g * (factor * x.powi(self.exponent.saturating_sub(1)))
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

/// [`Powi`] with an exponent that the compiler knows: where it is small, a few products that vectorise.
#[derive(Clone, Copy)]
pub struct ConstPowi<const N: i32>;
impl<const N: i32> Unary for ConstPowi<N> {
    const NAME: &'static str = "powi";
    const READS: Reads = Powi::READS;
    #[inline(always)]
    fn f<E: Real>(&self, x: E) -> E {
        Powi { exponent: N }.f(x)
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, x: E, y: E) -> E {
        Powi { exponent: N }.vjp(g, x, y)
    }
    fn cases(&self, c: &mut Cases) {
        Powi { exponent: N }.cases(c);
    }
}

/// y = x^p, NaN for a negative x and a broken p; dx = g p x^(p - 1), 0 for p = 0.
#[derive(Clone, Copy)]
pub struct Powf {
    /// The exponent.
    pub exponent: f64,
}
impl Unary for Powf {
    const NAME: &'static str = "powf";
    const READS: Reads = Reads::only(&[0]);
    #[inline(always)]
    fn f<E: Real>(&self, x: E) -> E {
        let exponent = x.like(self.exponent);
        x.pow(exponent)
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, x: E, _y: E) -> E {
        if self.exponent == 0.0 {
            return g.like(0.0);
        }
        let (factor, exponent) = (g.like(self.exponent), g.like(self.exponent - 1.0));
        g * (factor * x.pow(exponent))
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

/// y = a^b; da = g b a^(b - 1), db = g y ln a. At a = 0 da is 0 for b = 0, and db is 0 for b >= 0; NaN for a negative a
/// and a broken b.
#[derive(Clone, Copy)]
pub struct Pow;
impl Binary for Pow {
    const NAME: &'static str = "pow";
    const READS: Reads = Reads::ALL;
    #[inline(always)]
    fn f<E: Real>(&self, a: E, b: E) -> E {
        a.pow(b)
    }
    #[inline(always)]
    fn vjp_a<E: Real>(&self, g: E, a: E, b: E, _y: E) -> E {
        let (zero, one) = (g.like(0.0), g.like(1.0));
        let full = b.clone() * a.clone().pow(b.clone() - one);
        // 0 where both are 0, and NaN where one is.
        let origin = (a.clone() + b.clone()) * zero;
        g * (a.abs() + b.abs()).if_positive(full, origin)
    }
    #[inline(always)]
    fn vjp_b<E: Real>(&self, g: E, a: E, b: E, y: E) -> E {
        let (zero, one) = (g.like(0.0), g.like(1.0));
        let size = a.clone().abs();
        // A logarithm that is finite where it is not chosen, or the next derivative would be NaN.
        let ln = size.if_positive(a.clone(), one).ln();
        let full = y.clone() * ln;
        let at_zero = (-b).if_positive(y.clone() * a.clone().abs().ln(), y * zero.clone() + a * zero);
        g * size.if_positive(full, at_zero)
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(0.5..2.0).domain(-2.0..2.0);
        c.at([0.0, 0.0], 1.0, [0.0, 0.0]).at([0.0, 2.0], 0.0, [0.0, 0.0]).at([0.0, 1.0], 0.0, [1.0, 0.0]);
        c.at([0.0, 0.5], 0.0, [INF, 0.0]).at([0.0, -1.0], INF, [-INF, -INF]).at([-2.0, 3.0], -8.0, [12.0, NAN]);
        c.at([5.0, 0.0], 1.0, [0.0, 5.0_f64.ln()]).at([-2.0, 0.5], NAN, [NAN, NAN]);
    }
}

/// y = a ln b, 0 for a = 0 unless b is NaN; da = g ln b, but 0 where a = 0 and b <= 0; db = g a / b, but 0 where a = 0.
#[derive(Clone, Copy)]
pub struct Xlogy;
impl Binary for Xlogy {
    const NAME: &'static str = "xlogy";
    const READS: Reads = Reads::INPUTS;
    #[inline(always)]
    fn f<E: Real>(&self, a: E, b: E) -> E {
        let ln = b.clone().ln();
        let zero = a.like(0.0) * (a.clone() + b.clone().sign());
        a.clone().abs().if_positive(a * ln, zero)
    }
    #[inline(always)]
    fn vjp_a<E: Real>(&self, g: E, a: E, b: E, _y: E) -> E {
        // The logarithm of 1 where a is 0 and b has none.
        let divisor = a.abs().if_positive(b.clone(), b.like(1.0));
        g * b.if_positive(b.clone(), divisor).ln()
    }
    #[inline(always)]
    fn vjp_b<E: Real>(&self, g: E, a: E, b: E, _y: E) -> E {
        // Divided by 1 where a is 0, so that the next derivative is not NaN there.
        let one = b.like(1.0);
        let divisor = a.clone().abs().if_positive(b, one);
        g * (a / divisor)
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-3.0..3.0).domain(0.5..3.0);
        c.at([0.0, 0.0], 0.0, [0.0, 0.0]).at([0.0, 2.0], 0.0, [2.0_f64.ln(), 0.0]).at([0.0, -1.0], 0.0, [0.0, 0.0]);
        c.at([2.0, 0.0], -INF, [-INF, INF]).at([1.0, -1.0], NAN, [NAN, -1.0]).at([0.0, NAN], NAN, [0.0, 0.0]);
        c.at([0.0, INF], 0.0, [INF, 0.0]);
    }
}

impl<'t, T: Scalar> Var<'t, T> {
    /// `1 / self`.
    #[track_caller]
    pub fn reciprocal(&self) -> Self {
        self.tape().apply(Map(Reciprocal), &[self])
    }

    /// `self` to a whole power; exponent 0 gives 1, with gradient 0, whatever the base.
    #[track_caller]
    pub fn powi(&self, exponent: i32) -> Self {
        match exponent {
            -1 => self.reciprocal(),
            2 => self.tape().apply(Map(ConstPowi::<2>), &[self]),
            3 => self.tape().apply(Map(ConstPowi::<3>), &[self]),
            4 => self.tape().apply(Map(ConstPowi::<4>), &[self]),
            _ => self.tape().apply(Map(Powi { exponent }), &[self]),
        }
    }

    /// `self` to a constant real power: NaN for a negative base and a broken exponent; exponent 0 gives 1 with gradient
    /// 0.
    #[track_caller]
    pub fn powf(&self, exponent: f64) -> Self {
        self.tape().apply(Map(Powf { exponent }), &[self])
    }

    /// `self` to the power of `exponent`; broadcasts. At base 0 the gradient of the exponent is 0 unless that is
    /// negative, and for a negative base it is NaN.
    ///
    /// # Panics
    /// If the shapes do not broadcast.
    #[track_caller]
    pub fn pow(&self, exponent: &Self) -> Self {
        self.tape().apply(Zip(Pow), &[self, exponent])
    }

    /// `self * ln(y)`, which is 0 where `self` is 0 even if `y` is 0 or negative; broadcasts. An entropy is
    /// `-p.xlogy(&p)`.
    ///
    /// # Panics
    /// If the shapes do not broadcast.
    #[track_caller]
    pub fn xlogy(&self, y: &Self) -> Self {
        self.tape().apply(Zip(Xlogy), &[self, y])
    }
}
