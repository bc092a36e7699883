//! The framework away from NeRF: overhead of recorded operations, small training steps, single operations. One JSON line
//! each in the form of `benches/peers/ops.py` and `benches/peers/rust-peers`, with the same work, to take ratios against.
//!
//! ```sh
//! cargo bench --bench framework -- [scalars] [training] [operations]
//! ```

use rand::rngs::StdRng;
use rand::{Rng, RngExt, SeedableRng};
use raygrad::tensor::{map, parallel};
use raygrad::{
    Activation, Adam, AdamConfig, Axes, Bound, Conv2d, Conv2dConfig, Gradient, Init, Linear, Mlp, Optimizer, Params,
    Pool, Pool2dConfig, Tape, Tensor, Var, formula,
};
use rayon::prelude::*;
use std::time::Instant;

fn main() {
    let names: Vec<String> = std::env::args().skip(1).filter(|a| !a.starts_with("--")).collect();
    let asked = |group: &str| names.is_empty() || names.iter().any(|name| name == group);
    if asked("scalars") {
        scalars();
    }
    if asked("training") {
        training();
    }
    if asked("operations") {
        operations();
    }
}

/// The median time of `repeats` calls in seconds, after a tenth as many that are not timed.
fn median(repeats: usize, mut f: impl FnMut()) -> f64 {
    let warm_up = repeats.div_ceil(10);
    let mut times: Vec<f64> = (0..warm_up + repeats)
        .map(|_| {
            let start = Instant::now();
            f();
            start.elapsed().as_secs_f64()
        })
        .collect();
    times.drain(..warm_up);
    times.sort_by(f64::total_cmp);
    times[repeats / 2]
}

fn report(what: &str, figures: &[(&str, f64)]) {
    let mut line = serde_json::json!({ "framework": "raygrad", "what": what });
    for &(name, value) in figures {
        line[name] = value.into();
    }
    line["peak_rss_bytes"] = peak_rss().into();
    line["threads"] = rayon::current_num_threads().into();
    println!("{line}");
}

/// The most memory that the process has held, where the system says so.
fn peak_rss() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    Some(1024 * line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()?)
}

/// x <- w x + w, 500 times over.
fn scalars() {
    fn chain<'t>(w: &Var<'t, f32>) -> Var<'t, f32> {
        (0..500).fold(w.clone(), |x, _| x * w + w)
    }
    let mut tape = Tape::new();
    let forward = median(100, || {
        chain(&tape.leaf(Tensor::scalar(0.999)));
        tape.clear();
    });
    let both = median(100, || {
        let w = tape.leaf(Tensor::scalar(0.999));
        chain(&w).backward(&[&w]);
        drop(w);
        tape.clear();
    });
    let figures =
        [("nanoseconds_forward_per_op", forward * 1e6), ("nanoseconds_backward_per_op", (both - forward) * 1e6)];
    report("scalar chain, 1000 recorded operations", &figures);
}

/// Rows of a batch: inputs and targets.
struct Shard {
    x: Tensor<f32>,
    target: Tensor<f32>,
    pool: Pool<f32>,
}

impl Shard {
    /// A batch cut into one shard for each thread; `target` gives a row's targets.
    fn batch(rows: usize, row: &[usize], targets: usize, target: impl Fn(usize, usize) -> f32) -> Vec<Shard> {
        let rng = &mut StdRng::seed_from_u64(1);
        let count = rayon::current_num_threads().min(rows);
        (0..count)
            .map(|i| {
                let range = rows * i / count..rows * (i + 1) / count;
                let shape: Vec<usize> = [&[range.len()], row].concat();
                Shard {
                    x: Tensor::from_fn(&shape, |_| rng.random()),
                    target: Tensor::from_fn(&[range.len(), targets], |k| {
                        target(range.start + k / targets, k % targets)
                    }),
                    pool: Pool::new(),
                }
            })
            .collect()
    }
}

/// Forward, backward and Adam; each shard of the batch on a thread and a tape of its own.
fn train(
    what: &str,
    mut params: Params<f32>,
    shards: &[Shard],
    loss: impl for<'t> Fn(&Bound<'t, f32>, &Var<'t, f32>, &Var<'t, f32>) -> Var<'t, f32> + Sync,
) {
    let mut adam = Adam::new(AdamConfig::default());
    let rows: usize = shards.iter().map(|shard| shard.x.shape()[0]).sum();
    let (mut first, mut last) = (None, 0.0);
    let seconds = median(if rows * params.elements() < 1 << 23 { 3000 } else { 60 }, || {
        let gradient = |shard: &Shard| {
            let tape = Tape::with_pool(shard.pool.clone());
            let bound = params.bind(&tape);
            let share = shard.x.shape()[0] as f64 / rows as f64;
            let mean = loss(&bound, &tape.constant(shard.x.clone()), &tape.constant(shard.target.clone())) * share;
            (mean.item(), bound.backward(&mean))
        };
        let (mut value, mut sum) = (0.0, Vec::<Gradient<f32>>::new());
        for (part, grads) in shards.par_iter().map(|shard| parallel::serial(|| gradient(shard))).collect::<Vec<_>>() {
            value += f64::from(part);
            if sum.is_empty() {
                sum = grads;
            } else {
                sum.iter_mut().zip(grads).for_each(|(sum, grad)| sum.add(grad));
            }
        }
        adam.update(&mut params, &sum, 1e-3).check().expect("finite gradients");
        last = value;
        first.get_or_insert(value);
    });
    report(what, &[("seconds_per_step", seconds), ("loss_first", first.unwrap_or(0.0)), ("loss_last", last)]);
}

fn head(params: &mut Params<f32>, sizes: [usize; 2], rng: &mut impl Rng) -> Linear {
    Linear::new(params, "head", sizes, Activation::Identity, Init::Glorot, rng)
}

/// The mean cross entropy of logits and one-hot targets.
fn cross_entropy<'t>(logits: &Var<'t, f32>, target: &Var<'t, f32>) -> Var<'t, f32> {
    -(logits.log_softmax(-1) * target).sum_over(1).mean()
}

fn training() {
    let rng = &mut StdRng::seed_from_u64(0);
    let one_hot = |row: usize, class: usize| if row % 10 == class { 1.0 } else { 0.0 };

    let mut params = Params::new();
    let trunk = Mlp::new(&mut params, "trunk", [32, 64, 3], &[], rng);
    let last = head(&mut params, [64, 3], rng);
    let shards = Shard::batch(256, &[32], 3, |row, i| ((row * 3 + i) as f32 * 0.7).sin() * 0.5 + 0.5);
    train("train MLP 32-64-64-64-3, 256 rows, MSE", params, &shards, |bound, x, target| {
        (last.forward(bound, &trunk.forward(bound, x)) - target).square().mean()
    });

    let mut params = Params::new();
    let trunk = Mlp::new(&mut params, "trunk", [784, 512, 2], &[], rng);
    let last = head(&mut params, [512, 10], rng);
    let shards = Shard::batch(128, &[784], 10, one_hot);
    train("train MLP 784-512-512-10, 128 rows, cross entropy", params, &shards, |bound, x, target| {
        cross_entropy(&last.forward(bound, &trunk.forward(bound, x)), target)
    });

    let mut params = Params::new();
    let padded = Conv2dConfig { padding: [1, 1], ..Conv2dConfig::default() };
    let mut conv =
        |name, channels| Conv2d::new(&mut params, name, channels, [3, 3], padded, Activation::Relu, Init::He, rng);
    let (first, second) = (conv("first", [1, 8]), conv("second", [8, 16]));
    let last = head(&mut params, [16 * 7 * 7, 10], rng);
    let shards = Shard::batch(64, &[1, 28, 28], 10, one_hot);
    train("train CNN 8-16, 64 images 28x28, cross entropy", params, &shards, |bound, x, target| {
        let pool = Pool2dConfig::new([2, 2]);
        let h = first.forward(bound, x).max_pool2d(&pool);
        let h = second.forward(bound, &h).max_pool2d(&pool);
        cross_entropy(&last.forward(bound, &h.reshape(&[h.shape()[0], 16 * 7 * 7])), target)
    });
}

/// The gradient of the sum of f(x).
fn operation(what: &str, shape: &[usize], f: impl for<'t> Fn(&Var<'t, f32>) -> Var<'t, f32>) {
    let rng = &mut StdRng::seed_from_u64(0);
    let values = Tensor::from_fn(shape, |_| 4.0 * rng.random::<f32>() - 2.0);
    let mut tape = Tape::new();
    let seconds = median(30, || {
        let x = tape.leaf(values.clone());
        f(&x).sum().backward(&[&x]);
        drop(x);
        tape.clear();
    });
    report(what, &[("seconds_forward_backward", seconds)]);
}

fn operations() {
    operation("elementwise chain, 1M", &[1_000_000], |x| {
        let bump = (x * x * -0.5).exp();
        (x * 1.5 + 0.5).tanh() * x + bump - x
    });
    operation("elementwise chain, 1M, fused", &[1_000_000], |x| {
        formula!(|x| (x * 1.5 + 0.5).tanh() * x + (x * x * -0.5).exp() - x).on([x])
    });
    operation("sum over axis 0, 4096x1024", &[4096, 1024], |x| x.sum_over(Axes::from(0).keepdims()));
    operation("sum over axis 1, 4096x1024", &[4096, 1024], |x| x.sum_over(Axes::from(1).keepdims()));
    operation("sum, 4096x1024", &[4096, 1024], |x| x.sum());
    // Weighted, since the sum of a softmax is constant.
    let weight = Tensor::from_fn(&[1024, 512], |i| (i as f32 * 0.7).sin());
    operation("softmax 1024x512", &[1024, 512], |x| x.softmax(-1) * x.tape().constant(weight.clone()));
    let (gain, bias) = (Tensor::ones(&[512]), Tensor::zeros(&[512]));
    operation("layer norm 1024x512", &[1024, 512], |x| {
        let (gain, bias) = (x.tape().leaf(gain.clone()), x.tape().leaf(bias.clone()));
        x.layer_norm(&gain, &bias, 1e-5) * x.tape().constant(weight.clone())
    });
    views();
    let rng = &mut StdRng::seed_from_u64(1);
    let mut noise = |shape: &[usize]| Tensor::from_fn(shape, |_| rng.random::<f32>() - 0.5);
    let (kernel, right) = (noise(&[32, 16, 3, 3]), noise(&[512, 32, 32]));
    let padded = Conv2dConfig { padding: [1, 1], ..Conv2dConfig::default() };
    operation("convolution of one image 16x128x128 to 32", &[1, 16, 128, 128], |x| {
        x.conv2d(&x.tape().leaf(kernel.clone()), &padded)
    });
    operation("512 products of 32x32 matrices", &[512, 32, 32], |x| x.matmul(x.tape().constant(right.clone())));
}

/// What views cost where their elements have to be written in order, against a copy; many slices, against the whole.
fn views() {
    let pool = Pool::new();
    let x = Tensor::<f32>::from_fn(&[4096, 4096], |i| i as f32);
    let copy = median(20, || drop(map([&x], &pool, |[x]| x)));
    let mut out = vec![0.0; x.len()];
    let transpose = median(20, || x.t().layout().read(x.buffer(), &mut out));
    report("transpose 4096x4096, written", &[("seconds", transpose), ("seconds_copy", copy)]);
    let values = Tensor::<f32>::from_fn(&[512, 4096], |i| (i % 97) as f32);
    let mut tape = Tape::new();
    let mut timed = |parts: usize| {
        median(20, || {
            let x = tape.leaf(values.clone());
            let part = |i| x.slice_axis(0, i * 512 / parts..i * 512 / parts + 512 / parts).square().sum();
            let sum = (1..parts).map(part).fold(part(0), |sum, part| sum + part);
            sum.backward(&[&x]);
            drop((sum, x));
            tape.clear();
        })
    };
    let (whole, slices) = (timed(1), timed(512));
    report("squares of 512 slices of 8 MB, with gradient", &[("seconds", slices), ("seconds_whole", whole)]);
}
