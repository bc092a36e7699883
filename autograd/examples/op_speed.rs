//! Time per element of operations that make up the cost of small models besides matrix products: softmax, layer
//! normalisation, losses, elementwise functions and reductions, forward and backward, on one thread in f32.
//!
//! `cargo run --release -p raygrad-autograd --example op_speed`; set `RAYGRAD_SIMD` to `v3` or `scalar` to compare.

use raygrad_autograd::{Pool, Tape, Tensor, Var};
use std::time::Instant;

type Call = for<'t> fn(&Var<'t, f32>, &[Var<'t, f32>]) -> Var<'t, f32>;

/// Nanoseconds an element, forward, and backward from the sum of all results: the fastest of several runs.
fn time(shape: &[usize], call: Call) -> [f64; 2] {
    let value = Tensor::from_fn(shape, |i| ((i * 7919) % 1013) as f32 * 0.004 - 2.0);
    let n = shape[shape.len() - 1];
    let row = Tensor::full(&[n], 0.5);
    let other = Tensor::from_fn(shape, |i| ((i * 31) % 101) as f32 * 0.01);
    let (pool, mut best) = (Pool::new(), [f64::INFINITY; 2]);
    for _ in 0..20 + 40_000_000 / value.len().max(1_000_000) {
        let tape = Tape::with_pool(pool.clone());
        let x = tape.leaf(value.clone());
        let rest = [tape.leaf(row.clone()), tape.leaf(row.clone()), tape.constant(other.clone())];
        let start = Instant::now();
        let y = call(&x, &rest);
        let forward = start.elapsed();
        let sum = y.sum();
        let start = Instant::now();
        let _grads = sum.backward(&[&x, &rest[0], &rest[1]]);
        let backward = start.elapsed();
        for (best, time) in best.iter_mut().zip([forward, backward]) {
            *best = best.min(time.as_nanos() as f64 / value.len() as f64);
        }
    }
    best
}

fn main() -> Result<(), rayon::ThreadPoolBuildError> {
    rayon::ThreadPoolBuilder::new().num_threads(1).build_global()?;
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
            let [forward, backward] = time(&shape, call);
            println!("{name:<24} {:>16} {forward:>9.3} {backward:>9.3}", format!("{shape:?}"));
        }
    }
    Ok(())
}
