//! Time per element of the functions of `vmath` against the standard library's, on one thread and in cache.
//!
//! `cargo run --release -p raygrad-tensor --example vmath_speed [ELEMENTS] [--json]`; set `RAYGRAD_SIMD` to `v3` or
//! `scalar` to compare. Against PyTorch, in turns: `benches/peers/vmath.py`.

use std::{hint::black_box, time::Instant};

use raygrad_tensor::{Real, Scalar, lanes, lanes_real, simd, vmath};

/// Nanoseconds an element: the fastest of several runs, which the rest of the machine disturbs least.
fn time<T: Scalar>(x: &[T], f: impl Fn(&[T], &mut [T])) -> f64 {
    let mut y = vec![T::ZERO; x.len()];
    let repeats = 1 + 100_000 / x.len();
    let mut run = || {
        let start = Instant::now();
        for _ in 0..repeats {
            f(black_box(x), black_box(&mut y));
        }
        start.elapsed().as_nanos() as f64 / (repeats * x.len()) as f64
    };
    (0..30).map(|_| run()).fold(f64::INFINITY, f64::min)
}

struct Report {
    elements: usize,
    json: bool,
}

impl Report {
    /// `ours` and `theirs` on arguments between `low` and `high`.
    fn row<T: Scalar>(
        &self,
        name: &str,
        (low, high): (f64, f64),
        ours: impl Fn(&[T], &mut [T]),
        theirs: impl Fn(&[T], &mut [T]),
    ) {
        // Random, as branch prediction in a libm would learn anything more regular.
        let mut state = 1_u64;
        let uniform = |_| {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            T::from_f64(low + (high - low) * (state >> 11) as f64 / (1_u64 << 53) as f64)
        };
        let x: Vec<T> = (0..self.elements).map(uniform).collect();
        let (a, b) = (time(&x, ours), time(&x, theirs));
        if self.json {
            println!(
                r#"{{"function": "{name}", "type": "{}", "nanoseconds_per_element": {a:.4}, "std": {b:.4}}}"#,
                T::NAME
            );
        } else {
            println!("{:<4} {name:<9} {a:>9.3} {b:>9.3} {:>9.1}", T::NAME, b / a);
        }
    }
}

macro_rules! rows {
    ($report:ident, $t:ident: $($name:literal $range:expr, |$x:ident| $std:expr, $ours:expr;)+) => {
        $($report.row::<$t>($name, $range, $ours, |x, y| y.iter_mut().zip(x).for_each(|(y, &$x)| *y = $std));)+
    };
}

macro_rules! plain {
    ($f:expr) => {
        |x, y| {
            lanes(
                [x],
                y,
                #[inline(always)]
                |[x]| $f(x),
            )
        }
    };
}

macro_rules! angle {
    ($f:ident) => {
        |x, y| lanes_real!(&[x], y, |[x]| Real::$f(x))
    };
}

macro_rules! table {
    ($report:ident, $t:ident, $pi:expr, $erf:expr) => {{
        use vmath::$t as vm;
        rows! { $report, $t:
            "exp" (-10.0, 10.0), |x| x.exp(), plain!(vm::exp);
            "exp2" (-10.0, 10.0), |x| x.exp2(), plain!(vm::exp2);
            "expm1" (-4.0, 4.0), |x| x.exp_m1(), plain!(vm::expm1);
            "ln" (1e-3, 100.0), |x| x.ln(), plain!(vm::ln);
            "ln1p" (-0.9, 4.0), |x| x.ln_1p(), plain!(vm::ln1p);
            "log2" (1e-3, 100.0), |x| x.log2(), plain!(vm::log2);
            "sin" (-10.0, 10.0), |x| x.sin(), angle!(sin);
            "cos" (-10.0, 10.0), |x| x.cos(), angle!(cos);
            "sin, far" (1e10, 1e30), |x| x.sin(), angle!(sin);
            "sin_pi" (-10.0, 10.0), |x| (x * $pi).sin(), plain!(vm::sin_pi);
            "cos_pi" (-10.0, 10.0), |x| (x * $pi).cos(), plain!(vm::cos_pi);
            "tanh" (-4.0, 4.0), |x| x.tanh(), plain!(vm::tanh);
            "sigmoid" (-10.0, 10.0), |x| 1.0 / (1.0 + (-x).exp()), plain!(vm::sigmoid);
            "softplus" (-10.0, 10.0), |x| x.max(0.0) + (-x.abs()).exp().ln_1p(), plain!(vm::softplus);
            "erf" (-4.0, 4.0), |x| $erf(x), plain!(vm::erf);
        }
    }};
}

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let elements = arguments.iter().find_map(|a| a.parse().ok()).unwrap_or(4096);
    let report = Report { elements, json: arguments.iter().any(|a| a == "--json") };
    if !report.json {
        println!("instruction set: {}, nanoseconds an element, {elements} elements", simd::name());
        println!("     {:<9} {:>9} {:>9} {:>9}", "function", "vmath", "std", "ratio");
    }
    table!(report, f32, std::f32::consts::PI, libm::erff);
    table!(report, f64, std::f64::consts::PI, libm::erf);
    if report.json {
        return;
    }
    println!("\nexp of short slices, nanoseconds a call");
    for len in [1, 2, 4, 8, 15, 16, 17, 32, 64] {
        println!("{len:>3} {:>6.2}", len as f64 * time(&vec![0.5; len], plain!(vmath::f32::exp)));
    }
}
