//! Second derivatives of elementwise operations over all bits of arguments and of both incoming gradients.
//!
//! With a gradient `g` of the result and a gradient `h` of the derivative by operand k, the second pass gives `h g`
//! times a second derivative for each operand, and `h` times the first derivative for `g`. `ACCURACY_SECONDS` sets how
//! many cases are drawn.

use super::exact::Exact;
use super::operations::{Operation, density, one, operations, power, real_power, tanh_argument};
use super::{Column, Format, Random, is_asked, report, setting};
use raygrad_autograd::{Scalar, Tape, Tensor, Var};

/// A second derivative and its largest term, in whose units errors count where terms cancel.
type Term = (Exact, Exact);

/// Second derivatives of an operation: of one operand by itself; or of two, by the first, by both and by the second.
struct Seconds {
    name: &'static str,
    derivatives: fn(&[f64]) -> Vec<Term>,
}

fn alone(x: Exact) -> Term {
    (x, x)
}

/// A difference and its larger term.
fn difference(a: Exact, b: Exact) -> Term {
    (a - b, if a.abs() > b.abs() { a } else { b })
}

macro_rules! seconds {
    ($($name:literal: |$x:ident| $derivatives:expr;)*) => {
        vec![$(Seconds { name: $name, derivatives: |x| {
            let $x: Vec<Exact> = x.iter().copied().map(Exact::new).collect();
            $derivatives.into()
        } }),*]
    };
}

/// `n (n - 1) x^(n - 2)` for a whole n.
fn of_power(x: Exact, n: i32) -> [Term; 1] {
    [alone(Exact::new(f64::from(n)) * Exact::new(f64::from(n - 1)) * power(x, n - 2))]
}

/// `s(x) s(-x)`.
fn bump(x: Exact) -> Exact {
    x.sigmoid() * (-x).sigmoid()
}

fn seconds() -> Vec<Seconds> {
    seconds! {
        "exp": |x| [alone(x[0].exp())];
        "expm1": |x| [alone(x[0].exp())];
        "exp2": |x| [alone((x[0] * Exact::new(2.0).ln()).exp() * Exact::new(2.0).ln().square())];
        "ln": |x| [alone(-x[0].square().recip())];
        "ln1p": |x| [alone(-(one() + x[0]).square().recip())];
        "log2": |x| [alone(-(x[0].square() * Exact::new(2.0).ln()).recip())];
        "sqrt": |x| [alone(-(x[0].sqrt() * x[0]).recip().shifted(-2))];
        "rsqrt": |x| [alone(Exact::new(0.75) / (x[0].sqrt() * x[0].square()))];
        "erf": |x| [alone(-x[0].shifted(2) * (-x[0].square()).exp() / Exact::PI.sqrt())];
        "normal_cdf": |x| [alone(-x[0] * density(x[0]))];
        "asin": |x| {
            let square = (one() - x[0]) * (one() + x[0]);
            [alone(x[0] / (square * square.sqrt()))]
        };
        "atan": |x| [alone(-x[0].shifted(1) / (one() + x[0].square()).square())];
        "sinh": |x| [alone(x[0].sinh())];
        "cosh": |x| [alone(x[0].cosh())];
        "tanh": |x| [alone(-(bump(x[0].shifted(1)) * x[0].tanh()).shifted(3))];
        "reciprocal": |x| [alone(power(x[0], -3).shifted(1))];
        "sigmoid": |x| [alone(-bump(x[0]) * x[0].shifted(-1).tanh())];
        "softplus": |x| [alone(bump(x[0]))];
        "log_sigmoid": |x| [alone(-bump(x[0]))];
        "elu": |x| [alone(if x[0] > Exact::ZERO { Exact::ZERO } else { Exact::new(1.5) * x[0].exp() })];
        "silu": |x| {
            let (bump, slope) = (bump(x[0]), x[0] * x[0].shifted(-1).tanh());
            [(bump * (Exact::new(2.0) - slope), bump * if slope > Exact::new(2.0) { slope } else { Exact::new(2.0) })]
        };
        "gelu": |x| {
            let (density, square, two) = (density(x[0]), x[0].square(), Exact::new(2.0));
            [(density * (two - square), density * if square > two { square } else { two })]
        };
        "gelu_tanh": |x| {
            let [u, slope, bend] = tanh_argument(x[0]);
            let (bump, tanh) = (bump(u), u.shifted(-1).tanh());
            let (a, b) = (slope.shifted(1) + x[0] * bend, x[0] * tanh * slope.square());
            [(bump * (a - b), bump * if a > b { a } else { b })]
        };
        "square": |_x| [alone(Exact::new(2.0))];
        "powi, 3": |x| of_power(x[0], 3);
        "powi, 4": |x| of_power(x[0], 4);
        "powi, 5": |x| of_power(x[0], 5);
        "powi, 12": |x| of_power(x[0], 12);
        "powi, -2": |x| of_power(x[0], -2);
        "powi, -7": |x| of_power(x[0], -7);
        "div": |x| [alone(Exact::ZERO), alone(-x[1].square().recip()), alone(x[0].shifted(1) * power(x[1], -3))];
        "mul": |_x| [alone(Exact::ZERO), alone(one()), alone(Exact::ZERO)];
        "atan2": |x| {
            let (a, b) = (x[0], x[1]);
            let fourth = (a.square() + b.square()).square();
            let (turn, (bend, term)) = ((a * b).shifted(1) / fourth, difference(a.square(), b.square()));
            [alone(-turn), (bend / fourth, term / fourth), alone(turn)]
        };
        "hypot": |x| {
            let (a, b) = (x[0], x[1]);
            let square = a.square() + b.square();
            let cube = square * square.sqrt();
            [alone(b.square() / cube), alone(-a * b / cube), alone(a.square() / cube)]
        };
        "xlogy": |x| [alone(Exact::ZERO), alone(x[1].recip()), alone(-x[0] / x[1].square())];
        "logaddexp": |x| {
            let bump = bump(x[0] - x[1]);
            [alone(bump), alone(-bump), alone(bump)]
        };
        "squared_error": |_x| [2.0, -2.0, 2.0].map(|x| alone(Exact::new(x)));
        "binary_cross_entropy_with_logits": |x| [alone(bump(x[0])), alone(-one()), alone(Exact::ZERO)];
    }
    .into_iter()
    .chain([
        Seconds { name: "powf, 1.75", derivatives: |x| vec![alone(Exact::new(1.3125) * real_power(x[0], -0.25))] },
        Seconds { name: "powf, 0.5", derivatives: |x| vec![alone(-real_power(x[0], -1.5).shifted(-2))] },
        Seconds { name: "powf, -0.5", derivatives: |x| vec![alone(Exact::new(0.75) * real_power(x[0], -2.5))] },
        Seconds { name: "sin", derivatives: |x| vec![alone(-Exact::sin_cos(x[0])[0])] },
        Seconds { name: "cos", derivatives: |x| vec![alone(-Exact::sin_cos(x[0])[1])] },
        Seconds { name: "sin_pi", derivatives: |x| vec![alone(-Exact::sin_cos_pi(x[0])[0] * Exact::PI.square())] },
        Seconds { name: "cos_pi", derivatives: |x| vec![alone(-Exact::sin_cos_pi(x[0])[1] * Exact::PI.square())] },
        Seconds {
            name: "tan",
            derivatives: |x| {
                let [sine, cosine] = Exact::sin_cos(x[0]);
                vec![alone(sine.shifted(1) / power(cosine, 3))]
            },
        },
        Seconds {
            name: "pow",
            derivatives: |x| {
                let y = real_power(x[0], x[1]);
                let [a, b] = [x[0], x[1]].map(Exact::new);
                let ln = if x[0] < 0.0 { Exact::new(f64::NAN) } else { a.ln() };
                let (both, term) = difference(one(), -b * ln);
                vec![alone(b * (b - one()) * y / a.square()), (y / a * both, y / a * term), alone(y * ln.square())]
            },
        },
    ])
    .collect()
}

/// Functions whose derivative reads the result alone. Their second derivatives are ordinary products, so only incoming
/// gradients between 2^-30 and 2^30 are compared.
const OF_RESULTS: [&str; 3] = ["sqrt", "rsqrt", "tan"];

fn is_ordinary(g: Exact) -> bool {
    g.is_zero() || g.exponent().abs() <= 30
}

/// Where a tensor may have numbers far from 1. These decide how a recorded gradient is computed.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Far {
    Anywhere,
    InOperands,
    InGradients,
}

/// A number that `draw` gives, and that is not far from 1 unless `may_be_far`.
fn drawn_near(may_be_far: bool, mut draw: impl FnMut() -> f64) -> f64 {
    loop {
        let x = draw();
        if may_be_far || x == 0.0 || (-62..30).contains(&Exact::new(x).exponent()) {
            return x;
        }
    }
}

/// The errors of second derivatives, with one column for each pair of operands and each operand's derivative by `g`.
fn examine<T: Scalar>(operation: &Operation<T>, seconds: &Seconds, far: Far, cases: usize) -> Vec<Column> {
    let (format, n) = (Format::of::<T>(), operation.operands);
    let least = 2.0_f64.powi(format.least as i32);
    // The value's column, which `report` expects first, is not measured.
    let mut columns = vec![Column::default(); 1 + n * (n + 1)];
    columns[0].count = cases;
    let mut random = Random::of(operation.name, 1 << 41);
    for k in 0..n {
        let drawn: Vec<_> = (0..cases)
            .map(|_| {
                let mut draw = || drawn_near(far != Far::InGradients, || random.argument::<T>());
                let x = (0..n).map(|_| draw()).collect();
                let x = if far == Far::InGradients { x } else { random.related::<T>(x) };
                let x: Vec<f64> = (operation.domain)(x);
                let reference = (operation.reference)(&x, [0.0; 2]);
                let second = (seconds.derivatives)(&x);
                let of: Vec<Term> = (0..n).map(|i| second[i + k]).collect();
                let exponent = |x: Exact| (!x.is_zero() && x.is_finite()).then(|| x.exponent());
                let slope = [exponent(reference.slopes[k].0)];
                let g = drawn_near(far != Far::InOperands, || random.gradient::<T>(&slope));
                let sizes: Vec<_> = of.iter().map(|&(second, _)| exponent(Exact::new(g) * second)).collect();
                let h = random.gradient::<T>(&sizes);
                (x, reference, of, g, h)
            })
            .collect();
        let tape = Tape::<T>::new();
        let column = |f: &dyn Fn(usize) -> f64| Tensor::from_fn(&[cases], |i| T::from_f64(f(i)));
        let x: Vec<_> = (0..n).map(|j| tape.leaf(column(&|i| drawn[i].0[j]))).collect();
        let (g, h) = (tape.leaf(column(&|i| drawn[i].3)), tape.constant(column(&|i| drawn[i].4)));
        let y = (operation.function)(&x, [0.0; 2]);
        let first = y.vjp(&g, &[&x[k]]).remove(0);
        let wrt: Vec<&Var<'_, T>> = x.iter().chain([&g]).collect();
        let got = tape.no_grad(|| first.tracked().vjp(&h, &wrt));
        for (i, (x, reference, of, g, h)) in drawn.iter().enumerate() {
            let (slope, term) = reference.slopes[k];
            let (g, h) = (Exact::new(*g), Exact::new(*h));
            let is_kept = !OF_RESULTS.contains(&operation.name) || is_ordinary(g) && is_ordinary(h);
            // Conventions decide where there is no derivative.
            if !y.value().as_slice()[i].is_finite() || !slope.is_finite() || !is_kept {
                continue;
            }
            let exact = of.iter().map(|&(second, term)| (g * h * second, g * h * term));
            for (j, (exact, term)) in exact.chain([(h * slope, h * term)]).enumerate() {
                let value = got[j].value().as_slice()[i].to_f64();
                let is_tiny = exact.is_zero() || exact.exponent() < format.least;
                // Of numbers that underflow, digits do not count; nor do terms that cancel beyond the range.
                let cancels = exact.is_zero() && !term.is_zero() && term.exponent() > format.greatest;
                if exact.is_finite() && !cancels && !(is_tiny && value.abs() <= 4.0 * least) {
                    let error = format.error(value, exact, term);
                    let at = || x.iter().copied().chain([drawn[i].3, drawn[i].4]).collect();
                    columns[1 + k * (n + 1) + j].add(error, LIMIT, at);
                }
            }
        }
    }
    columns
}

/// Errors above this many units in the last place are breaches.
const LIMIT: f64 = 64.0;

fn check<T: Scalar>(cases: usize) -> Vec<String> {
    let operations = operations::<T>();
    let asked = operations.iter().filter(|operation| is_asked(operation.name, operation.operands));
    let rows = asked.filter_map(|operation| {
        let row = seconds().into_iter().find(|seconds| operation.name == seconds.name)?;
        let failed = |far| {
            let failed = report::<T>(operation.name, examine(operation, &row, far, cases), 0);
            failed.into_iter().map(move |failed| format!("far numbers {far:?}: {failed}"))
        };
        Some([Far::Anywhere, Far::InOperands, Far::InGradients].into_iter().flat_map(failed).collect::<Vec<_>>())
    });
    rows.flatten().collect()
}

#[test]
fn second_derivatives_of_all_bits() {
    let failed = check::<f32>(setting("ACCURACY_SECONDS").unwrap_or(500));
    assert!(failed.is_empty(), "beyond {LIMIT} units in the last place:\n{}", failed.join("\n"));
}

/// The operands' shapes differ, and their numbers are so far from 1 that the recorded gradient is one operation.
#[test]
fn second_derivatives_of_broadcast_operands_are_summed() {
    let tape = Tape::<f32>::new();
    let a = tape.leaf(Tensor::from([[2e12], [3e12]]));
    let b = tape.leaf(Tensor::from([1.0, 2.0, 4.0]));
    let first = (&a / &b).sum().grad_graph(&[&a, &b]);
    let check = |what: &str, got: &Tensor<f32>, expected: &Tensor<f32>| {
        assert_eq!(got.shape(), expected.shape(), "{what}");
        let both = got.as_slice().iter().zip(expected.as_slice());
        assert!(both.into_iter().all(|(x, y)| (x - y).abs() <= 1e-6 * y.abs()), "{what}: {got:?}, not {expected:?}");
    };
    check("by a", first[0].value(), &Tensor::from([[1.75], [1.75]]));
    check("by b", first[1].value(), &Tensor::from([-5e12, -1.25e12, -3.125e11]));
    let second = first[1].sum().grad(&[&a, &b]);
    check("by b and a", &second[0], &Tensor::from([[-1.3125], [-1.3125]]));
    check("by b twice", &second[1], &Tensor::from([1e13, 1.25e12, 1.5625e11]));
}
