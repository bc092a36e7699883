//! Reductions and scans over every set of axes, against plain loops and finite differences, down to no elements and no
//! axes.

use raygrad_autograd::check::{Check, check_function};
use raygrad_autograd::{Axes, Scalar, Tape, Tensor, Var};

type Reduce = for<'t> fn(&Var<'t, f64>, Axes) -> Var<'t, f64>;
type Plain = fn(&[f64]) -> f64;

fn variance(x: &[f64], correction: f64) -> f64 {
    let mean = x.iter().sum::<f64>() / x.len() as f64;
    x.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / (x.len() as f64 - correction).max(0.0)
}

const REDUCTIONS: [(&str, Reduce, Plain); 10] = [
    ("sum", |x, axes| x.sum_over(axes), |x| x.iter().sum()),
    ("mean", |x, axes| x.mean_over(axes), |x| x.iter().sum::<f64>() / x.len() as f64),
    ("var", |x, axes| x.var_over(axes, 1), |x| variance(x, 1.0)),
    ("std", |x, axes| x.std_over(axes, 0), |x| variance(x, 0.0).sqrt()),
    ("max", |x, axes| x.max_over(axes), |x| x.iter().copied().fold(f64::NEG_INFINITY, f64::max)),
    ("min", |x, axes| x.min_over(axes), |x| x.iter().copied().fold(f64::INFINITY, f64::min)),
    ("prod", |x, axes| x.prod_over(axes), |x| x.iter().product()),
    ("logsumexp", |x, axes| x.logsumexp_over(axes), |x| x.iter().map(|x| x.exp()).sum::<f64>().ln()),
    ("norm", |x, axes| x.norm_over(axes), |x| x.iter().map(|x| x * x).sum::<f64>().sqrt()),
    ("norm_l1", |x, axes| x.norm_l1_over(axes), |x| x.iter().map(|x| x.abs()).sum()),
];

/// Values without ties or a pattern, none of them near 0.
fn values(shape: &[usize]) -> Tensor<f64> {
    Tensor::from_fn(shape, |i| ((i as f64 + 1.0) * 0.618_033_988_749_895).fract() * 1.8 - 0.8)
}

/// For each element of the result, those of `x` that go into it.
fn groups(x: &Tensor<f64>, reduced: &[bool]) -> Vec<Vec<f64>> {
    let extents: Vec<usize> =
        x.shape().iter().zip(reduced).map(|(&extent, &reduced)| if reduced { 1 } else { extent }).collect();
    let mut groups = vec![vec![]; extents.iter().product()];
    for (i, &value) in x.as_slice().iter().enumerate() {
        let (mut rest, mut to, mut stride) = (i, 0, 1);
        for axis in (0..extents.len()).rev() {
            to += if reduced[axis] { 0 } else { rest % x.shape()[axis] * stride };
            stride *= extents[axis];
            rest /= x.shape()[axis];
        }
        groups[to].push(value);
    }
    groups
}

#[test]
fn reductions_any_axes_agree_with_loops() {
    for shape in [&[2, 3, 4][..], &[3, 1, 2], &[5], &[], &[0, 3], &[2, 0, 2], &[40, 3]] {
        let x = values(shape);
        for mask in 0..1 << shape.len() {
            let reduced: Vec<bool> = (0..shape.len()).map(|axis| mask >> axis & 1 == 1).collect();
            let groups = groups(&x, &reduced);
            // Alternately from the start and from the end.
            let number = |axis: usize| {
                if axis.is_multiple_of(2) { axis as isize } else { axis as isize - shape.len() as isize }
            };
            let axes: Vec<isize> = (0..shape.len()).filter(|&axis| reduced[axis]).map(number).collect();
            for (name, reduce, plain) in REDUCTIONS {
                let no_elements = groups.iter().any(Vec::is_empty);
                if no_elements && (name == "max" || name == "min") {
                    continue;
                }
                let tape = Tape::new();
                let leaf = tape.leaf(x.clone());
                let y = reduce(&leaf, Axes::from(&axes[..]));
                let kept = reduce(&leaf, Axes::from(&axes[..]).keepdims());
                let stay: Vec<usize> =
                    (0..shape.len()).filter(|&axis| !reduced[axis]).map(|axis| shape[axis]).collect();
                let ones: Vec<usize> =
                    (0..shape.len()).map(|axis| if reduced[axis] { 1 } else { shape[axis] }).collect();
                let context = format!("{name} of {shape:?} over {axes:?}");
                assert_eq!((y.shape(), kept.shape()), (&stay[..], &ones[..]), "{context}");
                for (got, group) in y.value().as_slice().iter().zip(&groups) {
                    let expected = plain(group);
                    let close = (got - expected).abs() <= 1e-13 * expected.abs().max(1.0) || *got == expected;
                    assert!(close || got.is_nan() && expected.is_nan(), "{context}: {got} for {expected}");
                }
                // Gradients exist, have the right shape, and can be differentiated.
                let grad = y.sum().grad_graph(&[&leaf]).remove(0);
                assert_eq!(grad.shape(), shape, "{context}");
                assert_eq!(grad.sum().grad(&[&leaf])[0].shape(), shape, "{context}");
            }
        }
    }
}

#[test]
fn derivatives_of_reductions_agree_with_differences() {
    for (name, reduce, _) in REDUCTIONS {
        for axes in [&[0][..], &[1], &[-1], &[0, 2], &[0, 1], &[-1, -2], &[0, 1, 2]] {
            let result = check_function(&Check::default(), &[values(&[2, 3, 2])], |x| reduce(&x[0], Axes::from(axes)));
            assert!(result.is_ok(), "{name} over {axes:?}: {result:?}");
        }
    }
}

type Scan = for<'t> fn(&Var<'t, f64>, isize) -> Var<'t, f64>;
type Lines = fn(&[f64]) -> Vec<f64>;

/// Operations that keep the shape, with what they make of one line.
const SCANS: [(&str, Scan, Lines); 5] = [
    ("cumsum", |x, axis| x.cumsum(axis), |x| (1..=x.len()).map(|n| x[..n].iter().sum()).collect()),
    ("reverse_cumsum", |x, axis| x.reverse_cumsum(axis), |x| (0..x.len()).map(|n| x[n..].iter().sum()).collect()),
    ("cumprod", |x, axis| x.cumprod(axis), |x| (1..=x.len()).map(|n| x[..n].iter().product()).collect()),
    (
        "softmax",
        |x, axis| x.softmax(axis),
        |x| {
            let sum: f64 = x.iter().map(|x| x.exp()).sum();
            x.iter().map(|x| x.exp() / sum).collect()
        },
    ),
    (
        "log_softmax",
        |x, axis| x.log_softmax(axis),
        |x| {
            let sum: f64 = x.iter().map(|x| x.exp()).sum();
            x.iter().map(|x| x - sum.ln()).collect()
        },
    ),
];

#[test]
fn scans_any_axis_agree_with_loops() {
    for shape in [&[2, 3, 4][..], &[5], &[], &[0, 3], &[2, 0]] {
        let x = values(shape);
        for axis in 0..shape.len().max(1) {
            let reduced: Vec<bool> = (0..shape.len()).map(|other| other == axis).collect();
            for (name, scan, plain) in SCANS {
                let context = format!("{name} of {shape:?} along {axis}");
                let tape = Tape::new();
                let leaf = tape.leaf(x.clone());
                let y = scan(&leaf, axis as isize);
                assert_eq!(y.shape(), shape, "{context}");
                let from_end = scan(&leaf, axis as isize - shape.len().max(1) as isize);
                assert_eq!(y.value(), from_end.value(), "{context}");
                // The lines of x, scanned, are the lines of y.
                for (x, y) in groups(&x, &reduced).iter().zip(groups(y.value(), &reduced)) {
                    for (got, expected) in y.iter().zip(plain(x)) {
                        assert!((got - expected).abs() < 1e-14, "{context}: {got} for {expected}");
                    }
                }
                let result =
                    check_function(&Check::default(), std::slice::from_ref(&x), |x| scan(&x[0], axis as isize));
                assert!(result.is_ok(), "{context}: {result:?}");
            }
        }
    }
}

#[test]
fn a_recurrence_is_what_its_definition_says() {
    let tape = Tape::<f64>::new();
    let (a, b) = (tape.leaf(Tensor::full(&[4, 2], 0.5)), tape.leaf(Tensor::ones(&[4, 2])));
    let y = a.recurrence(&b, 0);
    assert_eq!(y.value().as_slice(), [1.0, 1.0, 1.5, 1.5, 1.75, 1.75, 1.875, 1.875]);
    // The first factor meets a 0.
    assert_eq!(y.sum().grad(&[&a])[0].as_slice()[..2], [0.0, 0.0]);
}

/// Value and gradient, unrecorded and recorded, of variance, deviation and layer normalisation along the first or the
/// last axis.
fn of_moments<T: Scalar>(x: &Tensor<f64>, first: bool) -> Vec<(String, Tensor<f64>)> {
    let tape = Tape::<T>::new();
    let x = tape.leaf(x.cast());
    let rows = if first { x.t() } else { x.clone() };
    let n = rows.shape()[1];
    let weights = tape.constant(Tensor::from_fn(&[n], |i| T::from_f64((i as f64 * 0.7).sin())));
    let (gain, bias) = (tape.constant(Tensor::ones(&[n])), tape.constant(Tensor::zeros(&[n])));
    let axis = if first { 0 } else { 1 };
    let results = [
        ("var", x.var_over(axis, 1)),
        ("std", x.std_over(axis, 0)),
        ("layer_norm", rows.layer_norm(&gain, &bias, 1e-5) * weights),
    ];
    let each = |(name, y): (&str, Var<'_, T>)| {
        let sum = y.sum();
        let grads = [sum.grad(&[&x]).remove(0), sum.grad_graph(&[&x]).remove(0).into_value()];
        let [grad, recorded] = grads.map(|grad| grad.cast());
        let what = |part: &str| format!("{part} of {name} in {} along axis {axis}", T::NAME);
        [(what("value"), y.value().cast()), (what("gradient"), grad), (what("recorded gradient"), recorded)]
    };
    results.into_iter().flat_map(each).collect()
}

#[test]
fn moments_of_numbers_far_from_zero_keep_their_digits() {
    // Exact in f32, as is nothing of their mean.
    let x = Tensor::<f64>::from_fn(&[37, 41], |i| 30_000.0 + ((i * 7919) % 1013) as f64 / 512.0);
    for first in [false, true] {
        for ((what, got), (_, expected)) in of_moments::<f32>(&x, first).iter().zip(of_moments::<f64>(&x, first)) {
            assert_eq!(got.shape(), expected.shape());
            let apart =
                got.as_slice().iter().zip(expected.as_slice()).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt();
            let norm = expected.as_slice().iter().map(|b| b * b).sum::<f64>().sqrt();
            assert!(apart <= 1e-6 * norm, "{what}: {apart:e} of {norm:e} apart");
        }
    }
}

#[test]
fn deviations_of_equal_numbers_are_zero() {
    fn check<T: Scalar>() {
        let tape = Tape::<T>::new();
        for n in 1..100 {
            for value in [0.1, 0.3, 0.7, 0.9, 1.1, 3.3, -7.7, 1e10 / 3.0, 1e-10 / 3.0] {
                let x = tape.leaf(Tensor::full(&[n, 3], T::from_f64(value)));
                for (x, axis) in [(x.clone(), 0), (x.t(), 1)] {
                    let y = x.std_over(axis, 0);
                    let grad = y.sum().grad(&[&x]).remove(0);
                    // The rounding of the mean leaves the root of its own rounding.
                    let within = |x: &Tensor<T>, most: f64| x.as_slice().iter().all(|x| x.to_f64().abs() <= most);
                    let what = format!("{n} times {value} in {} along axis {axis}", T::NAME);
                    let digits = 8.0 * T::EPSILON.sqrt();
                    assert!(within(y.value(), digits * T::EPSILON * value.abs()), "{what}: {:?}", y.value());
                    assert!(within(&grad, digits), "gradient of {what}: {grad:?}");
                }
            }
        }
    }
    check::<f32>();
    check::<f64>();
}

/// The product of `x` and its gradient, recorded and not, against exact values to a few roundings.
fn product_is<T: Scalar>(x: &[f64], value: f64, gradient: &[f64]) {
    let tape = Tape::<T>::new();
    let leaf = tape.leaf(Tensor::from_fn(&[x.len()], |i| T::from_f64(x[i])));
    let y = leaf.prod();
    let found = [y.grad(&[&leaf]).remove(0), y.grad_graph(&[&leaf]).remove(0).into_value()];
    let check = |what: &str, got: T, expected: f64| {
        let (got, expected) = (got.to_f64(), T::from_f64(expected).to_f64());
        let close = (got - expected).abs() <= 8.0 * T::EPSILON * expected.abs();
        let same = got == expected || close || got.is_nan() && expected.is_nan();
        assert!(same, "{what} of the product of {x:?} in {}: {got:e} for {expected:e}", T::NAME);
    };
    check("value", y.item(), value);
    for (what, found) in ["gradient", "recorded gradient"].into_iter().zip(found) {
        found.as_slice().iter().zip(gradient).for_each(|(&got, &expected)| check(what, got, expected));
        assert_eq!(found.len(), gradient.len());
    }
}

#[test]
fn products_do_not_overflow_or_vanish_on_the_way() {
    // The powers of ten that overflow or vanish are those of f64 alone; the others those of f32 too.
    product_is::<f64>(&[1e-200, 1e-200, 1e300], 1e-100, &[1e100, 1e100, 0.0]);
    product_is::<f64>(&[1e-200, 1e-200, 1e300, 1e100], 1.0, &[1e200, 1e200, 1e-300, 1e-100]);
    product_is::<f64>(&[1e200, -1e200, 1e-300, 0.0], 0.0, &[-0.0, 0.0, -0.0, -1e100]);
    product_is::<f64>(&[1e300, 1e300, 1e-300, -1e-300], -1.0, &[-1e-300, -1e-300, -1e300, 1e300]);
    product_is::<f64>(
        &[2.0_f64.powi(-1000), 2.0_f64.powi(900), 2.0_f64.powi(1000)],
        2.0_f64.powi(900),
        &[f64::INFINITY, 1.0, 2.0_f64.powi(-100)],
    );
    product_is::<f32>(&[1e-30, 1e-30, 1e38], 1e-22, &[1e8, 1e8, 0.0]);
    product_is::<f32>(&[1e-30, 1e-30, 1e30, 1e20, 1e10], 1.0, &[1e30, 1e30, 1e-30, 1e-20, 1e-10]);
    // Long runs of one size, that only the others take back.
    let side = |i: usize, large: f64, small: f64| if i < 1000 { large } else { small };
    let x: Vec<f64> = (0..2000).map(|i| side(i, 8.0, 0.125)).collect();
    let gradient: Vec<f64> = (0..2000).map(|i| side(i, 0.125, 8.0)).collect();
    product_is::<f64>(&x, 1.0, &gradient);
    product_is::<f32>(&x, 1.0, &gradient);
}

#[test]
fn products_with_zeros_infinities_and_nan() {
    fn check<T: Scalar>() {
        let (inf, nan) = (f64::INFINITY, f64::NAN);
        product_is::<T>(&[inf, 2.0], inf, &[2.0, inf]);
        product_is::<T>(&[inf, 1e-30, 1e-30, 1e-30], inf, &[1e-90, inf, inf, inf]);
        product_is::<T>(&[inf, 0.0], nan, &[0.0, inf]);
        product_is::<T>(&[nan, 2.0, 0.0], nan, &[0.0, nan, nan]);
        product_is::<T>(&[0.0, 1e30, 1e30, 1e-30, 1e-30], 0.0, &[1.0, 0.0, 0.0, 0.0, 0.0]);
        product_is::<T>(&[0.0, 3.0, 0.0], 0.0, &[0.0; 3]);
        product_is::<T>(&[-0.0], -0.0, &[1.0]);
        product_is::<T>(&[], 1.0, &[]);
    }
    check::<f32>();
    check::<f64>();
}

#[test]
fn product_second_order_with_zeros_and_large() {
    let tape = Tape::<f64>::new();
    let x = tape.leaf(Tensor::from_vec(&[4], vec![0.0, 3.0, 1e300, 1e-290]));
    let first = x.prod().grad_graph(&[&x]).remove(0);
    // d2y / dx0 dx1 = x2 x3, where the first derivative for x1 is 0.
    let second = first.slice_axis(0, 1..2).sum().grad(&[&x]).remove(0);
    for (got, expected) in second.as_slice().iter().zip([1e10, 0.0, 0.0, 0.0]) {
        assert!((got - expected).abs() <= 1e-5, "{second:?}");
    }
}

#[test]
#[should_panic(
    expected = "softmax[[2, 3]]: there is no axis 2 in a tensor of shape [2, 3] (recorded at autograd/tests/testsuite/reductions.rs"
)]
fn an_axis_that_does_not_exist_is_named() {
    let tape = Tape::<f32>::new();
    let _ = tape.constant(Tensor::zeros(&[2, 3])).softmax(2);
}
