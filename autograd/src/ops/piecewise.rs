//! Functions with kinks and steps: absolute value, sign, maximum, minimum, clamp, rounding.

use crate::cases::{INF, NAN};
use crate::error::ensure;
use crate::{Cases, Formula, Var};
use raygrad_tensor::{Real, Scalar};

/// y = |x|; dx = g sign(x), so 0 at the kink.
#[derive(Clone, Copy)]
pub struct Abs;
impl Formula<1> for Abs {
    const NAME: &'static str = "abs";
    #[inline(always)]
    fn f<E: Real>(&self, [x]: [E; 1]) -> E {
        x.abs()
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(0.1..3.0).domain_also(-3.0..-0.1).at([0.0], 0.0, [0.0]).at([-0.0], 0.0, [0.0]).at([-INF], INF, [-1.0]);
    }
}

/// y = 1 for x > 0, -1 for x < 0, else x; dx = 0.
#[derive(Clone, Copy)]
pub struct Sign;
impl Formula<1> for Sign {
    const NAME: &'static str = "sign";
    #[inline(always)]
    fn f<E: Real>(&self, [x]: [E; 1]) -> E {
        x.sign()
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(0.1..3.0).domain_also(-3.0..-0.1).at([0.0], 0.0, [0.0]).at([-INF], -1.0, [0.0]).at([NAN], NAN, [0.0]);
    }
}

/// y = the larger of a and b, NaN if one is NaN. The larger one gets g; at a tie each gets half.
#[derive(Clone, Copy)]
pub struct Maximum;
impl Formula<2> for Maximum {
    const NAME: &'static str = "maximum";
    #[inline(always)]
    fn f<E: Real>(&self, [a, b]: [E; 2]) -> E {
        a.maximum(b)
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(0.1..3.0).domain(-3.0..-0.1).domain_also(3.1..4.0);
        c.at([2.0, 2.0], 2.0, [0.5, 0.5]).at([-INF, 1.0], 1.0, [0.0, 1.0]).at([INF, INF], INF, [0.5, 0.5]);
        c.at([NAN, 1.0], NAN, [0.5, 0.5]).at([1.0, NAN], NAN, [0.5, 0.5]);
    }
}

/// y = the smaller of a and b, NaN if one is NaN. The smaller one gets g; at a tie each gets half.
#[derive(Clone, Copy)]
pub struct Minimum;
impl Formula<2> for Minimum {
    const NAME: &'static str = "minimum";
    #[inline(always)]
    fn f<E: Real>(&self, [a, b]: [E; 2]) -> E {
        a.minimum(b)
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(0.1..3.0).domain(-3.0..-0.1).domain_also(3.1..4.0);
        c.at([2.0, 2.0], 2.0, [0.5, 0.5]).at([-INF, 1.0], -INF, [1.0, 0.0]).at([INF, INF], INF, [0.5, 0.5]);
        c.at([NAN, 1.0], NAN, [0.5, 0.5]).at([1.0, NAN], NAN, [0.5, 0.5]);
    }
}

/// g where `lead` > 0, 0 where it is negative, half of g at a tie or NaN.
#[inline(always)]
pub(crate) fn share<E: Real>(g: E, lead: E) -> E {
    let (zero, half) = (g.like(0.0), g.like(0.5) * g);
    lead.if_positive(g, (-lead).if_positive(zero, half))
}

/// y = x limited to low..=high, NaN for NaN; dx = g inside and on the limits, 0 beyond.
#[derive(Clone, Copy)]
pub struct Clamp {
    /// The lower limit.
    pub low: f64,
    /// The upper limit.
    pub high: f64,
}
impl Formula<1> for Clamp {
    const NAME: &'static str = "clamp";
    #[inline(always)]
    fn f<E: Real>(&self, [x]: [E; 1]) -> E {
        let (low, high) = (x.like(self.low), x.like(self.high));
        let below = (low - x).if_positive(low, x);
        (x - high).if_positive(high, below)
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

/// y = the largest whole number that is not above x; dx = 0.
#[derive(Clone, Copy)]
pub struct Floor;
impl Formula<1> for Floor {
    const NAME: &'static str = "floor";
    #[inline(always)]
    fn f<E: Real>(&self, [x]: [E; 1]) -> E {
        x.floor()
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-1.9..-1.1).domain_also(2.1..2.9).at([-0.5], -1.0, [0.0]).at([2.0], 2.0, [0.0]).at([INF], INF, [0.0]);
    }
}

/// y = the smallest whole number that is not below x; dx = 0.
#[derive(Clone, Copy)]
pub struct Ceil;
impl Formula<1> for Ceil {
    const NAME: &'static str = "ceil";
    #[inline(always)]
    fn f<E: Real>(&self, [x]: [E; 1]) -> E {
        x.ceil()
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-1.9..-1.1).domain_also(2.1..2.9).at([0.5], 1.0, [0.0]).at([2.0], 2.0, [0.0]).at([-INF], -INF, [0.0]);
    }
}

/// y = the whole number nearest to x; ties go to the even one; dx = 0.
#[derive(Clone, Copy)]
pub struct Round;
impl Formula<1> for Round {
    const NAME: &'static str = "round";
    #[inline(always)]
    fn f<E: Real>(&self, [x]: [E; 1]) -> E {
        x.round()
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
    /// Limits the elements to `low..=high`; NaN stays NaN. The gradient passes between the limits and on them, and is 0
    /// beyond. An infinite limit has no effect.
    ///
    /// # Panics
    /// If `low` is above `high`, or if one is NaN.
    #[track_caller]
    pub fn clamp(&self, low: f64, high: f64) -> Self {
        self.fits("clamp", ensure(low <= high, || format!("no number is between {low} and {high}")));
        Clamp { low, high }.on([self])
    }
}

elementwise! {
    /// The absolute value. The gradient at 0 is 0.
    abs() = Abs;
    /// The sign: 1 for positive elements, -1 for negative ones; 0 and NaN stay. The gradient is 0.
    sign() = Sign;
    /// The larger of two elements, NaN if one is NaN. Shapes broadcast. At a tie each gets half of the gradient.
    ///
    /// # Panics
    /// If the shapes do not broadcast.
    maximum(other) = Maximum;
    /// The smaller of two elements, NaN if one is NaN. Shapes broadcast. At a tie each gets half of the gradient.
    ///
    /// # Panics
    /// If the shapes do not broadcast.
    minimum(other) = Minimum;
    /// The largest whole number that is not above. The gradient is 0.
    floor() = Floor;
    /// The smallest whole number that is not below. The gradient is 0.
    ceil() = Ceil;
    /// The nearest whole number; ties go to the even one. The gradient is 0.
    round() = Round;
    also examined: Clamp { low: -1.0, high: 2.0 };
}
