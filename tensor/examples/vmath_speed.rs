//! Time per element of the f32 functions of `vmath` against the standard library's, on one thread and in cache.
//!
//! `cargo run --release -p raygrad-tensor --example vmath_speed`; set `RAYGRAD_SIMD` to `v3` or `scalar` to compare.

use std::{hint::black_box, time::Instant};

use raygrad_tensor::{simd, vmath::f32 as vm};

const LEN: usize = 4096;

/// Nanoseconds an element: the fastest of several runs, which the rest of the machine disturbs least.
fn time(x: &[f32], y: &mut [f32], f: impl Fn(&[f32], &mut [f32])) -> f64 {
    let repeats = 1 + 100_000 / x.len();
    let run = |y: &mut [f32]| {
        let start = Instant::now();
        for _ in 0..repeats {
            f(black_box(x), black_box(y));
        }
        start.elapsed().as_nanos() as f64 / (repeats * x.len()) as f64
    };
    (0..30).map(|_| run(y)).fold(f64::INFINITY, f64::min)
}

fn map(x: &[f32], y: &mut [f32], f: impl Fn(f32) -> f32) {
    simd::dispatch(
        #[inline(always)]
        || {
            for (y, &x) in y.iter_mut().zip(x) {
                *y = f(x);
            }
        },
    )
}

macro_rules! row {
    ($f:ident, $from:literal..$to:literal, $std:expr) => {{
        let x: Vec<f32> = (0..LEN).map(|i| $from + ($to - $from) * i as f32 / LEN as f32).collect();
        let mut y = vec![0.0; LEN];
        let ours = |x: &[f32], y: &mut [f32]| map(x, y, vm::$f);
        let theirs = |x: &[f32], y: &mut [f32]| y.iter_mut().zip(x).for_each(|(y, &x)| *y = $std(x));
        let (a, b) = (time(&x, &mut y, ours), time(&x, &mut y, theirs));
        println!("{:<9} {a:>9.3} {b:>9.3} {:>9.1}", stringify!($f), b / a);
    }};
}

fn main() {
    println!("instruction set: {}, nanoseconds an element, {LEN} elements", simd::name());
    println!("{:<9} {:>9} {:>9} {:>9}", "function", "vmath", "std", "ratio");
    row!(exp, -10.0..10.0, f32::exp);
    row!(exp2, -10.0..10.0, f32::exp2);
    row!(expm1, -10.0..10.0, f32::exp_m1);
    row!(ln, 1e-3..100.0, f32::ln);
    row!(ln1p, -0.9..100.0, f32::ln_1p);
    row!(log2, 1e-3..100.0, f32::log2);
    row!(sin, -10.0..10.0, f32::sin);
    row!(cos, -10.0..10.0, f32::cos);
    row!(sin_pi, -10.0..10.0, |x: f32| (x * std::f32::consts::PI).sin());
    row!(cos_pi, -10.0..10.0, |x: f32| (x * std::f32::consts::PI).cos());
    row!(tanh, -10.0..10.0, f32::tanh);
    row!(sigmoid, -10.0..10.0, |x: f32| 1.0 / (1.0 + (-x).exp()));
    row!(softplus, -10.0..10.0, |x: f32| x.max(0.0) + (-x.abs()).exp().ln_1p());
    row!(erf, -4.0..4.0, |x: f32| libm::erff(x));

    println!("\nexp of short slices, nanoseconds a call");
    for len in [1, 2, 4, 8, 15, 16, 17, 32, 64] {
        let (x, mut y) = (vec![0.5; len], vec![0.0; len]);
        println!("{len:>3} {:>6.2}", len as f64 * time(&x, &mut y, |x, y| map(x, y, vm::exp)));
    }
}
