//! The operations that are measured, each with its value and derivatives in exact arithmetic.

use super::exact::Exact;
use raygrad_autograd::{Scalar, Var};

/// Exact results and their largest terms, in whose units errors count where terms cancel.
pub struct Reference {
    /// The value; none where a convention decides.
    pub value: Option<(Exact, Exact)>,
    /// The derivative by each operand; NaN where a convention decides.
    pub slopes: Vec<(Exact, Exact)>,
}

/// An operation of [`Var`] and its reference. Both have two constants, numbers of the type, which only some operations
/// use.
pub struct Operation<T: Scalar> {
    pub name: &'static str,
    pub operands: usize,
    pub function: Function<T>,
    /// Moves arguments into the domain.
    pub domain: fn(Vec<f64>) -> Vec<f64>,
    pub reference: fn(&[f64], [f64; 2]) -> Reference,
    /// Moves random constants into their domain.
    pub constants: Option<fn([f64; 2]) -> [f64; 2]>,
}

/// A function of variables, with constants.
pub type Function<T> = for<'t> fn(&[Var<'t, T>], [f64; 2]) -> Var<'t, T>;

/// Results without terms that cancel.
fn of<const N: usize>(value: Exact, slopes: [Exact; N]) -> Reference {
    with_terms((value, value), slopes.map(|slope| (slope, slope)))
}

fn with_terms<const N: usize>(value: (Exact, Exact), slopes: [(Exact, Exact); N]) -> Reference {
    Reference { value: Some(value), slopes: slopes.to_vec() }
}

/// A sum of two terms, and the larger one.
fn sum(a: Exact, b: Exact) -> (Exact, Exact) {
    (a + b, if a.abs() > b.abs() { a } else { b })
}

const NAN: f64 = f64::NAN;

pub fn one() -> Exact {
    Exact::new(1.0)
}

/// `sqrt(1 - x^2)`.
fn complement(x: Exact) -> Exact {
    ((one() - x) * (one() + x)).sqrt()
}

pub fn asin(x: Exact) -> Exact {
    x.atan2(complement(x))
}

pub fn acos(x: Exact) -> Exact {
    complement(x).atan2(x)
}

/// The density of the standard normal distribution.
pub fn density(x: Exact) -> Exact {
    (-x.square().shifted(-1)).exp() / Exact::PI.shifted(1).sqrt()
}

/// The argument of the sigmoid in `gelu_tanh`, and its derivatives.
pub fn tanh_argument(x: Exact) -> [Exact; 3] {
    let scale = (Exact::new(2.0) / Exact::PI).sqrt().shifted(1);
    let cubic = Exact::new(44715.0) / Exact::new(1e6) * scale;
    let three = Exact::new(3.0);
    [scale * x + cubic * power(x, 3), scale + three * cubic * x.square(), (three * cubic * x).shifted(1)]
}

/// `x / (a^2 + b^2)`.
fn over_length(x: Exact, a: Exact, b: Exact) -> Exact {
    x / (a.square() + b.square())
}

/// A whole power.
pub fn power(x: Exact, n: i32) -> Exact {
    let product = (0..n.abs()).fold(one(), |product, _| product * x);
    if n < 0 { product.recip() } else { product }
}

fn is_odd(x: f64) -> bool {
    x % 2.0 != 0.0 && x % 1.0 == 0.0
}

/// `a^b`; NaN for a negative base and a fractional exponent.
pub fn real_power(a: f64, b: f64) -> Exact {
    let size = Exact::new(a.abs()).pow(Exact::new(b));
    if a < 0.0 && b % 1.0 != 0.0 {
        Exact::new(NAN)
    } else if a < 0.0 && is_odd(b) {
        -size
    } else {
        size
    }
}

/// A power with a constant exponent; conventions decide at 0.
fn constant_power(x: f64, p: f64) -> Reference {
    let y = real_power(x, p);
    if x == 0.0 {
        Reference { value: None, slopes: vec![(Exact::new(NAN), y)] }
    } else {
        of(y, [Exact::new(p) * y / Exact::new(x)])
    }
}

fn pair([a, b]: [f64; 2]) -> [Exact; 2] {
    [Exact::new(a), Exact::new(b)]
}

macro_rules! rows {
    ($($name:literal: |$v:ident| $function:expr, |$x:ident| $reference:expr;)*) => {
        vec![$(Operation { name: $name, operands: 1, function: |$v, _| $function, domain: |x| x, reference: |x, _| {
            let $x = x[0];
            $reference
        }, constants: None }),*]
    };
}

macro_rules! pairs {
    ($($name:literal: |$v:ident| $function:expr, |$a:ident, $b:ident| $reference:expr;)*) => {
        vec![$(Operation { name: $name, operands: 2, function: |$v, _| $function, domain: |x| x, reference: |x, _| {
            let [$a, $b] = [x[0], x[1]];
            $reference
        }, constants: None }),*]
    };
}

/// Every elementwise operation.
pub fn operations<T: Scalar>() -> Vec<Operation<T>> {
    [functions(), activations(), powers(), binary(), choices(), losses(), with_constants()]
        .into_iter()
        .flatten()
        .collect()
}

fn functions<T: Scalar>() -> Vec<Operation<T>> {
    rows! {
        "exp": |v| v[0].exp(), |x| of(Exact::new(x).exp(), [Exact::new(x).exp()]);
        "expm1": |v| v[0].expm1(), |x| of(Exact::new(x).expm1(), [Exact::new(x).exp()]);
        "exp2": |v| v[0].exp2(), |x| {
            let ln_2 = Exact::new(2.0).ln();
            let y = (Exact::new(x) * ln_2).exp();
            of(y, [y * ln_2])
        };
        "ln": |v| v[0].ln(), |x| of(Exact::new(x).ln(), [Exact::new(x).recip()]);
        "ln1p": |v| v[0].ln1p(), |x| of(Exact::new(x).ln1p(), [(one() + Exact::new(x)).recip()]);
        "log2": |v| v[0].log2(), |x| {
            let ln_2 = Exact::new(2.0).ln();
            of(Exact::new(x).ln() / ln_2, [(Exact::new(x) * ln_2).recip()])
        };
        "sqrt": |v| v[0].sqrt(), |x| {
            let y = Exact::new(x).sqrt();
            of(y, [y.shifted(1).recip()])
        };
        "rsqrt": |v| v[0].rsqrt(), |x| {
            let y = Exact::new(x).sqrt().recip();
            of(y, [-power(y, 3).shifted(-1)])
        };
        "erf": |v| v[0].erf(), |x| {
            let x = Exact::new(x);
            of(x.erf(), [(-x.square()).exp().shifted(1) / Exact::PI.sqrt()])
        };
        "normal_cdf": |v| v[0].normal_cdf(), |x| of(Exact::new(x).normal_cdf(), [density(Exact::new(x))]);
        "sin": |v| v[0].sin(), |x| {
            let [sine, cosine] = Exact::sin_cos(x);
            of(sine, [cosine])
        };
        "cos": |v| v[0].cos(), |x| {
            let [sine, cosine] = Exact::sin_cos(x);
            of(cosine, [-sine])
        };
        "sin_pi": |v| v[0].sin_pi(), |x| {
            let [sine, cosine] = Exact::sin_cos_pi(x);
            of(sine, [cosine * Exact::PI])
        };
        "cos_pi": |v| v[0].cos_pi(), |x| {
            let [sine, cosine] = Exact::sin_cos_pi(x);
            of(cosine, [-sine * Exact::PI])
        };
        "tan": |v| v[0].tan(), |x| {
            let [sine, cosine] = Exact::sin_cos(x);
            of(sine / cosine, [cosine.square().recip()])
        };
        "asin": |v| v[0].asin(), |x| of(asin(Exact::new(x)), [complement(Exact::new(x)).recip()]);
        "acos": |v| v[0].acos(), |x| of(acos(Exact::new(x)), [-complement(Exact::new(x)).recip()]);
        "atan": |v| v[0].atan(), |x| of(Exact::new(x).atan(), [(one() + Exact::new(x).square()).recip()]);
        "sinh": |v| v[0].sinh(), |x| of(Exact::new(x).sinh(), [Exact::new(x).cosh()]);
        "cosh": |v| v[0].cosh(), |x| of(Exact::new(x).cosh(), [Exact::new(x).sinh()]);
        "tanh": |v| v[0].tanh(), |x| of(Exact::new(x).tanh(), [Exact::new(x).cosh().square().recip()]);
        "abs": |v| v[0].abs(), |x| of(Exact::new(x.abs()), [if x == 0.0 { Exact::ZERO } else { Exact::new(x.signum()) }]);
        "sign": |v| v[0].sign(), |x| {
            of(Exact::new(if x == 0.0 { 0.0 } else { x.signum() }), [Exact::ZERO])
        };
        "floor": |v| v[0].floor(), |x| of(Exact::new(x.floor()), [Exact::ZERO]);
        "ceil": |v| v[0].ceil(), |x| of(Exact::new(x.ceil()), [Exact::ZERO]);
        "round": |v| v[0].round(), |x| of(Exact::new(x.round_ties_even()), [Exact::ZERO]);
        "reciprocal": |v| v[0].reciprocal(), |x| of(Exact::new(x).recip(), [-Exact::new(x).square().recip()]);
        "affine": |v| v[0].affine(-2.5, 0.75), |x| {
            of(Exact::new(x) * Exact::new(-2.5) + Exact::new(0.75), [Exact::new(-2.5)])
        };
        "clamp": |v| v[0].clamp(-1.0, 2.0), |x| {
            of(Exact::new(x.clamp(-1.0, 2.0)), [Exact::new(if (-1.0..=2.0).contains(&x) { 1.0 } else { 0.0 })])
        };
    }
}

fn activations<T: Scalar>() -> Vec<Operation<T>> {
    /// The value and derivative of x s for the share s with derivative ds.
    fn gated(x: Exact, share: Exact, slope: Exact) -> Reference {
        with_terms((x * share, x * share), [sum(share, x * slope)])
    }
    rows! {
        "relu": |v| v[0].relu(), |x| of(Exact::new(x.max(0.0)), [Exact::new(if x > 0.0 { 1.0 } else { 0.0 })]);
        "sigmoid": |v| v[0].sigmoid(), |x| {
            let [y, rest] = [Exact::new(x).sigmoid(), Exact::new(-x).sigmoid()];
            of(y, [y * rest])
        };
        "softplus": |v| v[0].softplus(), |x| of(Exact::new(x).softplus(), [Exact::new(x).sigmoid()]);
        "log_sigmoid": |v| v[0].log_sigmoid(), |x| of(-Exact::new(-x).softplus(), [Exact::new(-x).sigmoid()]);
        "leaky_relu": |v| v[0].leaky_relu(0.125), |x| {
            let slope = Exact::new(if x > 0.0 { 1.0 } else { 0.125 });
            of(Exact::new(x) * slope, [slope])
        };
        "elu": |v| v[0].elu(1.5), |x| elu(x, 1.5);
        // Constants whose products with the derivative leave the range.
        "elu, 2^100": |v| v[0].elu(2.0_f64.powi(100)), |x| elu(x, 2.0_f64.powi(100));
        "silu": |v| v[0].silu(), |x| {
            let x = Exact::new(x);
            gated(x, x.sigmoid(), x.sigmoid() * (-x).sigmoid())
        };
        "gelu": |v| v[0].gelu(), |x| gated(Exact::new(x), Exact::new(x).normal_cdf(), density(Exact::new(x)));
        "gelu_tanh": |v| v[0].gelu_tanh(), |x| {
            let [u, slope, _] = tanh_argument(Exact::new(x));
            gated(Exact::new(x), u.sigmoid(), slope * u.sigmoid() * (-u).sigmoid())
        };
    }
}

fn powers<T: Scalar>() -> Vec<Operation<T>> {
    fn whole(x: f64, n: i32) -> Reference {
        let x = Exact::new(x);
        of(power(x, n), [Exact::new(f64::from(n)) * power(x, n - 1)])
    }
    rows! {
        "square": |v| v[0].square(), |x| whole(x, 2);
        "powi, 0": |v| v[0].powi(0), |_x| of(one(), [Exact::ZERO]);
        "powi, 1": |v| v[0].powi(1), |x| of(Exact::new(x), [one()]);
        "powi, 3": |v| v[0].powi(3), |x| whole(x, 3);
        "powi, 4": |v| v[0].powi(4), |x| whole(x, 4);
        "powi, 5": |v| v[0].powi(5), |x| whole(x, 5);
        "powi, 12": |v| v[0].powi(12), |x| whole(x, 12);
        "powi, -1": |v| v[0].powi(-1), |x| whole(x, -1);
        "powi, -2": |v| v[0].powi(-2), |x| whole(x, -2);
        "powi, -7": |v| v[0].powi(-7), |x| whole(x, -7);
        "powf, 0": |v| v[0].powf(0.0), |_x| of(one(), [Exact::ZERO]);
        "powf, 1": |v| v[0].powf(1.0), |x| of(Exact::new(x), [one()]);
        "powf, 0.5": |v| v[0].powf(0.5), |x| constant_power(x, 0.5);
        "powf, 1.75": |v| v[0].powf(1.75), |x| constant_power(x, 1.75);
        "powf, 2": |v| v[0].powf(2.0), |x| constant_power(x, 2.0);
        "powf, -0.5": |v| v[0].powf(-0.5), |x| constant_power(x, -0.5);
        "powf, 2^-80": |v| v[0].powf(2.0_f64.powi(-80)), |x| constant_power(x, 2.0_f64.powi(-80));
    }
}

fn binary<T: Scalar>() -> Vec<Operation<T>> {
    pairs! {
        "add": |v| &v[0] + &v[1], |a, b| of(Exact::new(a) + Exact::new(b), [one(), one()]);
        "sub": |v| &v[0] - &v[1], |a, b| of(Exact::new(a) - Exact::new(b), [one(), -one()]);
        "mul": |v| &v[0] * &v[1], |a, b| of(Exact::new(a) * Exact::new(b), [Exact::new(b), Exact::new(a)]);
        "div": |v| &v[0] / &v[1], |a, b| {
            let [a, b] = pair([a, b]);
            of(a / b, [b.recip(), -a / b.square()])
        };
        "maximum": |v| v[0].maximum(&v[1]), |a, b| {
            let share = |lead: f64| Exact::new(if lead > 0.0 { 1.0 } else if lead < 0.0 { 0.0 } else { 0.5 });
            of(Exact::new(a.max(b)), [share(a - b), share(b - a)])
        };
        "minimum": |v| v[0].minimum(&v[1]), |a, b| {
            let share = |lead: f64| Exact::new(if lead > 0.0 { 1.0 } else if lead < 0.0 { 0.0 } else { 0.5 });
            of(Exact::new(a.min(b)), [share(b - a), share(a - b)])
        };
        "atan2": |v| v[0].atan2(&v[1]), |a, b| {
            if a == 0.0 {
                // The sign of a zero decides, which this arithmetic does not have.
                return Reference { value: None, slopes: vec![(Exact::new(NAN), one()); 2] };
            }
            let [a, b] = pair([a, b]);
            of(a.atan2(b), [over_length(b, a, b), -over_length(a, a, b)])
        };
        "hypot": |v| v[0].hypot(&v[1]), |a, b| {
            let [a, b] = pair([a, b]);
            let y = (a.square() + b.square()).sqrt();
            let slope = |x: Exact| if y.is_zero() { Exact::ZERO } else { x / y };
            of(y, [slope(a), slope(b)])
        };
        "pow": |v| v[0].pow(&v[1]), |a, b| {
            if a == 0.0 {
                return Reference { value: None, slopes: vec![(Exact::new(NAN), one()); 2] };
            }
            let y = real_power(a, b);
            let ln = if a < 0.0 { Exact::new(NAN) } else { Exact::new(a).ln() };
            of(y, [Exact::new(b) * y / Exact::new(a), y * ln])
        };
        "xlogy": |v| v[0].xlogy(&v[1]), |a, b| {
            if a == 0.0 {
                return Reference { value: None, slopes: vec![(Exact::new(NAN), one()); 2] };
            }
            let [a, b] = pair([a, b]);
            of(a * b.ln(), [b.ln(), a / b])
        };
        "logaddexp": |v| v[0].logaddexp(&v[1]), |a, b| {
            let difference = Exact::new(a) - Exact::new(b);
            let value = sum(Exact::new(a.max(b)), (-difference.abs()).exp().ln1p());
            let slopes = [difference.sigmoid(), (-difference).sigmoid()];
            with_terms(value, slopes.map(|slope| (slope, slope)))
        };
        "remainder": |v| v[0].remainder(&v[1]), |a, b| {
            let rest = a % b;
            let is_other_sign = rest != 0.0 && (rest < 0.0) != (b < 0.0);
            let y = if is_other_sign { Exact::new(rest) + Exact::new(b) } else { Exact::new(rest) };
            of(y, [one(), -((Exact::new(a) - y) / Exact::new(b))])
        };
    }
}

fn choices<T: Scalar>() -> Vec<Operation<T>> {
    let row = |name, function, reference| Operation {
        name,
        operands: 3,
        function,
        domain: |x| x,
        reference,
        constants: None,
    };
    let if_positive: Function<T> = |v, _| v[0].if_positive(&v[1], &v[2]);
    let where_: Function<T> = |v, _| v[1].where_(&v[0].value().gt(T::ZERO), &v[2]);
    let choice = |x: &[f64], _| {
        let [yes, no] = [x[1], x[2]].map(Exact::new);
        if x[0] > 0.0 { of(yes, [Exact::ZERO, one(), Exact::ZERO]) } else { of(no, [Exact::ZERO, Exact::ZERO, one()]) }
    };
    let lerp = |x: &[f64], _| {
        let [a, b, w] = [x[0], x[1], x[2]].map(Exact::new);
        // From the nearer end, as documented: these are the terms that may cancel.
        let (from, share) = if w > Exact::new(0.5) { (b, w - one()) } else { (a, w) };
        with_terms(sum(from, share * (b - a)), [one() - w, w, b - a].map(|slope| (slope, slope)))
    };
    vec![
        row("if_positive", if_positive, choice),
        row("where", where_, choice),
        row("lerp", |v, _| v[0].lerp(&v[1], &v[2]), lerp),
    ]
}

/// Operations with constants of any bits.
fn with_constants<T: Scalar>() -> Vec<Operation<T>> {
    fn row<T: Scalar>(
        name: &'static str,
        operands: usize,
        function: Function<T>,
        reference: fn(&[f64], [f64; 2]) -> Reference,
        constants: fn([f64; 2]) -> [f64; 2],
    ) -> Operation<T> {
        Operation { name, operands, function, domain: |x| x, reference, constants: Some(constants) }
    }
    let positive = |c: [f64; 2]| c.map(|c| if c == 0.0 { 1.0 } else { c.abs() });
    let exponent = |[n, _]: [f64; 2]| [(if n.abs() < 2.0_f64.powi(31) { n } else { n % 1000.0 }).trunc(), 0.0];
    vec![
        row("powf, any", 1, |v, [p, _]| v[0].powf(p), |x, [p, _]| constant_power(x[0], p), |c| c),
        row("powi, any", 1, |v, [n, _]| v[0].powi(n as i32), |x, [n, _]| constant_power(x[0], n), exponent),
        row("elu, any", 1, |v, [alpha, _]| v[0].elu(alpha), |x, [alpha, _]| elu(x[0], alpha), |c| c),
        row(
            "leaky_relu, any",
            1,
            |v, [slope, _]| v[0].leaky_relu(slope),
            |x, [slope, _]| {
                let slope = Exact::new(if x[0] > 0.0 { 1.0 } else { slope });
                of(Exact::new(x[0]) * slope, [slope])
            },
            |c| c,
        ),
        row(
            "affine, any",
            1,
            |v, [scale, shift]| v[0].affine(scale, shift),
            |x, [scale, shift]| {
                let scale = Exact::new(scale);
                of(Exact::new(x[0]) * scale + Exact::new(shift), [scale])
            },
            |c| c,
        ),
        row(
            "clamp, any",
            1,
            |v, [low, high]| v[0].clamp(low, high),
            |x, [low, high]| {
                let slope = if (low..=high).contains(&x[0]) { 1.0 } else { 0.0 };
                of(Exact::new(x[0].clamp(low, high)), [Exact::new(slope)])
            },
            |[a, b]| [a.min(b), a.max(b)],
        ),
        row("huber, any", 2, |v, [c, _]| v[0].huber(&v[1], c), |x, [c, _]| huber(x[0], x[1], c), positive),
        row("smooth_l1, any", 2, |v, [c, _]| v[0].smooth_l1(&v[1], c), |x, [c, _]| smooth_l1(x[0], x[1], c), positive),
    ]
}

fn losses<T: Scalar>() -> Vec<Operation<T>> {
    let mut rows = pairs! {
        "squared_error": |v| v[0].squared_error(&v[1]), |a, b| {
            let r = Exact::new(a) - Exact::new(b);
            of(r.square(), [r.shifted(1), -r.shifted(1)])
        };
        "absolute_error": |v| v[0].absolute_error(&v[1]), |a, b| {
            let sign = Exact::new(if a > b { 1.0 } else if a < b { -1.0 } else { 0.0 });
            of((Exact::new(a) - Exact::new(b)).abs(), [sign, -sign])
        };
        "huber, 1.5": |v| v[0].huber(&v[1], 1.5), |a, b| huber(a, b, 1.5);
        "huber, 2^100": |v| v[0].huber(&v[1], 2.0_f64.powi(100)), |a, b| huber(a, b, 2.0_f64.powi(100));
        "huber, 2^-100": |v| v[0].huber(&v[1], 2.0_f64.powi(-100)), |a, b| huber(a, b, 2.0_f64.powi(-100));
        "smooth_l1, 1.5": |v| v[0].smooth_l1(&v[1], 1.5), |a, b| smooth_l1(a, b, 1.5);
        "smooth_l1, 2^100": |v| v[0].smooth_l1(&v[1], 2.0_f64.powi(100)), |a, b| smooth_l1(a, b, 2.0_f64.powi(100));
        "smooth_l1, 2^-100": |v| v[0].smooth_l1(&v[1], 2.0_f64.powi(-100)), |a, b| smooth_l1(a, b, 2.0_f64.powi(-100));
        "binary_cross_entropy_with_logits": |v| v[0].binary_cross_entropy_with_logits(&v[1]), |a, b| {
            let [logit, target] = pair([a, b]);
            let tail = (-logit.abs()).softplus();
            let other = logit.abs() * if a > 0.0 { one() - target } else { target };
            // s(a) - b, or (1 - b) - s(-a).
            let slope = if a > 0.0 { sum(one() - target, -(-logit).sigmoid()) } else { sum(logit.sigmoid(), -target) };
            with_terms(sum(tail, other), [slope, (-logit, -logit)])
        };
    };
    // Targets are probabilities.
    if let Some(row) = rows.last_mut() {
        row.domain = |x| {
            let target = x[1].abs();
            vec![x[0], if target > 1.0 { 0.0 } else { target }]
        };
    }
    rows
}

fn elu(x: f64, alpha: f64) -> Reference {
    let (alpha, below) = (Exact::new(alpha), Exact::new(x));
    if x > 0.0 { of(below, [one()]) } else { of(alpha * below.expm1(), [alpha * below.exp()]) }
}

fn huber(a: f64, b: f64, delta: f64) -> Reference {
    let (r, delta) = (Exact::new(a) - Exact::new(b), Exact::new(delta));
    if r.abs() > delta {
        let slope = if r.is_negative() { -delta } else { delta };
        of(delta * (r.abs() - delta.shifted(-1)), [slope, -slope])
    } else {
        of(r.square().shifted(-1), [r, -r])
    }
}

fn smooth_l1(a: f64, b: f64, beta: f64) -> Reference {
    let (r, beta) = (Exact::new(a) - Exact::new(b), Exact::new(beta));
    if r.abs() < beta {
        of(r.square().shifted(-1) / beta, [r / beta, -r / beta])
    } else {
        let sign = Exact::new(if r.is_negative() {
            -1.0
        } else if r.is_zero() {
            0.0
        } else {
            1.0
        });
        of(r.abs() - beta.shifted(-1), [sign, -sign])
    }
}
