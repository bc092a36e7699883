//! Time per element of operations that make up the cost of small models besides matrix products: softmax, layer
//! normalisation, losses, elementwise functions and reductions, forward and backward, on one thread in f32.
//!
//! `cargo run --release -p raygrad-autograd --example op_speed`; set `RAYGRAD_SIMD` to `v3` or `scalar` to compare. With
//! the argument `functions` it prints a line of JSON for each elementwise function, in cache, for
//! `benches/peers/accuracy.py`.

use raygrad_autograd::{Pool, Tape, Tensor, Var};
use std::time::Instant;

type Call = for<'t> fn(&Var<'t, f32>, &[Var<'t, f32>]) -> Var<'t, f32>;

/// Elementwise functions of numbers between 0 and 1.
const FUNCTIONS: [(&str, Call); 48] = [
    ("exp", |x, _| x.exp()),
    ("expm1", |x, _| x.expm1()),
    ("exp2", |x, _| x.exp2()),
    ("ln", |x, _| x.ln()),
    ("ln1p", |x, _| x.ln1p()),
    ("log2", |x, _| x.log2()),
    ("sqrt", |x, _| x.sqrt()),
    ("rsqrt", |x, _| x.rsqrt()),
    ("erf", |x, _| x.erf()),
    ("normal_cdf", |x, _| x.normal_cdf()),
    ("sin", |x, _| x.sin()),
    ("cos", |x, _| x.cos()),
    ("sin_pi", |x, _| x.sin_pi()),
    ("cos_pi", |x, _| x.cos_pi()),
    ("tan", |x, _| x.tan()),
    ("asin", |x, _| x.asin()),
    ("acos", |x, _| x.acos()),
    ("atan", |x, _| x.atan()),
    ("sinh", |x, _| x.sinh()),
    ("cosh", |x, _| x.cosh()),
    ("tanh", |x, _| x.tanh()),
    ("abs", |x, _| x.abs()),
    ("reciprocal", |x, _| x.reciprocal()),
    ("relu", |x, _| x.relu()),
    ("sigmoid", |x, _| x.sigmoid()),
    ("softplus", |x, _| x.softplus()),
    ("log_sigmoid", |x, _| x.log_sigmoid()),
    ("silu", |x, _| x.silu()),
    ("gelu", |x, _| x.gelu()),
    ("gelu_tanh", |x, _| x.gelu_tanh()),
    ("square", |x, _| x.square()),
    ("elu", |x, _| x.elu(1.5)),
    ("leaky_relu", |x, _| x.leaky_relu(0.125)),
    ("powi, 3", |x, _| x.powi(3)),
    ("powi, -2", |x, _| x.powi(-2)),
    ("powf, 1.75", |x, _| x.powf(1.75)),
    ("atan2", |x, rest| x.atan2(&rest[2])),
    ("hypot", |x, rest| x.hypot(&rest[2])),
    ("pow", |x, rest| x.pow(&rest[2])),
    ("xlogy", |x, rest| x.xlogy(&rest[2])),
    ("logaddexp", |x, rest| x.logaddexp(&rest[2])),
    ("remainder", |x, rest| x.remainder(&rest[2])),
    ("squared_error", |x, rest| x.squared_error(&rest[2])),
    ("huber, 1.5", |x, rest| x.huber(&rest[2], 1.5)),
    ("smooth_l1, 1.5", |x, rest| x.smooth_l1(&rest[2], 1.5)),
    ("binary_cross_entropy_with_logits", |x, rest| x.binary_cross_entropy_with_logits(&rest[2])),
    ("mul", |x, rest| x * &rest[2]),
    ("div", |x, rest| x / &rest[2]),
];

/// Nanoseconds an element, forward, and backward from the sum of all results: the fastest of several runs.
///
/// With `of_all`, backward is by the second operand too.
fn time(shape: &[usize], [low, high]: [f32; 2], call: Call, of_all: bool) -> [f64; 2] {
    let value = Tensor::from_fn(shape, |i| ((i * 7919) % 1013) as f32 / 1013.0 * (high - low) + low);
    let n = shape[shape.len() - 1];
    let row = Tensor::full(&[n], 0.5);
    let other = Tensor::from_fn(shape, |i| ((i * 31) % 101) as f32 * 0.0098 + 0.005);
    let (pool, mut best) = (Pool::new(), [f64::INFINITY; 2]);
    for _ in 0..20 + 40_000_000 / value.len().max(1_000_000) {
        let tape = Tape::with_pool(pool.clone());
        let x = tape.leaf(value.clone());
        let second = if of_all { tape.leaf(other.clone()) } else { tape.constant(other.clone()) };
        let rest = [tape.leaf(row.clone()), tape.leaf(row.clone()), second];
        let wrt = [&x, &rest[0], &rest[1], &rest[2]];
        let start = Instant::now();
        let y = call(&x, &rest);
        let forward = start.elapsed();
        let sum = y.sum();
        let start = Instant::now();
        let _grads = sum.backward(&wrt[..if of_all { 4 } else { 3 }]);
        let backward = start.elapsed();
        for (best, time) in best.iter_mut().zip([forward, backward]) {
            *best = best.min(time.as_nanos() as f64 / value.len() as f64);
        }
    }
    best
}

fn main() -> Result<(), rayon::ThreadPoolBuildError> {
    rayon::ThreadPoolBuilder::new().num_threads(1).build_global()?;
    if std::env::args().any(|argument| argument == "functions") {
        for (name, call) in FUNCTIONS {
            let [forward, backward] = time(&[128, 1024], [0.02, 0.98], call, true);
            println!(r#"{{"function": "{name}", "forward": {forward:.4}, "backward": {backward:.4}}}"#);
        }
        return Ok(());
    }
    println!("instruction set: {}, nanoseconds an element", raygrad_tensor::simd::name());
    println!("{:<24} {:>16} {:>9} {:>9}", "operation", "shape", "forward", "backward");
    let calls: [(&str, Call); 17] = [
        ("softmax", |x, _| x.softmax(-1)),
        ("log_softmax", |x, _| x.log_softmax(-1)),
        ("logsumexp", |x, _| x.logsumexp_over(-1)),
        ("layer_norm", |x, rest| x.layer_norm(&rest[0], &rest[1], 1e-5)),
        ("cross_entropy", |x, _| x.cross_entropy(vec![1; x.value().len() / x.shape()[1]])),
        ("binary_cross_entropy_with_logits", |x, rest| x.binary_cross_entropy_with_logits(&rest[2])),
        ("mse_loss", |x, rest| x.mse_loss(&rest[2])),
        ("sum", |x, _| x.sum()),
        ("sum over axis 0", |x, _| x.sum_over(0)),
        ("max over axis -1", |x, _| x.max_over(-1)),
        ("max over axis 0", |x, _| x.max_over(0)),
        ("var over axis -1", |x, _| x.var_over(-1, 0)),
        ("var over axis 0", |x, _| x.var_over(0, 0)),
        ("cumsum over axis -1", |x, _| x.cumsum(-1)),
        ("gelu", |x, _| x.gelu()),
        ("silu", |x, _| x.silu()),
        ("x^3", |x, _| x.powi(3)),
    ];
    for (name, call) in calls {
        for shape in [[128, 10], [1024, 1000]] {
            let [forward, backward] = time(&shape, [-2.0, 2.0], call, false);
            println!("{name:<24} {:>16} {forward:>9.3} {backward:>9.3}", format!("{shape:?}"));
        }
    }
    Ok(())
}
