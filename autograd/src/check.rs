//! Gradient checks: an operation is examined against finite differences, dual numbers, its own reference and itself.

use crate::catalogue::{Entry, spread};
use crate::{Dual, Op, Tape, Var};
use raygrad_tensor::{Scalar, Tensor};
use std::sync::Arc;

/// How hard to check, and what error to accept.
#[derive(Debug, Clone)]
pub struct Check {
    /// Worst relative error of first and second derivatives against finite differences.
    pub tolerance: f64,
    /// Step of the central differences, relative to `max(1, |x|)`.
    pub step: f64,
    /// Number of directions along which a derivative is taken if there are more inputs than that.
    pub directions: usize,
    /// Whether gradients of gradients are checked.
    pub second_order: bool,
}

impl Default for Check {
    /// 1e-7, with Richardson-extrapolated central differences of step 1e-3 along at most 48 directions.
    fn default() -> Self {
        Check { tolerance: 1e-7, step: 1e-3, directions: 48, second_order: true }
    }
}

/// The worst errors that a check saw, each relative to the scale of what was compared.
#[derive(Debug, Clone, Copy, Default)]
pub struct Report {
    /// First derivatives against finite differences.
    pub first_order: f64,
    /// Second derivatives against finite differences of first ones.
    pub second_order: f64,
    /// Values and gradients in f32 against f64.
    pub single: f64,
    /// Number of comparisons.
    pub comparisons: usize,
}

impl Report {
    fn merge(&mut self, other: Report) {
        self.first_order = self.first_order.max(other.first_order);
        self.second_order = self.second_order.max(other.second_order);
        self.single = self.single.max(other.single);
        self.comparisons += other.comparisons;
    }
}

/// A comparison that NaN fails: the error of `got` against `expected` relative to `scale`, which must not exceed
/// `tolerance`.
fn compare(what: &str, got: f64, expected: f64, scale: f64, tolerance: f64) -> Result<f64, String> {
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

fn inner(a: &[Tensor<f64>], b: &[Tensor<f64>]) -> f64 {
    a.iter().zip(b).flat_map(|(a, b)| a.as_slice().iter().zip(b.as_slice())).map(|(a, b)| a * b).sum()
}

/// `x + h d`.
fn moved(x: &[Tensor<f64>], d: &[Tensor<f64>], h: f64) -> Vec<Tensor<f64>> {
    let pair =
        |(x, d): (&Tensor<f64>, &Tensor<f64>)| Tensor::from_fn(x.shape(), |i| x.as_slice()[i] + h * d.as_slice()[i]);
    x.iter().zip(d).map(pair).collect()
}

/// Directions to differentiate along: each coordinate if there are few, else vectors without a pattern.
fn directions(x: &[Tensor<f64>], most: usize) -> Vec<Vec<Tensor<f64>>> {
    let total: usize = x.iter().map(Tensor::len).sum();
    let zeros = || x.iter().map(|x| Tensor::zeros(x.shape())).collect::<Vec<_>>();
    if total > most {
        let random = |k| x.iter().enumerate().map(|(i, x)| spread(x.shape(), &[-1.0..1.0], 13 * k + i + 5)).collect();
        return (0..most).map(random).collect();
    }
    let mut all = vec![];
    for (which, x) in x.iter().enumerate() {
        for i in 0..x.len() {
            let mut d = zeros();
            d[which].as_mut_slice()[i] = x.as_slice()[i].abs().max(1.0);
            all.push(d);
        }
    }
    all
}

/// Compares `grads`, the gradients of `f` at `x`, with Richardson-extrapolated central differences.
fn against_differences(
    what: &str,
    check: &Check,
    x: &[Tensor<f64>],
    grads: &[Tensor<f64>],
    f: &dyn Fn(&[Tensor<f64>]) -> f64,
) -> Result<(f64, usize), String> {
    let (mut worst, mut count) = (0.0_f64, 0);
    let here = f(x).abs();
    for (k, d) in directions(x, check.directions).iter().enumerate() {
        let difference = |h: f64| (f(&moved(x, d, h)) - f(&moved(x, d, -h))) / (2.0 * h);
        let numeric = (4.0 * difference(0.5 * check.step) - difference(check.step)) / 3.0;
        let analytic = inner(grads, d);
        let scale = numeric.abs().max(analytic.abs()).max(here).max(1.0);
        let what = format!("{what}, direction {k}");
        worst = worst.max(compare(&what, analytic, numeric, scale, check.tolerance)?);
        count += 1;
    }
    Ok((worst, count))
}

/// Checks the first and second derivatives of `f` at `x` against finite differences in f64.
///
/// `f` must use its inputs only through the tape, so that it can be evaluated elsewhere; its result may have any
/// shape.
///
/// ```
/// use raygrad_autograd::{Check, check_function};
/// use raygrad_tensor::Tensor;
/// let x = Tensor::from_vec(&[2], vec![0.3, 1.2]);
/// check_function(&Check::default(), &[x], |x| (x[0].sin() * &x[0]).exp()).unwrap();
/// ```
///
/// # Errors
/// If a derivative is wrong or NaN, in words.
pub fn check_function(
    check: &Check,
    x: &[Tensor<f64>],
    f: impl for<'t> Fn(&[Var<'t, f64>]) -> Var<'t, f64>,
) -> Result<Report, String> {
    let mut report = Report::default();
    let tape = Tape::new();
    let leaves: Vec<_> = x.iter().map(|x| tape.leaf(x.clone())).collect();
    let wrt: Vec<_> = leaves.iter().collect();
    let y = f(&leaves);
    let seed = spread(y.shape(), &[0.3..1.3], 3);
    // The function is reduced to one number by a fixed weighting of its outputs.
    let number = |x: &[Tensor<f64>]| -> f64 {
        let tape = Tape::new();
        let x: Vec<_> = x.iter().map(|x| tape.constant(x.clone())).collect();
        inner(&[f(&x).into_value()], std::slice::from_ref(&seed))
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
    let gradient = |x: &[Tensor<f64>]| -> f64 {
        let tape = Tape::new();
        let leaves: Vec<_> = x[..x.len() - 1].iter().map(|x| tape.leaf(x.clone())).collect();
        let seed = tape.constant(x[x.len() - 1].clone());
        inner(&(f(&leaves) * seed).sum().grad(&leaves.iter().collect::<Vec<_>>()), &weights)
    };
    let seed = tape.leaf(both[both.len() - 1].clone());
    let recorded = (f(&leaves) * &seed).sum().grad_graph(&wrt);
    let recorded_values: Vec<_> = recorded.iter().map(|grad| grad.value().clone()).collect();
    let scale = inner(&grads, &grads).sqrt().max(1.0);
    let what = "the recorded gradient against the unrecorded one";
    compare(what, inner(&recorded_values, &weights), inner(&grads, &weights), scale, 1e-10)?;
    let mut total = tape.constant(Tensor::scalar(0.0));
    for (grad, weight) in recorded.iter().zip(&weights) {
        total = total + (grad * tape.constant(weight.clone())).sum();
    }
    let wrt: Vec<_> = leaves.iter().chain([&seed]).collect();
    let second = total.grad(&wrt);
    let (second, count) = against_differences("second derivative", check, &both, &second, &gradient)?;
    report.merge(Report { second_order: second, comparisons: count + 1, ..Report::default() });
    Ok(report)
}

impl<T: Scalar> Op<T> for Arc<dyn Op<T>> {
    fn name(&self) -> &'static str {
        (**self).name()
    }
    fn shape(&self, x: &[&[usize]]) -> Result<raygrad_tensor::Shape, crate::ShapeError> {
        (**self).shape(x)
    }
    fn forward(&self, x: &[&Tensor<T>], pool: &raygrad_tensor::Pool<T>) -> Tensor<T> {
        (**self).forward(x, pool)
    }
    fn reads(&self) -> crate::Reads {
        (**self).reads()
    }
    fn vjp<'t>(&self, cx: &crate::Vjp<'t, '_, T>) -> crate::Grads<'t, T> {
        (**self).vjp(cx)
    }
    fn try_vjp<'t>(&self, cx: &crate::Vjp<'t, '_, T>) -> Result<crate::Grads<'t, T>, crate::Error> {
        (**self).try_vjp(cx)
    }
    fn is_fused(&self) -> bool {
        (**self).is_fused()
    }
    fn reference<'t>(&self, x: &[Var<'t, T>]) -> Option<Var<'t, T>> {
        (**self).reference(x)
    }
}

/// Value and gradients of an operation for a fixed seed.
fn evaluate<T: Scalar>(op: &Arc<dyn Op<T>>, x: &[Tensor<T>], reference: bool) -> Option<Vec<Tensor<T>>> {
    let tape = Tape::new();
    let leaves: Vec<_> = x.iter().map(|x| tape.leaf(x.clone())).collect();
    let wrt: Vec<_> = leaves.iter().collect();
    let y = if reference { op.reference(&leaves)? } else { tape.apply(op.clone(), &wrt) };
    let seed = tape.constant(spread(y.shape(), &[0.3..1.3], 3).cast());
    let mut all = (&y * seed).sum().grad(&wrt);
    all.push(y.into_value());
    Some(all)
}

/// Compares lists of tensors by their L2 distance relative to the norm, NaN failing.
fn compare_all<T: Scalar>(
    what: &str,
    got: &[Tensor<T>],
    expected: &[Tensor<f64>],
    tolerance: f64,
) -> Result<f64, String> {
    let mut worst = 0.0_f64;
    for (i, (got, expected)) in got.iter().zip(expected).enumerate() {
        if got.shape() != expected.shape() {
            return Err(format!("{what}, result {i}: shape {:?} instead of {:?}", got.shape(), expected.shape()));
        }
        let distance = got.as_slice().iter().zip(expected.as_slice()).map(|(g, e)| (g.to_f64() - e).powi(2));
        let norm = expected.as_slice().iter().map(|e| e * e).sum::<f64>().sqrt().max(1e-3);
        let error = distance.sum::<f64>().sqrt();
        worst = worst.max(compare(&format!("{what}, result {i}"), error, 0.0, norm, tolerance)?);
    }
    Ok(worst)
}

/// Examines an operation as the catalogue describes it: first and second derivatives against finite differences in
/// f64, f32 against f64, a fused operation against its reference, an elementwise formula against dual numbers, a linear
/// operation for linearity, exact values and gradients at extremes, and the same bits when run twice.
///
/// # Errors
/// If a check fails, in words.
pub fn check_op(check: &Check, entry: &Entry) -> Result<Report, String> {
    let mut report = Report::default();
    for (k, x) in entry.samples.iter().enumerate() {
        let shapes: Vec<_> = x.iter().map(Tensor::shape).collect();
        let context = |error: String| format!("{} sample {k} {shapes:?}: {error}", entry.name);
        report.merge(check_function(check, x, apply(&entry.f64)).map_err(context)?);
        let Some(double) = evaluate(&entry.f64, x, false) else { continue };
        if evaluate(&entry.f64, x, false).as_deref() != Some(&double[..]) {
            return Err(context("two runs differ".into()));
        }
        let singles: Vec<Tensor<f32>> = x.iter().map(Tensor::cast).collect();
        // The f64 side gets what the f32 side sees, so that only the arithmetic differs.
        let rounded: Vec<Tensor<f64>> = singles.iter().map(Tensor::cast).collect();
        if let (Some(single), Some(double)) =
            (evaluate(&entry.f32, &singles, false), evaluate(&entry.f64, &rounded, false))
        {
            report.single = report.single.max(compare_all("f32 against f64", &single, &double, 2e-6).map_err(context)?);
        }
        if let Some(reference) = evaluate(&entry.f64, x, true) {
            compare_all("fused against reference", &double, &reference, 1e-12).map_err(context)?;
        } else if entry.f64.is_fused() {
            return Err(context("a fused operation without a reference".into()));
        }
        if entry.linear {
            let two =
                |c: f64| x.iter().map(|x| Tensor::from_fn(x.shape(), |i| c * x.as_slice()[i])).collect::<Vec<_>>();
            if let (Some(mut a), Some(b)) = (evaluate(&entry.f64, &two(-2.0), false), evaluate(&entry.f64, x, false)) {
                a.iter_mut().last().into_iter().flat_map(|y| y.as_mut_slice()).for_each(|y| *y *= -0.5);
                compare_all("f(-2 x) / -2 and the gradients against those at x", &a, &b, 1e-12).map_err(context)?;
            }
        }
        if let Some(formula) = &entry.dual {
            against_duals(formula, &double, x).map_err(context)?;
        }
    }
    for extreme in &entry.extremes {
        extreme_case(&entry.f64, extreme, 1e-9).map_err(|error| format!("{} in f64: {error}", entry.name))?;
        extreme_case(&entry.f32, extreme, 5e-7).map_err(|error| format!("{} in f32: {error}", entry.name))?;
        report.comparisons += 2;
    }
    Ok(report)
}

/// An operation as a function, for [`check_function`].
fn apply(op: &Arc<dyn Op<f64>>) -> impl for<'t> Fn(&[Var<'t, f64>]) -> Var<'t, f64> + '_ {
    fn hint<F: for<'t> Fn(&[Var<'t, f64>]) -> Var<'t, f64>>(f: F) -> F {
        f
    }
    hint(|x| x[0].tape().apply(op.clone(), &x.iter().collect::<Vec<_>>()))
}

/// An elementwise operation on inputs of equal shape against its formula on dual numbers.
fn against_duals(formula: &dyn Fn(&[Dual]) -> Dual, got: &[Tensor<f64>], x: &[Tensor<f64>]) -> Result<(), String> {
    if x.iter().any(|other| other.shape() != x[0].shape()) {
        return Ok(());
    }
    let seed = spread(x[0].shape(), &[0.3..1.3], 3);
    for i in 0..x[0].len() {
        for which in 0..x.len() {
            let slope = |k| if k == which { 1.0 } else { 0.0 };
            let duals: Vec<_> = (0..x.len()).map(|k| Dual { value: x[k].as_slice()[i], slope: slope(k) }).collect();
            let y = formula(&duals);
            let (value, grad) = (got[x.len()].as_slice()[i], got[which].as_slice()[i] / seed.as_slice()[i]);
            compare("the value against dual numbers", value, y.value, y.value.abs().max(1e-3), 1e-13)?;
            compare("the gradient against dual numbers", grad, y.slope, y.slope.abs().max(1e-3), 1e-12)?;
        }
    }
    Ok(())
}

fn extreme_case<T: Scalar>(op: &Arc<dyn Op<T>>, extreme: &crate::Extreme, tolerance: f64) -> Result<(), String> {
    let tape = Tape::new();
    let leaves: Vec<_> = extreme.x.iter().map(|&x| tape.leaf(Tensor::scalar(T::from_f64(x)))).collect();
    let wrt: Vec<_> = leaves.iter().collect();
    let y = tape.apply(op.clone(), &wrt);
    let grads = y.grad(&wrt);
    let same = |what: &str, got: T, expected: f64| {
        // The expectation as this type holds it: what overflows or underflows there is to do so.
        let expected = T::from_f64(expected).to_f64();
        if expected.is_nan() && got.to_f64().is_nan() {
            return Ok(0.0);
        }
        compare(&format!("{what} at {:?}", extreme.x), got.to_f64(), expected, expected.abs(), tolerance)
    };
    same("the value", y.item(), extreme.y)?;
    for (i, (grad, &expected)) in grads.iter().zip(&extreme.grads).enumerate() {
        same(&format!("gradient {i}"), grad.item(), expected)?;
    }
    Ok(())
}
