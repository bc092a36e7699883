//! All checks of one operation: finite differences, dual numbers, reference, adjoint, f32, inputs of any layout, and
//! values at extremes.

use super::catalogue::DualFormula;
use super::function::{compare, inner};
use super::{Check, Report, check_function};
use super::{Entry, spread};
use crate::{Op, Tape, Var};
use raygrad_tensor::{Pool, Scalar, Tensor};
use std::sync::Arc;

/// Largest accepted distance of f32 results from f64 ones: relative to the norm, and for one element in units in the
/// last place.
const SINGLE: (f64, f64) = (2e-6, 32.0);
/// Replaces a norm of 0 as the divisor of a relative error.
const TINY: f64 = f64::MIN_POSITIVE;

impl<T: Scalar> Op<T> for Arc<dyn Op<T>> {
    fn name(&self) -> &'static str {
        (**self).name()
    }
    fn arity(&self) -> Option<usize> {
        (**self).arity()
    }
    fn shape(&self, x: &[&[usize]]) -> Result<raygrad_tensor::Shape, crate::ShapeError> {
        (**self).shape(x)
    }
    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        (**self).forward(x, pool)
    }
    fn reads(&self) -> crate::Reads {
        (**self).reads()
    }
    fn reads_for(&self, has_gradient: &dyn Fn(usize) -> bool) -> crate::Reads {
        (**self).reads_for(has_gradient)
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

/// Runs all checks on a catalogue entry.
///
/// On every sample it checks:
///
/// - first and second derivatives against finite differences in f64 ([`check_function`]);
/// - that a second run gives the same bits, on buffers with old values too;
/// - that inputs from transposed and reversed arrays give the same results;
/// - that one variable passed as two inputs gives the value and derivatives of two equal variables;
/// - that a constant input leaves the derivatives by the other inputs unchanged;
/// - f32 against f64, by norm and by units in the last place;
/// - a fused operation against its reference, and an elementwise formula against dual numbers;
/// - linearity of a linear operation, and that its gradient is the adjoint: `<J x, u> = <x, J' u>`.
///
/// At the extremes it compares values and gradients with the exact ones, in f64 and f32.
///
/// # Errors
/// If a check fails. The text names the operation, the sample and the check.
pub fn check_op(check: &Check, entry: &Entry) -> Result<Report, String> {
    let mut report = Report::default();
    for (k, x) in entry.samples.iter().enumerate() {
        let shapes: Vec<_> = x.iter().map(Tensor::shape).collect();
        let context = |error: String| format!("{} sample {k} {shapes:?}: {error}", entry.name);
        report.merge(check_sample(check, entry, x).map_err(context)?);
    }
    for extreme in &entry.extremes {
        extreme_case(&entry.f64, extreme, 1e-9).map_err(|error| format!("{} in f64: {error}", entry.name))?;
        extreme_case(&entry.f32, extreme, 5e-7).map_err(|error| format!("{} in f32: {error}", entry.name))?;
        report.comparisons += 2 * (1 + extreme.grads.len());
    }
    Ok(report)
}

fn check_sample(check: &Check, entry: &Entry, x: &[Tensor<f64>]) -> Result<Report, String> {
    let mut report = check_function(check, x, apply(&entry.f64))?;
    let double = evaluate(&entry.f64, x, &Pool::new());
    report.comparisons += independent(&entry.f64, x, &double)?;
    let equal_shapes = |i: usize| (0..i).filter(move |&j| x[i].shape() == x[j].shape()).map(move |j| (j, i));
    for (i, j) in (0..x.len()).flat_map(equal_shapes) {
        let what = format!("one variable as inputs {i} and {j} against two");
        // The values of one of the two, those that lie in the domain of both.
        let values = if evaluates(&entry.f64, x, i, j) { i } else { j };
        let [shared, apart] = [true, false].map(|shared| twice(&entry.f64, x, [i, j], values, shared));
        // Two derivatives may cancel: their rounding errors are accepted.
        compare_all(&what, &shared, &apart, 1e-12, 1e-3)?;
        report.comparisons += 1;
    }
    for held in (0..x.len()).filter(|_| x.len() > 1) {
        let [constant, leaf] = [true, false].map(|constant| by_others(&entry.f64, x, held, constant));
        compare_all(&format!("input {held} as a constant against a variable"), &constant, &leaf, 1e-12, 1e-3)?;
        report.comparisons += 1;
    }
    let singles: Vec<Tensor<f32>> = x.iter().map(Tensor::cast).collect();
    // The f64 side gets what the f32 side sees, so that only the arithmetic differs.
    let rounded: Vec<Tensor<f64>> = singles.iter().map(Tensor::cast).collect();
    let single = evaluate(&entry.f32, &singles, &Pool::new());
    let rounded = evaluate(&entry.f64, &rounded, &Pool::new());
    report.single = compare_all("f32 against f64", &single, &rounded, SINGLE.0, TINY)?;
    report.ulps = compare_ulps(&single, &rounded)?;
    report.comparisons += 2;
    if let Some(reference) = reference(&entry.f64, x) {
        compare_all("fused against reference", &double, &reference, 1e-12, TINY)?;
        report.comparisons += 1;
    } else if entry.f64.is_fused() {
        return Err("a fused operation without a reference".into());
    }
    if entry.linear {
        linear(&entry.f64, x, &double)?;
        report.comparisons += 2;
    }
    if let Some(formula) = &entry.dual {
        report.comparisons += against_duals(formula, &double, x)?;
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

/// The output gradient that all these checks use.
fn seed(shape: &[usize]) -> Tensor<f64> {
    spread(shape, &[0.3..1.3], 3)
}

/// The gradients of the inputs for [`seed`], and the value, of `f`.
fn results<T: Scalar>(
    x: &[Tensor<T>],
    pool: &Pool<T>,
    f: impl for<'t> Fn(&[Var<'t, T>]) -> Option<Var<'t, T>>,
) -> Option<Vec<Tensor<T>>> {
    let tape = Tape::with_pool(pool.clone());
    let leaves: Vec<_> = x.iter().map(|x| tape.leaf(x.clone())).collect();
    let wrt: Vec<_> = leaves.iter().collect();
    let y = f(&leaves)?.tracked(); // a reference may be constant for some inputs
    let seed = tape.constant(seed(y.shape()).cast());
    let mut all = (&y * seed).sum().grad(&wrt);
    all.push(y.into_value());
    Some(all)
}

fn evaluate<T: Scalar>(op: &Arc<dyn Op<T>>, x: &[Tensor<T>], pool: &Pool<T>) -> Vec<Tensor<T>> {
    results(x, pool, |x| Some(x[0].tape().apply(op.clone(), &x.iter().collect::<Vec<_>>()))).unwrap_or_default()
}

fn reference(op: &Arc<dyn Op<f64>>, x: &[Tensor<f64>]) -> Option<Vec<Tensor<f64>>> {
    results(x, &Pool::new(), |x| op.reference(x))
}

/// A pool whose buffers of up to about a thousand elements hold old values, so that an element that an operation
/// forgets to write shows. (New buffers, and those of tensors of up to 64 elements, hold NaN where assertions are on.)
fn used() -> Pool<f64> {
    let pool = Pool::new();
    let sizes = (4..9).flat_map(|power| (4..8).map(move |quarters| quarters << power));
    let buffers: Vec<_> = sizes.flat_map(|size| [size; 8]).map(|size| pool.full(&[size], 1e30)).collect();
    drop(buffers);
    pool
}

/// Largest accepted distance of a result on views from that on copies, relative to the largest element. Kernels may add
/// in memory order.
const VIEW_LIMIT: f64 = 1e-14;

/// Whether two results have the same shape and agree. NaN agrees with no value.
fn within(a: &Tensor<f64>, b: &Tensor<f64>, limit: f64) -> bool {
    let size = b.as_slice().iter().filter(|b| b.is_finite()).map(|b| b.abs()).fold(0.0, f64::max);
    let close = |(a, b): (&f64, &f64)| a == b || (a - b).abs() <= limit * size;
    a.shape() == b.shape() && a.as_slice().iter().zip(b.as_slice()).all(close)
}

/// Checks that results depend on the values of the inputs alone. Returns the number of comparisons.
fn independent(op: &Arc<dyn Op<f64>>, x: &[Tensor<f64>], expected: &[Tensor<f64>]) -> Result<usize, String> {
    let transposed =
        |x: &Tensor<f64>| x.view().reversed_axes().as_standard_layout().into_owned().reversed_axes().into();
    let reversed = |x: &Tensor<f64>| {
        let mut mirror = x.view();
        x.view().axes().for_each(|axis| mirror.invert_axis(axis.axis));
        let mut array = mirror.as_standard_layout().into_owned();
        x.view().axes().for_each(|axis| array.invert_axis(axis.axis));
        array.into()
    };
    let transposed: Vec<Tensor<f64>> = x.iter().map(transposed).collect();
    let reversed: Vec<Tensor<f64>> = x.iter().map(reversed).collect();
    let runs = [
        ("two runs differ", x, Pool::new(), 0.0),
        ("old values of a buffer that `Pool::tensor` gave are in the result", x, used(), 0.0),
        ("inputs from transposed arrays give other results", &transposed[..], Pool::new(), VIEW_LIMIT),
        ("inputs from reversed arrays give other results", &reversed[..], Pool::new(), VIEW_LIMIT),
    ];
    let count = runs.len();
    for (what, x, pool, limit) in runs {
        let got = evaluate(op, x, &pool);
        let same = got.len() == expected.len() && got.iter().zip(expected).all(|(a, b)| within(a, b, limit));
        if !same {
            return Err(what.into());
        }
    }
    Ok(count)
}

/// Whether value and gradients are not NaN where input `j` is equal to input `i`.
fn evaluates(op: &Arc<dyn Op<f64>>, x: &[Tensor<f64>], i: usize, j: usize) -> bool {
    let mut x = x.to_vec();
    x[j] = x[i].clone();
    evaluate(op, &x, &Pool::new()).iter().all(|result| result.as_slice().iter().all(|x| !x.is_nan()))
}

/// Value, recorded gradients, and gradients of a weighting of these, with inputs `i` and `j` both equal to input
/// `values`. They are passed as one variable, or as two whose derivatives are added.
fn twice(
    op: &Arc<dyn Op<f64>>,
    x: &[Tensor<f64>],
    [i, j]: [usize; 2],
    values: usize,
    shared: bool,
) -> Vec<Tensor<f64>> {
    let tape = Tape::new();
    let mut leaves: Vec<_> = x.iter().map(|x| tape.leaf(x.clone())).collect();
    leaves[i] = tape.leaf(x[values].clone());
    // The other variable has memory of its own, too.
    let copy = || Tensor::from_vec(x[values].shape(), x[values].as_slice().to_vec());
    leaves[j] = if shared { leaves[i].clone() } else { tape.leaf(copy()) };
    let y = tape.apply(op.clone(), &leaves.iter().collect::<Vec<_>>());
    let mut wrt: Vec<_> = leaves.iter().collect();
    if shared {
        wrt.remove(j);
    }
    let join = if shared { None } else { Some((i, j)) };
    let grads = joined((&y * seed(y.shape())).sum().grad_graph(&wrt), join);
    let second = joined(weighted(&grads).grad_graph(&wrt), join);
    grads.into_iter().chain(second).chain([y]).map(Var::into_value).collect()
}

/// A weighting of gradients.
fn weighted<'t>(grads: &[Var<'t, f64>]) -> Var<'t, f64> {
    let part = |(k, grad): (usize, &Var<'t, f64>)| (grad * spread(grad.shape(), &[-1.0..1.0], 29 + k)).sum();
    grads.iter().enumerate().map(part).sum::<Var<'t, f64>>().tracked()
}

/// Gradients, recorded gradients, and gradients of a weighting of these, by all inputs but input `held`.
fn by_others(op: &Arc<dyn Op<f64>>, x: &[Tensor<f64>], held: usize, constant: bool) -> Vec<Tensor<f64>> {
    let tape = Tape::new();
    let input = |(i, x): (usize, &Tensor<f64>)| {
        if constant && i == held { tape.constant(x.clone()) } else { tape.leaf(x.clone()) }
    };
    let inputs: Vec<_> = x.iter().enumerate().map(input).collect();
    let y = tape.apply(op.clone(), &inputs.iter().collect::<Vec<_>>()).tracked();
    let loss = (&y * seed(y.shape())).sum();
    let wrt: Vec<_> = inputs.iter().enumerate().filter(|(i, _)| *i != held).map(|(_, x)| x).collect();
    let grads = loss.grad_graph(&wrt);
    let second = weighted(&grads).grad_graph(&wrt);
    let all = grads.into_iter().chain(second).map(Var::into_value);
    loss.grad(&wrt).into_iter().chain(all).collect()
}

/// Adds element `j` of a pair `(i, j)` to element `i` and removes it; `j` comes after `i`.
fn joined<'t>(mut grads: Vec<Var<'t, f64>>, pair: Option<(usize, usize)>) -> Vec<Var<'t, f64>> {
    if let Some((i, j)) = pair {
        let other = grads.remove(j);
        grads[i] = &grads[i] + other;
    }
    grads
}

/// Compares lists of tensors by their L2 distance relative to the norm. NaN fails, even on both sides: no sample
/// expects one. A norm below `least` counts as `least`.
fn compare_all<T: Scalar>(
    what: &str,
    got: &[Tensor<T>],
    expected: &[Tensor<f64>],
    tolerance: f64,
    least: f64,
) -> Result<f64, String> {
    let mut worst = 0.0_f64;
    for (i, (got, expected)) in got.iter().zip(expected).enumerate() {
        if got.shape() != expected.shape() {
            return Err(format!("{what}, result {i}: shape {:?} instead of {:?}", got.shape(), expected.shape()));
        }
        let pairs = || got.as_slice().iter().map(|x| x.to_f64()).zip(expected.as_slice().iter().copied());
        // Equal ones, infinite ones too, are no distance apart.
        let apart = |&(g, e): &(f64, f64)| g != e;
        let distance: f64 = pairs().filter(apart).map(|(g, e)| (g - e).powi(2)).sum();
        let norm: f64 = pairs().map(|(_, e)| e * e).filter(|square| square.is_finite()).sum();
        let what = format!("{what}, result {i}");
        worst = worst.max(compare(&what, distance.sqrt(), 0.0, norm.sqrt().max(least), tolerance)?);
    }
    Ok(worst)
}

/// The worst error of an element in units in the last place of f32, as [`Report::ulps`] defines them.
fn compare_ulps(got: &[Tensor<f32>], expected: &[Tensor<f64>]) -> Result<f64, String> {
    let mut worst = 0.0_f64;
    for (i, (got, expected)) in got.iter().zip(expected).enumerate() {
        let square: f64 = expected.as_slice().iter().map(|e| e * e).sum();
        let typical = (square / expected.len().max(1) as f64).sqrt().max(TINY);
        for (k, (&got, &expected)) in got.as_slice().iter().zip(expected.as_slice()).enumerate() {
            let ulp = expected.abs().max(typical).log2().floor().exp2() * f64::from(f32::EPSILON);
            let what = format!("f32 against f64 in units in the last place, result {i}, element {k}");
            worst = worst.max(compare(&what, f64::from(got), expected, ulp, SINGLE.1)?);
        }
    }
    Ok(worst)
}

/// Checks that `f(-2 x) = -2 f(x)` with the same gradients, and that the gradient is the adjoint.
fn linear(op: &Arc<dyn Op<f64>>, x: &[Tensor<f64>], double: &[Tensor<f64>]) -> Result<(), String> {
    let (grads, y) = double.split_at(x.len());
    let scaled: Vec<_> = x.iter().map(|x| Tensor::from_fn(x.shape(), |i| -2.0 * x.as_slice()[i])).collect();
    let mut other = evaluate(op, &scaled, &Pool::new());
    other.iter_mut().last().into_iter().flat_map(|y| y.as_mut_slice()).for_each(|y| *y *= -0.5);
    compare_all("f(-2 x) / -2 and the gradients against those at x", &other, double, 1e-12, TINY)?;
    let seed = [seed(y[0].shape())];
    let size = |x: &[Tensor<f64>]| inner(x, x).sqrt();
    let scale = (size(y) * size(&seed)).max(size(x) * size(grads));
    let what = "the output along a gradient against the input along its adjoint";
    compare(what, inner(x, grads), inner(y, &seed), scale, 1e-14)?;
    Ok(())
}

/// Compares an elementwise operation on inputs of equal shape with its formula on dual numbers. Returns the number of
/// comparisons.
fn against_duals(formula: &DualFormula, got: &[Tensor<f64>], x: &[Tensor<f64>]) -> Result<usize, String> {
    if x.iter().any(|other| other.shape() != x[0].shape()) {
        return Ok(0);
    }
    let seed = seed(x[0].shape());
    for i in 0..x[0].len() {
        let operands: Vec<f64> = x.iter().map(|x| x.as_slice()[i]).collect();
        let (value, grads) = formula(&operands, seed.as_slice()[i]);
        compare("the value against dual numbers", got[x.len()].as_slice()[i], value, value.abs(), 1e-13)?;
        for (got, grad) in got.iter().zip(grads) {
            compare("the gradient against dual numbers", got.as_slice()[i], grad, grad.abs(), 1e-12)?;
        }
    }
    Ok((1 + x.len()) * x[0].len())
}

fn extreme_case<T: Scalar>(op: &Arc<dyn Op<T>>, extreme: &super::Extreme, tolerance: f64) -> Result<(), String> {
    let tape = Tape::new();
    let leaves: Vec<_> = extreme.x.iter().map(|&x| tape.leaf(Tensor::scalar(T::from_f64(x)))).collect();
    let wrt: Vec<_> = leaves.iter().collect();
    let y = tape.apply(op.clone(), &wrt);
    let grads = y.grad(&wrt);
    let same = |what: &str, got: T, expected: f64| {
        // The expected value in this type, where it may overflow or underflow.
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
