//! Functions with kinks and steps: absolute value, sign, extremes, limits, rounding.

use crate::catalogue::Cases;
use crate::elementwise::{Binary, Map, Unary, Zip};
use crate::{Reads, Var};
use raygrad_tensor::{Real, Scalar};

const INF: f64 = f64::INFINITY;
const NAN: f64 = f64::NAN;

/// y = |x|; dx = g sign(x), so 0 at the kink.
#[derive(Clone, Copy)]
pub struct Abs;
impl Unary for Abs {
    const NAME: &'static str = "abs";
    const READS: Reads = Reads::only(&[0]);
    #[inline(always)]
    fn f<E: Real>(&self, x: E) -> E {
        x.abs()
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, x: E, _y: E) -> E {
        g * x.sign()
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(0.1..3.0).domain_also(-3.0..-0.1).at([0.0], 0.0, [0.0]).at([-0.0], 0.0, [0.0]).at([-INF], INF, [-1.0]);
    }
}

/// y = 1 for x > 0, -1 for x < 0, else x; dx = 0.
#[derive(Clone, Copy)]
pub struct Sign;
impl Unary for Sign {
    const NAME: &'static str = "sign";
    const READS: Reads = Reads::NOTHING;
    #[inline(always)]
    fn f<E: Real>(&self, x: E) -> E {
        x.sign()
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, _x: E, _y: E) -> E {
        g.like(0.0)
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(0.1..3.0).domain_also(-3.0..-0.1).at([0.0], 0.0, [0.0]).at([-INF], -1.0, [0.0]).at([NAN], NAN, [0.0]);
    }
}

/// y = the greater of a and b, NaN if one is; its gradient is g, and each has half of it at a tie.
#[derive(Clone, Copy)]
pub struct Maximum;
impl Binary for Maximum {
    const NAME: &'static str = "maximum";
    const READS: Reads = Reads::INPUTS;
    #[inline(always)]
    fn f<E: Real>(&self, a: E, b: E) -> E {
        a.maximum(b)
    }
    #[inline(always)]
    fn vjp_a<E: Real>(&self, g: E, a: E, b: E, _y: E) -> E {
        share(g, a - b)
    }
    #[inline(always)]
    fn vjp_b<E: Real>(&self, g: E, a: E, b: E, _y: E) -> E {
        share(g, b - a)
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(0.1..3.0).domain(-3.0..-0.1).domain_also(3.1..4.0);
        c.at([2.0, 2.0], 2.0, [0.5, 0.5]).at([-INF, 1.0], 1.0, [0.0, 1.0]).at([INF, INF], INF, [0.5, 0.5]);
        c.at([NAN, 1.0], NAN, [0.5, 0.5]).at([1.0, NAN], NAN, [0.5, 0.5]);
    }
}

/// y = the smaller of a and b, NaN if one is; its gradient is g, and each has half of it at a tie.
#[derive(Clone, Copy)]
pub struct Minimum;
impl Binary for Minimum {
    const NAME: &'static str = "minimum";
    const READS: Reads = Reads::INPUTS;
    #[inline(always)]
    fn f<E: Real>(&self, a: E, b: E) -> E {
        a.minimum(b)
    }
    #[inline(always)]
    fn vjp_a<E: Real>(&self, g: E, a: E, b: E, _y: E) -> E {
        share(g, b - a)
    }
    #[inline(always)]
    fn vjp_b<E: Real>(&self, g: E, a: E, b: E, _y: E) -> E {
        share(g, a - b)
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(0.1..3.0).domain(-3.0..-0.1).domain_also(3.1..4.0);
        c.at([2.0, 2.0], 2.0, [0.5, 0.5]).at([-INF, 1.0], -INF, [1.0, 0.0]).at([INF, INF], INF, [0.5, 0.5]);
        c.at([NAN, 1.0], NAN, [0.5, 0.5]).at([1.0, NAN], NAN, [0.5, 0.5]);
    }
}

/// g where `lead` > 0, 0 where it is negative, half of g at a tie (and where nothing can be said).
#[inline(always)]
fn share<E: Real>(g: E, lead: E) -> E {
    let (zero, half) = (g.like(0.0), g.like(0.5) * g.clone());
    lead.if_positive(g, (-lead.clone()).if_positive(zero, half))
}

/// y = x limited to low..=high, NaN for NaN; dx = g inside and on the limits, 0 beyond.
#[derive(Clone, Copy)]
pub struct Clamp {
    /// The least value.
    pub low: f64,
    /// The greatest value.
    pub high: f64,
}
impl Unary for Clamp {
    const NAME: &'static str = "clamp";
    const READS: Reads = Reads::only(&[0]);
    #[inline(always)]
    fn f<E: Real>(&self, x: E) -> E {
        let (low, high) = (x.like(self.low), x.like(self.high));
        let below = (low.clone() - x.clone()).if_positive(low, x.clone());
        (x - high.clone()).if_positive(high, below)
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, x: E, _y: E) -> E {
        let (zero, low, high) = (g.like(0.0), x.like(self.low), x.like(self.high));
        let inside = (low - x.clone()).if_positive(zero.clone(), g);
        (x - high).if_positive(zero, inside)
    }
    fn cases(&self, c: &mut Cases) {
        let (low, high) = (self.low, self.high);
        let middle = 0.5 * (low + high);
        c.domain(low + 0.1..middle).domain_also(low - 2.0..low - 0.1).domain_also(high + 0.1..high + 2.0);
        c.at([low], low, [1.0]).at([high], high, [1.0]).at([-INF], low, [0.0]).at([INF], high, [0.0]).at(
            [NAN],
            NAN,
            [1.0],
        );
    }
}

/// y = the greatest whole number that is not above x; dx = 0.
#[derive(Clone, Copy)]
pub struct Floor;
impl Unary for Floor {
    const NAME: &'static str = "floor";
    const READS: Reads = Reads::NOTHING;
    #[inline(always)]
    fn f<E: Real>(&self, x: E) -> E {
        x.floor()
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, _x: E, _y: E) -> E {
        g.like(0.0)
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-1.9..-1.1).domain_also(2.1..2.9).at([-0.5], -1.0, [0.0]).at([2.0], 2.0, [0.0]).at([INF], INF, [0.0]);
    }
}

/// y = the least whole number that is not below x; dx = 0.
#[derive(Clone, Copy)]
pub struct Ceil;
impl Unary for Ceil {
    const NAME: &'static str = "ceil";
    const READS: Reads = Reads::NOTHING;
    #[inline(always)]
    fn f<E: Real>(&self, x: E) -> E {
        x.ceil()
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, _x: E, _y: E) -> E {
        g.like(0.0)
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-1.9..-1.1).domain_also(2.1..2.9).at([0.5], 1.0, [0.0]).at([2.0], 2.0, [0.0]).at([-INF], -INF, [0.0]);
    }
}

/// y = the whole number nearest to x, the even one of two; dx = 0.
#[derive(Clone, Copy)]
pub struct Round;
impl Unary for Round {
    const NAME: &'static str = "round";
    const READS: Reads = Reads::NOTHING;
    #[inline(always)]
    fn f<E: Real>(&self, x: E) -> E {
        x.round()
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, _x: E, _y: E) -> E {
        g.like(0.0)
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-1.4..-0.6)
            .domain_also(1.6..2.4)
            .at([0.5], 0.0, [0.0])
            .at([1.5], 2.0, [0.0])
            .at([-2.5], -2.0, [0.0])
            .at([NAN], NAN, [0.0]);
    }
}

impl<'t, T: Scalar> Var<'t, T> {
    /// The absolute value. The gradient at 0 is 0.
    #[track_caller]
    pub fn abs(&self) -> Self {
        self.tape().apply(Map(Abs), &[self])
    }

    /// 1 for positive elements, -1 for negative ones, 0 and NaN for 0 and NaN. The gradient is 0.
    #[track_caller]
    pub fn sign(&self) -> Self {
        self.tape().apply(Map(Sign), &[self])
    }

    /// The greater of two elements, NaN if one is NaN; broadcasts. At a tie each gets half of the gradient.
    ///
    /// # Panics
    /// If the shapes do not broadcast.
    #[track_caller]
    pub fn maximum(&self, other: &Self) -> Self {
        self.tape().apply(Zip(Maximum), &[self, other])
    }

    /// The smaller of two elements, NaN if one is NaN; broadcasts. At a tie each gets half of the gradient.
    ///
    /// # Panics
    /// If the shapes do not broadcast.
    #[track_caller]
    pub fn minimum(&self, other: &Self) -> Self {
        self.tape().apply(Zip(Minimum), &[self, other])
    }

    /// The elements limited to `low..=high`; NaN stays NaN. The gradient passes between the limits and on them, and is
    /// 0 beyond. An infinite limit is none.
    ///
    /// # Panics
    /// If `low` is not at most `high`.
    #[track_caller]
    pub fn clamp(&self, low: f64, high: f64) -> Self {
        assert!(low <= high, "clamp between {low} and {high}");
        self.tape().apply(Map(Clamp { low, high }), &[self])
    }

    /// The next whole number below. The gradient is 0.
    #[track_caller]
    pub fn floor(&self) -> Self {
        self.tape().apply(Map(Floor), &[self])
    }

    /// The next whole number above. The gradient is 0.
    #[track_caller]
    pub fn ceil(&self) -> Self {
        self.tape().apply(Map(Ceil), &[self])
    }

    /// The nearest whole number, the even one of two. The gradient is 0.
    #[track_caller]
    pub fn round(&self) -> Self {
        self.tape().apply(Map(Round), &[self])
    }
}
