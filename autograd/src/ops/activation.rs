//! Activation functions.

use crate::cases::INF;
use crate::slopes::{FAR, at_least, at_most, bell, checked, near_sigmoid, wide_bell, wide_sigmoid, within};
use crate::{Cases, Formula, Var};
use raygrad_tensor::{Real, Scalar, Wide};
use std::f64::consts::{FRAC_1_SQRT_2, FRAC_2_SQRT_PI};

/// y = max(x, 0), NaN for NaN; dx = g where x > 0, else 0 (also at the kink).
#[derive(Clone, Copy)]
pub struct Relu;
impl Formula<1> for Relu {
    const NAME: &'static str = "relu";
    // y is positive exactly where x is, and a fused layer can then overwrite x.
    #[inline(always)]
    fn f<E: Real>(&self, [x]: [E; 1]) -> E {
        // As a choice on -x, so that a NaN chooses itself.
        let zero = x.like(0.0);
        (-x).if_positive(zero, x)
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, [_x]: [E; 1], y: E) -> [E; 1] {
        let zero = g.like(0.0);
        [y.if_positive(g, zero)]
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(0.1..3.0).domain_also(-3.0..-0.1);
        c.at([0.0], 0.0, [0.0]).at([-INF], 0.0, [0.0]).at([INF], INF, [1.0]).at([f64::NAN], f64::NAN, [0.0]);
    }
}

/// y = 1 / (1 + e^-x); dx = g s(x) s(-x).
#[derive(Clone, Copy)]
pub struct Sigmoid;
impl Formula<1> for Sigmoid {
    const NAME: &'static str = "sigmoid";
    const WIDE_GRADIENT: bool = true;
    #[inline(always)]
    fn f<E: Real>(&self, [x]: [E; 1]) -> E {
        x.sigmoid()
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-3.0..3.0).at([0.0], 0.5, [0.25]).at([-INF], 0.0, [0.0]).at([INF], 1.0, [0.0]);
        c.at([17.0], 0.999_999_958_600_600_9, [4.139_937_377e-8]).at([-89.0], 2.227_363_561e-39, [2.227_363_561e-39]);
    }
}

/// y = s(x) s(-x), the derivative of the sigmoid s; dx = -g y tanh(x / 2), a product that keeps its digits close to 0.
#[derive(Clone, Copy)]
pub struct LogisticDensity;
impl Formula<1> for LogisticDensity {
    const NAME: &'static str = "logistic_density";
    #[inline(always)]
    fn f<E: Real>(&self, [x]: [E; 1]) -> E {
        x.logistic_density()
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, [x]: [E; 1], y: E) -> [E; 1] {
        [-(g * y * (x.like(0.5) * x).tanh())]
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-3.0..3.0).at([0.0], 0.25, [0.0]).at([-INF], 0.0, [0.0]).at([INF], 0.0, [0.0]);
        c.at([1e-10], 0.25, [-1.25e-11]);
    }
}

/// y = ln(1 + e^x); dx = g s(x).
#[derive(Clone, Copy)]
pub struct Softplus;
impl Formula<1> for Softplus {
    const NAME: &'static str = "softplus";
    const WIDE_GRADIENT: bool = true;
    #[inline(always)]
    fn f<E: Real>(&self, [x]: [E; 1]) -> E {
        x.softplus()
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-3.0..3.0).at([-20.0], 2.061_153_620e-9, [2.061_153_618e-9]).at([89.0], 89.0, [1.0]);
        c.at([-INF], 0.0, [0.0]).at([INF], INF, [1.0]);
    }
}

/// y = ln(1 / (1 + e^-x)) = -softplus(-x); dx = g s(-x).
#[derive(Clone, Copy)]
pub struct LogSigmoid;
impl Formula<1> for LogSigmoid {
    const NAME: &'static str = "log_sigmoid";
    const WIDE_GRADIENT: bool = true;
    #[inline(always)]
    fn f<E: Real>(&self, [x]: [E; 1]) -> E {
        -(-x).softplus()
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
impl Formula<1> for LeakyRelu {
    const NAME: &'static str = "leaky_relu";
    #[inline(always)]
    fn f<E: Real>(&self, [x]: [E; 1]) -> E {
        x * x.if_positive(x.like(1.0), x.like(self.slope))
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
impl Formula<1> for Elu {
    const NAME: &'static str = "elu";
    const WIDE_GRADIENT: bool = true;
    #[inline(always)]
    fn f<E: Real>(&self, [x]: [E; 1]) -> E {
        // Of min(x, 0): the branch not taken must not overflow either, or the second derivative would be NaN.
        let below = x.like(self.alpha) * x.if_positive(x.like(0.0), x).expm1();
        x.if_positive(x, below)
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, [x]: [E; 1], _y: E) -> [E; 1] {
        // Of min(x, 0), whose exponential is 1 above.
        let zero = x.like(0.0);
        let (below, alpha) = (x.if_positive(zero, x), x.if_positive(x.like(1.0), x.like(self.alpha)));
        let y = below.exp();
        [checked!(
            g * (y * alpha),
            g.like(2.0),
            [],
            [y, y * alpha],
            (g.wide() * E::Wide::exp(below, zero) * alpha.wide()).narrow()
        )]
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
impl Formula<1> for Gelu {
    const NAME: &'static str = "gelu";
    const WIDE_VALUE: bool = true;
    const WIDE_GRADIENT: bool = true;
    #[inline(always)]
    fn f<E: Real>(&self, [x]: [E; 1]) -> E {
        let x = at_least(x, -FAR);
        let share = x.normal_cdf();
        checked!(x * share, x, [], [share], (x.wide() * E::Wide::normal_cdf(x)).narrow())
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, [x]: [E; 1], _y: E) -> [E; 1] {
        let x = within(x, FAR);
        let peak = x.like(0.5 * FRAC_2_SQRT_PI * FRAC_1_SQRT_2);
        let (share, density) = (x.normal_cdf(), peak * bell(x, x, -0.5));
        [checked!(g * (share + density), g, [], [share], {
            let share = (g.wide() * E::Wide::normal_cdf(x)).narrow();
            share + (g.wide() * (peak * x).wide() * wide_bell(x, -0.5)).narrow()
        })]
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-3.0..3.0).at([0.0], 0.0, [0.5]).at([-INF], 0.0, [0.0]).at([INF], INF, [1.0]).at(
            [f64::NAN],
            f64::NAN,
            [f64::NAN],
        );
    }
}

/// y = x s(2 u), u = sqrt(2/pi) (x + 0.044715 x^3): the tanh approximation of [`Gelu`], within 5e-4 of it.
#[derive(Clone, Copy)]
pub struct GeluTanh;
impl Formula<1> for GeluTanh {
    const NAME: &'static str = "gelu_tanh";
    const WIDE_VALUE: bool = true;
    const WIDE_GRADIENT: bool = true;
    #[inline(always)]
    fn f<E: Real>(&self, [x]: [E; 1]) -> E {
        let x = at_least(x, -FAR);
        let [u, low] = gelu_argument(at_most(x, FAR));
        let share = near_sigmoid(u, low);
        checked!(x * share, x, [], [share], (x.wide() * E::Wide::sigmoid(u, low)).narrow())
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, [x]: [E; 1], _y: E) -> [E; 1] {
        let x = within(x, FAR);
        let [u, low] = gelu_argument(x);
        let share = near_sigmoid(u, low);
        let slope = x * (x.like(GELU_SCALE) + x.like(3.0 * GELU_SCALE * GELU_CUBIC) * (x * x));
        let density = share * near_sigmoid(-u, -low);
        [checked!(g * (share + density * slope), g * slope, [], [share], {
            let share = g.wide() * E::Wide::sigmoid(u, low);
            share.narrow() + (share * E::Wide::sigmoid(-u, -low) * slope.wide()).narrow()
        })]
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-3.0..3.0).at([0.0], 0.0, [0.5]).at([-INF], 0.0, [0.0]).at([INF], INF, [1.0]).at([1e30], 1e30, [1.0]);
        c.at([1.0], 0.841_191_990_608_276_8, [1.082964083845783]);
    }
}

/// y = x s(x), also called swish; dx = g (s(x) + x s(x) s(-x)).
#[derive(Clone, Copy)]
pub struct Silu;
impl Formula<1> for Silu {
    const NAME: &'static str = "silu";
    const WIDE_VALUE: bool = true;
    const WIDE_GRADIENT: bool = true;
    #[inline(always)]
    fn f<E: Real>(&self, [x]: [E; 1]) -> E {
        let x = at_least(x, -FAR);
        let share = x.sigmoid();
        checked!(x * share, x, [], [share], (x.wide() * wide_sigmoid(x)).narrow())
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, [x]: [E; 1], _y: E) -> [E; 1] {
        let x = within(x, FAR);
        let share = x.sigmoid();
        let density = share * (-x).sigmoid();
        [checked!(g * (share + x * density), g * x, [], [share], {
            let share = g.wide() * wide_sigmoid(x);
            share.narrow() + (share * wide_sigmoid(-x) * x.wide()).narrow()
        })]
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-3.0..3.0).at([0.0], 0.0, [0.5]).at([-INF], 0.0, [0.0]).at([INF], INF, [1.0]);
        c.at([-20.0], -4.122_307_236e-8, [-3.916_191_867e-8]).at([f64::NAN], f64::NAN, [f64::NAN]);
    }
}

const GELU_CUBIC: f64 = 0.044_715;
const GELU_SCALE: f64 = 1.595_769_121_605_730_7; // 2 sqrt(2/pi)
/// The scale and its product with the cubic coefficient in two parts. The first has 11 bits.
const GELU_PARTS: [[f64; 2]; 2] = [[1.595703125, 6.599660573071176e-05], [0.07135009765625, 4.718616350248776e-06]];

/// Twice the argument of tanh in [`GeluTanh`], and its rounding error, which counts as many times as the argument is
/// large.
#[inline(always)]
fn gelu_argument<E: Real>(x: E) -> [E; 2] {
    let [[scale, scale_low], [cubic, cubic_low]] = GELU_PARTS;
    let (scale, scale_low, cubic, cubic_low) = (x.like(scale), x.like(scale_low), x.like(cubic), x.like(cubic_low));
    let square = x * x;
    let square_low = x.mul_add(x, -square);
    let product = cubic * square;
    let product_low = cubic.mul_add(square, -product) + (cubic_low * square + cubic * square_low);
    let slope = scale + product;
    // The rounding error of a sum (Knuth's two-sum).
    let back = slope - scale;
    let slope_low = (product - back) + (scale - (slope - back)) + (product_low + scale_low);
    let rounded = slope + slope_low;
    let u = x * rounded;
    [u, x.mul_add(rounded, -u) + x * (slope_low - (rounded - slope))]
}

impl<'t, T: Scalar> Var<'t, T> {
    /// Leaky ReLU: `self` where it is positive, else `slope * self`. The gradient at 0 is `slope`.
    #[track_caller]
    pub fn leaky_relu(&self, slope: f64) -> Self {
        LeakyRelu { slope }.on([self])
    }

    /// ELU: `self` where it is positive, else `alpha (e^self - 1)`. The gradient at 0 is `alpha`.
    #[track_caller]
    pub fn elu(&self, alpha: f64) -> Self {
        Elu { alpha }.on([self])
    }
}

elementwise! {
    /// ReLU: `max(self, 0)`; NaN stays NaN. The gradient at 0 is 0.
    relu() = Relu;
    /// The logistic sigmoid, `1 / (1 + e^-self)`. Accurate at both ends.
    sigmoid() = Sigmoid;
    /// Softplus: `ln(1 + e^self)`. Accurate at both ends.
    softplus() = Softplus;
    /// The logarithm of the sigmoid, `ln(sigmoid(self))`. Accurate at both ends.
    log_sigmoid() = LogSigmoid;
    /// GELU: `self` times the normal distribution function of `self`. This is the exact form with the error function.
    gelu() = Gelu;
    /// The tanh approximation of [`gelu`](Self::gelu), as in older models. Within 5e-4 of the exact form.
    gelu_tanh() = GeluTanh;
    /// SiLU, also called swish: `self * sigmoid(self)`.
    silu() = Silu;
    also examined: LogisticDensity, LeakyRelu { slope: 0.125 }, Elu { alpha: 1.5 };
}
