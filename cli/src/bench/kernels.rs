//! Benchmarks of kernels: elementary functions, matrix products and the hash grid.

use std::hint::black_box;
use std::path::Path;
use std::time::Instant;

use raygrad::nerf::Result;
use raygrad::nerf::encoding::hash_grid::{HashEncoding, HashGrid, HashGridConfig};
use raygrad::tensor::matmul::{Matrix, gemm};
use raygrad::tensor::vmath::survey::{Function, doubles, singles, ulp_error};
use raygrad::tensor::{Scalar, simd};
use raygrad::{Op, Pool, Tensor};

use super::Results;
use super::figure::{Axis, Figure, Panel, Series};
use super::stopwatch::{Timed, compare};
use super::table::{Table, digits};
use crate::machine;

/// Elements of a slice, which fits in the L1 cache.
const ELEMENTS: usize = 2048;
/// Values from 220-bit arithmetic, relative to the root of the repository.
const DOUBLE_REFERENCE: &str = "tensor/tests/reference/vmath_f64.bin";

/// Measures all kernels.
pub fn run(quick: bool) -> Result<Results> {
    let rounds = if quick { 3 } else { 25 };
    let mut results = Results::default();
    functions(rounds, quick, &mut results);
    products(rounds, &mut results);
    hash_grids(rounds, quick, &mut results)?;
    Ok(results)
}

/// Reproducible numbers in 0..1 without a pattern.
fn unit(i: usize) -> f64 {
    let mut x = (i as u64 + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    x = (x ^ (x >> 32)).wrapping_mul(0xd6e8_feb8_6659_fd93);
    (x >> 11) as f64 / (1_u64 << 53) as f64
}

/// Largest and mean error in ULP.
#[derive(Clone, Copy)]
struct Accuracy {
    largest: f64,
    mean: f64,
}

impl Accuracy {
    fn of(errors: impl Iterator<Item = f64>) -> Self {
        let (mut largest, mut sum, mut count) = (0.0_f64, 0.0, 0.0);
        for error in errors {
            // NaN counts as an error.
            largest = if error <= largest { largest } else { error };
            (sum, count) = (sum + error, count + 1.0);
        }
        Accuracy { largest, mean: sum / count }
    }
}

/// Accuracy over every `step`-th f32 number.
fn single_accuracy(function: &Function<f32>, step: u64) -> Accuracy {
    let x: Vec<f32> = (0..(1_u64 << 32).div_ceil(step)).map(|i| f32::from_bits((i * step) as u32)).collect();
    let mut y = vec![0.0; x.len()];
    (function.apply)(&x, &mut y);
    Accuracy::of(x.iter().zip(&y).map(|(&x, &y)| ulp_error(y, (function.reference)(x.into()))))
}

/// Accuracy on the values of `tensor/tests/reference/vmath_f64.py`; `None` outside of the repository.
fn double_accuracies(functions: &[Function<f64>], reference: &Path) -> Option<Vec<Accuracy>> {
    let bytes = std::fs::read(reference).ok()?;
    // An argument, the f64 nearest to the value, and the remainder in ULP.
    let number = |b: &[u8]| f64::from_le_bytes(std::array::from_fn(|i| b[i]));
    let rest = |b: &[u8]| f64::from(f32::from_le_bytes(std::array::from_fn(|i| b[i])));
    let records: Vec<[f64; 3]> = bytes.chunks_exact(20).map(|b| [number(b), number(&b[8..]), rest(&b[16..])]).collect();
    let count = records.len() / functions.len();
    let accuracy = |(function, records): (&Function<f64>, &[[f64; 3]])| {
        let x: Vec<f64> = records.iter().map(|r| r[0]).collect();
        let mut y = vec![0.0; x.len()];
        (function.apply)(&x, &mut y);
        let error = |(got, [_, y, rest]): (&f64, &[f64; 3])| ((got - y) / (y.abs().next_up() - y.abs()) - rest).abs();
        Accuracy::of(y.iter().zip(records).map(error))
    };
    Some(functions.iter().zip(records.chunks(count.max(1))).map(accuracy).collect())
}

/// Time of a function relative to `baseline`, for one call on all elements.
fn time<T: Scalar>(function: &Function<T>, baseline: &Function<T>, rounds: usize) -> Timed {
    let arguments = |function: &Function<T>| -> Vec<T> {
        let [low, high] = function.range;
        (0..ELEMENTS).map(|i| T::from_f64(low + (high - low) * unit(i))).collect()
    };
    const REPEATS: usize = 64;
    let run = |function: &Function<T>, x: &[T], y: &mut [T]| {
        (0..REPEATS).for_each(|_| (function.apply)(black_box(x), black_box(y)));
    };
    let (x, base_x) = (arguments(function), arguments(baseline));
    let [mut y, mut base_y] = [vec![T::ZERO; ELEMENTS], vec![T::ZERO; ELEMENTS]];
    let timed = compare(rounds, || run(baseline, &base_x, &mut base_y), || run(function, &x, &mut y));
    Timed { seconds: timed.seconds / (REPEATS * ELEMENTS) as f64, ..timed }
}

fn functions(rounds: usize, quick: bool, results: &mut Results) {
    let columns = [
        "type",
        "function",
        "ns per element",
        "ratio to exp",
        "control",
        "control spread",
        "largest error, ULP",
        "mean error, ULP",
        "stated bound, ULP",
    ];
    let mut table = Table::new("functions", &columns);
    let step = if quick { 100_003 } else { 1009 };
    let (single, double) = (singles(), doubles());
    let single_errors: Vec<Option<Accuracy>> = single.iter().map(|f| Some(single_accuracy(f, step))).collect();
    let double_errors: Vec<Option<Accuracy>> = match double_accuracies(&double, Path::new(DOUBLE_REFERENCE)) {
        Some(errors) => errors.into_iter().map(Some).collect(),
        None => {
            let what = format!("no errors in f64, which need {DOUBLE_REFERENCE}: run in a checkout of the repository");
            results.findings.push(what);
            vec![None; double.len()]
        }
    };
    let mut panels = vec![];
    let mut add = |kind: &str, rows: Vec<(&'static str, f64, Timed, Option<Accuracy>)>| {
        let mut labels = vec![];
        for (name, bound, timed, error) in rows {
            let errors = [error.map(|e| e.largest), error.map(|e| e.mean)].map(|e| e.map_or(String::new(), digits));
            let times = [1e9 * timed.seconds, timed.ratio, timed.control, timed.spread].map(digits);
            let row = [kind.to_owned(), name.to_owned()].into_iter().chain(times).chain(errors);
            table.push(row.chain([bound.to_string()]).collect());
            if let Some(error) = error {
                labels.push(([1e9 * timed.seconds, error.largest], name.to_owned()));
            }
        }
        let points = labels.iter().map(|label| label.0).collect();
        panels.push(Panel {
            title: kind.to_owned(),
            x: Axis::log("ns per element"),
            y: Axis::linear("largest error, ULP"),
            series: vec![Series::marks("", usize::from(kind == "f64"), points)],
            labels,
        });
    };
    let all = |f: &Function<f32>| time(f, &single[0], rounds);
    add("f32", single.iter().zip(single_errors).map(|(f, e)| (f.name, f.bound, all(f), e)).collect());
    let all = |f: &Function<f64>| time(f, &double[0], rounds);
    add("f64", double.iter().zip(double_errors).map(|(f, e)| (f.name, f.bound, all(f), e)).collect());
    results.tables.push(table);
    results.figures.push(Figure {
        name: "functions".to_owned(),
        title: format!("Elementary functions, one thread, {}", simd::name()),
        caption: format!(
            "Slices of {ELEMENTS} elements, in cache. Errors in f32 cover every {step}th number; errors in f64 cover \
             samples and hard cases."
        ),
        columns: 2,
        panel: [600, 420],
        panels,
    });
}

/// Eight independent chains of sixteen fused multiply-adds each.
#[inline(always)]
fn chains(x: f32, factor: f32) -> f32 {
    let mut sums = [x, x + 1.0, x + 2.0, x + 3.0, x + 4.0, x + 5.0, x + 6.0, x + 7.0];
    // Unrolled by hand: an inner loop would prevent vectorisation over elements.
    macro_rules! round {
        ($($chain:literal)+) => { $(sums[$chain] = sums[$chain].mul_add(factor, x);)+ };
    }
    macro_rules! rounds {
        ($($_round:literal)+) => { $(let _: u8 = $_round; round!(0 1 2 3 4 5 6 7);)+ };
    }
    rounds!(0 1 2 3 4 5 6 7 8 9 10 11 12 13 14 15);
    ((sums[0] + sums[1]) + (sums[2] + sums[3])) + ((sums[4] + sums[5]) + (sums[6] + sums[7]))
}

/// Peak FLOP/s of one thread, with fused multiply-adds in registers.
fn peak(rounds: usize) -> f64 {
    // Includes the additions at the start of each chain and at the end.
    const FLOP: usize = 2 * 8 * 16 + 7 + 7;
    let (x, mut y) = (vec![0.5_f32; ELEMENTS], vec![0.0_f32; ELEMENTS]);
    let factor = black_box(0.999_f32);
    let mut run = || {
        let (x, y) = (black_box(&x[..]), black_box(&mut y[..]));
        simd::dispatch(
            #[inline(always)]
            || {
                for (y, &x) in y.iter_mut().zip(x) {
                    *y = chains(x, factor);
                }
            },
        );
    };
    let least = (0..20 * rounds).map(|_| seconds(&mut run)).fold(f64::INFINITY, f64::min);
    (FLOP * ELEMENTS) as f64 / least
}

fn seconds(f: &mut impl FnMut()) -> f64 {
    let start = Instant::now();
    f();
    start.elapsed().as_secs_f64()
}

/// Rows, inner dimension and columns of the matrices: layers of small MLPs, of the classic MLP, and squares.
const SHAPES: [[usize; 3]; 8] = [
    [4096, 16, 64],
    [4096, 32, 64],
    [4096, 64, 16],
    [4096, 64, 64],
    [512, 256, 256],
    [4096, 256, 256],
    [256, 256, 256],
    [1024, 1024, 1024],
];

fn products(rounds: usize, results: &mut Results) {
    let peak = peak(rounds);
    let columns = [
        "rows x inner x columns",
        "FLOP",
        "operand bytes",
        "microseconds",
        "GFLOP/s",
        "fraction of FMA peak",
        "control",
        "control spread",
    ];
    let mut table = Table::new("gemm", &columns);
    let operands = |[m, k, n]: [usize; 3]| {
        let fill = |len: usize| (0..len).map(|i| unit(i) as f32 - 0.5).collect::<Vec<_>>();
        (fill(m * k), fill(k * n), vec![0.0_f32; m * n])
    };
    let multiply = |[m, k, n]: [usize; 3], (a, b, c): &mut (Vec<f32>, Vec<f32>, Vec<f32>), repeats: usize| {
        for _ in 0..repeats {
            gemm(Matrix::new(black_box(&a[..]), m, k), Matrix::new(&b[..], k, n), black_box(&mut c[..]), false);
        }
    };
    let repeats = |shape: [usize; 3]| (20_000_000 / shape.iter().product::<usize>()).max(1);
    let mut points = vec![];
    for (i, shape) in SHAPES.into_iter().enumerate() {
        let (base, count) = (SHAPES[3], repeats(shape));
        let (mut own, mut other) = (operands(shape), operands(base));
        let timed = compare(rounds, || multiply(base, &mut other, repeats(base)), || multiply(shape, &mut own, count));
        let seconds = timed.seconds / count as f64;
        let [m, k, n] = shape;
        let (flop, bytes) = (2 * m * k * n, 4 * (m * k + k * n + m * n));
        let rate = flop as f64 / seconds;
        points.push([(i + 1) as f64, 1e-9 * rate]);
        let numbers = [1e6 * seconds, 1e-9 * rate, rate / peak, timed.control, timed.spread].map(digits);
        let row = [format!("{m} x {k} x {n}"), flop.to_string(), bytes.to_string()];
        table.push(row.into_iter().chain(numbers).collect());
    }
    let line = vec![[1.0, 1e-9 * peak], [SHAPES.len() as f64, 1e-9 * peak]];
    let names = SHAPES.iter().zip(&points).map(|([m, k, n], point)| (*point, format!("{m} x {k} x {n}"))).collect();
    results.findings.push(format!("FMA peak of one thread in f32: {:.0} GFLOP/s", 1e-9 * peak));
    results.figures.push(Figure {
        name: "gemm".to_owned(),
        title: "Matrix products in f32, one thread".to_owned(),
        caption: "The line is the peak of fused multiply-adds in registers.".to_owned(),
        columns: 1,
        panel: [760, 360],
        panels: vec![Panel {
            title: "by shape: rows x inner x columns".to_owned(),
            x: Axis::linear("shape number"),
            y: Axis::linear("GFLOP/s"),
            series: vec![Series::marks("gemm", 0, points), Series::line("FMA peak", 1, line)],
            labels: names,
        }],
    });
    results.tables.push(table);
}

/// Samples per call of the encoding.
const SAMPLES: usize = 4096;

fn hash_grids(rounds: usize, quick: bool, results: &mut Results) -> Result<()> {
    let columns = [
        "log2 table size",
        "table bytes",
        "look-ups per sample",
        "bytes looked up per sample",
        "ns per sample, along rays",
        "ns per sample, random",
        "control",
        "control spread",
    ];
    let mut table = Table::new("hash-grid", &columns);
    let sizes: &[u32] = if quick { &[12, 15, 18] } else { &[10, 12, 13, 14, 15, 16, 17, 18, 19, 20] };
    let random = Tensor::from_fn(&[SAMPLES, 3], |i| unit(i) as f32);
    // Runs of 64 consecutive samples, as along a ray.
    let along = Tensor::from_fn(&[SAMPLES, 3], |i| {
        let (ray, step, axis) = (i / 192, (i / 3 % 64) as f64, i % 3);
        (0.05 + 0.8 * unit(3 * ray + axis) + [0.5, 0.6, 0.62][axis] * step / 512.0) as f32
    });
    let mut points = [vec![], vec![]];
    let pool = Pool::new();
    for &log2_table in sizes {
        let grid = HashGrid::new(&HashGridConfig { levels: 8, features: 4, log2_table, ..HashGridConfig::paper() })?;
        let rows = grid.init::<f32>(1);
        let encoding = HashEncoding::new(grid.clone());
        let run = |x: &Tensor<f32>| {
            black_box(encoding.forward(&[x, &rows], &pool));
        };
        let timed = compare(rounds, || run(&random), || run(&along));
        let bytes = 4 * rows.len();
        let (in_order, anywhere) = (1e9 * timed.seconds / SAMPLES as f64, 1e9 * timed.baseline / SAMPLES as f64);
        points[0].push([bytes as f64 / 1024.0, in_order]);
        points[1].push([bytes as f64 / 1024.0, anywhere]);
        let lookups = 8 * grid.levels().len();
        let counts = [log2_table as usize, bytes, lookups, lookups * 4 * grid.features()].map(|n| n.to_string());
        let times = [in_order, anywhere, timed.control, timed.spread].map(digits);
        table.push(counts.into_iter().chain(times).collect());
    }
    let [along, random] = points;
    let lowest = along.iter().chain(&random).map(|point| point[1]).fold(f64::INFINITY, f64::min);
    let caches = machine::caches().into_iter().map(|(name, bytes)| ([bytes as f64 / 1024.0, lowest], name));
    results.figures.push(Figure {
        name: "hash-grid".to_owned(),
        title: "Hash grid, 8 levels of 4 features: encoding one sample, one thread".to_owned(),
        caption: "Diamonds mark the cache sizes.".to_owned(),
        columns: 1,
        panel: [760, 360],
        panels: vec![Panel {
            title: "time against table size".to_owned(),
            x: Axis::log("table size, KiB"),
            y: Axis::linear("ns per sample"),
            series: vec![
                Series::line("along rays", 0, along),
                Series::line("random", 1, random),
                Series::marks("caches", 3, caches.clone().map(|cache| cache.0).collect()),
            ],
            labels: caches.collect(),
        }],
    });
    results.tables.push(table);
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn accuracy_on_sampled_f32_is_within_bounds() {
        for function in singles() {
            let accuracy = single_accuracy(&function, 1_000_003);
            assert!(accuracy.largest <= function.bound, "{}: {}", function.name, accuracy.largest);
            assert!(accuracy.mean > 0.0 && accuracy.mean < 0.6, "{}: {}", function.name, accuracy.mean);
        }
        let functions = doubles();
        let reference = Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(DOUBLE_REFERENCE);
        let accuracies = double_accuracies(&functions, &reference).unwrap();
        for (function, accuracy) in functions.iter().zip(accuracies) {
            assert!(accuracy.largest <= function.bound, "{}: {}", function.name, accuracy.largest);
        }
    }
}
