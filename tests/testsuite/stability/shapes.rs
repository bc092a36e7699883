//! Tape programs on random shapes: a clear error, or a result with gradients, and no other panic. Shapes and values
//! equal ndarray's where it has the operation.

use ndarray::{ArrayD, Axis, IxDyn, Slice, concatenate, stack};
use proptest::prelude::*;
use raygrad::nerf::volume::{Accumulate, OpticalDepth, Weights};
use raygrad::nerf::{Contraction, PositionalEncoding, SphericalHarmonics, rotation_exp};
use raygrad::{Activation, Axes, Conv2dConfig, Indices, Pool2dConfig, Segments, Tape, Tensor, Var};
use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;

type V<'t> = Var<'t, f64>;

/// Operation number `op` on values and small numbers, some of them out of range.
fn apply<'t>(op: usize, a: &V<'t>, b: &V<'t>, c: &V<'t>, [i, j, k]: [usize; 3]) -> Option<V<'t>> {
    let tape = a.tape();
    // Axes may count from the end, positions count from the start.
    let (axis, at) = (i as isize - 2, i as isize);
    let index: Arc<[u32]> = (0..j).map(|n| ((n * 3 + k) % 5) as u32).collect();
    let indices = || Indices::new(&[j], index.clone());
    let along = || {
        let count: usize = c.shape().iter().product();
        Indices::new(c.shape(), (0..count).map(|n| ((n + k) % 3) as u32).collect::<Vec<_>>())
    };
    let segments = || Segments::new([0, i as u32, (i + j) as u32]);
    let conv = Conv2dConfig { stride: [i, 1], padding: [j, 0], dilation: [1, k] };
    let pool = Pool2dConfig { kernel: [i, j], stride: [1, j], padding: [k / 2, 0] };
    Some(match op {
        0 => a + b,
        1 => a * b,
        2 => a / b,
        3 => a.matmul(b),
        4 => a.t().matmul(b),
        5 => a.dot(b),
        6 => a.outer(b),
        7 => a.cross(b),
        8 => a.normalize(),
        9 => a.sum_over(Axes::from(at).keepdims()),
        10 => a.mean_over(axis),
        11 => a.max_over(axis),
        12 => a.min_over([axis, j as isize - 2]),
        13 => a.var_over(axis, j),
        14 => a.std_over(axis, j),
        15 => a.norm_over(axis),
        16 => a.prod_over(axis),
        17 => a.logsumexp_over(axis),
        18 => a.softmax(axis),
        19 => a.log_softmax(axis),
        20 => a.cumsum(axis),
        21 => a.cumprod(axis),
        22 => a.recurrence(b, axis),
        23 => a.permute(&[at, j as isize]),
        24 => a.transpose(at, j as isize),
        25 => a.t(),
        26 => a.reshape(&[i, j]),
        27 => a.slice_axis(at, j..j + k),
        28 => a.slice_axis(at, Slice::from(j..k).step_by(2)),
        29 => a.flip(at),
        30 => a.squeeze(at),
        31 => a.unsqueeze(at),
        32 => a.roll(at, k as isize - 2),
        33 => a.repeat(at, j),
        34 => a.tile(&[i, j]),
        35 => a.pad(&[[i, j], [k, 0]], 0.5),
        36 => a.broadcast_to(&[i, j]),
        37 => a.sum_to(&[i, j]),
        38 => Var::concat(&[a, b, c], at),
        39 => Var::stack(&[a, b], at),
        40 => a.split(at, &[j, k]).pop()?,
        41 => a.gather_rows(&index),
        42 => a.scatter_rows(&index, i),
        43 => a.gather(at, along()),
        44 => a.scatter_add(at, along(), b),
        45 => a.index_select(at, &index),
        46 => a.index_add(at, &index, b),
        47 => a.sort(at, j % 2 == 0).0,
        48 => tape.one_hot(indices(), k),
        49 => a.where_(&b.gt(0.5), c),
        50 => a.lerp(b, c),
        51 => a.tril(axis),
        52 => a.diagonal(axis),
        53 => a.diag_embed(axis),
        54 => a.diag(axis),
        55 => a.einsum_with(b, i),
        56 => a.conv2d(b, &conv),
        57 => a.max_pool2d(&pool),
        58 => a.avg_pool2d(&pool),
        59 => a.layer_norm(b, c, 1e-5),
        60 => a.linear(b, Some(c), Activation::Relu),
        61 => a.segment_sum(&segments()),
        62 => a.segment_expand(&segments()),
        63 => a.segment_cumsum(&segments(), k % 2 == 0),
        64 => a.cross_entropy([i, j, k].map(|class| class as u32)),
        65 => a.mse_loss(b),
        66 => a.huber(b, 0.5),
        67 => a.conv2d_transpose(b, &conv, [i, k]),
        68 => tape.apply(Contraction, &[a]),
        69 => tape.apply(PositionalEncoding { levels: j, input: k % 2 == 0 }, &[a]),
        70 => tape.apply(SphericalHarmonics::new(i), &[a]),
        71 => rotation_exp(a),
        73 => tape.apply(OpticalDepth::new(Tensor::ones(&[i + j])), &[&a.square()]),
        78 => tape.apply(Weights::new(segments()), &[&a.square()]),
        72 => tape.apply(Accumulate(segments()), &[&a.square(), b]),
        74 => tape.constant(Tensor::scalar(a.searchsorted(b, false).as_slice().len() as f64)),
        75 => tape.constant(Tensor::scalar(a.argmax(axis).as_slice().len() as f64)),
        76 => Var::meshgrid(&[a, b]).pop()?,
        77 => a.if_positive(b, c),
        _ => return None,
    })
}

const OPERATIONS: usize = 79;

trait Einsum {
    fn einsum_with(&self, other: &Self, which: usize) -> Self;
}

impl Einsum for V<'_> {
    fn einsum_with(&self, other: &Self, which: usize) -> Self {
        const EQUATIONS: [&str; 6] = ["ij,jk->ik", "i,i->", "ii,i->i", "...i,i->...", "ij->", "ij,jk-"];
        Var::einsum(EQUATIONS[which % 6], &[self, other])
    }
}

/// Messages of invalid inputs that constructors and plain tensors check, not the tape. Any other panic is a bug: an
/// index out of bounds, an overflow, an `unwrap`.
const MESSAGES: [&str; 6] = [
    "one_hot: index",
    "the last axis of rotation vectors must be 3",
    "searchsorted in a scalar",
    "searchsorted of shapes",
    "segment offsets do not fall",
    "the degree of spherical harmonics must be 1 to 4",
];

/// Returns true if a panic has a message for users.
fn is_a_message(text: &str) -> bool {
    MESSAGES.iter().any(|words| text.contains(words))
}

/// The message of a panic.
fn words(panic: Box<dyn Any + Send>) -> String {
    let text = panic.downcast_ref::<String>().cloned();
    text.or(panic.downcast_ref::<&str>().map(|text| text.to_string())).unwrap_or_default()
}

fn shape() -> impl Strategy<Value = Vec<usize>> {
    prop::collection::vec(0..4_usize, 0..5)
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 6000, max_shrink_iters: 2000, ..ProptestConfig::default() })]

    #[test]
    fn operations_on_any_shapes_give_results_or_errors(
        op in 0..OPERATIONS, a in shape(), b in shape(), c in shape(), alike in 0..4_usize, k in [0..5_usize, 0..5, 0..5],
    ) {
        // Independent shapes rarely fit; equal ones often do.
        let b = if alike >= 1 { a.clone() } else { b };
        let c = if alike >= 2 { a.clone() } else { c };
        let outcome = catch_unwind(AssertUnwindSafe(|| {
            let tape = Tape::<f64>::new();
            let mut value = 0.0;
            let mut leaf = |shape: &[usize]| tape.leaf(Tensor::from_fn(shape, |_| { value += 0.37; 0.1 + value % 1.0 }));
            let [a, b, c] = [&a, &b, &c].map(|shape| leaf(shape));
            // Invalid shapes are errors; results have gradients of any order.
            let Ok(y) = tape.try_run(|| apply(op, &a, &b, &c, k)) else { return };
            let Some(y) = y else { return };
            let first = y.tracked().sum().grad_graph(&[&a, &b, &c]);
            let again = first.iter().fold(tape.constant(Tensor::scalar(0.0)), |sum, grad| sum + grad.square().sum());
            again.grad(&[&a, &b, &c]);
        }));
        if let Err(panic) = outcome {
            let text = words(panic);
            prop_assert!(is_a_message(&text), "operation {}: {}", op, text);
        }
    }
}

/// A reduced axis in ndarray's numbering; `None` if it is out of range.
fn counted(axis: isize, x: &ArrayD<f64>) -> Option<Axis> {
    let ndim = x.ndim() as isize;
    let axis = if axis < 0 { axis + ndim } else { axis };
    (0..ndim).contains(&axis).then_some(Axis(axis as usize))
}

fn zipped(a: &ArrayD<f64>, b: &ArrayD<f64>, f: fn(f64, f64) -> f64) -> Option<ArrayD<f64>> {
    let shape = raygrad::tensor::broadcast_shape(&[a.shape(), b.shape()]);
    // The common shape is ndarray's; one of the two is broadcast.
    let sum = catch_unwind(AssertUnwindSafe(|| a + b)).ok();
    assert_eq!(shape.as_deref(), sum.as_ref().map(|sum| sum.shape()));
    let shape = sum?.raw_dim();
    let (a, b) = (a.broadcast(shape.clone())?, b.broadcast(shape)?);
    Some(ndarray::Zip::from(a).and(b).map_collect(|&a, &b| f(a, b)))
}

/// ndarray's matrix product, for each pair of a batch.
fn product(a: &ArrayD<f64>, b: &ArrayD<f64>) -> Option<ArrayD<f64>> {
    if a.ndim() != 2 || b.ndim() != 2 || a.shape()[1] != b.shape()[0] {
        return None;
    }
    let [a, b] = [a, b].map(|x| x.view().into_dimensionality::<ndarray::Ix2>().unwrap());
    Some(a.dot(&b).into_dyn())
}

/// ndarray's result of operation number `op`: `Some(None)` if it must be an error, `None` without a counterpart.
fn by_ndarray(op: usize, x: [&ArrayD<f64>; 3], [i, j, k]: [usize; 3]) -> Option<Option<ArrayD<f64>>> {
    let [a, b, c] = x;
    let (axis, extent) = (i as isize - 2, a.shape().get(i).copied());
    let reduce = |f: &dyn Fn(Axis) -> ArrayD<f64>| counted(axis, a).map(f);
    let extreme = |pick: fn(f64, f64) -> f64| {
        let axis = counted(axis, a)?;
        // An empty axis has no maximum.
        let rest: usize = a.shape().iter().enumerate().filter(|(i, _)| *i != axis.0).map(|(_, n)| n).product();
        let is_empty = a.len_of(axis) == 0 && rest > 0;
        (!is_empty).then(|| a.fold_axis(axis, f64::NAN, |&best, &x| if best.is_nan() { x } else { pick(best, x) }))
    };
    Some(match op {
        0 => zipped(a, b, |a, b| a + b),
        1 => zipped(a, b, |a, b| a * b),
        2 => zipped(a, b, |a, b| a / b),
        3 if a.ndim() == 2 && b.ndim() == 2 => product(a, b),
        9 => extent.map(|_| a.sum_axis(Axis(i)).insert_axis(Axis(i))),
        10 => reduce(&|axis| a.sum_axis(axis) / a.len_of(axis) as f64),
        11 => extreme(|best, x| if x > best { x } else { best }),
        16 => reduce(&|axis| a.fold_axis(axis, 1.0, |product, x| product * x)),
        23 => (a.ndim() == 2 && [[0, 1], [1, 0]].contains(&[i, j])).then(|| a.clone().permuted_axes(IxDyn(&[i, j]))),
        24 => (i < a.ndim() && j < a.ndim()).then(|| {
            let mut a = a.clone();
            a.swap_axes(i, j);
            a
        }),
        26 => a.to_shape(IxDyn(&[i, j])).ok().map(|y| y.to_owned()),
        27 => extent.filter(|&n| j + k <= n).map(|_| a.slice_axis(Axis(i), (j..j + k).into()).to_owned()),
        28 => extent
            .filter(|&n| j <= n && k <= n)
            .map(|_| a.slice_axis(Axis(i), Slice::new(j as isize, Some(k.max(j) as isize), 2)).to_owned()),
        29 => extent.map(|_| {
            let mut a = a.clone();
            a.invert_axis(Axis(i));
            a
        }),
        30 => extent.filter(|&n| n == 1).map(|_| a.clone().remove_axis(Axis(i))),
        31 => (i <= a.ndim()).then(|| a.clone().insert_axis(Axis(i))),
        36 => a.broadcast(IxDyn(&[i, j])).map(|y| y.to_owned()),
        38 => extent.and_then(|_| concatenate(Axis(i), &[a.view(), b.view(), c.view()]).ok()),
        39 => (i <= a.ndim()).then(|| stack(Axis(i), &[a.view(), b.view()]).ok()).flatten(),
        _ => return None,
    })
}

/// The operations of [`by_ndarray`].
const COMPARED: [usize; 19] = [0, 1, 2, 3, 9, 10, 11, 16, 23, 24, 26, 27, 28, 29, 30, 31, 36, 38, 39];

proptest! {
    #![proptest_config(ProptestConfig { cases: 6000, max_shrink_iters: 2000, ..ProptestConfig::default() })]

    #[test]
    fn shapes_and_values_equal_ndarray(
        op in prop::sample::select(&COMPARED[..]), a in shape(), b in shape(), c in shape(), alike in 0..4_usize,
        fits: bool, k in [0..5_usize, 0..5, 0..5],
    ) {
        let b = if alike >= 1 { a.clone() } else { b };
        let c = if alike >= 2 { a.clone() } else { c };
        // Matrices that fit, which random shapes rarely do.
        let (a, b) = if op == 3 && fits { (vec![k[0], k[1]], vec![k[1], k[2]]) } else { (a, b) };
        let mut value = 0.0;
        let mut tensor = |shape: &[usize]| Tensor::from_fn(shape, |_| { value += 0.37; 0.1 + value % 1.0 });
        let [a, b, c] = [&a, &b, &c].map(|shape| tensor(shape));
        let arrays = [&a, &b, &c].map(|x| x.view().to_owned());
        let expected = catch_unwind(AssertUnwindSafe(|| by_ndarray(op, arrays.each_ref(), k)));
        let Ok(Some(expected)) = expected else { return Ok(()) };
        let got = catch_unwind(AssertUnwindSafe(|| {
            let tape = Tape::<f64>::new();
            let [a, b, c] = [&a, &b, &c].map(|x| tape.leaf(x.clone()));
            tape.try_run(|| apply(op, &a, &b, &c, k)).ok().flatten().map(Var::into_value)
        }));
        match (got, expected) {
            (Ok(Some(got)), Some(expected)) => {
                prop_assert_eq!(got.shape(), expected.shape());
                for (got, expected) in got.as_slice().iter().zip(&expected) {
                    prop_assert!((got - expected).abs() <= 1e-14 * expected.abs() || got.is_nan() && expected.is_nan());
                }
            }
            (Ok(None), None) => {}
            (Ok(got), expected) => prop_assert!(false, "{:?} where ndarray has {:?}", got, expected),
            (Err(panic), expected) => prop_assert!(false, "{} where ndarray has {:?}", words(panic), expected),
        }
    }
}
