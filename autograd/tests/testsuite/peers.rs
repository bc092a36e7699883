//! Every operation of the catalogue against PyTorch in f64: value, gradient, and the gradient of a contraction of the
//! gradient. `reference/make.py` says what the reference holds and writes it.

use raygrad_autograd::check::catalogue;
use raygrad_autograd::{
    Activation, Axes, Conv2dConfig, INFER, Indices, Mask, Op, Pool2dConfig, Scalar, Segments, Slice, Tape, Tensor, Var,
};
use raygrad_nn::Params;
use std::collections::BTreeSet;
use std::path::Path;
use std::sync::Arc;

/// An operation in the order of the reference's inputs.
type Function<T> = Box<dyn for<'t> Fn(&[Var<'t, T>]) -> Var<'t, T>>;

/// A case of the reference, for both precisions.
struct Case {
    name: String,
    f64: Function<f64>,
    f32: Function<f32>,
}

macro_rules! cases {
    ($($name:literal: |$x:ident| $y:expr;)*) => {
        vec![$(Case { name: $name.into(), f64: Box::new(|$x| $y), f32: Box::new(|$x| $y) }),*]
    };
}

/// Operations of the catalogue without a reference, and why.
const WITHOUT: [(&str, &str); 21] = [
    ("alias", "the tape's own copy of an input, not callable from outside; it is the identity"),
    ("mul_add", "the exact sum of a product in recorded gradients, not callable from outside; tests of those cover it"),
    ("ratio", "part of the gradients of norm, var and std, not callable from outside; tests of their range cover it"),
    ("spread_to", "the gradient of mean, compared as such, not callable from outside"),
    ("cosine", "part of recorded gradients of hypot, not callable from outside; tests of those cover it"),
    ("logistic_density", "the same of sigmoid and tanh"),
    ("cumprod_grad", "compared as the gradient of cumprod"),
    ("layer_norm_grad", "compared as the gradient of layer_norm"),
    ("log_softmax_grad", "compared as the gradient of log_softmax"),
    ("logsumexp_grad", "compared as the gradient of logsumexp"),
    ("cross_entropy_grad", "compared as the gradient of cross_entropy"),
    ("normalize_grad", "compared as the gradient of normalize"),
    ("prod_grad", "compared as the gradient of prod"),
    ("recurrence_grad", "compared as the gradient of recurrence"),
    ("softmax_grad", "compared as the gradient of softmax"),
    ("mean", "compared as sum.mean"),
    ("mean_loss", "compared as squared_error.mse_loss"),
    ("mean_cross_entropy", "compared as cross_entropy.mean"),
    ("matmul_left_transposed", "compared as matmul.tn"),
    ("matmul_right_transposed", "compared as matmul.nt"),
    ("matmul_both_transposed", "compared as matmul.tt"),
];

/// Of the functions that the catalogue lists by name, those of two operands, as methods: the order of operands is the method's.
fn elementwise() -> Vec<Case> {
    cases! {
        "affine": |x| x[0].affine(-2.5, 0.75);
        "leaky_relu": |x| x[0].leaky_relu(0.125);
        "elu": |x| x[0].elu(1.5);
        "clamp": |x| x[0].clamp(-1.0, 2.0);
        "powi.0": |x| x[0].powi(0);
        "powi.1": |x| x[0].powi(1);
        "powi.2": |x| x[0].powi(2);
        "powi.3": |x| x[0].powi(3);
        "powi.-1": |x| x[0].powi(-1);
        "powi.-4": |x| x[0].powi(-4);
        "powf.0.0": |x| x[0].powf(0.0);
        "powf.0.5": |x| x[0].powf(0.5);
        "powf.1.5": |x| x[0].powf(1.5);
        "powf.2.5": |x| x[0].powf(2.5);
        "powf.-0.5": |x| x[0].powf(-0.5);
        "atan2": |x| x[0].atan2(&x[1]);
        "pow": |x| x[0].pow(&x[1]);
        "xlogy": |x| x[0].xlogy(&x[1]);
        "hypot": |x| x[0].hypot(&x[1]);
        "logaddexp": |x| x[0].logaddexp(&x[1]);
        "remainder": |x| x[0].remainder(&x[1]);
        "maximum": |x| x[0].maximum(&x[1]);
        "minimum": |x| x[0].minimum(&x[1]);
        "add": |x| &x[0] + &x[1];
        "add.broadcast": |x| &x[0] + &x[1];
        "sub": |x| &x[0] - &x[1];
        "sub.broadcast": |x| &x[0] - &x[1];
        "mul": |x| &x[0] * &x[1];
        "mul.broadcast": |x| &x[0] * &x[1];
        "div": |x| &x[0] / &x[1];
        "div.broadcast": |x| &x[0] / &x[1];
        "compare.gt": |x| number(&x[0], x[0].gt(&x[1]));
        "compare.gt.broadcast": |x| number(&x[0], x[0].gt(&x[1]));
        "compare.ge": |x| number(&x[0], x[0].ge(&x[1]));
        "compare.ge.broadcast": |x| number(&x[0], x[0].ge(&x[1]));
        "compare.lt": |x| number(&x[0], x[0].lt(&x[1]));
        "compare.lt.broadcast": |x| number(&x[0], x[0].lt(&x[1]));
        "compare.le": |x| number(&x[0], x[0].le(&x[1]));
        "compare.le.broadcast": |x| number(&x[0], x[0].le(&x[1]));
        "compare.eq": |x| number(&x[0], x[0].elementwise_eq(&x[1]));
        "compare.eq.broadcast": |x| number(&x[0], x[0].elementwise_eq(&x[1]));
        "compare.ne": |x| number(&x[0], !x[0].elementwise_eq(&x[1]));
        "compare.ne.broadcast": |x| number(&x[0], !x[0].elementwise_eq(&x[1]));
        "where": |x| x[1].where_(&!x[0].elementwise_eq(0.0), &x[2]);
        "where.scalar": |x| x[1].where_(&!x[0].elementwise_eq(0.0), &x[2]);
        "if_positive": |x| x[0].if_positive(&x[1], &x[2]);
        "lerp": |x| x[0].lerp(&x[1], &x[2]);
        "lerp.broadcast": |x| x[0].lerp(&x[1], &x[2]);
    }
}

fn losses() -> Vec<Case> {
    cases! {
        "squared_error": |x| x[0].squared_error(&x[1]);
        "squared_error.mse_loss": |x| x[0].mse_loss(&x[1]);
        "absolute_error": |x| x[0].absolute_error(&x[1]);
        "absolute_error.l1_loss": |x| x[0].l1_loss(&x[1]);
        "huber": |x| x[0].huber(&x[1], 0.5);
        "huber.huber_loss": |x| x[0].huber_loss(&x[1], 1.0);
        "smooth_l1": |x| x[0].smooth_l1(&x[1], 0.5);
        "smooth_l1.smooth_l1_loss": |x| x[0].smooth_l1_loss(&x[1], 0.25);
        "binary_cross_entropy_with_logits": |x| x[0].binary_cross_entropy_with_logits(&x[1]);
        "binary_cross_entropy_with_logits.loss": |x| x[0].binary_cross_entropy_with_logits_loss(&x[1]);
        "cross_entropy": |x| x[0].cross_entropy([2, 0, 2]);
        "cross_entropy.wide": |x| x[0].cross_entropy([34, 0, 34]);
        "cross_entropy.loss": |x| x[0].cross_entropy_loss([2, 0, 2]);
    }
}

fn reductions() -> Vec<Case> {
    cases! {
        "sum": |x| x[0].sum();
        "sum.over": |x| x[0].sum_over([0, 2]);
        "sum.mean": |x| x[0].mean();
        "sum.mean_over": |x| x[0].mean_over(Axes::from(1).keepdims());
        "sum.norm_l1": |x| x[0].norm_l1_over(0);
        "broadcast_to": |x| x[0].broadcast_to(&[2, 3, 4]);
        "expand": |x| x[0].broadcast_to(&[2, 3]);
        "expand.scalar": |x| x[0].broadcast_to(&[2, 3]);
        "var.0": |x| x[0].var(0);
        "std.0": |x| x[0].std(0);
        "var.1": |x| x[0].var(1);
        "std.1": |x| x[0].std(1);
        "var.over": |x| x[0].var_over([0, 2], 1);
        "var.wide": |x| x[0].var_over(-1, 0);
        "std.over": |x| x[0].std_over(1, 0);
        "norm": |x| x[0].norm();
        "norm.over": |x| x[0].norm_over(1);
        "extremum.max": |x| x[0].max();
        "extremum.min": |x| x[0].min();
        "extremum.max_over": |x| x[0].max_over([0, 2]);
        "extremum.min_over": |x| x[0].min_over(1);
        "extremum.tie": |x| x[0].max_over(1);
        "prod": |x| x[0].prod();
        "prod.over": |x| x[0].prod_over(1);
        "prod.zero": |x| x[0].prod();
        "prod.zeros": |x| x[0].prod();
        "logsumexp": |x| x[0].logsumexp();
        "logsumexp.over": |x| x[0].logsumexp_over([0, 2]);
        "softmax": |x| x[0].softmax(-1);
        "softmax.first": |x| x[0].softmax(0);
        "softmax.wide": |x| x[0].softmax(-1);
        "log_softmax": |x| x[0].log_softmax(-1);
        "log_softmax.first": |x| x[0].log_softmax(0);
        "log_softmax.wide": |x| x[0].log_softmax(-1);
        "cumsum": |x| x[0].cumsum(1);
        "cumsum.reverse": |x| x[0].reverse_cumsum(0);
        "cumprod": |x| x[0].cumprod(0);
        "cumprod.zeros": |x| x[0].cumprod(0);
        "recurrence": |x| x[0].recurrence(&x[1], 0);
        "layer_norm": |x| x[0].layer_norm(&x[1], &x[2], 1e-3);
        "layer_norm.wide": |x| x[0].layer_norm(&x[1], &x[2], 1e-3);
        "segment_sum": |x| x[0].segment_sum(&segments());
        "segment_expand": |x| x[0].segment_expand(&segments());
        "segment_cumsum": |x| x[0].segment_cumsum(&segments(), false);
        "segment_cumsum.exclusive": |x| x[0].segment_cumsum(&segments(), true);
    }
}

fn segments() -> Segments {
    Segments::new([0, 3, 3, 4, 7])
}

fn shapes() -> Vec<Case> {
    cases! {
        "reshape": |x| x[0].reshape(&[3, INFER]);
        "view.permute": |x| x[0].permute(&[2, 0, 1]);
        "view.slice": |x| x[0].slice_axis(1, 1..3);
        "view.diagonal": |x| x[0].diagonal(1);
        "scatter_view": |x| x[0].diag_embed(-1);
        "slice_step": |x| x[0].slice_axis(0, Slice::from(1..6).step_by(-2));
        "windows": |x| x[0].windows(0, 3, 2);
        "transpose": |x| x[0].transpose(0, 2);
        "squeeze": |x| x[0].squeeze(1).unsqueeze(0);
        "concat": |x| Var::concat(&[&x[0], &x[1]], 1);
        "stack": |x| Var::stack(&[&x[0], &x[1], &x[0]], 1);
        "split": |x| {
            let parts = x[0].split(1, &[2, 1]);
            parts[0].square() * &parts[1]
        };
        "pad": |x| x[0].pad(&[[1, 2], [0, 1]], 0.5);
        "tile": |x| x[0].tile(&[2, 1, 3]);
        "repeat": |x| x[0].repeat(0, 3);
        "flip": |x| x[0].flip(0);
        "roll": |x| x[0].roll(0, -2);
        "diag": |x| x[0].diag(-1);
        "diag.of_matrix": |x| x[0].diag(-1);
        "triangle.tril": |x| x[0].tril(-1);
        "triangle.triu": |x| x[0].triu(1);
        "meshgrid": |x| {
            let grids = Var::meshgrid(&[&x[0], &x[1]]);
            &grids[0] * grids[1].square()
        };
        "gather": |x| x[0].gather(1, along());
        "scatter_add": |x| x[0].scatter_add(1, along(), &x[1]);
        "index_select": |x| x[0].index_select(1, [2, 0, 2]);
        "index_add": |x| x[0].index_add(1, [2, 0, 2], &x[1]);
        "gather_rows": |x| x[0].gather_rows([2, 0, 2]);
        "scatter_rows": |x| x[0].scatter_rows([2, 0, 2], 4);
        "sort": |x| x[0].sort(0, false).0;
        "sort_descending": |x| x[0].sort(1, true).0;
    }
}

fn along() -> Indices {
    Indices::new(&[2, 2, 2], [0, 2, 2, 1, 1, 1, 0, 2])
}

fn algebra() -> Vec<Case> {
    cases! {
        "matmul": |x| x[0].matmul(&x[1]);
        "matmul.vectors": |x| x[0].matmul(&x[1]);
        "matmul.vector_matrix": |x| x[0].matmul(&x[1]);
        "matmul.matrix_vector": |x| x[0].matmul(&x[1]);
        "matmul.batch": |x| x[0].matmul(&x[1]);
        "matmul.batch_matrix": |x| x[0].matmul(&x[1]);
        "matmul.tn": |x| x[0].t().matmul(&x[1]);
        "matmul.nt": |x| x[0].matmul(x[1].t());
        "matmul.tt": |x| x[0].t().matmul(x[1].t());
        "dot": |x| x[0].dot(&x[1]);
        "outer": |x| x[0].outer(&x[1]);
        "einsum": |x| Var::einsum("bij,bjk->bik", &[&x[0], &x[1]]);
        "einsum.one": |x| Var::einsum("iij->j", &[&x[0]]);
        "einsum_diagonal": |x| Var::einsum("iji,kj->k", &[&x[0], &x[1]]);
        "cross": |x| x[0].cross(&x[1]);
        "cross.broadcast": |x| x[0].cross(&x[1]);
        "normalize": |x| x[0].normalize();
        "linear": |x| x[0].linear(&x[1], Some(&x[2]), Activation::Identity);
        "linear.no_bias": |x| x[0].linear(&x[1], None, Activation::Identity);
        "linear.relu": |x| x[0].linear(&x[1], Some(&x[2]), Activation::Relu);
    }
}

const PLAIN: Conv2dConfig = Conv2dConfig { stride: [1, 1], padding: [0, 0], dilation: [1, 1] };
const UNEVEN: Conv2dConfig = Conv2dConfig { stride: [2, 1], padding: [1, 2], dilation: [1, 2] };
const WINDOWS: Pool2dConfig = Pool2dConfig { kernel: [3, 2], stride: [2, 1], padding: [1, 0] };

/// The gradient of `f` at `x` for the cotangent `g`, on the graph.
fn gradient<'t, T: Scalar>(x: &Var<'t, T>, g: &Var<'t, T>, f: impl Fn(&Var<'t, T>) -> Var<'t, T>) -> Var<'t, T> {
    // On the graph even where the reference's input is not, as the zeros at which a linear function is differentiated.
    let x = if x.is_on_graph() { x.clone() } else { x.tape().leaf(x.value().clone()) };
    (f(&x) * g).sum().grad_graph(&[&x]).remove(0)
}

fn zeros<'t, T: Scalar>(like: &Var<'t, T>, shape: &[usize]) -> Var<'t, T> {
    like.tape().leaf(Tensor::zeros(shape))
}

fn images() -> Vec<Case> {
    cases! {
        "conv2d": |x| x[0].conv2d(&x[1], &PLAIN);
        "conv2d.bias": |x| x[0].conv2d_bias(&x[1], &x[2], &PLAIN);
        "conv2d.uneven": |x| x[0].conv2d_bias(&x[1], &x[2], &UNEVEN);
        "conv2d_transpose": |x| x[0].conv2d_transpose(&x[1], &Conv2dConfig { stride: [2, 2], ..PLAIN }, [5, 5]);
        "conv2d_input": |x| x[0].conv2d_transpose(&x[1], &PLAIN, [3, 4]);
        "conv2d_input.uneven": |x| x[0].conv2d_transpose(&x[1], &UNEVEN, [4, 3]);
        "conv2d_weight": |x| gradient(&zeros(&x[0], &[2, 1, 3, 2]), &x[1], |w| x[0].conv2d(w, &UNEVEN));
        "max_pool2d": |x| x[0].max_pool2d(&WINDOWS);
        "max_pool2d.plain": |x| x[0].max_pool2d(&Pool2dConfig::new([2, 2]));
        "avg_pool2d": |x| x[0].avg_pool2d(&WINDOWS);
        "scatter_planes": |x| gradient(&x[0], &x[1], |x| x.max_pool2d(&WINDOWS));
        "gather_planes": |x| gradient(&zeros(&x[0], &[2, 1, 3, 3]), &x[1], |g| {
            gradient(&x[0], g, |x| x.max_pool2d(&WINDOWS))
        });
        "avg_pool2d_input": |x| gradient(&x[0], &x[1], |x| x.avg_pool2d(&WINDOWS));
    }
}

/// The operation of a case, by its name.
fn operation(case: &str) -> &str {
    case.split('.').next().unwrap_or_default()
}

/// An operation of the catalogue as a function.
fn function<T: Scalar>(op: Arc<dyn Op<T>>) -> Function<T> {
    Box::new(move |x| x[0].tape().apply(op.clone(), &x.iter().collect::<Vec<_>>()))
}

/// The cases above, and for all others of the reference the operation of the catalogue that has their name.
fn cases(reference: &Params<f64>) -> Vec<Case> {
    let mut cases: Vec<_> =
        [elementwise(), losses(), reductions(), shapes(), algebra(), images()].into_iter().flatten().collect();
    let catalogue = catalogue();
    for name in reference.iter().filter_map(|(name, _)| name.strip_suffix("/y")) {
        let entry = catalogue.iter().find(|entry| entry.name == operation(name));
        if let Some(entry) = entry.filter(|_| cases.iter().all(|case| case.name != name)) {
            let (f64, f32) = (function(entry.f64.clone()), function(entry.f32.clone()));
            cases.push(Case { name: name.into(), f64, f32 });
        }
    }
    cases
}

fn reference() -> Params<f64> {
    Params::read_npz(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/reference/peers.npz")).unwrap()
}

/// The values of all tensors behind one another.
fn flat<T: Scalar>(parts: &[Tensor<T>]) -> Vec<f64> {
    parts.iter().flat_map(|part| part.as_slice().iter().map(|x| x.to_f64())).collect()
}

/// The worst error of any element, relative to itself or, if it is smaller than others, to a tenth of the largest. NaN
/// for a NaN on either side.
fn error(got: &[f64], expected: &[f64]) -> f64 {
    assert_eq!(got.len(), expected.len());
    let largest = expected.iter().fold(0.0, |most: f64, x| most.max(x.abs()));
    let each = got.iter().zip(expected).map(|(got, expected)| {
        if got == expected { 0.0 } else { (got - expected).abs() / expected.abs().max(0.1 * largest) }
    });
    each.fold(0.0, |worst, error| if error > worst || error.is_nan() { error } else { worst })
}

/// The errors of value, gradient, recorded gradient and second gradient of a case.
fn errors<T: Scalar>(f: &Function<T>, expected: &impl Fn(&str) -> Option<Tensor<f64>>) -> [f64; 4] {
    let of = |key: &str| expected(key).unwrap_or_else(|| panic!("the reference has no {key}"));
    let tape = Tape::<T>::new();
    let inputs: Vec<_> = (0..).map_while(|i| expected(&format!("x{i}"))).collect();
    let x: Vec<_> = inputs.iter().map(|x| tape.leaf(x.cast())).collect();
    let (y, u) = (f(&x), tape.leaf(of("u").cast()));
    assert_eq!(y.shape(), of("y").shape());
    let wrt: Vec<_> = x.iter().collect();
    let along = (&y * &u).sum();
    let (plain, recorded) = (along.grad(&wrt), along.grad_graph(&wrt));
    let (w, mut start) = (of("w"), 0);
    let mut total = tape.constant(Tensor::scalar(T::ZERO));
    for grad in &recorded {
        let w = Tensor::from_fn(grad.shape(), |i| T::from_f64(w.as_slice()[start + i]));
        start += w.len();
        total += (grad * tape.constant(w)).sum();
    }
    let second = total.grad(&x.iter().chain([&u]).collect::<Vec<_>>());
    let recorded: Vec<_> = recorded.into_iter().map(Var::into_value).collect();
    [(&[y.into_value()][..], "y"), (&plain, "g"), (&recorded, "g"), (&second, "h")]
        .map(|(got, key)| error(&flat(got), of(key).as_slice()))
}

#[test]
fn every_case_agrees_with_the_reference() {
    let reference = reference();
    let mut failures = vec![];
    println!("{:<26} {:>9} {:>9} {:>9}   f32", "case", "value", "gradient", "second");
    for case in cases(&reference) {
        let expected = |key: &str| {
            let name = format!("{}/{key}", case.name);
            reference.iter().find(|(other, _)| **other == *name).map(|(_, value)| value.clone())
        };
        let (double, single) = (errors(&case.f64, &expected), errors(&case.f32, &expected));
        println!(
            "{:<26} {:>9.1e} {:>9.1e} {:>9.1e}   {:.1e} {:.1e} {:.1e}",
            case.name, double[0], double[1], double[3], single[0], single[1], single[3]
        );
        // Negated, so that NaN fails.
        if !double.iter().all(|&error| error <= 2e-14) || !single.iter().all(|&error| error <= 4e-6) {
            failures.push(format!("{}: {double:?} in f64, {single:?} in f32", case.name));
        }
    }
    assert!(failures.is_empty(), "{}", failures.join("\n"));
}

#[test]
fn every_operation_has_a_peer_or_a_reason() {
    let reference = reference();
    let cases = cases(&reference);
    let mut covered: BTreeSet<_> = cases.iter().map(|case| operation(&case.name)).collect();
    covered.extend(WITHOUT.map(|(name, _)| name));
    let missing: Vec<_> = catalogue().iter().map(|entry| entry.name).filter(|&name| !covered.contains(name)).collect();
    assert!(missing.is_empty(), "without a reference: {missing:?}");
    // And no case of the reference is left out.
    let known: BTreeSet<_> = cases.iter().map(|case| case.name.as_str()).collect();
    let cases = reference.iter().filter_map(|(name, _)| name.strip_suffix("/y"));
    let unused: Vec<_> = cases.filter(|name| !known.contains(name)).collect();
    assert!(unused.is_empty(), "in the reference, but not in the test: {unused:?}");
}

/// A mask as numbers.
fn number<'t, T: Scalar>(x: &Var<'t, T>, mask: Mask) -> Var<'t, T> {
    x.tape().constant(mask.cast())
}
