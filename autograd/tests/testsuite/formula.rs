//! Formulas: fused operations against what they are made of, and the whole crate imported at once.

// Everything, as a user may: nothing of it may shadow the methods of `Var`.
use raygrad_autograd::check::*;
use raygrad_autograd::*;

#[test]
fn glob_import_keeps_var_methods() {
    let tape = Tape::<f64>::new();
    let x = tape.leaf(Tensor::scalar(0.5));
    let y = x.sin() + x.cos() * x.exp() + x.maximum(&x) + x.powi(3);
    let slope = 0.5_f64.cos() + 0.5_f64.exp() * (0.5_f64.cos() - 0.5_f64.sin()) + 1.0 + 0.75;
    assert!((y.grad(&[&x])[0].item() - slope).abs() < 1e-15);
}

#[test]
fn formulas_pass_the_examination() {
    let mut cases = Cases::default();
    cases.domain(-2.0..2.0).domain(0.5..1.5).domain(-1.0..1.0);
    let power = 1.5;
    let examined = [
        Entry::formula(formula!(|x, a, b| (x * a + b).tanh() * x), &cases),
        Entry::formula(formula!(|x, a, b| a.ln() - (b / a).sin() * (2.0 - x).exp()), &cases),
        Entry::formula(formula!([power] | x, a, b | 1.0 / (1.0 + (x - b).powi(2)) + power * a.pow(power)), &cases),
        Entry::formula(formula!(|x, a, b| (a + 2.0).atan2(x) * b.if_positive(x, 3.0 * x.sigmoid())), &{
            let mut cases = Cases::default();
            cases.domain(-2.0..2.0).domain(0.5..1.5).domain(0.1..1.0).domain_also(-1.0..-0.1);
            cases
        }),
    ];
    for entry in examined {
        let report = check_op(&Check::default(), &entry).unwrap_or_else(|error| panic!("{error}"));
        assert!(report.second_order < 1e-7, "{}", entry.name);
    }
}

#[test]
fn a_linear_formula_and_its_extremes_are_examined_too() {
    let mut cases = Cases::default();
    cases.linear().domain(-2.0..2.0).domain(-2.0..2.0).at([1.0, 2.0], -4.0, [2.0, -3.0]);
    check_op(&Check::default(), &Entry::formula(formula!(|a, b| 2.0 * a - b * 3.0), &cases)).unwrap();
    cases.at([1.0, 2.0], -4.0, [2.0, 3.0]);
    let wrong = check_op(&Check::default(), &Entry::formula(formula!(|a, b| 2.0 * a - b * 3.0), &cases));
    assert!(wrong.unwrap_err().contains("gradient 1 at [1.0, 2.0]"));
}

/// Values and gradients, bit by bit but for NaN, a few units in the last place, and subnormal results: products of a
/// written formula may underflow.
fn agree<T: Scalar>(what: &str, fused: &[Tensor<T>], plain: &[Tensor<T>]) {
    let least = if T::NAME == "f32" { f32::MIN_POSITIVE.into() } else { f64::MIN_POSITIVE };
    for (fused, plain) in fused.iter().zip(plain) {
        assert_eq!(fused.shape(), plain.shape(), "{what}");
        for (a, b) in fused.as_slice().iter().zip(plain.as_slice()) {
            let (a, b) = (a.to_f64(), b.to_f64());
            let close = (a - b).abs() <= 4.0 * T::EPSILON * b.abs() + least;
            assert!(a == b || close || a.is_nan() && b.is_nan(), "{what}: {a} for {b}");
        }
    }
}

/// Value and gradients of a weighting of it.
fn results<'t, T: Scalar>(y: &Var<'t, T>, wrt: &[&Var<'t, T>]) -> Vec<Tensor<T>> {
    let seed = y.tape().constant(Tensor::full(y.shape(), T::from_f64(0.75)));
    // Recorded, and in the one pass that an ordinary gradient takes.
    let recorded = y.vjp(&seed, wrt).into_iter().map(Var::into_value);
    let plain = (y * &seed).sum().grad(wrt);
    recorded.chain(plain).chain([y.value().clone()]).collect()
}

/// What functions have kinks, steps, ties and edges at, and angles that need the long reduction.
const POINTS: [f64; 21] = [
    f64::NEG_INFINITY,
    -1e9,
    -30.0,
    -2.5,
    -1.0,
    -0.5,
    -1e-30,
    -0.0,
    0.0,
    1e-30,
    0.5,
    0.75,
    1.0,
    1.5,
    2.0,
    3.0,
    30.0,
    1e9,
    1e30,
    f64::INFINITY,
    f64::NAN,
];

fn the_functions_of_a_formula_are_the_operations<T: Scalar>() {
    let tape = Tape::<T>::new();
    let n = POINTS.len();
    let point = |i: usize| T::from_f64(POINTS[i % n]);
    let (x, y) = (tape.leaf(Tensor::from_fn(&[n, n], |i| point(i / n))), tape.leaf(Tensor::from_fn(&[n, n], point)));
    macro_rules! one {
        ($($f:ident)*) => {
            $(agree(stringify!($f), &results(&formula!(|x| x.$f()).on([&x]), &[&x]), &results(&x.$f(), &[&x]));)*
        };
    }
    one! {
        exp expm1 ln ln1p sin cos sin_pi cos_pi tanh sigmoid softplus sqrt exp2 log2 erf tan asin acos atan sinh cosh
        abs sign floor ceil round normal_cdf
    }
    macro_rules! two {
        ($($f:ident)*) => {
            $(agree(
                stringify!($f),
                &results(&formula!(|x, y| x.$f(y)).on([&x, &y]), &[&x, &y]),
                &results(&x.$f(&y), &[&x, &y]),
            );)*
        };
    }
    two! { atan2 pow maximum minimum hypot remainder }
    let fused = formula!(|x, y| x.if_positive(y, 1.0)).on([&x, &y]);
    agree("if_positive", &results(&fused, &[&x, &y]), &results(&x.if_positive(&y, x.constant(1.0)), &[&x, &y]));
    agree("powi", &results(&formula!(|x| x.powi(-3)).on([&x]), &[&x]), &results(&x.powi(-3), &[&x]));
    agree("powi", &results(&formula!(|x| x.powi(0)).on([&x]), &[&x]), &results(&x.powi(0), &[&x]));
}

#[test]
fn formula_functions_equal_operations() {
    the_functions_of_a_formula_are_the_operations::<f32>();
    the_functions_of_a_formula_are_the_operations::<f64>();
}

#[test]
fn large_formulas_agree_with_their_operations() {
    let tape = Tape::<f64>::new();
    let x = tape.leaf(Tensor::from_fn(&[517, 1031], |i| (i % 4001) as f64 * 0.001 - 2.0));
    let a = tape.leaf(Tensor::from_fn(&[1031], |i| 0.5 + (i % 7) as f64));
    let b = tape.leaf(Tensor::from_fn(&[517, 1], |i| (i % 11) as f64 - 5.0));
    let c = tape.constant(Tensor::scalar(0.25));
    let fused = formula!(|x, a, b, c| (x * a + b).tanh() * x + (c * x).sin() / a).on([&x, &a, &b, &c]);
    let plain = (&x * &a + &b).tanh() * &x + (&c * &x).sin() / &a;
    for (fused, plain) in results(&fused, &[&x, &a, &b]).iter().zip(results(&plain, &[&x, &a, &b])) {
        let largest = plain.as_slice().iter().map(|x| x.abs()).fold(0.0, Real::maximum);
        for (a, b) in fused.as_slice().iter().zip(plain.as_slice()) {
            assert!((a - b).abs() <= 1e-14 * largest, "{a} for {b}");
        }
    }
}

#[test]
#[should_panic(expected = "x * y[[2], [3]]: the shapes do not broadcast")]
fn shapes_that_disagree_are_reported_with_the_formula() {
    let tape = Tape::<f32>::new();
    let _ = formula!(|x, y| x * y).on([&tape.leaf(Tensor::zeros(&[2])), &tape.leaf(Tensor::zeros(&[3]))]);
}
