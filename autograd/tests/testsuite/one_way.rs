//! What variables share with tensors: names, axes from either end, operands of every form; and errors of the tape, at the
//! line that asked.

use raygrad_autograd::{
    Conv2dConfig, Error, Indices, Mask, Pool2dConfig, Real, Scalar, SliceInfoElem, Tape, Tensor, Var, formula, record,
    s,
};

/// An error, and that it names a line of this file.
#[track_caller]
fn refused<T: Scalar, R>(tape: &Tape<T>, f: impl FnOnce() -> R) -> Error {
    let Err(error) = tape.try_run(f) else { panic!("nothing was refused") };
    assert!(error.to_string().contains("autograd/tests/testsuite/one_way.rs:"), "{error}");
    error
}

#[test]
fn misfit_is_an_error_at_the_callers_line() {
    let tape = Tape::<f64>::new();
    let x = tape.leaf(Tensor::from_fn(&[2, 3], |i| i as f64));
    let wide = tape.leaf(Tensor::zeros(&[1 << 40, 1]));
    let whole = |step| SliceInfoElem::Slice { start: 0, end: None, step };
    refused(&tape, || x.slice(s![2]));
    refused(&tape, || x.slice([whole(0)]));
    refused(&tape, || x.slice(s![.., .., 0]));
    refused(&tape, || x.slice_axis(1, 0..4));
    refused(&tape, || x.windows(1, 2, 0));
    refused(&tape, || x.windows(1, 0, 1));
    refused(&tape, || x.windows(2, 1, 1));
    refused(&tape, || tape.leaf(Tensor::zeros(&[(1 << 33) - 1])).windows(0, 1 << 32, 1));
    refused(&tape, || x.permute(&[0, 0]));
    refused(&tape, || x.transpose(0, -3));
    refused(&tape, || x.sum().t());
    refused(&tape, || x.flip(2));
    refused(&tape, || x.squeeze(0));
    refused(&tape, || x.unsqueeze(-4));
    refused(&tape, || x.reshape(&[4, usize::MAX]));
    refused(&tape, || x.pad(&[[0, 0], [usize::MAX, 1]], 0.0));
    refused(&tape, || x.tile(&[1, usize::MAX]));
    refused(&tape, || x.repeat(0, usize::MAX));
    refused(&tape, || x.split(1, &[usize::MAX, 4]));
    refused(&tape, || x.broadcast_to(&[usize::MAX / 2, 2, 3]));
    refused(&tape, || &wide + &tape.constant(Tensor::zeros(&[1 << 40])));
    refused(&tape, || x.sum_over(2));
    refused(&tape, || x.sum_over([0, 0]));
    refused(&tape, || x.cumsum(2));
    refused(&tape, || x.softmax(2));
    refused(&tape, || x.argmax(2));
    refused(&tape, || x.sort(-3, true));
    refused(&tape, || x.searchsorted(tape.constant(Tensor::zeros(&[3, 2])), false));
    refused(&tape, || x.gather_rows(Indices::new(&[1, 1], [0])));
    refused(&tape, || x.index_select(0, [2]));
    refused(&tape, || x.index_add(0, [0], &x));
    refused(&tape, || x.scatter_add(0, Indices::new(&[1, 2], [0, 0]), &x.slice(s![..1, ..2])));
    refused(&tape, || tape.one_hot([0, 3], 3));
    refused(&tape, || x.reshape(&[1, 2, 3]).cross_entropy(Indices::new(&[2, 1], [0, 0])));
    refused(&tape, || x.cross_entropy([0]));
    refused(&tape, || x.mse_loss(0.0));
    assert!(refused(&tape, || x.huber(&x, 0.0)).to_string().contains("delta is 0; it must be above 0"));
    assert!(refused(&tape, || x.smooth_l1(&x, -1.0)).to_string().contains("beta is -1; it must be at least 0"));
    refused(&tape, || x.clamp(1.0, 0.0));
    refused(&tape, || x.gt(x.t()));
    refused(&tape, || x.where_(&Mask::new(&[2], [true, false]), 0.0));
    refused(&tape, || x.masked_select(&Mask::new(&[2], [true, false])));
    refused(&tape, || x.dot(&x));
    refused(&tape, || x.outer(&x));
    refused(&tape, || x.matmul(1.0));
    refused(&tape, || x.diag_embed(isize::MAX));
    refused(&tape, || x.sum().diagonal(0));
    refused(&tape, || x.unsqueeze(0).diag(0));
    // Sizes that wrapped to numbers that look possible.
    let half = 1 << (usize::BITS - 1);
    let (image, weight) = (tape.leaf(Tensor::zeros(&[1, 1, 4, 4])), tape.leaf(Tensor::zeros(&[1, 1, 3, 3])));
    for config in [
        Conv2dConfig { dilation: [half, 1], ..Conv2dConfig::default() },
        Conv2dConfig { dilation: [1, half], ..Conv2dConfig::default() },
        Conv2dConfig { padding: [half, 0], ..Conv2dConfig::default() },
        Conv2dConfig { padding: [1 << 32; 2], stride: [1; 2], dilation: [1; 2] },
    ] {
        refused(&tape, || image.conv2d(&weight, &config));
        refused(&tape, || image.conv2d_transpose(&weight, &config, [4, 4]));
    }
    refused(&tape, || image.max_pool2d(&Pool2dConfig { padding: [half, 0], ..Pool2dConfig::new([2, 2]) }));
    refused(&tape, || image.avg_pool2d(&Pool2dConfig { padding: [0, half], ..Pool2dConfig::new([2, 2]) }));
    let long = tape.leaf(Tensor::zeros(&[usize::MAX / 2, 0]));
    refused(&tape, || Var::concat(&[&long, &long, &long], 0));
    // Methods that are made of operations hide no line.
    refused(&tape, || Var::stack(&[&x], 9));
    refused(&tape, || Var::stack(&[&x, &x.t()], 0));
    refused(&tape, || Var::concat(&[&x, &x.t()], -1));
    refused(&tape, || Var::meshgrid(&[&x]));
    refused(&tape, || Var::einsum("ij,ij,ij->", &[&x, &x, &x]));
    refused(&tape, || Var::einsum("ijk->", &[&x]));
}

#[test]
fn clamp_limits_out_of_order_are_refused() {
    let tape = Tape::<f64>::new();
    let a = Tensor::from([0.0, 2.0]);
    let x = tape.leaf(a.clone());
    for [low, high] in [[3.0, 1.0], [f64::NAN, 1.0], [0.0, f64::NAN], [f64::INFINITY, f64::NEG_INFINITY]] {
        refused(&tape, || x.clamp(low, high));
        let alone = std::panic::catch_unwind(|| a.clamp(low, high));
        let message = *alone.expect_err("nothing was refused").downcast::<String>().unwrap();
        assert_eq!(message, format!("clamp: no number is between {low} and {high}"));
    }
    for [low, high] in [[1.0, 1.0], [0.5, 1.5], [f64::NEG_INFINITY, 1.0], [-0.0, 0.0]] {
        assert_eq!(x.clamp(low, high).value(), &a.clamp(low, high));
    }
}

#[test]
fn composed_method_nodes_have_callers_line() {
    let tape = Tape::<f32>::new();
    tape.check_finite(true);
    let x = tape.leaf(Tensor::full(&[2, 2], f32::MAX));
    let is_here = |error: Error| assert!(matches!(error, Error::NonFinite { .. }), "{error}");
    is_here(refused(&tape, || x.cumsum(0)));
    is_here(refused(&tape, || Var::einsum("ij,jk->ik", &[&x, &x])));
    is_here(refused(&tape, || record([&x], |[x]| [x + x])));
    is_here(refused(&tape, || formula!(|x| x + x).on([&x])));
}

#[test]
fn axes_count_from_either_end_as_those_of_tensors_do() {
    let tape = Tape::<f64>::new();
    let a = Tensor::from_fn(&[2, 3, 4], |i| ((i * 7) % 11) as f64);
    let x = tape.leaf(a.clone());
    for axis in 0..3_isize {
        let back = axis - 3;
        let same = |x: Var<'_, f64>, y: Var<'_, f64>, tensor: Option<Tensor<f64>>| {
            assert_eq!(x.value(), y.value());
            assert!(tensor.is_none_or(|tensor| &tensor == x.value()));
        };
        same(x.flip(axis), x.flip(back), Some(a.flip(back)));
        same(x.slice_axis(axis, 1..2), x.slice_axis(back, 1..2), Some(a.slice_axis(back, 1..2)));
        same(x.windows(axis, 2, 1), x.windows(back, 2, 1), Some(a.windows(back, 2, 1)));
        same(x.unsqueeze(axis).squeeze(back - 1), x.unsqueeze(back - 1).squeeze(axis), Some(a.clone()));
        same(x.roll(axis, 1), x.roll(back, 1), Some(a.roll(back, 1)));
        same(x.repeat(axis, 2), x.repeat(back, 2), Some(a.repeat(back, 2)));
        same(x.cumsum(axis), x.cumsum(back), None);
        same(x.sort(axis, false).0, x.sort(back, false).0, None);
        same(x.sum_over(axis), x.sum_over(back), Some(a.sum_over(back)));
        same(x.max_over(axis), x.max_over(back), Some(a.max_over(axis)));
        same(x.index_select(axis, [1, 0]), x.index_select(back, [1, 0]), Some(a.take(back, [1, 0])));
        same(Var::concat(&[&x, &x], axis), Var::concat(&[&x, &x], back), Some(Tensor::concat(&[&a, &a], back)));
        same(Var::stack(&[&x, &x], axis), Var::stack(&[&x, &x], back - 1), Some(Tensor::stack(&[&a, &a], back - 1)));
        same(x.transpose(axis, -1), x.transpose(back, 2), Some(a.transpose(back, 2)));
        let (first, second) =
            (x.split(axis, &[1, a.shape()[axis as usize] - 1]), x.split(back, &[1, a.shape()[axis as usize] - 1]));
        let parts = a.split(back, &[1, a.shape()[axis as usize] - 1]);
        same(first[1].clone(), second[1].clone(), Some(parts[1].clone()));
    }
    assert_eq!(x.permute(&[-1, 0, 1]).value(), &a.permute(&[2, 0, 1]));
    assert_eq!(x.slice(s![-1, .., ..;-2]).value(), &a.slice(s![1, .., ..;-2]));
    // Each element counts as often as windows show it.
    let y = tape.leaf(Tensor::from([1.0, 2.0, 3.0, 4.0, 5.0]));
    let weights = Tensor::from([[1.0, 10.0, 100.0], [2.0, 20.0, 200.0]]);
    let grad = (y.windows(0, 3, 2) * weights).sum().grad(&[&y]).remove(0);
    assert_eq!(grad, Tensor::from([1.0, 10.0, 102.0, 20.0, 200.0]));
}

#[test]
fn numbers_and_tensors_are_constants() {
    let tape = Tape::<f64>::new();
    let a = Tensor::from([2.0, -4.0]);
    let x = tape.leaf(a.clone());
    let grad = |y: Var<'_, f64>| y.sum().grad(&[&x]).remove(0);
    assert_eq!(grad(0.5 / &x), Tensor::from([-0.125, -0.03125]));
    assert_eq!(grad(&x / 4.0_f32), Tensor::from([0.25, 0.25]));
    assert_eq!(grad(1.0 - &x * 3), Tensor::from([-3.0, -3.0]));
    assert_eq!(grad(&x * &a - x.maximum(0.0)), Tensor::from([1.0, -4.0]));
    assert_eq!(grad(x.matmul(&a) + x.dot(&a)), Tensor::from([4.0, -8.0]));
    assert_eq!(grad(x.lerp(&a, 0.25)), Tensor::from([0.75, 0.75]));
    assert_eq!(grad(x.if_positive(&x, 0.0)), Tensor::from([1.0, 0.0]));
    assert_eq!(grad(x.pow(2.0)), Tensor::from([4.0, -8.0]));
    // A product with a number changes no sign of zero.
    let zero = tape.leaf(Tensor::from([0.0, -0.0]));
    let signs = |y: Var<'_, f64>| [0, 1].map(|i| y.value()[[i]].is_sign_negative());
    assert_eq!([signs(&zero * 2.0), signs(-&zero), signs(&zero * -1.0)], [[false, true], [true, false], [true, false]]);
}

#[test]
fn triangles_beyond_the_corners_are_all_or_nothing() {
    let tape = Tape::<f32>::new();
    let x = tape.leaf(Tensor::from([[1.0, 2.0], [3.0, 4.0]]));
    assert_eq!(x.tril(isize::MAX).value(), x.value());
    assert_eq!(x.triu(isize::MIN).value(), x.value());
    assert_eq!(x.tril(isize::MIN).sum().item() + x.triu(isize::MAX).sum().item(), 0.0);
}

#[test]
fn classes_come_in_a_list_or_in_the_shape_of_the_rows() {
    let tape = Tape::<f64>::new();
    let x = tape.leaf(Tensor::from_fn(&[2, 3, 4], |i| (i as f64).sin()));
    let list = x.cross_entropy([0, 1, 2, 3, 0, 1]);
    assert_eq!(list.value(), x.cross_entropy(Indices::new(&[2, 3], [0, 1, 2, 3, 0, 1])).value());
    let expected = -x.log_softmax(-1).gather(-1, Indices::new(&[2, 3, 1], [0, 1, 2, 3, 0, 1])).squeeze(-1);
    assert!(list.value().allclose(expected.value(), 1e-14, 0.0));
    let sorted = tape.leaf(Tensor::from([1.0, 2.0, 2.0, 3.0]));
    let found = [false, true].map(|right| sorted.searchsorted(2.0, right).as_slice()[0]);
    assert_eq!(found, [1, 3]);
}

#[test]
fn angle_gradients_any_size_are_right() {
    // The quick reduction does not reach them.
    for angle in [1e9_f64, 1e30, -3e22] {
        let tape = Tape::<f64>::new();
        let x = tape.leaf(Tensor::full(&[5000], angle).packed());
        let expected = [Real::cos(angle), -Real::sin(angle)];
        for (y, expected) in [(x.sin(), expected[0]), (x.cos(), expected[1])] {
            assert_eq!(y.sum().grad(&[&x])[0][[4999]], expected);
        }
        let y = formula!(|x| x.sin() * 2.0).on([&x]);
        assert_eq!(y.sum().grad(&[&x])[0][[4999]], 2.0 * expected[0]);
    }
}
