//! Gradient checks: derivatives of a function against finite differences.

use super::spread;
use crate::{Tape, Var};
use raygrad_tensor::Tensor;

/// Settings of a gradient check: tolerance, step, number of directions.
#[derive(Debug, Clone)]
pub struct Check {
    /// Largest accepted error of first and second derivatives against finite differences. It is relative to the norm of
    /// the gradient by the input that moves. The rounding error of the function's values is allowed in addition.
    pub tolerance: f64,
    /// Step of the central differences, relative to `max(1, |x|)`.
    pub step: f64,
    /// Largest number of directions for each input. An input with more elements is checked along this many directions.
    pub directions: usize,
    /// Whether to check gradients of gradients too.
    pub second_order: bool,
}

impl Default for Check {
    /// Tolerance 1e-7, with Richardson-extrapolated central differences of step 1e-3. At most 48 directions for each
    /// input, and second derivatives too.
    fn default() -> Self {
        Check { tolerance: 1e-7, step: 1e-3, directions: 48, second_order: true }
    }
}

/// The worst errors of a check, each relative to the scale of the compared values.
#[derive(Debug, Clone, Copy, Default)]
pub struct Report {
    /// First derivatives against finite differences.
    pub first_order: f64,
    /// Second derivatives against finite differences of first ones.
    pub second_order: f64,
    /// Values and gradients in f32 against f64: the distance relative to the norm.
    pub single: f64,
    /// The worst element of the same comparison, in units in the last place of f32. An element below the root mean
    /// square of its tensor counts as that large.
    pub ulps: f64,
    /// Number of comparisons.
    pub comparisons: usize,
}

impl Report {
    /// Keeps the larger of each error, and adds the comparisons.
    pub fn merge(&mut self, other: Report) {
        self.first_order = self.first_order.max(other.first_order);
        self.second_order = self.second_order.max(other.second_order);
        self.single = self.single.max(other.single);
        self.ulps = self.ulps.max(other.ulps);
        self.comparisons += other.comparisons;
    }
}

/// The error of `got` against `expected`, relative to `scale`. It must not exceed `tolerance`; NaN fails.
pub(crate) fn compare(what: &str, got: f64, expected: f64, scale: f64, tolerance: f64) -> Result<f64, String> {
    if got == expected {
        return Ok(0.0);
    }
    let error = (got - expected).abs() / scale;
    if error <= tolerance {
        Ok(error)
    } else {
        Err(format!("{what}: got {got:e}, expected {expected:e}, error {error:.1e}"))
    }
}

/// The sum of all products of elements, and the sum of their sizes.
fn value_and_size(a: &[Tensor<f64>], b: &[Tensor<f64>]) -> [f64; 2] {
    let products = a.iter().zip(b).flat_map(|(a, b)| a.as_slice().iter().zip(b.as_slice())).map(|(a, b)| a * b);
    products.fold([0.0; 2], |[sum, size], x| [sum + x, size + x.abs()])
}

/// The sum of all products of elements.
pub(crate) fn inner(a: &[Tensor<f64>], b: &[Tensor<f64>]) -> f64 {
    value_and_size(a, b)[0]
}

/// The Euclidean norm.
pub(crate) fn norm(x: &Tensor<f64>) -> f64 {
    inner(std::slice::from_ref(x), std::slice::from_ref(x)).sqrt()
}

/// `x + h d`.
fn moved(x: &[Tensor<f64>], d: &[Tensor<f64>], h: f64) -> Vec<Tensor<f64>> {
    let pair =
        |(x, d): (&Tensor<f64>, &Tensor<f64>)| Tensor::from_fn(x.shape(), |i| x.as_slice()[i] + h * d.as_slice()[i]);
    x.iter().zip(d).map(pair).collect()
}

/// Directions in which input number `which` of `x` moves alone: each coordinate if there are few, else vectors without
/// a pattern. Each comes with the size of a moved element: the derivative is of the order of the gradient's norm times
/// that size.
fn directions(x: &[Tensor<f64>], which: usize, most: usize) -> Vec<(Vec<Tensor<f64>>, f64)> {
    let along = |d: Tensor<f64>| -> Vec<_> {
        (0..x.len()).map(|k| if k == which { d.clone() } else { Tensor::zeros(x[k].shape()) }).collect()
    };
    let x = &x[which];
    let unit = |i: usize| {
        let mut d = Tensor::zeros(x.shape());
        let size = x.as_slice()[i].abs().max(1.0);
        d.as_mut_slice()[i] = size;
        (along(d), size)
    };
    let random = |k: usize| {
        let mut d = spread(x.shape(), &[-1.0..1.0], 13 * k + which + 5);
        d.as_mut_slice().iter_mut().zip(x.iter()).for_each(|(d, x)| *d *= x.abs().max(1.0));
        let size = norm(&d) / (d.len() as f64).sqrt();
        (along(d), size)
    };
    if x.len() > most { (0..most).map(random).collect() } else { (0..x.len()).map(unit).collect() }
}

/// Rounding errors that the value of a function may have, in units of the size of its terms.
const ROUNDINGS: f64 = 16.0;

/// Compares `grads`, the gradients of `f` at `x`, with Richardson-extrapolated central differences. `f` returns its
/// value and the size of the terms of that sum.
fn against_differences(
    what: &str,
    check: &Check,
    x: &[Tensor<f64>],
    grads: &[Tensor<f64>],
    f: &dyn Fn(&[Tensor<f64>]) -> [f64; 2],
) -> Result<(f64, usize), String> {
    let (mut worst, mut count) = (0.0_f64, 0);
    // The effect of rounding on a difference, as a scale: the tolerance times this is accepted.
    let rounding = ROUNDINGS * f64::EPSILON * f(x)[1] / (check.step * check.tolerance);
    for (which, grad) in grads.iter().enumerate() {
        let norm = norm(grad);
        for (k, (d, size)) in directions(x, which, check.directions).iter().enumerate() {
            let difference = |h: f64| (f(&moved(x, d, h))[0] - f(&moved(x, d, -h))[0]) / (2.0 * h);
            let numeric = (4.0 * difference(0.5 * check.step) - difference(check.step)) / 3.0;
            let analytic = inner(std::slice::from_ref(grad), &d[which..=which]);
            let what = format!("{what} by input {which}, direction {k}");
            let scale = norm * size + rounding;
            worst = worst.max(compare(&what, analytic, numeric, scale, check.tolerance)?);
            count += 1;
        }
    }
    Ok((worst, count))
}

/// Checks the first and second derivatives of `f` at `x` against finite differences in f64.
///
/// `f` must use its inputs only through the tape, because the check evaluates it on other tapes. Its result may have
/// any shape.
///
/// ```
/// use raygrad_autograd::check::{Check, check_function};
/// use raygrad_tensor::Tensor;
/// let x = Tensor::from([0.3, 1.2]);
/// check_function(&Check::default(), &[x], |x| (x[0].sin() * &x[0]).exp()).unwrap();
/// ```
///
/// # Errors
/// If a derivative is wrong or NaN. The text names the derivative and both values.
pub fn check_function(
    check: &Check,
    x: &[Tensor<f64>],
    f: impl for<'t> Fn(&[Var<'t, f64>]) -> Var<'t, f64>,
) -> Result<Report, String> {
    check_derivatives(check, x, &f)
}

/// [`check_function`], compiled once for all functions.
fn check_derivatives(
    check: &Check,
    x: &[Tensor<f64>],
    f: &dyn for<'t> Fn(&[Var<'t, f64>]) -> Var<'t, f64>,
) -> Result<Report, String> {
    let mut report = Report::default();
    let tape = Tape::new();
    let leaves: Vec<_> = x.iter().map(|x| tape.leaf(x.clone())).collect();
    let wrt: Vec<_> = leaves.iter().collect();
    let y = f(&leaves).tracked();
    let seed = spread(y.shape(), &[0.3..1.3], 3);
    // The function is reduced to one number by a fixed weighting of its outputs.
    let number = |x: &[Tensor<f64>]| {
        let tape = Tape::new();
        // Leaves, so that `f` may take gradients.
        let x: Vec<_> = x.iter().map(|x| tape.leaf(x.clone())).collect();
        value_and_size(&[f(&x).into_value()], std::slice::from_ref(&seed))
    };
    let grads = (&y * tape.constant(seed.clone())).sum().grad(&wrt);
    let (first, count) = against_differences("first derivative", check, x, &grads, &number)?;
    report.merge(Report { first_order: first, comparisons: count, ..Report::default() });
    if !check.second_order {
        return Ok(report);
    }
    // The gradients, weighted, as a function of the inputs and of the output's gradient.
    let weights: Vec<_> = x.iter().enumerate().map(|(i, x)| spread(x.shape(), &[-1.0..1.0], 29 + i)).collect();
    let both: Vec<_> = x.iter().cloned().chain([seed]).collect();
    let gradient = |x: &[Tensor<f64>]| {
        let tape = Tape::new();
        let leaves: Vec<_> = x[..x.len() - 1].iter().map(|x| tape.leaf(x.clone())).collect();
        let seed = tape.constant(x[x.len() - 1].clone());
        value_and_size(&(f(&leaves) * seed).sum().grad(&leaves.iter().collect::<Vec<_>>()), &weights)
    };
    let seed = tape.leaf(both[both.len() - 1].clone());
    let recorded = (f(&leaves) * &seed).sum().grad_graph(&wrt);
    let recorded_values: Vec<_> = recorded.iter().map(|grad| grad.value().clone()).collect();
    for (i, (recorded, grad)) in recorded_values.iter().zip(&grads).enumerate() {
        let what = format!("the recorded gradient against the unrecorded one, input {i}");
        let norm = norm(grad);
        for (&recorded, &grad) in recorded.as_slice().iter().zip(grad.as_slice()) {
            compare(&what, recorded, grad, norm.max(f64::MIN_POSITIVE), 1e-10)?;
        }
    }
    let mut total = tape.constant(Tensor::scalar(0.0));
    for (grad, weight) in recorded.iter().zip(&weights) {
        total += (grad * tape.constant(weight.clone())).sum();
    }
    let wrt: Vec<_> = leaves.iter().chain([&seed]).collect();
    let second = total.grad(&wrt);
    let (second, count) = against_differences("second derivative", check, &both, &second, &gradient)?;
    report.merge(Report { second_order: second, comparisons: count + grads.len(), ..Report::default() });
    Ok(report)
}
