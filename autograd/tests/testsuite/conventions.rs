//! Values and gradients at ties, kinks and the edges of domains, as the table in `src/conventions.rs` states them.

use raygrad_autograd::{Scalar, Tape, Tensor, Var};

/// The operation of a row of the table.
fn apply<'t, T: Scalar>(operation: &str, x: &[Var<'t, T>]) -> Option<Var<'t, T>> {
    let (a, b, c) = (&x[0], x.get(1).unwrap_or(&x[0]), x.get(2).unwrap_or(&x[0]));
    Some(match operation {
        "abs(x)" => a.abs(),
        "sign(x)" => a.sign(),
        "relu(x)" => a.relu(),
        "leaky_relu(x, 0.1)" => a.leaky_relu(0.1),
        "elu(x, 1.5)" => a.elu(1.5),
        "clamp(x, -1, 2)" => a.clamp(-1.0, 2.0),
        "floor(x)" => a.floor(),
        "ceil(x)" => a.ceil(),
        "round(x)" => a.round(),
        "absolute_error(a, b)" => a.absolute_error(b),
        "huber(a, b, 2)" => a.huber(b, 2.0),
        "smooth_l1(a, b, 0)" => a.smooth_l1(b, 0.0),
        "smooth_l1(a, b, 0.5)" => a.smooth_l1(b, 0.5),
        "maximum(a, b)" => a.maximum(b),
        "minimum(a, b)" => a.minimum(b),
        "max(x)" => a.max(),
        "min(x)" => a.min(),
        "gt(a, b)" => a.tape().constant(a.gt(b).cast()),
        "elementwise_eq(a, b)" => a.tape().constant(a.elementwise_eq(b).cast()),
        "where(mask, a, b)" => b.where_(&!a.elementwise_eq(0.0), c),
        "if_positive(x, a, b)" => a.if_positive(b, c),
        "sqrt(x)" => a.sqrt(),
        "rsqrt(x)" => a.rsqrt(),
        "reciprocal(x)" => a.reciprocal(),
        "div(a, b)" => a / b,
        "ln(x)" => a.ln(),
        "log2(x)" => a.log2(),
        "ln1p(x)" => a.ln1p(),
        "asin(x)" => a.asin(),
        "acos(x)" => a.acos(),
        "atan2(a, b)" => a.atan2(b),
        "hypot(a, b)" => a.hypot(b),
        "logaddexp(a, b)" => a.logaddexp(b),
        "remainder(a, b)" => a.remainder(b),
        "powi(x, 0)" => a.powi(0),
        "powi(x, -1)" => a.powi(-1),
        "powf(x, 0.5)" => a.powf(0.5),
        "powf(x, 1)" => a.powf(1.0),
        "powf(x, 2)" => a.powf(2.0),
        "powf(x, inf)" => a.powf(f64::INFINITY),
        "powf(x, -inf)" => a.powf(f64::NEG_INFINITY),
        "pow(a, b)" => a.pow(b),
        "xlogy(a, b)" => a.xlogy(b),
        "norm(x)" => a.norm(),
        "norm_l1(x)" => a.norm_l1(),
        "std(x, 1)" => a.std(1),
        "prod(x)" => a.prod(),
        "cumprod(x)" => a.cumprod(0),
        "sum(x)" => a.sum(),
        "mean(x)" => a.mean(),
        "logsumexp(x)" => a.logsumexp(),
        "softmax(x)" => a.softmax(-1),
        "cross_entropy(x, 0)" => a.cross_entropy([0]),
        "cross_entropy(x, 1)" => a.cross_entropy([1]),
        "sigmoid(x)" => a.sigmoid(),
        "softplus(x)" => a.softplus(),
        "log_sigmoid(x)" => a.log_sigmoid(),
        "gelu(x)" => a.gelu(),
        "gelu_tanh(x)" => a.gelu_tanh(),
        "silu(x)" => a.silu(),
        "tanh(x)" => a.tanh(),
        "erf(x)" => a.erf(),
        "normal_cdf(x)" => a.normal_cdf(),
        "binary_cross_entropy_with_logits(a, b)" => a.binary_cross_entropy_with_logits(b),
        _ => return None,
    })
}

/// Numbers and lists of numbers, separated by semicolons.
fn tensors<T: Scalar>(text: &str) -> Vec<Tensor<T>> {
    let number = |text: &str| T::from_f64(text.trim().parse().unwrap_or_else(|_| panic!("{text:?} is no number")));
    let tensor = |text: &str| match text.trim().strip_prefix('[').and_then(|rest| rest.strip_suffix(']')) {
        Some(list) => {
            let values: Vec<T> = list.split(',').filter(|part| !part.is_empty()).map(number).collect();
            Tensor::from_vec(&[values.len()], values)
        }
        None => Tensor::scalar(number(text)),
    };
    text.split(';').map(tensor).collect()
}

/// The gradient of the sum of the first input's gradient and twice the second's: of differences, the sum would be 0.
fn second<T: Scalar>(operation: &str, x: &[Tensor<T>]) -> Vec<Tensor<T>> {
    let tape = Tape::<T>::new();
    let vars: Vec<Var<'_, T>> = x.iter().map(|x| tape.leaf(x.clone())).collect();
    let factor = tape.leaf(Tensor::scalar(T::ONE));
    let x: Vec<&Var<'_, T>> = vars.iter().collect();
    let first = (apply(operation, &vars).unwrap().sum() * &factor).grad_graph(&x);
    let total = first.iter().zip(1..).map(|(x, k)| x.sum() * f64::from(k)).reduce(|a, b| a + b).unwrap().tracked();
    let wrt: Vec<_> = x.iter().copied().chain([&factor]).collect();
    let mut grads = total.grad(&wrt);
    let by_factor = grads.pop().unwrap().item();
    assert_eq!(by_factor, total.item(), "{operation}: the gradient is linear in that of the output");
    grads
}

#[test]
fn second_derivatives_are_limits_where_there_are_some() {
    for (operation, at, expected) in [
        ("pow(a, b)", "[0, 0, 0]; [2, 3, 4]", "[2, 0, 0]; [0, 0, 0]"),
        ("pow(a, b)", "0; 0", "0; 0"),
        ("pow(a, b)", "3; 0", "0.6666666666666666; 2.7472312549584976"),
        ("logsumexp(x)", "[-inf, -inf]", "[0, 0]"),
        ("logsumexp(x)", "[0, -inf]", "[0, 0]"),
        ("smooth_l1(a, b, 0)", "1; 1", "0; 0"),
        ("smooth_l1(a, b, 0)", "2; 1", "0; 0"),
        ("absolute_error(a, b)", "1; 1", "0; 0"),
        ("powi(x, 0)", "0", "0"),
        ("xlogy(a, b)", "0; 2", "1; 0.5"),
        ("norm_l1(x)", "[0, -2]", "[0, 0]"),
        ("prod(x)", "[0, 3]", "[1, 1]"),
        ("softmax(x)", "[-inf, 0]", "[0, 0]"),
        ("sigmoid(x)", "-inf", "0"),
        ("softplus(x)", "inf", "0"),
        ("log_sigmoid(x)", "-inf", "0"),
        ("gelu(x)", "-inf", "0"),
        ("silu(x)", "-inf", "0"),
        ("tanh(x)", "inf", "0"),
        ("asin(x)", "1", "inf"),
        ("asin(x)", "-1", "-inf"),
        ("acos(x)", "1", "-inf"),
        ("acos(x)", "-1", "inf"),
        ("atan2(a, b)", "inf; 1", "0; 0"),
        ("atan2(a, b)", "-1; -inf", "0; 0"),
        ("atan2(a, b)", "inf; inf", "0; 0"),
        ("powf(x, 0.5)", "inf", "0"),
        ("powf(x, 1)", "inf", "0"),
        ("powf(x, 1)", "[1e-40, -1e-45]", "[0, 0]"),
        ("powf(x, inf)", "0.5", "0"),
        ("pow(a, b)", "0.5; inf", "0; 0"),
        ("pow(a, b)", "2; -inf", "0; 0"),
        ("pow(a, b)", "inf; -1", "0; 0"),
        ("pow(a, b)", "inf; -inf", "0; 0"),
        ("powf(x, 2)", "1e30", "2"),
        ("erf(x)", "inf", "0"),
        ("erf(x)", "-inf", "0"),
        ("normal_cdf(x)", "inf", "0"),
        ("normal_cdf(x)", "-inf", "0"),
        ("huber(a, b, 2)", "inf; 0", "0; 0"),
        ("huber(a, b, 2)", "0; inf", "0; 0"),
        ("smooth_l1(a, b, 0.5)", "inf; 0", "0; 0"),
        ("smooth_l1(a, b, 0.5)", "-inf; 0", "0; 0"),
        ("smooth_l1(a, b, 0)", "inf; 0", "0; 0"),
    ] {
        let got = second::<f64>(operation, &tensors(at));
        assert!(same(&got, &tensors(expected)), "{operation} at {at}: {got:?}");
        let got = second::<f32>(operation, &tensors(at));
        assert!(same(&got, &tensors(expected)), "{operation} at {at} in f32: {got:?}");
    }
    // A constant exponent.
    let tape = Tape::<f64>::new();
    let x = tape.leaf(Tensor::from([0.0; 4]));
    let first = x.pow(Tensor::from([0.0, 1.0, 2.0, 3.0])).sum().grad_graph(&[&x]).remove(0);
    assert_eq!(first.sum().grad(&[&x])[0], [0.0, 0.0, 2.0, 0.0]);
}

fn same<T: Scalar>(got: &[Tensor<T>], expected: &[Tensor<T>]) -> bool {
    let equal = |(a, b): (&T, &T)| {
        let (a, b) = (a.to_f64(), b.to_f64());
        a == b || a.is_nan() && b.is_nan() || (a - b).abs() <= 4.0 * T::EPSILON * b.abs()
    };
    let pair =
        |(a, b): (&Tensor<T>, &Tensor<T>)| a.shape() == b.shape() && a.as_slice().iter().zip(b.as_slice()).all(equal);
    got.len() == expected.len() && got.iter().zip(expected).all(pair)
}

fn check<T: Scalar>(row: &[&str]) -> Result<(), String> {
    let tape = Tape::<T>::new();
    let x: Vec<_> = tensors(row[1]).into_iter().map(|x| tape.leaf(x)).collect();
    let wrt: Vec<_> = x.iter().collect();
    let y = apply(row[0], &x).ok_or_else(|| format!("{} is not among the operations of the test", row[0]))?;
    // An operation that is constant in its inputs, such as a comparison, has gradient 0 here.
    let sum = y.sum().tracked();
    let recorded: Vec<_> = sum.grad_graph(&wrt).into_iter().map(Var::into_value).collect();
    let (grads, y) = (sum.grad(&wrt), [y.into_value()]);
    for (what, got, expected) in
        [("value", &y[..], row[2]), ("gradient", &grads, row[3]), ("recorded", &recorded, row[3])]
    {
        if !same(got, &tensors(expected)) {
            return Err(format!("{} at {} in {}: {what} {got:?} for {expected}", row[0], row[1], T::NAME));
        }
    }
    Ok(())
}

#[test]
fn every_row_of_the_table_is_what_the_operation_gives() {
    let rows = include_str!("../../src/conventions.rs").lines().filter_map(|line| line.strip_prefix("//! | `"));
    let (mut count, mut failures) = (0, vec![]);
    for row in rows {
        let cells: Vec<_> = row.split('|').map(|cell| cell.trim().trim_matches('`')).collect();
        failures.extend([check::<f32>(&cells), check::<f64>(&cells)].into_iter().filter_map(Result::err));
        count += 1;
    }
    assert!(count >= 87, "only {count} rows were found");
    assert!(failures.is_empty(), "{}", failures.join("\n"));
}
