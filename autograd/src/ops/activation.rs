//! Activation functions.

use crate::catalogue::Cases;
use crate::elementwise::{Map, Unary};
use crate::{Reads, Var};
use raygrad_tensor::{Real, Scalar};

const INF: f64 = f64::INFINITY;

/// y = max(x, 0), NaN for NaN; dx = g where x > 0, else 0 (also at the kink).
#[derive(Clone, Copy)]
pub struct Relu;
impl Unary for Relu {
    const NAME: &'static str = "relu";
    // y is positive exactly where x is, and a fused layer can then overwrite x.
    const READS: Reads = Reads::OUTPUT;
    #[inline(always)]
    fn f<E: Real>(&self, x: E) -> E {
        // As a choice on -x, so that a NaN chooses itself.
        let zero = x.like(0.0);
        (-x.clone()).if_positive(zero, x)
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, _x: E, y: E) -> E {
        let zero = g.like(0.0);
        y.if_positive(g, zero)
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(0.1..3.0).domain_also(-3.0..-0.1);
        c.at([0.0], 0.0, [0.0]).at([-INF], 0.0, [0.0]).at([INF], INF, [1.0]).at([f64::NAN], f64::NAN, [0.0]);
    }
}

/// y = 1 / (1 + e^-x); dx = g s(x) s(-x), which keeps digits where y is near 1.
#[derive(Clone, Copy)]
pub struct Sigmoid;
impl Unary for Sigmoid {
    const NAME: &'static str = "sigmoid";
    const READS: Reads = Reads::only(&[0]).and_output();
    #[inline(always)]
    fn f<E: Real>(&self, x: E) -> E {
        x.sigmoid()
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, x: E, y: E) -> E {
        g * (y * (-x).sigmoid())
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-3.0..3.0).at([0.0], 0.5, [0.25]).at([-INF], 0.0, [0.0]).at([INF], 1.0, [0.0]);
        c.at([17.0], 0.999_999_958_600_600_9, [4.139_937_377e-8]).at([-89.0], 2.227_363_561e-39, [2.227_363_561e-39]);
    }
}

/// y = ln(1 + e^x); dx = g s(x).
#[derive(Clone, Copy)]
pub struct Softplus;
impl Unary for Softplus {
    const NAME: &'static str = "softplus";
    const READS: Reads = Reads::only(&[0]);
    #[inline(always)]
    fn f<E: Real>(&self, x: E) -> E {
        x.softplus()
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, x: E, _y: E) -> E {
        g * x.sigmoid()
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-3.0..3.0).at([-20.0], 2.061_153_620e-9, [2.061_153_618e-9]).at([89.0], 89.0, [1.0]);
        c.at([-INF], 0.0, [0.0]).at([INF], INF, [1.0]);
    }
}

impl<'t, T: Scalar> Var<'t, T> {
    /// `max(self, 0)`; NaN stays NaN. The gradient at 0 is 0.
    #[track_caller]
    pub fn relu(&self) -> Self {
        self.tape().apply(Map(Relu), &[self])
    }

    /// `1 / (1 + e^-self)`, accurate at both ends.
    #[track_caller]
    pub fn sigmoid(&self) -> Self {
        self.tape().apply(Map(Sigmoid), &[self])
    }

    /// `ln(1 + e^self)`, accurate at both ends.
    #[track_caller]
    pub fn softplus(&self) -> Self {
        self.tape().apply(Map(Softplus), &[self])
    }
}
