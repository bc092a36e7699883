//! Catalogue entries of operations on whole arrays: shape, indexing, linear algebra, convolution.

use super::Entry;
use super::spread;
use crate::ops::gradient_op::GradientOp;
use crate::ops::pick::{ELEMENTS, ENTRIES, PIXELS, Pick, Places, Put, ROWS};
use crate::ops::{Conv2dConfig, Pool2dConfig, convolution, matmul, matrix, pooling, shape, vector};
use crate::{INFER, Slice};
use crate::{Indices, Var};
use raygrad_tensor::{Layout, Shape};

/// A function made of operations, written once for both precisions.
macro_rules! function {
    ($name:literal, |$x:ident| $y:expr) => {
        Entry::function($name, |$x| $y, |$x| $y)
    };
}

/// The operations on whole arrays, and the functions made of them.
pub(crate) fn entries() -> Vec<Entry> {
    let mut entries = shapes();
    entries.extend(indexing());
    entries.extend(algebra());
    entries.extend(images());
    entries
}

fn shapes() -> Vec<Entry> {
    let view = |from: &[usize], layout: fn(Layout) -> Layout| shape::View {
        from: Shape::from_slice(from),
        layout: layout(Layout::contiguous(from)),
    };
    let pad = |value| shape::Pad { view: view(&[4, 5], |layout| layout.sliced(0, 1, 2, 1)), value };
    let triangle = |upper, diagonal| Entry::new(matrix::Triangle { upper, diagonal }).linear();
    vec![
        Entry::new(view(&[2, 3, 4], |layout| layout.permuted(&[2, 0, 1]))).linear().sample(&[&[2, 3, 4]]),
        Entry::new(view(&[4, 5], |layout| layout.sliced(1, 4, 2, -3))).linear().sample(&[&[4, 5]]),
        Entry::new(shape::Scatter(view(&[4, 5], |layout| layout.sliced(1, 1, 3, 1)))).linear().sample(&[&[4, 3]]),
        Entry::new(view(&[3, 4], |layout| layout.diagonal(0, 1, 1))).linear().sample(&[&[3, 4]]),
        function!("windows", |x| x[0].windows(0, 3, 2)).linear().sample(&[&[7]]).sample(&[&[4, 2]]),
        Entry::new(shape::Scatter(view(&[3, 2, 4], |layout| layout.diagonal(0, 2, -1)))).linear().sample(&[&[2, 2]]),
        Entry::new(pad(0.0)).linear().sample(&[&[2, 5]]),
        Entry::new(pad(-1.5)).sample(&[&[2, 5]]),
        triangle(true, 1).sample(&[&[3, 4]]).sample(&[&[2, 4, 2]]).sample(&[&[0, 3]]).sample(&[&[3, 0]]),
        triangle(false, -1).sample(&[&[3, 4]]).sample(&[&[1, 1]]),
        function!("reshape", |x| x[0].reshape(&[INFER, 2])).linear().sample(&[&[2, 3]]).sample(&[&[0]]).sample(&[&[2]]),
        function!("transpose", |x| x[0].transpose(0, 2)).linear().sample(&[&[2, 3, 4]]).sample(&[&[2, 0, 1]]),
        function!("squeeze", |x| x[0].squeeze(1).unsqueeze(0)).linear().sample(&[&[2, 1, 3]]).sample(&[&[0, 1]]),
        function!("slice_step", |x| x[0].slice_axis(0, Slice::from(1..6).step_by(-2)))
            .linear()
            .sample(&[&[7]])
            .sample(&[&[6, 2]]),
        function!("stack", |x| Var::stack(&[&x[0], &x[1], &x[0]], 0))
            .linear()
            .sample(&[&[], &[]])
            .sample(&[&[0], &[0]]),
        function!("stack", |x| Var::stack(&[&x[0], &x[1]], 1))
            .linear()
            .sample(&[&[2, 3], &[2, 3]])
            .sample(&[&[4], &[4]]),
        function!("split", |x| {
            let parts = x[0].split(1, &[2, 0, 1]);
            parts[0].square() * &parts[2] + parts[1].sum()
        })
        .sample(&[&[2, 3]])
        .sample(&[&[0, 3]]),
        function!("pad", |x| x[0].pad(&[[1, 2], [0, 1]], 0.5)).sample(&[&[2, 3]]).sample(&[&[0, 1]]),
        function!("expand", |x| x[0].broadcast_to(&[2, 3])).linear().sample(&[&[]]).sample(&[&[3]]).sample(&[&[2, 1]]),
        function!("tile", |x| x[0].tile(&[2, 1, 3])).linear().sample(&[&[2, 2]]).sample(&[&[]]).sample(&[&[1, 0, 2]]),
        function!("repeat", |x| x[0].repeat(0, 3)).linear().sample(&[&[2]]).sample(&[&[2, 2]]).sample(&[&[0, 2]]),
        function!("flip", |x| x[0].flip(0)).linear().sample(&[&[3]]).sample(&[&[2, 3]]).sample(&[&[0, 2]]),
        function!("roll", |x| x[0].roll(0, -2)).linear().sample(&[&[5]]).sample(&[&[3, 2]]).sample(&[&[0]]),
        function!("diag", |x| x[0].diag(-1))
            .linear()
            .sample(&[&[3]])
            .sample(&[&[3, 4]])
            .sample(&[&[0]])
            .sample(&[&[0, 2]]),
        function!("meshgrid", |x| {
            let grids = Var::meshgrid(&[&x[0], &x[1]]);
            &grids[0] * grids[1].square()
        })
        .sample(&[&[2], &[3]])
        .sample(&[&[0], &[3]]),
    ]
}

fn indexing() -> Vec<Entry> {
    let entries = |index: &[u32]| Places::Entries(index.into());
    let elements = |shape: &[usize], index: &[u32]| Places::Elements(Indices::new(shape, index));
    let pick = |method, axis, places| Entry::new(Pick { method, axis, places }).linear();
    let put = |method, axis, places, extent| Entry::new(Put { pick: Pick { method, axis, places }, extent }).linear();
    let pixels = elements(&[2, 3], &[3, 0, 3, 5, 1, 2]);
    vec![
        pick(ROWS, 0, entries(&[2, 0, 2, 3])).sample(&[&[4]]).sample(&[&[5, 3]]),
        pick(ROWS, 0, entries(&[])).sample(&[&[4]]).sample(&[&[0, 3]]),
        put(ROWS, 0, entries(&[2, 0, 2]), 4).sample(&[&[3]]).sample(&[&[3, 2]]),
        pick(ELEMENTS, 0, elements(&[4], &[2, 0, 2, 1])).sample(&[&[3]]),
        pick(ELEMENTS, 1, elements(&[2, 2, 2], &[0, 2, 2, 1, 1, 1, 0, 2])).sample(&[&[2, 3, 2]]),
        pick(ELEMENTS, 1, elements(&[2, 0], &[])).sample(&[&[2, 3]]).sample(&[&[2, 0]]),
        put(ELEMENTS, 0, elements(&[4], &[2, 0, 2, 1]), 5).sample(&[&[4]]),
        put(ELEMENTS, 1, elements(&[2, 2, 2], &[0, 2, 2, 1, 1, 1, 0, 2]), 3).sample(&[&[2, 2, 2]]),
        put(ELEMENTS, 0, elements(&[0, 2], &[]), 3).sample(&[&[0, 2]]),
        pick(PIXELS, 1, pixels.clone()).sample(&[&[2, 6]]),
        put(PIXELS, 1, pixels, 6).sample(&[&[2, 3]]),
        pick(ENTRIES, 1, entries(&[2, 0, 2])).sample(&[&[2, 3]]).sample(&[&[2, 3, 2]]).sample(&[&[0, 4]]),
        pick(ENTRIES, 0, entries(&[])).sample(&[&[3]]).sample(&[&[0, 2]]),
        put(ENTRIES, 1, entries(&[2, 0, 2]), 4).sample(&[&[2, 3]]).sample(&[&[2, 3, 2]]),
        put(ENTRIES, 0, entries(&[]), 2).sample(&[&[0]]).sample(&[&[0, 3]]),
        function!("scatter_add", |x| x[0].scatter_add(0, Indices::new(&[3, 2], [1, 0, 1, 1, 0, 0]), &x[1]))
            .linear()
            .sample(&[&[2, 2], &[3, 2]]),
        function!("index_add", |x| x[0].index_add(1, [1, 1], &x[1])).linear().sample(&[&[2, 3], &[2, 2]]),
        function!("sort", |x| x[0].sort(0, false).0).sample(&[&[7]]).sample(&[&[4, 3]]).sample(&[&[0]]),
        function!("sort_descending", |x| x[0].sort(1, true).0).sample(&[&[2, 5]]).sample(&[&[3, 1, 2]]),
    ]
}

fn algebra() -> Vec<Entry> {
    let row = |x: &[f64]| raygrad_tensor::Tensor::from_vec(&[x.len()], x.to_vec());
    vec![
        Entry::new(matmul::Matmul)
            .sample(&[&[2, 3, 4], &[2, 4, 2]])
            .sample(&[&[2, 1, 2, 3], &[3, 3, 1]])
            .sample(&[&[0, 2, 3], &[1, 3, 2]]),
        function!("matmul_left_transposed", |x| x[0].t().matmul(&x[1]))
            .sample(&[&[2, 4, 3], &[4, 2]])
            .sample(&[&[4, 3], &[2, 4, 2]])
            .sample(&[&[4, 3], &[4, 2]]),
        function!("matmul_right_transposed", |x| x[0].matmul(x[1].t()))
            .sample(&[&[1, 3, 4], &[2, 2, 4]])
            .sample(&[&[0, 2, 3], &[1, 2, 3]])
            .sample(&[&[3, 4], &[2, 4]]),
        function!("matmul_both_transposed", |x| x[0].t().matmul(x[1].t()))
            .sample(&[&[2, 4, 3], &[2, 2, 4]])
            .sample(&[&[2, 0, 3], &[2, 2, 0]])
            .sample(&[&[4, 3], &[2, 4]]),
        function!("matmul", |x| x[0].matmul(&x[1]))
            .sample(&[&[3], &[3]])
            .sample(&[&[3], &[3, 2]])
            .sample(&[&[2, 3], &[3]])
            .sample(&[&[2, 2, 3], &[3]])
            .sample(&[&[3], &[2, 3, 2]])
            .sample(&[&[2, 2, 3], &[3, 2]])
            .sample(&[&[0], &[0]]),
        function!("dot", |x| x[0].dot(&x[1])).sample(&[&[4], &[4]]).sample(&[&[0], &[0]]),
        function!("outer", |x| x[0].outer(&x[1])).sample(&[&[3], &[2]]).sample(&[&[0], &[2]]),
        function!("einsum", |x| Var::einsum("bij,bjk->bik", &[&x[0], &x[1]])).sample(&[&[2, 3, 2], &[2, 2, 3]]),
        function!("einsum_diagonal", |x| Var::einsum("iji,kj->k", &[&x[0], &x[1]])).sample(&[&[2, 3, 2], &[2, 3]]),
        Entry::new(vector::Cross).sample(&[&[3], &[3]]).sample(&[&[2, 1, 3], &[4, 3]]).sample(&[&[0, 3], &[3]]),
        Entry::new(vector::Normalize)
            .sample_of(vec![row(&[0.8, -0.6, 1.1])])
            .sample_of(vec![spread(&[2, 40], &[0.3..1.0, -1.0..-0.3], 1)])
            .sample(&[&[0, 3]])
            .sample(&[&[2, 0]])
            .sample_of(vec![row(&[-0.7])]),
        Entry::new(GradientOp { op: vector::Normalize, input: 0 })
            .sample_of(vec![row(&[0.8, -0.6, 1.1]), row(&[-0.3, 0.7, 0.2])])
            .sample(&[&[0, 3], &[0, 3]]),
    ]
}

fn images() -> Vec<Entry> {
    let plain = Conv2dConfig::default();
    let uneven = Conv2dConfig { stride: [2, 1], padding: [1, 2], dilation: [1, 2] };
    let pool = Pool2dConfig { kernel: [3, 2], stride: [2, 1], padding: [1, 0] };
    vec![
        Entry::new(convolution::Conv2d(plain))
            .sample(&[&[2, 2, 3, 4], &[3, 2, 2, 2]])
            .sample(&[&[2, 2, 2, 2], &[3, 2, 1, 1], &[3]])
            .sample(&[&[0, 2, 3, 3], &[1, 2, 2, 2], &[1]])
            .sample(&[&[1, 0, 3, 3], &[2, 0, 2, 2], &[2]]),
        Entry::new(convolution::Conv2d(uneven))
            .sample(&[&[2, 1, 4, 3], &[2, 1, 3, 2], &[2]])
            .sample(&[&[18, 1, 1, 1], &[1, 1, 2, 2]]),
        Entry::new(convolution::Conv2dInput { config: plain, image: [3, 4] })
            .sample(&[&[2, 3, 2, 3], &[3, 2, 2, 2]])
            .sample(&[&[2, 2, 3, 4], &[2, 3, 1, 1]]),
        Entry::new(convolution::Conv2dInput { config: uneven, image: [4, 3] }).sample(&[&[1, 2, 2, 5], &[2, 1, 3, 2]]),
        Entry::new(convolution::Conv2dWeight { config: plain, kernel: [2, 2] })
            .sample(&[&[2, 2, 3, 3], &[2, 1, 2, 2]])
            .sample(&[&[0, 2, 3, 3], &[0, 1, 2, 2]])
            .sample(&[&[18, 1, 2, 2], &[18, 1, 1, 1]]),
        Entry::new(convolution::Conv2dWeight { config: uneven, kernel: [3, 2] })
            .sample(&[&[1, 1, 4, 3], &[1, 2, 2, 5]]),
        Entry::new(pooling::MaxPool2d(Pool2dConfig::new([2, 2]))).sample(&[&[1, 2, 4, 5]]).sample(&[&[0, 1, 2, 2]]),
        Entry::new(pooling::MaxPool2d(pool)).sample(&[&[2, 1, 5, 4]]),
        Entry::new(pooling::AvgPool2d(pool)).linear().sample(&[&[2, 1, 5, 4]]).sample(&[&[1, 0, 3, 2]]),
        Entry::new(pooling::AvgPool2dInput { config: pool, image: [5, 4] }).linear().sample(&[&[1, 2, 3, 3]]),
        function!("conv2d_transpose", |x| {
            x[0].conv2d_transpose(&x[1], &Conv2dConfig { stride: [2, 2], ..Default::default() }, [5, 6])
        })
        .sample(&[&[1, 2, 2, 2], &[2, 1, 3, 3]]),
    ]
}
