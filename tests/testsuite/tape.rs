//! The tape: derivatives of any order, one tape per thread, errors that name the line.

use raygrad::check::{Check, Entry, check_function, check_op};
use raygrad::{
    Activation, Axes, Error, Grads, Op, Pool, Reads, RowGrad, Scalar, Shape, ShapeError, Tape, Tensor, Var, Vjp,
};
use std::panic::{AssertUnwindSafe, catch_unwind};

fn vector(values: &[f64]) -> Tensor<f64> {
    Tensor::from_vec(&[values.len()], values.to_vec())
}

#[track_caller]
fn assert_close(what: &str, got: &[f64], expected: &[f64], tolerance: f64) {
    assert_eq!(got.len(), expected.len(), "{what}");
    for (got, expected) in got.iter().zip(expected) {
        let error = (got - expected).abs() / expected.abs().max(1.0);
        assert!(error <= tolerance, "{what}: {got} instead of {expected}");
    }
}

/// The message of the panic that `f` ends in.
#[track_caller]
fn panic_of<R>(f: impl FnOnce() -> R) -> String {
    let Err(panic) = catch_unwind(AssertUnwindSafe(f)) else { panic!("nothing panicked") };
    *panic.downcast::<String>().expect("the message of a formatted panic is a string")
}

#[test]
fn three_derivatives_of_exp_sin() {
    let x = [-2.0, -0.3, 0.0, 0.7, 4.0];
    let tape = Tape::new();
    let leaf = tape.leaf(vector(&x));
    let mut y = leaf.sin().exp();
    let closed: [fn(f64, f64) -> f64; 4] = [|_, _| 1.0, |_, c| c, |s, c| c * c - s, |s, c| c * c * c - 3.0 * s * c - c];
    for (order, factor) in closed.into_iter().enumerate() {
        let expected = x.map(|x| factor(x.sin(), x.cos()) * x.sin().exp());
        assert_close(&format!("derivative {order}"), y.value().as_slice(), &expected, 1e-14);
        y = y.sum().grad_graph(&[&leaf]).remove(0);
    }
}

#[test]
fn hessian_times_vector_of_a_quadratic_form() {
    // f = x'Ax: the gradient is (A + A')x, and the gradient of (gradient . v) is (A + A')v.
    let tape = Tape::new();
    let a = Tensor::from_vec(&[3, 3], vec![1.0, -2.0, 0.5, 3.0, 4.0, -1.0, 0.0, 2.0, -3.0]);
    let symmetric = |i: usize, j: usize| a.as_slice()[3 * i + j] + a.as_slice()[3 * j + i];
    let times = |x: [f64; 3]| [0, 1, 2].map(|i| (0..3).map(|j| symmetric(i, j) * x[j]).sum::<f64>());
    let (at, along) = ([0.3, -1.0, 2.0], [1.0, 0.5, -0.25]);
    let x = tape.leaf(Tensor::from_vec(&[3, 1], at.to_vec()));
    let form = (&x * tape.constant(a.clone()).matmul(&x)).sum();
    let gradient = form.grad_graph(&[&x]).remove(0);
    assert_close("gradient", gradient.value().as_slice(), &times(at), 1e-14);
    let product = (gradient * tape.constant(Tensor::from_vec(&[3, 1], along.to_vec()))).sum().grad(&[&x]);
    assert_close("Hessian times vector", product[0].as_slice(), &times(along), 1e-14);
}

#[test]
fn reused_variable_sums_all_shares() {
    let tape = Tape::<f64>::new();
    let x = tape.leaf(vector(&[0.5, -1.0]));
    // Small integers, so that the sum 1 + 2 + .. + 100 is exact.
    let mut sum = &x * 1.0;
    for k in 2..=100 {
        sum += &x * f64::from(k);
    }
    assert_eq!(sum.sum().grad(&[&x])[0].as_slice(), [5050.0; 2]);
    // Both factors, a broadcast operand, and one variable requested twice.
    let y = (&x * &x).sum() + (&x + tape.constant(Tensor::zeros(&[3, 2]))).sum();
    let grads = y.grad(&[&x, &x]);
    assert_eq!(grads[0].as_slice(), [4.0, 1.0], "2 x + 3");
    assert_eq!(grads[0], grads[1]);
}

#[test]
fn interior_and_unreached_nodes_have_gradients() {
    let tape = Tape::new();
    let x = tape.leaf(vector(&[0.2, 0.4]));
    let inner = x.sin();
    let unused = tape.leaf(Tensor::<f64>::ones(&[2, 3]));
    let y = inner.square().sum();
    let later = tape.leaf(vector(&[1.0]));
    let grads = y.grad(&[&inner, &unused, &x, &later, &y]);
    let [sines, cosines] = [[0.2_f64.sin(), 0.4_f64.sin()], [0.2_f64.cos(), 0.4_f64.cos()]];
    assert_close("the interior node", grads[0].as_slice(), &sines.map(|s| 2.0 * s), 1e-15);
    assert_close("the leaf below it", grads[2].as_slice(), &[0, 1].map(|i| 2.0 * sines[i] * cosines[i]), 1e-15);
    assert_eq!(grads[1], Tensor::zeros(&[2, 3]));
    assert_eq!(grads[3], Tensor::zeros(&[1]));
    assert_eq!(grads[4], Tensor::ones(&[]));
}

#[test]
fn detach_constants_and_no_grad_stop_gradients() {
    let tape = Tape::new();
    let x = tape.leaf(vector(&[3.0]));
    let y = (&x * x.detach()).sum();
    assert_eq!(y.grad(&[&x])[0].as_slice(), [3.0], "only the factor that is on the graph");
    let before = tape.len();
    let silent = tape.no_grad(|| x.exp().square());
    assert!(!silent.is_on_graph() && tape.len() == before && tape.is_recording());
    assert!(matches!(silent.sum().try_grad(&[&x]), Err(Error::OfConstant { .. })));
    let constants = tape.constant(vector(&[1.0])) + tape.constant(vector(&[2.0]));
    assert!(!constants.is_on_graph() && tape.len() == before, "constants leave no trace");
}

#[test]
fn recording_returns_after_a_panic() {
    let tape = Tape::new();
    let x = tape.leaf(vector(&[1.0, 2.0]));
    let longer = tape.constant(vector(&[1.0, 2.0, 3.0]));
    let message = panic_of(|| tape.no_grad(|| x.matmul(&longer)));
    assert!(message.starts_with("matmul"), "{message}");
    assert!(tape.is_recording());
    assert_eq!(x.square().sum().grad(&[&x])[0].as_slice(), [2.0, 4.0]);
}

#[test]
fn gradient_of_a_freed_graph_is_an_error() {
    let tape = Tape::new();
    let x = tape.leaf(vector(&[0.5]));
    let y = x.sin().sum();
    assert_eq!(y.grad(&[&x]), y.grad(&[&x]), "`grad` can be repeated");
    let last = y.backward(&[&x]).remove(0).into_dense(tape.pool());
    assert_close("once", last.as_slice(), &[0.5_f64.cos()], 1e-15);
    let error = y.try_grad(&[&x]).unwrap_err();
    assert!(matches!(error, Error::Freed { .. }), "{error}");
    assert!(error.to_string().contains(&format!("{}:{}", file!(), line!() - 2)), "{error}");
    assert!(matches!(y.try_backward(&[&x]), Err(Error::Freed { .. })));
}

#[test]
fn cleared_tape_gives_same_bits_without_allocating() {
    let mut tape = Tape::<f32>::new();
    let mut first = None;
    let mut allocated = 0;
    for round in 0..4 {
        let x = tape.leaf(Tensor::from_fn(&[50, 40], |i| (i as f32 * 0.37).sin()));
        let loss = (x.t().matmul(&x) * 0.1).tanh().square().sum();
        let grad = loss.backward(&[&x]).remove(0).into_dense(tape.pool());
        let bits: Vec<_> = grad.as_slice().iter().map(|x| x.to_bits()).collect();
        assert_eq!(*first.get_or_insert(bits.clone()), bits, "round {round}");
        drop((x, loss, grad));
        tape.clear();
        assert!(tape.is_empty());
        if round == 0 {
            allocated = tape.pool().allocated();
        }
        assert_eq!(tape.pool().allocated(), allocated, "round {round} takes its buffers from the pool");
    }
}

/// The bits of a gradient through products, broadcasts and nonlinearities.
fn gradient_bits(salt: usize) -> Vec<u32> {
    let mut tape = Tape::<f32>::new();
    let mut bits = vec![];
    for round in 0..5 {
        let value = |i: usize| ((i * (salt + 3) + round) as f32 * 0.61).sin();
        let (x, w) = (tape.leaf(Tensor::from_fn(&[33, 17], value)), tape.leaf(Tensor::from_fn(&[17, 9], value)));
        let loss = (x.matmul(&w).softplus() / (1.0 + w.square().sum_over(Axes::from(0).keepdims()))).exp().mean();
        for grad in loss.grad(&[&x, &w]) {
            bits.extend(grad.as_slice().iter().map(|x| x.to_bits()));
        }
        drop((x, w, loss));
        tape.clear();
    }
    bits
}

#[test]
fn threads_with_own_tapes_give_equal_bits() {
    for threads in [4, 8] {
        let serial: Vec<_> = (0..threads).map(gradient_bits).collect();
        let parallel: Vec<_> = std::thread::scope(|scope| {
            let handles: Vec<_> = (0..threads).map(|salt| scope.spawn(move || gradient_bits(salt))).collect();
            handles.into_iter().map(|handle| handle.join().unwrap()).collect()
        });
        assert!(serial == parallel, "{threads} threads");
        assert_ne!(serial[0], serial[1]);
    }
}

/// A user's operation: `y = ln sum exp x` over the last axis, which keeps the extent 1. `dx = g exp(x - y)`.
#[derive(Clone)]
struct LogSumExp;

impl<T: Scalar> Op<T> for LogSumExp {
    fn name(&self) -> &'static str {
        "log_sum_exp"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        match x[0].split_last() {
            Some((&columns, rows)) if columns > 0 => Ok(rows.iter().copied().chain([1]).collect()),
            _ => Err("the last axis must not be empty".into()),
        }
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let columns = x[0].shape()[x[0].ndim() - 1];
        let rows = x[0].as_slice().chunks_exact(columns).map(|row| {
            let top = row.iter().fold(f64::NEG_INFINITY, |top, x| top.max(x.to_f64()));
            T::from_f64(top + row.iter().map(|x| (x.to_f64() - top).exp()).sum::<f64>().ln())
        });
        let mut shape = Shape::from_slice(x[0].shape());
        shape[x[0].ndim() - 1] = 1;
        pool.copy_of(&shape, &rows.collect::<Vec<_>>())
    }

    fn reads(&self) -> Reads {
        Reads::ALL
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        Grads::one(cx.g() * (cx.x(0) - cx.y()).exp())
    }
}

#[test]
fn custom_operation_passes_all_checks() {
    let entry = Entry::new(LogSumExp).sample(&[&[4, 3]]).sample(&[&[2, 2, 5]]).sample(&[&[1]]).sample(&[&[0, 2]]);
    check_op(&Check::default(), &entry).unwrap();
    let tape = Tape::<f32>::new();
    let y = tape.apply(LogSumExp, &[&tape.leaf(Tensor::full(&[2], 1000.0))]);
    assert_eq!(y.value().as_slice(), [1000.0 + 2.0_f32.ln()]);
}

/// Rematerialisation: keeps only its inputs and evaluates `f(a, b) = exp(a sin b)` again to differentiate it.
#[derive(Clone)]
struct Replay;

impl Replay {
    fn run<'t, T: Scalar>(a: &Var<'t, T>, b: &Var<'t, T>) -> Var<'t, T> {
        (a * b.sin()).exp()
    }
}

impl<T: Scalar> Op<T> for Replay {
    fn name(&self) -> &'static str {
        "replay"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        if x[0] == x[1] { Ok(Shape::from_slice(x[0])) } else { Err("the shapes must be equal".into()) }
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let tape = Tape::with_pool(pool.clone());
        Self::run(&tape.constant(x[0].clone()), &tape.constant(x[1].clone())).into_value()
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        if cx.recording() {
            // New nodes: an input that depends on the other keeps its own share, and a constant has a gradient.
            let (a, b) = ((cx.x(0) * 1.0).tracked(), (cx.x(1) * 1.0).tracked());
            return Grads::new(Self::run(&a, &b).vjp(cx.g(), &[&a, &b]).into_iter().map(Some));
        }
        let tape = Tape::with_pool(cx.pool().clone());
        let (a, b) = (tape.leaf(cx.x(0).into_value()), tape.leaf(cx.x(1).into_value()));
        let y = Self::run(&a, &b) * tape.constant(cx.g().value().clone());
        Grads::new(y.sum().grad(&[&a, &b]).into_iter().map(|grad| Some(cx.constant(grad))))
    }
}

#[test]
fn gradient_inside_a_vjp_is_supported() {
    check_op(&Check::default(), &Entry::new(Replay).sample(&[&[2, 3], &[2, 3]])).unwrap();
    // One input depends on the other: first and second derivatives equal those of the plain expression.
    let derivatives = |f: for<'t> fn(&Var<'t, f64>, &Var<'t, f64>) -> Var<'t, f64>| {
        let tape = Tape::new();
        let x = tape.leaf(vector(&[0.3, 0.8]));
        let first = f(&x, &x.square()).sum().grad_graph(&[&x]).remove(0);
        let second = first.square().sum().grad(&[&x]).remove(0);
        [first.into_value(), second]
    };
    let plain = derivatives(Replay::run);
    let replayed = derivatives(|a, b| a.tape().apply(Replay, &[a, b]));
    for (order, (plain, replayed)) in plain.iter().zip(&replayed).enumerate() {
        assert_close(&format!("derivative {}", order + 1), replayed.as_slice(), plain.as_slice(), 1e-14);
    }
}

#[test]
fn fused_operation_keeps_dependent_inputs_apart() {
    // x is a function of w, and both are inputs of the dense layer.
    let derivatives = |layer: for<'t> fn(&Var<'t, f64>, &Var<'t, f64>) -> Var<'t, f64>| {
        let tape = Tape::new();
        let w = tape.leaf(Tensor::from_vec(&[2, 2], vec![0.3, -0.8, 1.1, 0.4]));
        let first = layer(&w.sin(), &w).sum().grad_graph(&[&w]).remove(0);
        let second = first.square().sum().grad(&[&w]).remove(0);
        [first.into_value(), second]
    };
    let plain = derivatives(|x, w| x.matmul(w));
    let fused = derivatives(|x, w| x.linear(w, None, Activation::Identity));
    for (plain, fused) in plain.iter().zip(&fused) {
        assert_close("a derivative", fused.as_slice(), plain.as_slice(), 1e-14);
    }
}

#[test]
fn shape_errors_name_operation_shapes_and_line() {
    let tape = Tape::<f32>::new();
    let (a, b) = (tape.leaf(Tensor::zeros(&[2, 3])), tape.leaf(Tensor::zeros(&[4, 5])));
    let check = |message: String, parts: [&str; 3], line: u32| {
        let place = format!("{}:{line}:", file!());
        assert!(parts.iter().all(|part| message.contains(part)) && message.contains(&place), "{message}");
    };
    check(panic_of(|| a.matmul(&b)), ["matmul", "[[2, 3], [4, 5]]", "inner extents 3 and 4"], line!());
    check(panic_of(|| &a + &b), ["add", "[[2, 3], [4, 5]]", "do not broadcast"], line!());
    let error = tape.try_apply(LogSumExp, &[&tape.leaf(Tensor::zeros(&[2, 0]))]).map(|_| ()).unwrap_err();
    assert!(matches!(error, Error::Shape { .. }));
    check(error.to_string(), ["log_sum_exp", "[[2, 0]]", "must not be empty"], line!() - 2);
    let error = a.try_grad(&[&a]).unwrap_err();
    check(error.to_string(), ["[2, 3]", "reduce it to one element", "Var::vjp"], line!() - 1);
}

#[test]
fn variables_of_two_tapes_panic_together() {
    let (one, two) = (Tape::<f32>::new(), Tape::<f32>::new());
    let (x, y) = (one.leaf(Tensor::ones(&[])), two.leaf(Tensor::ones(&[])));
    assert!(panic_of(|| &x * &y).contains("another tape"));
    let by_other = catch_unwind(AssertUnwindSafe(|| drop(x.grad(&[&y]))));
    let with_other = catch_unwind(AssertUnwindSafe(|| drop((&x + 1.0).vjp(&y, &[&x]))));
    for (result, expected) in [(by_other, "a variable of another tape"), (with_other, "a seed of another tape")] {
        let message = result.unwrap_err();
        assert!(message.downcast_ref::<&str>().is_some_and(|text| text.contains(expected)));
    }
}

#[test]
fn nan_finder_names_operation_line_and_index() {
    let tape = Tape::<f64>::new();
    tape.check_finite(true);
    let x = tape.leaf(Tensor::from_vec(&[2, 2], vec![1.0, 2.0, -1.0, -3.0]));
    let message = panic_of(|| x.ln());
    let expected = format!("ln: output is NaN at index [1, 0] (recorded at {}:{}:", file!(), line!() - 1);
    assert!(message.starts_with(&expected), "{message}");

    // The root is finite at 0; its slope is not.
    let x = tape.leaf(vector(&[4.0, 1.0, 0.0]));
    let root = x.sqrt();
    let line = line!() - 1;
    let error = root.sum().try_grad(&[&x]).unwrap_err();
    let expected = format!("sqrt: the gradient of input 0 is inf at index [2] (recorded at {}:{line}:", file!());
    assert!(error.to_string().starts_with(&expected), "{error}");

    tape.check_finite(false);
    assert_eq!(root.sum().grad(&[&x])[0].as_slice(), [0.25, 0.5, f64::INFINITY]);
}

#[test]
fn nan_finder_names_the_source_of_a_bad_value() {
    let tape = Tape::<f64>::new();
    tape.check_finite(true);
    let message = panic_of(|| tape.leaf(vector(&[1.0, f64::INFINITY])));
    let expected = format!("leaf: the value is inf at index [1] (recorded at {}:{}:", file!(), line!() - 1);
    assert!(message.starts_with(&expected), "{message}");
    // Constants are not checked, but an operation on one names the input.
    let (x, bad) = (tape.leaf(vector(&[1.0, 2.0])), tape.constant(vector(&[f64::NAN, 0.0])));
    let message = panic_of(|| &x + &bad);
    assert!(message.starts_with("add: output (and input 1 was not finite before) is NaN at index [0]"), "{message}");
}

#[test]
fn nan_finder_checks_recorded_and_sparse_gradients() {
    let tape = Tape::<f32>::new();
    tape.check_finite(true);
    let starts = |message: String, expected: &str, line: u32| {
        assert!(message.starts_with(&format!("{expected} (recorded at {}:{line}:", file!())), "{message}");
    };
    // The error names the user's line, also for gradients of recorded operations.
    let x = tape.leaf(Tensor::from_vec(&[2], vec![1.0, 0.0]));
    let root = x.sqrt();
    let line = line!() - 1;
    starts(panic_of(|| root.sum().grad_graph(&[&x])), "sqrt: the gradient of input 0 is inf at index [1]", line);
    // Two finite shares whose sum overflows: at a leaf, and before an operation.
    let x = tape.leaf(Tensor::from_vec(&[2], vec![1e-3, 1e-3]));
    let line = line!() - 1;
    let sum = (&x * 3e38 + &x * 3e38).slice_axis(0, ..1).sum();
    starts(sum.try_grad(&[&x]).unwrap_err().to_string(), "leaf: the gradient is inf at index [0]", line);
    let h = x.affine(0.5, 0.0);
    let line = line!() - 1;
    let sum = (&h * 3e38 + &h * 3e38).slice_axis(0, ..1).sum();
    starts(
        sum.try_grad(&[&x]).unwrap_err().to_string(),
        "affine: the gradient of the output is inf at index [0]",
        line,
    );
    // A sparse gradient with a repeated row.
    let rows = x.gather_rows([0, 0]);
    let line = line!() - 1;
    let sum = (rows * 3e38).sum();
    starts(
        sum.try_grad(&[&x]).unwrap_err().to_string(),
        "gather_rows: the gradient of input 0 is inf at index [0]",
        line,
    );
    assert!(panic_of(|| sum.backward(&[&x])).contains("gather_rows: the gradient of input 0 is inf"));
    // An overflow inside a gradient is not reported if the result is finite: softplus of a large number.
    let large = tape.leaf(Tensor::scalar(200.0));
    assert_eq!(large.softplus().grad_graph(&[&large])[0].item(), 1.0);
}

#[test]
fn tape_reused_gives_all_gradients() {
    let tape = Tape::new();
    let x = tape.leaf(vector(&[0.3, -1.2]));
    let h = x.sin() * &x;
    let (first, second) = (h.exp().sum(), (&h * &h).sum());
    let both = &first + &second;
    let [a, b] = [&first, &second].map(|y| y.grad(&[&x]).remove(0));
    let sum: Vec<_> = a.as_slice().iter().zip(b.as_slice()).map(|(a, b)| a + b).collect();
    assert_close("both", both.grad(&[&x])[0].as_slice(), &sum, 1e-15);
    // In any order and by any method; none changes the values of the graph.
    let recorded = first.grad_graph(&[&x]).remove(0);
    assert_close("recorded", recorded.value().as_slice(), a.as_slice(), 1e-15);
    let seed = tape.constant(Tensor::scalar(2.0));
    assert_close(
        "vjp",
        first.vjp(&seed, &[&x])[0].value().as_slice(),
        &a.as_slice().iter().map(|a| 2.0 * a).collect::<Vec<_>>(),
        1e-15,
    );
    let values = tape.no_grad(|| first.vjp(&seed, &[&x, &h]));
    assert!(values.iter().all(|x| !x.is_on_graph()));
    assert_close(
        "vjp values",
        values[0].value().as_slice(),
        &a.as_slice().iter().map(|a| 2.0 * a).collect::<Vec<_>>(),
        1e-15,
    );
    assert_eq!(second.grad(&[&x])[0], b);
    recorded.sum().grad(&[&x]);
    assert_eq!(first.grad(&[&x])[0], a);
    // `backward` frees its own nodes only, not the leaf, which other graphs share.
    let apart = x.cos().sum();
    assert_eq!(first.backward(&[&x])[0].dense(), Some(&a));
    assert!(second.try_grad(&[&x]).is_err());
    assert_close("apart", apart.grad(&[&x])[0].as_slice(), &[-0.3_f64.sin(), 1.2_f64.sin()], 1e-15);
}

#[test]
fn scopes_without_recording_nest_and_end() {
    let tape = Tape::new();
    let x = tape.leaf(vector(&[2.0]));
    let (inner, outer) = tape.no_grad(|| {
        let inner = tape.no_grad(|| x.exp());
        assert!(!tape.is_recording(), "the inner scope gives back what it found");
        let error = x.square().sum().try_grad(&[&x]).unwrap_err();
        assert!(matches!(error, Error::OfConstant { .. }), "nothing was recorded: {error}");
        (inner, x.square())
    });
    assert!(tape.is_recording() && !inner.is_on_graph() && !outer.is_on_graph());
    assert_eq!(tape.len(), 1);
    // A leaf made inside is a leaf, and operations after the scope are recorded.
    let leaf = tape.no_grad(|| tape.leaf(vector(&[3.0])));
    assert_eq!((&leaf * &outer).sum().grad(&[&leaf])[0].as_slice(), [4.0]);
}

#[test]
fn empty_and_scalar_tensors_pass_through_a_tape() {
    for shape in [&[][..], &[0], &[3, 0, 2], &[1]] {
        let tape = Tape::<f64>::new();
        tape.check_finite(true);
        let x = tape.leaf(Tensor::full(shape, 0.5));
        let h = x.map_grad(|g| g * 1.0).inspect_grad(|_| ());
        let y = tape.checkpoint(&[&h], |x| x[0].tanh() * &x[0]);
        let total = (&y + &h).sum();
        let first = total.grad_graph(&[&x]).remove(0);
        let second = first.square().sum().grad(&[&x]).remove(0);
        assert_eq!((first.shape(), second.shape()), (shape, shape));
        let tanh = 0.5_f64.tanh();
        let slope = tanh + 0.5 * (1.0 - tanh * tanh) + 1.0;
        assert!(first.value().as_slice().iter().all(|g| (g - slope).abs() < 1e-15));
        assert_eq!(total.backward(&[&x]).len(), 1);
        assert!(tape.to_dot().contains("freed"));
    }
}

/// The slope of x^3 as a model that computes it by a gradient: 3 x^2.
fn slope<'t>(x: &[Var<'t, f64>]) -> Var<'t, f64> {
    x[0].powi(3).sum().grad_graph(&[&x[0]]).remove(0)
}

#[test]
fn gradient_inside_a_running_function_is_taken() {
    // A checkpoint first runs it unrecorded.
    let tape = Tape::<f64>::new();
    let x = tape.leaf(Tensor::scalar(3.0));
    let y = tape.checkpoint(&[&x], slope);
    assert_eq!((y.item(), y.grad(&[&x])[0].item()), (27.0, 18.0));
    let second = y.grad_graph(&[&x]).remove(0);
    assert_eq!((second.item(), second.grad(&[&x])[0].item()), (18.0, 6.0));
    assert_eq!(tape.no_grad(|| tape.checkpoint(&[&x], slope)).item(), 27.0);
    assert_eq!(tape.checkpoint(&[&tape.constant(Tensor::scalar(3.0))], slope).item(), 27.0);
    // By an input without a requested gradient: a constant, or another variable.
    let by_second = |x: &[Var<'_, f64>]| (x[0].square() * &x[1]).sum().grad_graph(&[&x[1]]).remove(0).value().clone();
    let constant = tape.constant(Tensor::scalar(5.0));
    for other in [&constant, &x.exp()] {
        let y = tape.checkpoint(&[&x, other], move |x| x[0].tape().constant(by_second(x)) * &x[0]);
        assert_eq!((y.item(), y.grad(&[&x])[0].item(), y.grad_graph(&[&x])[0].item()), (27.0, 9.0, 9.0));
    }
    // Compared with differences, also for functions of tensors.
    let at = Tensor::from_vec(&[2], vec![0.4, -1.1]);
    check_function(&Check::default(), &[at], |x| slope(x) * &x[0]).unwrap();
    let (y, grads) = raygrad::derivatives::value_and_grad(slope, &[Tensor::scalar(3.0)]);
    assert_eq!((y, grads[0].item()), (27.0, 18.0));
}

#[test]
fn missing_gradient_is_an_error_never_zero() {
    let tape = Tape::<f64>::new();
    let x = tape.leaf(Tensor::scalar(3.0));
    let c = tape.constant(Tensor::scalar(2.0));
    let text = |result: Result<Vec<Tensor<f64>>, Error>| result.unwrap_err().to_string();
    let message = text(tape.no_grad(|| x.square()).try_grad(&[&x]));
    assert!(message.starts_with("gradient of a constant") && message.contains("enable_grad"), "{message}");
    assert!(message.contains(&format!("{}:{}", file!(), line!() - 2)), "{message}");
    let message = text((&x * &c).try_grad(&[&x, &c]));
    assert!(message.starts_with("gradient with respect to a constant, number 1"), "{message}");
    for error in [
        c.try_backward(&[&x]).err(),
        c.try_grad_graph(&[&x]).err(),
        c.try_vjp(&c, &[&x]).err(),
        c.square().try_grad(&[&x]).err(),
    ] {
        assert!(matches!(error, Some(Error::OfConstant { .. })));
    }
    assert!(panic_of(|| c.jvp(&[&x], &[&c])).starts_with("gradient of a constant"));
    assert!(matches!(x.try_vjp(&tape.constant(vector(&[1.0])), &[&x]), Err(Error::Shape { op: "vjp", .. })));
    // A constant gradient is still a function of the variable, with the gradient zero.
    let third = (0..3).fold(x.square(), |y, _| y.grad_graph(&[&x]).remove(0));
    assert_eq!((third.item(), third.grad(&[&x])[0].item()), (0.0, 0.0));
    assert_eq!(x.affine(3.0, 1.0).hvp(&[&x], &[&c])[0].item(), 0.0);
    // Requesting no gradient is valid.
    assert!(x.square().grad(&[]).is_empty());
}

#[test]
fn enable_grad_works_inside_no_grad() {
    let force = |x: &Var<'_, f64>| {
        let x = x.tracked();
        let energy = x.tape().enable_grad(|| x.powi(4).sum());
        (-energy.grad_graph(&[&x]).remove(0)).value().clone()
    };
    let tape = Tape::<f64>::new();
    let (x, c) = (tape.leaf(vector(&[1.0, -2.0])), tape.constant(vector(&[1.0, -2.0])));
    for force in [force(&x), force(&c), tape.no_grad(|| force(&x)), tape.no_grad(|| force(&c))] {
        assert_eq!(force.as_slice(), [-4.0, 32.0]);
    }
    let inside = tape.no_grad(|| {
        let y = tape.enable_grad(|| x.exp().sum());
        assert!(!tape.is_recording() && y.is_on_graph());
        y.grad_graph(&[&x]).remove(0)
    });
    assert!(!inside.is_on_graph() && tape.is_recording());
    assert_eq!(inside.value(), x.exp().value());
}

/// An operation with its own form of gradient: the sum of `x[0]`, with one number for all elements.
struct Total;

/// One number for all elements.
struct Everywhere(Shape, f64);

impl raygrad::SparseGrad<f64> for Everywhere {
    fn shape(&self) -> &[usize] {
        &self.0
    }
    fn add_to(&self, dense: &mut Tensor<f64>) {
        dense.as_mut_slice().iter_mut().for_each(|x| *x += self.1);
    }
}

impl Op<f64> for Total {
    fn name(&self) -> &'static str {
        "total"
    }
    fn shape(&self, _x: &[&[usize]]) -> Result<Shape, ShapeError> {
        Ok(Shape::new())
    }
    fn forward(&self, x: &[&Tensor<f64>], _pool: &Pool<f64>) -> Tensor<f64> {
        Tensor::scalar(x[0].as_slice().iter().sum())
    }
    fn reads(&self) -> Reads {
        Reads::NOTHING
    }
    fn vjp<'t>(&self, cx: &Vjp<'t, '_, f64>) -> Grads<'t, f64> {
        let share = Everywhere(cx.shape(0).into(), cx.g().item());
        Grads::new([None]).with_sparse(0, std::sync::Arc::new(share))
    }
}

#[test]
fn sparse_and_dense_shares_sum_to_the_gradient() {
    /// An embedding with a penalty, tied weights, and two tables, one of them with a share of an unknown kind.
    type Model = for<'t> fn(&Var<'t, f64>, &Var<'t, f64>) -> Var<'t, f64>;
    let rows = |table: &Var<'_, f64>, index: [u32; 3]| table.value().shape()[0] > index[2] as usize;
    let models: [(&str, Model, Model); 5] = [
        (
            "rows and a penalty",
            |a, b| a.gather_rows([3, 1, 3]).exp().sum() + a.square().sum() * 0.5 + b.sum(),
            |a, b| pick(a, [3, 1, 3]).exp().sum() + a.square().sum() * 0.5 + b.sum(),
        ),
        (
            "tied weights",
            |a, b| (a.gather_rows([0, 2, 1]).matmul(a.t()) * 0.1).tanh().sum() * b.sum(),
            |a, b| (pick(a, [0, 2, 1]).matmul(a.t()) * 0.1).tanh().sum() * b.sum(),
        ),
        (
            "two tables",
            |a, b| (a.gather_rows([3, 3, 0]) * b.gather_rows([1, 0, 1])).exp().sum(),
            |a, b| (pick(a, [3, 3, 0]) * pick(b, [1, 0, 1])).exp().sum(),
        ),
        (
            "shares of other kinds",
            |a, b| {
                let total = a.tape().apply(Total, &[a]);
                (a.gather_rows([1, 1, 2]).sum() * total.sin() + a.tape().apply(Total, &[b])) * a.exp().sum()
            },
            |a, b| (pick(a, [1, 1, 2]).sum() * a.sum().sin() + b.sum()) * a.exp().sum(),
        ),
        (
            "a table that is computed",
            |a, b| (a * 2.0).gather_rows([3, 1, 3]).exp().sum() + a.slice_axis(0, 1..3).square().sum() * b.sum(),
            |a, b| {
                pick(&(a * 2.0), [3, 1, 3]).exp().sum() + pick(a, [1, 2, 2]).square().sum() * b.sum()
                    - pick(a, [2, 2, 2]).square().sum() * b.sum() / 3.0
            },
        ),
    ];
    /// Gathers rows by a product with a matrix of ones and zeros, so that every gradient is dense.
    fn pick<'t>(table: &Var<'t, f64>, index: [u32; 3]) -> Var<'t, f64> {
        let rows = table.shape()[0];
        let one = |i: usize| f64::from(u8::from(index[i / rows] as usize == i % rows));
        table.tape().constant(Tensor::from_fn(&[3, rows], one)).matmul(table)
    }
    for (name, sparse, dense) in models {
        let gradients = |model: Model, backward: bool| {
            let tape = Tape::<f64>::new();
            let table = |rows: usize| tape.leaf(Tensor::from_fn(&[rows, 2], |i| (i as f64 * 1.7).sin()));
            let (a, b) = (table(4), table(2));
            assert!(rows(&a, [0, 0, 3]));
            let loss = model(&a, &b);
            match backward {
                true => loss.backward(&[&a, &b]).into_iter().map(|grad| grad.into_dense(tape.pool())).collect(),
                false => loss.grad(&[&a, &b]),
            }
        };
        let expected = gradients(dense, false);
        for got in [gradients(sparse, true), gradients(sparse, false)] {
            for (got, expected) in got.iter().zip(&expected) {
                assert!(expected.as_slice().iter().any(|&g| g != 0.0));
                assert_close(name, got.as_slice(), expected.as_slice(), 1e-14);
            }
        }
    }
}

/// Breaks one of the promises of an operation with one input.
#[derive(Clone, Copy, PartialEq)]
enum Broken {
    Output,
    Gradient,
    Sparse,
    Missing,
    Surplus,
    Recorded,
}

impl Op<f64> for Broken {
    fn name(&self) -> &'static str {
        "broken"
    }
    fn arity(&self) -> Option<usize> {
        Some(1)
    }
    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        Ok(x[0].into())
    }
    fn forward(&self, x: &[&Tensor<f64>], _pool: &Pool<f64>) -> Tensor<f64> {
        if *self == Broken::Output { Tensor::zeros(&[x[0].len() + 1]) } else { x[0].clone() }
    }
    fn vjp<'t>(&self, cx: &Vjp<'t, '_, f64>) -> Grads<'t, f64> {
        let rows = |extent: usize| {
            let grad = RowGrad::new(&[extent], [0].into(), Tensor::ones(&[1]));
            Grads::new([None]).with_sparse(0, std::sync::Arc::new(grad))
        };
        match self {
            Broken::Output => Grads::one(cx.g().clone()),
            Broken::Gradient => Grads::one(cx.g().sum()),
            Broken::Sparse => rows(5),
            Broken::Recorded => rows(2),
            Broken::Missing => Grads::new([]),
            Broken::Surplus => Grads::new([Some(cx.g().clone()), None]),
        }
    }
}

#[test]
fn operation_promises_are_checked_in_every_build() {
    let tape = Tape::<f64>::new();
    let x = tape.leaf(vector(&[1.0, 2.0]));
    let run = |op: Broken, recorded: bool| {
        panic_of(|| {
            let y = tape.apply(op, &[&x]).sum();
            if recorded { y.grad_graph(&[&x]).remove(0).into_value() } else { y.grad(&[&x]).remove(0) }
        })
    };
    for (op, recorded, expected) in [
        (Broken::Output, false, "broken: `forward` and `shape` disagree"),
        (Broken::Gradient, false, "broken: the gradient of input 0 has another shape"),
        (Broken::Gradient, true, "broken: the gradient of input 0 has another shape"),
        (Broken::Sparse, false, "broken: the gradient of input 0 has another shape"),
        (Broken::Missing, false, "broken: as many gradients as inputs"),
        (Broken::Surplus, false, "broken: as many gradients as inputs"),
        (Broken::Recorded, true, "broken: the gradient of input 0 is sparse in a recorded pass"),
    ] {
        let message = run(op, recorded);
        assert!(message.contains(expected), "{message}");
    }
    assert_eq!(tape.apply(Broken::Recorded, &[&x]).sum().grad(&[&x])[0].as_slice(), [1.0, 0.0]);
    assert!(panic_of(|| tape.apply(Broken::Missing, &[&x, &x])).contains("broken: 2 inputs instead of 1"));
    let twice = raygrad::formula!(|x| x + x);
    assert!(panic_of(|| tape.apply(raygrad::Elementwise::<_, 1>(twice), &[&x, &x])).contains("2 inputs instead of 1"));
}

#[test]
fn only_paths_to_wanted_variables_are_swept() {
    // In both orders of the leaves.
    for late in [false, true] {
        let tape = Tape::<f64>::new();
        let leaf = |value| tape.leaf(Tensor::scalar(value));
        let (x, z) = if late {
            let z = leaf(0.7);
            (leaf(0.5), z)
        } else {
            (leaf(0.5), leaf(0.7))
        };
        let inner = x.sin();
        let y = &inner * &z;
        // For an interior variable, the sweep ends there.
        assert_eq!(y.backward(&[&inner])[0].dense().unwrap().item(), 0.7);
        assert_eq!(inner.grad(&[&x])[0].item(), 0.5_f64.cos());
        // Freed nodes off the path do not matter.
        let y = &inner * &z;
        inner.backward(&[&x]);
        assert_eq!(y.grad(&[&z])[0].item(), 0.5_f64.sin());
        assert!(matches!(y.try_grad(&[&z, &x]), Err(Error::Freed { .. })));
        assert!(matches!(y.try_grad(&[&x]), Err(Error::Freed { .. })));
    }
}

#[test]
fn million_node_graph_is_swept_dropped_and_cleared() {
    let mut tape = Tape::<f64>::new();
    for free in [false, true] {
        let x = tape.leaf(Tensor::scalar(1.0));
        let aside = x.affine(3.0, 0.0);
        let y = (0..1_000_000).fold(x.clone(), |y, _| y + &x);
        let grad = match free {
            true => y.backward(&[&x]).remove(0).into_dense(tape.pool()),
            false => y.grad(&[&x]).remove(0),
        };
        assert_eq!(grad.item(), 1_000_001.0);
        assert_eq!(aside.grad(&[&x])[0].item(), 3.0);
        drop((x, y, aside));
        tape.clear();
    }
    let x = tape.leaf(Tensor::scalar(1.0));
    assert_eq!((x.square().grad(&[&x])[0].item(), tape.len()), (2.0, 2));
}

#[test]
fn small_gradients_on_long_tape_cost_own_nodes_only() {
    // Repeated gradients of three nodes: a tape that is a thousand times longer must not be much slower.
    let time = |before: usize| {
        let tape = Tape::<f64>::new();
        let x = tape.leaf(Tensor::scalar(0.3));
        let long = (0..before).fold(x.clone(), |y, _| y + &x);
        let start = std::time::Instant::now();
        for _ in 0..2000 {
            assert_eq!((x.sin() * 2.0).grad(&[&x])[0].item(), 2.0 * 0.3_f64.cos());
        }
        drop(long);
        start.elapsed().as_secs_f64()
    };
    let short = (0..5).map(|_| time(100)).fold(f64::INFINITY, f64::min);
    let long = (0..5).map(|_| time(100_000)).fold(f64::INFINITY, f64::min);
    assert!(long < 8.0 * short, "{long} s after {short} s");
}

#[test]
fn gradient_of_many_slices_costs_one_sum() {
    let (count, width) = (512, 2048);
    let tape = Tape::<f64>::new();
    let x = tape.leaf(Tensor::from_fn(&[count, width], |i| i as f64));
    let time = |y: &Var<'_, f64>| {
        let run = || {
            let start = std::time::Instant::now();
            let grad = y.grad(&[&x]).remove(0);
            (start.elapsed().as_secs_f64(), grad)
        };
        (0..3).map(|_| run()).min_by(|a, b| a.0.total_cmp(&b.0)).unwrap()
    };
    let weight = |i: usize| 1.0 + (i % 7) as f64;
    let sum = (0..count).fold(x.constant(0.0), |sum, i| sum + (x.slice_axis(0, i..i + 1).square() * weight(i)).sum());
    let weights = Tensor::from_fn(&[count, 1], weight);
    let (whole, expected) = time(&(x.square() * tape.constant(weights)).sum());
    let (slices, got) = time(&sum);
    assert!(got == expected);
    assert!(slices < 20.0 * whole, "{slices} s for slices, {whole} s for the whole");
    // Overlapping and reversed slices, and diagonals.
    let x = tape.leaf(Tensor::from_fn(&[3, 3], |i| i as f64));
    let y = x.slice_axis(0, ..2).sum()
        + x.slice_axis(0, 1..3).square().sum()
        + (x.flip(1).slice_axis(1, ..1) * 10.0).sum()
        + (x.diagonal(0) * 100.0).sum();
    let expected = [101.0, 1.0, 11.0, 7.0, 109.0, 21.0, 12.0, 14.0, 126.0];
    assert_eq!(y.grad(&[&x])[0].as_slice(), expected);
    assert_eq!(y.grad_graph(&[&x])[0].value().as_slice(), expected);
}

#[test]
fn errors_of_chained_methods_can_be_handled() {
    let tape = Tape::<f64>::new();
    let (x, w) = (tape.leaf(Tensor::ones(&[2, 3])), tape.leaf(Tensor::ones(&[4, 5])));
    let (result, line) = (tape.try_run(|| (x.exp().matmul(&w) + 1.0).sum().item()), line!());
    let error = result.unwrap_err().to_string();
    assert!(error.starts_with("matmul[[2, 3], [4, 5]]") && error.contains(&format!("{}:{line}:", file!())), "{error}");
    assert!(matches!(tape.try_run(|| &x + &w), Err(Error::Shape { op: "add", .. })));
    assert!(matches!(tape.try_run(|| x.grad(&[&x])), Err(Error::NotScalar { .. })));
    assert!(matches!(tape.try_run(|| tape.no_grad(|| x.sum()).grad(&[&x])), Err(Error::OfConstant { .. })));
    assert!(tape.is_recording(), "scopes end");
    // Inside of a checkpoint, forwards and backwards, and from nested scopes.
    assert!(matches!(
        tape.try_run(|| tape.checkpoint(&[&x, &w], |x| x[0].matmul(&x[1]))),
        Err(Error::Shape { op: "matmul", .. })
    ));
    assert_eq!(tape.try_run(|| tape.try_run(|| x.matmul(&w)).is_err()).ok(), Some(true));
    tape.check_finite(true);
    let y = tape.checkpoint(&[&x], |x| (&x[0] - 1.0).sqrt().sum());
    let error = tape.try_run(|| y.grad(&[&x])).unwrap_err();
    assert!(matches!(error, Error::NonFinite { op: "sqrt", .. }), "{error}");
    assert!(matches!(tape.try_run(|| (&x * 1e308) * 1e308), Err(Error::NonFinite { .. })));
    assert!(matches!(tape.try_run(|| tape.leaf(vector(&[f64::NAN]))), Err(Error::NonFinite { op: "leaf", .. })));
    tape.check_finite(false);
    // Other panics pass through, and outside of a scope errors panic as usual.
    assert_eq!(panic_of(|| tape.try_run(|| panic!("{}", "of another kind"))), "of another kind");
    assert!(panic_of(|| x.matmul(&w)).starts_with("matmul"));
    assert_eq!(tape.try_run(|| x.square().sum().grad(&[&x])).unwrap()[0], Tensor::full(&[2, 3], 2.0));
}

#[test]
fn jacobians_of_nothing_check_their_variables() {
    let tape = Tape::<f64>::new();
    let (x, constant) = (tape.leaf(Tensor::zeros(&[0])), tape.constant(Tensor::zeros(&[0])));
    assert_eq!(x.jacobian(&[&x])[0].shape(), [0, 0]);
    assert!(matches!(constant.try_jacobian(&[&x]), Err(Error::OfConstant { .. })));
    assert!(matches!(x.try_jacobian(&[&x, &constant]), Err(Error::ByConstant { index: 1, .. })));
}
