//! What the tape promises: derivatives of any order, threads that never meet, errors that name the line at fault.

use raygrad::autograd::{
    Activation, Check, Entry, Error, Grads, Op, Pool, Reads, Scalar, Shape, ShapeError, Tape, Tensor, Var, Vjp,
    check_op,
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

/// The text of the panic that `f` ends in.
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
fn a_variable_used_often_gathers_every_share() {
    let tape = Tape::<f64>::new();
    let x = tape.leaf(vector(&[0.5, -1.0]));
    // Small integers: the sum 1 + 2 + .. + 100 is exact.
    let mut sum = &x * 1.0;
    for k in 2..=100 {
        sum = sum + &x * f64::from(k);
    }
    assert_eq!(sum.sum().grad(&[&x])[0].as_slice(), [5050.0; 2]);
    // Both factors, a broadcast operand, and the same variable asked for twice.
    let y = (&x * &x).sum() + (&x + tape.constant(Tensor::zeros(&[3, 2]))).sum();
    let grads = y.grad(&[&x, &x]);
    assert_eq!(grads[0].as_slice(), [4.0, 1.0], "2 x + 3");
    assert_eq!(grads[0], grads[1]);
}

#[test]
fn gradients_of_interior_nodes_and_of_what_is_not_reached() {
    let tape = Tape::new();
    let x = tape.leaf(vector(&[0.2, 0.4]));
    let inner = x.sin();
    let unused = tape.leaf(Tensor::<f64>::ones(&[2, 3]));
    let y = inner.square().sum();
    let later = tape.leaf(vector(&[1.0]));
    let constant = tape.constant(vector(&[1.0, 2.0, 3.0]));
    let grads = y.grad(&[&inner, &unused, &x, &later, &constant, &y]);
    let [sines, cosines] = [[0.2_f64.sin(), 0.4_f64.sin()], [0.2_f64.cos(), 0.4_f64.cos()]];
    assert_close("the interior node", grads[0].as_slice(), &sines.map(|s| 2.0 * s), 1e-15);
    assert_close("the leaf below it", grads[2].as_slice(), &[0, 1].map(|i| 2.0 * sines[i] * cosines[i]), 1e-15);
    assert_eq!(grads[1], Tensor::zeros(&[2, 3]));
    assert_eq!(grads[3], Tensor::zeros(&[1]));
    assert_eq!(grads[4], Tensor::zeros(&[3]));
    assert_eq!(grads[5], Tensor::ones(&[]));
}

#[test]
fn detached_values_constants_and_no_grad_stop_gradients() {
    let tape = Tape::new();
    let x = tape.leaf(vector(&[3.0]));
    let y = (&x * x.detach()).sum();
    assert_eq!(y.grad(&[&x])[0].as_slice(), [3.0], "only the factor that is on the graph");
    let before = tape.len();
    let silent = tape.no_grad(|| x.exp().square());
    assert!(!silent.is_on_graph() && tape.len() == before && tape.is_recording());
    assert_eq!(silent.sum().grad(&[&x])[0].as_slice(), [0.0]);
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
fn a_freed_graph_says_so() {
    let tape = Tape::new();
    let x = tape.leaf(vector(&[0.5]));
    let y = x.sin().sum();
    assert_eq!(y.grad(&[&x]), y.grad(&[&x]), "`grad` can be repeated");
    assert_close("once", y.grad_once(&[&x])[0].as_slice(), &[0.5_f64.cos()], 1e-15);
    let error = y.try_grad(&[&x]).unwrap_err();
    assert!(matches!(error, Error::Freed { .. }), "{error}");
    assert!(error.to_string().contains(&format!("{}:{}", file!(), line!() - 2)), "{error}");
    assert!(matches!(y.try_grad_once(&[&x]), Err(Error::Freed { .. })));
}

#[test]
fn a_cleared_tape_gives_the_same_bits_without_allocating() {
    let mut tape = Tape::<f32>::new();
    let mut first = None;
    let mut allocated = 0;
    for round in 0..4 {
        let x = tape.leaf(Tensor::from_fn(&[50, 40], |i| (i as f32 * 0.37).sin()));
        let loss = (x.matmul_t(true, &x, false) * 0.1).tanh().square().sum();
        let grad = loss.grad_once(&[&x]).remove(0);
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

/// The bits of a gradient that passes through products, broadcasts and nonlinearities.
fn gradient_bits(salt: usize) -> Vec<u32> {
    let mut tape = Tape::<f32>::new();
    let mut bits = vec![];
    for round in 0..5 {
        let value = |i: usize| ((i * (salt + 3) + round) as f32 * 0.61).sin();
        let (x, w) = (tape.leaf(Tensor::from_fn(&[33, 17], value)), tape.leaf(Tensor::from_fn(&[17, 9], value)));
        let loss = (x.matmul(&w).softplus() / (1.0 + w.square().sum_axes(&[0]))).exp().mean();
        for grad in loss.grad(&[&x, &w]) {
            bits.extend(grad.as_slice().iter().map(|x| x.to_bits()));
        }
        drop((x, w, loss));
        tape.clear();
    }
    bits
}

#[test]
fn many_threads_with_a_tape_each_give_the_bits_of_one() {
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

/// A user's operation: y = log of the sum over the last axis of exp x, which stays as an axis of extent 1.
/// dx = g exp(x - y).
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
fn a_users_operation_is_one_like_any_other() {
    let entry = Entry::new(LogSumExp).sample(&[&[4, 3]]).sample(&[&[2, 2, 5]]).sample(&[&[1]]).sample(&[&[0, 2]]);
    check_op(&Check::default(), &entry).unwrap();
    let tape = Tape::<f32>::new();
    let y = tape.apply(LogSumExp, &[&tape.leaf(Tensor::full(&[2], 1000.0))]);
    assert_eq!(y.value().as_slice(), [1000.0 + 2.0_f32.ln()]);
}

/// Rematerialisation: keeps only its inputs and runs `f(a, b) = exp(a sin b)` again to differentiate it.
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
            // New nodes, so that an input which depends on the other keeps to its own share.
            let (a, b) = (cx.x(0) * 1.0, cx.x(1) * 1.0);
            return Grads::new(Self::run(&a, &b).vjp(cx.g(), &[&a, &b]).into_iter().map(Some));
        }
        let tape = Tape::with_pool(cx.pool().clone());
        let (a, b) = (tape.leaf(cx.x(0).into_value()), tape.leaf(cx.x(1).into_value()));
        let y = Self::run(&a, &b) * tape.constant(cx.g().value().clone());
        Grads::new(y.sum().grad_once(&[&a, &b]).into_iter().map(|grad| Some(cx.constant(grad))))
    }
}

#[test]
fn a_gradient_can_be_taken_inside_a_vjp() {
    check_op(&Check::default(), &Entry::new(Replay).sample(&[&[2, 3], &[2, 3]])).unwrap();
    // One input depends on the other: first and second derivatives are those of the plain expression.
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
fn a_fused_operation_keeps_the_shares_of_dependent_inputs_apart() {
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
fn shape_errors_name_the_operation_the_shapes_and_the_line() {
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
fn variables_of_two_tapes_do_not_mix() {
    let (one, two) = (Tape::<f32>::new(), Tape::<f32>::new());
    let (x, y) = (one.leaf(Tensor::ones(&[])), two.leaf(Tensor::ones(&[])));
    assert!(panic_of(|| &x * &y).contains("another tape"));
    let message = catch_unwind(AssertUnwindSafe(|| x.grad(&[&y]))).unwrap_err();
    assert!(message.downcast_ref::<&str>().is_some_and(|text| text.contains("another tape")));
}

#[test]
fn the_nan_finder_names_operation_line_and_index() {
    let tape = Tape::<f64>::new();
    tape.check_finite(true);
    let x = tape.leaf(Tensor::from_vec(&[2, 2], vec![1.0, 2.0, -1.0, -3.0]));
    let message = panic_of(|| x.ln());
    let expected = format!("ln: output is NaN at index [1, 0] (recorded at {}:{}:", file!(), line!() - 1);
    assert!(message.starts_with(&expected), "{message}");

    // The root is finite at 0, its slope is not.
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
fn the_nan_finder_says_where_a_bad_value_came_in() {
    let tape = Tape::<f64>::new();
    tape.check_finite(true);
    let message = panic_of(|| tape.leaf(vector(&[1.0, f64::INFINITY])));
    let expected = format!("leaf: the value is inf at index [1] (recorded at {}:{}:", file!(), line!() - 1);
    assert!(message.starts_with(&expected), "{message}");
    // A constant is not looked at, but what is computed from it says whose fault it is.
    let (x, bad) = (tape.leaf(vector(&[1.0, 2.0])), tape.constant(vector(&[f64::NAN, 0.0])));
    let message = panic_of(|| &x + &bad);
    assert!(message.starts_with("add: output (and input 1 was not finite before) is NaN at index [0]"), "{message}");
}

#[test]
fn the_nan_finder_checks_recorded_gradients_sums_and_sparse_ones() {
    let tape = Tape::<f32>::new();
    tape.check_finite(true);
    let starts = |message: String, expected: &str, line: u32| {
        assert!(message.starts_with(&format!("{expected} (recorded at {}:{line}:", file!())), "{message}");
    };
    // The line is the user's also where the gradient is made of recorded operations.
    let x = tape.leaf(Tensor::from_vec(&[2], vec![1.0, 0.0]));
    let root = x.sqrt();
    let line = line!() - 1;
    starts(panic_of(|| root.sum().grad_graph(&[&x])), "sqrt: the gradient of input 0 is inf at index [1]", line);
    // Two finite shares whose sum overflows: at a leaf, and before an operation.
    let x = tape.leaf(Tensor::from_vec(&[2], vec![1e-3, 1e-3]));
    let line = line!() - 1;
    let sum = (&x * 3e38 + &x * 3e38).slice(0, 0, 1).sum();
    starts(sum.try_grad(&[&x]).unwrap_err().to_string(), "leaf: the gradient is inf at index [0]", line);
    let h = x.affine(0.5, 0.0);
    let line = line!() - 1;
    let sum = (&h * 3e38 + &h * 3e38).slice(0, 0, 1).sum();
    starts(
        sum.try_grad(&[&x]).unwrap_err().to_string(),
        "affine: the gradient of the output is inf at index [0]",
        line,
    );
    // A sparse gradient with two rows in one place.
    let rows = x.gather_rows(&[0, 0].into());
    let line = line!() - 1;
    let sum = (rows * 3e38).sum();
    starts(
        sum.try_grad(&[&x]).unwrap_err().to_string(),
        "gather_rows: the gradient of input 0 is inf at index [0]",
        line,
    );
    assert!(panic_of(|| sum.backward(&[&x])).contains("gather_rows: the gradient of input 0 is inf"));
    // What overflows inside a gradient is not reported if the gradient is finite: softplus of a large number.
    let large = tape.leaf(Tensor::scalar(200.0));
    assert_eq!(large.softplus().grad_graph(&[&large])[0].item(), 1.0);
}

#[test]
fn one_tape_gives_many_gradients_of_many_results() {
    let tape = Tape::new();
    let x = tape.leaf(vector(&[0.3, -1.2]));
    let h = x.sin() * &x;
    let (first, second) = (h.exp().sum(), (&h * &h).sum());
    let both = &first + &second;
    let [a, b] = [&first, &second].map(|y| y.grad(&[&x]).remove(0));
    let sum: Vec<_> = a.as_slice().iter().zip(b.as_slice()).map(|(a, b)| a + b).collect();
    assert_close("both", both.grad(&[&x])[0].as_slice(), &sum, 1e-15);
    // In any order and of any kind, and none of them changes the graph's values.
    let recorded = first.grad_graph(&[&x]).remove(0);
    assert_close("recorded", recorded.value().as_slice(), a.as_slice(), 1e-15);
    let seed = tape.constant(Tensor::scalar(2.0));
    assert_close(
        "vjp",
        first.vjp(&seed, &[&x])[0].value().as_slice(),
        &a.as_slice().iter().map(|a| 2.0 * a).collect::<Vec<_>>(),
        1e-15,
    );
    assert_eq!(first.grad_with(&Tensor::scalar(1.0), &[&x, &h])[0], a);
    assert_eq!(second.grad(&[&x])[0], b);
    recorded.sum().grad(&[&x]);
    assert_eq!(first.grad(&[&x])[0], a);
    // The last one frees what it passes, and only that: not the leaf, which other graphs have too.
    let apart = x.cos().sum();
    assert_eq!(first.grad_once(&[&x])[0], a);
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
        // A derivative inside records what it needs, but its result is not on a graph that the scope could miss.
        let grads = x.square().sum().grad(&[&x]);
        assert_eq!(grads[0].as_slice(), [0.0], "nothing was recorded");
        (inner, x.square())
    });
    assert!(tape.is_recording() && !inner.is_on_graph() && !outer.is_on_graph());
    assert_eq!(tape.len(), 1);
    // A leaf that is made inside is a leaf, and what follows after the scope is recorded.
    let leaf = tape.no_grad(|| tape.leaf(vector(&[3.0])));
    assert_eq!((&leaf * &outer).sum().grad(&[&leaf])[0].as_slice(), [4.0]);
}

#[test]
fn empty_and_scalar_tensors_pass_through_everything_of_a_tape() {
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
