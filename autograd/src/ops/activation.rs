//! Activation functions.

use crate::catalogue::Cases;
use crate::elementwise::{Map, Unary};
use crate::{Reads, Var};
use raygrad_tensor::{Real, Scalar};
use std::f64::consts::{FRAC_1_SQRT_2, FRAC_2_SQRT_PI};

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

/// y = ln(1 / (1 + e^-x)) = -softplus(-x); dx = g s(-x).
#[derive(Clone, Copy)]
pub struct LogSigmoid;
impl Unary for LogSigmoid {
    const NAME: &'static str = "log_sigmoid";
    const READS: Reads = Reads::only(&[0]);
    #[inline(always)]
    fn f<E: Real>(&self, x: E) -> E {
        -(-x).softplus()
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, x: E, _y: E) -> E {
        g * (-x).sigmoid()
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-3.0..3.0).at([0.0], -std::f64::consts::LN_2, [0.5]).at([20.0], -2.061_153_620e-9, [2.061_153_618e-9]);
        c.at([-INF], -INF, [1.0]).at([INF], 0.0, [0.0]).at([-89.0], -89.0, [1.0]);
    }
}

/// y = x where x > 0, else slope x; dx = g or slope g, the latter at the kink.
#[derive(Clone, Copy)]
pub struct LeakyRelu {
    /// The slope below 0, positive.
    pub slope: f64,
}
impl Unary for LeakyRelu {
    const NAME: &'static str = "leaky_relu";
    const READS: Reads = Reads::only(&[0]);
    #[inline(always)]
    fn f<E: Real>(&self, x: E) -> E {
        let scaled = x.like(self.slope) * x.clone();
        x.if_positive(x.clone(), scaled)
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, x: E, _y: E) -> E {
        let scaled = g.like(self.slope) * g.clone();
        x.if_positive(g, scaled)
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(0.1..3.0).domain_also(-3.0..-0.1);
        c.at([0.0], 0.0, [self.slope]).at([-INF], -INF, [self.slope]).at([INF], INF, [1.0]);
        c.at([f64::NAN], f64::NAN, [self.slope]);
    }
}

/// y = x where x > 0, else alpha (e^x - 1); dx = g or g alpha e^x, the latter at the kink.
#[derive(Clone, Copy)]
pub struct Elu {
    /// Minus the limit at -inf.
    pub alpha: f64,
}
impl Unary for Elu {
    const NAME: &'static str = "elu";
    const READS: Reads = Reads::only(&[0]);
    #[inline(always)]
    fn f<E: Real>(&self, x: E) -> E {
        let below = x.like(self.alpha) * x.clone().expm1();
        x.if_positive(x.clone(), below)
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, x: E, _y: E) -> E {
        // e^min(x, 0): what is not chosen must not overflow either, or it would be NaN in the next derivative.
        let zero = x.like(0.0);
        let below = x.like(self.alpha) * x.if_positive(zero, x.clone()).exp();
        g.clone() * x.if_positive(g.like(1.0), below)
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(0.1..3.0).domain_also(-3.0..-0.1);
        c.at([0.0], 0.0, [self.alpha]).at([-INF], -self.alpha, [0.0]).at([INF], INF, [1.0]).at(
            [-1e-20],
            -1e-20 * self.alpha,
            [self.alpha],
        );
    }
}

/// y = x P(x), with P the normal distribution function (1 + erf(x / sqrt 2)) / 2; dx = g (P(x) + x p(x)), with p its
/// density.
#[derive(Clone, Copy)]
pub struct Gelu;
impl Unary for Gelu {
    const NAME: &'static str = "gelu";
    const READS: Reads = Reads::only(&[0]);
    #[inline(always)]
    fn f<E: Real>(&self, x: E) -> E {
        let (half, root) = (x.like(0.5), x.like(FRAC_1_SQRT_2));
        let share = half.clone() + half * (x.clone() * root).erf();
        scaled(x, share)
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, x: E, _y: E) -> E {
        let (half, root) = (x.like(0.5), x.like(FRAC_1_SQRT_2));
        let share = half.clone() + half.clone() * (x.clone() * root).erf();
        let density = x.like(0.5 * FRAC_2_SQRT_PI * FRAC_1_SQRT_2) * (-(half * (x.clone() * x.clone()))).exp();
        g * (share + scaled(x, density))
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-3.0..3.0).at([0.0], 0.0, [0.5]).at([-INF], 0.0, [0.0]).at([INF], INF, [1.0]).at(
            [f64::NAN],
            f64::NAN,
            [f64::NAN],
        );
    }
}

/// y = x s(2 u), u = sqrt(2/pi) (x + 0.044715 x^3): [`Gelu`] by way of tanh, within 5e-4 of it.
#[derive(Clone, Copy)]
pub struct GeluTanh;
impl Unary for GeluTanh {
    const NAME: &'static str = "gelu_tanh";
    const READS: Reads = Reads::only(&[0]);
    #[inline(always)]
    fn f<E: Real>(&self, x: E) -> E {
        let share = gelu_argument(x.clone()).sigmoid();
        scaled(x, share)
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, x: E, _y: E) -> E {
        let u = gelu_argument(x.clone());
        let share = u.clone().sigmoid();
        let density = share.clone() * (-u).sigmoid();
        let (scale, cubic) = (x.like(GELU_SCALE), x.like(3.0 * GELU_CUBIC));
        // Where the density is 0, its factor may be infinite.
        let slope = scale.clone() + scale * cubic * (x.clone() * x.clone());
        g * (share + scaled(x * slope, density))
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-3.0..3.0).at([0.0], 0.0, [0.5]).at([-INF], 0.0, [0.0]).at([INF], INF, [1.0]).at([1e30], 1e30, [1.0]);
        c.at([1.0], 0.841_191_990_608_276_8, [1.082964083845783]);
    }
}

/// y = x s(x), also called swish; dx = g (s(x) + x s(x) s(-x)).
#[derive(Clone, Copy)]
pub struct Silu;
impl Unary for Silu {
    const NAME: &'static str = "silu";
    const READS: Reads = Reads::only(&[0]);
    #[inline(always)]
    fn f<E: Real>(&self, x: E) -> E {
        let share = x.clone().sigmoid();
        scaled(x, share)
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, x: E, _y: E) -> E {
        let share = x.clone().sigmoid();
        let density = share.clone() * (-x.clone()).sigmoid();
        g * (share + scaled(x, density))
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-3.0..3.0).at([0.0], 0.0, [0.5]).at([-INF], 0.0, [0.0]).at([INF], INF, [1.0]);
        c.at([-20.0], -4.122_307_236e-8, [-3.916_191_867e-8]).at([f64::NAN], f64::NAN, [f64::NAN]);
    }
}

/// `x share` for a share that tends to 0 faster than x grows: 0, and not NaN, where the share is 0.
#[inline(always)]
fn scaled<E: Real>(x: E, share: E) -> E {
    let product = x * share.clone();
    share.if_positive(product, share.clone())
}

const GELU_SCALE: f64 = 1.595_769_121_605_730_7; // 2 sqrt(2/pi)
const GELU_CUBIC: f64 = 0.044_715;

/// Twice the argument of tanh in [`GeluTanh`].
#[inline(always)]
fn gelu_argument<E: Real>(x: E) -> E {
    let (scale, cubic) = (x.like(GELU_SCALE), x.like(GELU_CUBIC));
    let cube = x.clone() * x.clone() * x.clone();
    scale * (x + cubic * cube)
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

    /// `ln(sigmoid(self))`, accurate at both ends.
    #[track_caller]
    pub fn log_sigmoid(&self) -> Self {
        self.tape().apply(Map(LogSigmoid), &[self])
    }

    /// `self` where it is positive, else `slope * self`. The gradient at 0 is `slope`.
    #[track_caller]
    pub fn leaky_relu(&self, slope: f64) -> Self {
        self.tape().apply(Map(LeakyRelu { slope }), &[self])
    }

    /// `self` where it is positive, else `alpha (e^self - 1)`. The gradient at 0 is `alpha`.
    #[track_caller]
    pub fn elu(&self, alpha: f64) -> Self {
        self.tape().apply(Map(Elu { alpha }), &[self])
    }

    /// `self` times the normal distribution function of `self`: the exact form, by way of the error function.
    #[track_caller]
    pub fn gelu(&self) -> Self {
        self.tape().apply(Map(Gelu), &[self])
    }

    /// [`gelu`](Self::gelu) in the form with tanh, which older models were trained with; within 5e-4 of the exact one.
    #[track_caller]
    pub fn gelu_tanh(&self) -> Self {
        self.tape().apply(Map(GeluTanh), &[self])
    }

    /// `self * sigmoid(self)`, also called swish.
    #[track_caller]
    pub fn silu(&self) -> Self {
        self.tape().apply(Map(Silu), &[self])
    }
}
