//! Reductions and scans over every set of axes, against plain loops and finite differences, down to no elements and no
//! axes.

use raygrad_autograd::{Axes, Check, Tape, Tensor, Var, check_function};

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
fn reductions_over_every_set_of_axes_agree_with_plain_loops() {
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
fn scans_along_every_axis_agree_with_plain_loops_and_differences() {
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

#[test]
fn products_with_large_and_small_factors_have_finite_gradients() {
    let tape = Tape::<f32>::new();
    let x = tape.leaf(Tensor::from_fn(&[200], |i| if i < 100 { 10.0 } else { 0.1 }));
    let y = x.prod();
    assert!((y.item() - 1.0).abs() < 1e-4, "{}", y.item());
    let grad = y.grad(&[&x]).remove(0);
    assert!((grad.as_slice()[0] - 0.1).abs() < 1e-5 && (grad.as_slice()[199] - 10.0).abs() < 1e-3);
}

#[test]
#[should_panic(expected = "axis 2 of a tensor of shape [2, 3]")]
fn an_axis_that_does_not_exist_is_named() {
    let tape = Tape::<f32>::new();
    let _ = tape.constant(Tensor::zeros(&[2, 3])).softmax(2);
}
