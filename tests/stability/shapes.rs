//! Tape programs on shapes that may not fit: a message that says so, or a result with gradients. No other panic.

use proptest::prelude::*;
use raygrad::autograd::{Activation, Conv2dConfig, Indices, Pool2dConfig, Segments, Tape, Tensor, Var};
use raygrad::nerf::{Composite, Contraction, PositionalEncoding, SphericalHarmonics, rotation_exp, rotation_log};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;

type V<'t> = Var<'t, f64>;

/// Operation number `op` of values and small numbers, some of them out of range.
fn apply<'t>(op: usize, a: &V<'t>, b: &V<'t>, c: &V<'t>, [i, j, k]: [usize; 3]) -> Option<V<'t>> {
    let tape = a.tape();
    let axis = i as isize - 2;
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
        9 => a.sum_axes(&[i]),
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
        23 => a.permute(&[i, j]),
        24 => a.transpose(i, j),
        25 => a.t(),
        26 => a.reshape(&[i, j]),
        27 => a.slice(i, j, k),
        28 => a.slice_step(i, j..k, 2),
        29 => a.flip(i),
        30 => a.squeeze(i),
        31 => a.unsqueeze(i),
        32 => a.roll(i, k as isize - 2),
        33 => a.repeat(i, j),
        34 => a.tile(&[i, j]),
        35 => a.pad(&[[i, j], [k, 0]], 0.5),
        36 => a.broadcast_to(&[i, j]),
        37 => a.sum_to(&[i, j]),
        38 => Var::concat(&[a, b, c], i),
        39 => Var::stack(&[a, b], i),
        40 => a.split(i, &[j, k]).pop()?,
        41 => a.gather_rows(&index),
        42 => a.scatter_rows(&index, i),
        43 => a.gather(i, &along()),
        44 => a.scatter_add(i, &along(), b),
        45 => a.index_select(i, &index),
        46 => a.index_add(i, &index, b),
        47 => a.sort(i, j % 2 == 0).0,
        48 => tape.one_hot(&indices(), k),
        49 => a.where_(b, c),
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
        64 => a.cross_entropy(&[i, j, k]),
        65 => a.mse_loss(b),
        66 => a.huber(b, 0.5),
        67 => a.conv2d_transpose(b, &conv, [i, k]),
        68 => tape.apply(Contraction, &[a]),
        69 => tape.apply(PositionalEncoding { levels: j, input: k % 2 == 0 }, &[a]),
        70 => tape.apply(SphericalHarmonics::new(i), &[a]),
        71 => rotation_exp(a),
        72 => rotation_log(a),
        73 => tape.apply(Composite::new(Tensor::ones(&[i + j]), segments()), &[&a.square(), b]),
        74 => tape.constant(Tensor::scalar(a.searchsorted(b, false).as_slice().len() as f64)),
        75 => tape.constant(Tensor::scalar(a.argmax(axis).as_slice().len() as f64)),
        76 => Var::meshgrid(&[a, b]).pop()?,
        77 => a.if_positive(b, c),
        _ => return None,
    })
}

const OPERATIONS: usize = 78;

trait Einsum {
    fn einsum_with(&self, other: &Self, which: usize) -> Self;
}

impl Einsum for V<'_> {
    fn einsum_with(&self, other: &Self, which: usize) -> Self {
        const EQUATIONS: [&str; 6] = ["ij,jk->ik", "i,i->", "ii,i->i", "...i,i->...", "ij->", "ij,jk-"];
        Var::einsum(EQUATIONS[which % 6], &[self, other])
    }
}

/// Words of panics that nobody has written for a user.
const ACCIDENTS: [&str; 14] = [
    "index out of bounds",
    "out of range for slice",
    "attempt to",
    "unwrap()",
    "overflow",
    "mid > len",
    "unreachable",
    "divide by zero",
    "divisor of zero",
    "slice index",
    "capacity",
    "range end",
    "range start",
    "must be non-zero",
];

fn shape() -> impl Strategy<Value = Vec<usize>> {
    prop::collection::vec(0..4_usize, 0..5)
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 6000, max_shrink_iters: 2000, ..ProptestConfig::default() })]

    #[test]
    fn every_operation_on_any_shapes(
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
            let Some(y) = apply(op, &a, &b, &c, k) else { return };
            let first = y.sum().grad_graph(&[&a, &b, &c]);
            let again = first.iter().fold(tape.constant(Tensor::scalar(0.0)), |sum, grad| sum + grad.square().sum());
            again.grad(&[&a, &b, &c]);
        }));
        if let Err(panic) = outcome {
            let text = panic.downcast_ref::<String>().cloned();
            let text = text.or(panic.downcast_ref::<&str>().map(|text| text.to_string())).unwrap_or_default();
            prop_assert!(!ACCIDENTS.iter().any(|words| text.contains(words)), "operation {}: {}", op, text);
        }
    }
}
