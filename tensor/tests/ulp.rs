//! Accuracy of the functions of `vmath`: f32 against f64 references, f64 against values from 220-bit arithmetic.

use std::f64::consts::PI;

use raygrad_tensor::{Pool, Real, Tensor, map_real, simd, vmath, vmath::f32 as vm};
use rayon::prelude::*;

/// A name, the function applied to a slice, an f64 reference, and the bound in ULP.
type Case = (&'static str, fn(&[f32], &mut [f32]), fn(f64) -> f64, f64);

macro_rules! case {
    ($f:ident, $reference:expr, $bound:expr) => {
        (
            stringify!($f),
            |x, y| {
                simd::dispatch(
                    #[inline(always)]
                    || {
                        for (y, &x) in y.iter_mut().zip(x) {
                            *y = vm::$f(x);
                        }
                    },
                )
            },
            $reference,
            $bound,
        )
    };
}

/// As `case`, for a function with a quick form: where that holds, it must give the same bits.
macro_rules! either_case {
    ($f:ident, $reference:expr, $bound:expr) => {
        (
            stringify!($f),
            |x, y| {
                let x = Tensor::from_vec(&[x.len()], x.to_vec());
                y.copy_from_slice(map_real!([&x], &Pool::none(), |[x]| x.$f()).as_slice());
                let plain = raygrad_tensor::map(
                    [&x],
                    &Pool::none(),
                    #[inline(always)]
                    |[x]| vm::$f(x),
                );
                for ((&y, &plain), &x) in y.iter().zip(plain.as_slice()).zip(x.as_slice()) {
                    assert!(y.to_bits() == plain.to_bits() || y.is_nan(), "two values for {x:e}: {y:e}, {plain:e}");
                }
            },
            $reference,
            $bound,
        )
    };
}

const CASES: [Case; 14] = [
    case!(exp, f64::exp, 1.0),
    case!(exp2, f64::exp2, 1.0),
    case!(expm1, f64::exp_m1, 2.0),
    case!(ln, f64::ln, 1.0),
    case!(ln1p, f64::ln_1p, 2.0),
    case!(log2, f64::log2, 2.0),
    either_case!(sin, f64::sin, 2.0),
    either_case!(cos, f64::cos, 2.0),
    case!(sin_pi, sin_pi, 2.0),
    case!(cos_pi, |x| sin_pi(x.abs() % 2.0 + 0.5), 2.0),
    case!(tanh, f64::tanh, 2.0),
    case!(sigmoid, |x| 1.0 / (1.0 + (-x).exp()), 2.0),
    case!(softplus, |x| x.max(0.0) + (-x.abs()).exp().ln_1p(), 2.0),
    case!(erf, libm::erf, 2.0),
];

/// sin(pi x) for an x that came from f32 (plus one half): the reduction to |r| <= 1/4 is exact in f64.
fn sin_pi(x: f64) -> f64 {
    let y = x - 2.0 * (x / 2.0).round();
    let n = (2.0 * y).round();
    let r = PI * (y - n / 2.0);
    match n as i32 & 3 {
        0 => r.sin(),
        1 => r.cos(),
        2 => -r.sin(),
        _ => -r.cos(),
    }
}

/// |got - reference| in units of the spacing of f32 numbers at the reference.
fn ulp_error(got: f32, reference: f64) -> f64 {
    if got.is_nan() || reference.is_nan() {
        return if got.is_nan() && reference.is_nan() { 0.0 } else { f64::INFINITY };
    }
    if got == reference as f32 && got.is_infinite() {
        return 0.0;
    }
    // Infinity stands where the next number after the largest would be.
    let got = if got.is_infinite() { 2.0_f64.powi(128).copysign(got.into()) } else { got.into() };
    let exponent = ((reference.to_bits() >> 52) & 0x7ff) as i32 - 1023;
    let ulp = f64::from_bits(((exponent.clamp(-126, 127) - 23 + 1023) as u64) << 52);
    (got - reference).abs() / ulp
}

/// The largest error over every `step`-th bit pattern, with its argument.
fn worst((_, f, reference, _): Case, step: u64) -> (f64, f32) {
    const CHUNK: u64 = 1 << 12;
    let count = (1_u64 << 32).div_ceil(step);
    (0..count.div_ceil(CHUNK))
        .into_par_iter()
        .map(|chunk| {
            let patterns = (chunk * CHUNK)..((chunk + 1) * CHUNK).min(count);
            let x: Vec<f32> = patterns.map(|i| f32::from_bits((i * step) as u32)).collect();
            let mut y = vec![0.0; x.len()];
            f(&x, &mut y);
            let errors = x.iter().zip(&y).map(|(&x, &y)| (ulp_error(y, reference(x.into())), x));
            errors.fold((0.0, 0.0), |a, b| if b.0 > a.0 { b } else { a })
        })
        .reduce(|| (0.0, 0.0), |a, b| if b.0 > a.0 { b } else { a })
}

/// Prints a line a function and asserts all bounds; with `VMATH_ONLY=sin,cos`, those of these functions.
fn check(step: u64) {
    let only = std::env::var("VMATH_ONLY").unwrap_or_default();
    println!("{:<9} {:>8}  at", "f32", "max ULP");
    let failed: Vec<_> = CASES
        .into_iter()
        .filter(|case| only.is_empty() || only.split(',').any(|name| name == case.0))
        .filter(|&case| {
            let (error, at) = worst(case, step);
            println!("{:<9} {error:>8.4}  {at:e} = {:#010x}", case.0, at.to_bits());
            error > case.3
        })
        .map(|case| case.0)
        .collect();
    assert!(failed.is_empty(), "beyond their bounds: {failed:?}");
}

#[test]
fn every_997th_argument() {
    check(997);
}

#[test]
#[ignore = "2^32 inputs a function: minutes; \
            run with cargo test --release -p raygrad-tensor --test ulp -- --ignored --nocapture"]
fn every_argument() {
    check(1);
}

/// A name, the function applied to a slice, and the bound in ULP.
type Case64 = (&'static str, fn(&[f64]) -> Tensor<f64>, f64);

macro_rules! cases_f64 {
    ($($f:ident $bound:literal),+) => {
        [$((
            stringify!($f),
            |x| {
                let x = Tensor::from_vec(&[x.len()], x.to_vec());
                raygrad_tensor::map([&x], &Pool::none(), #[inline(always)] |[x]| vmath::f64::$f(x))
            },
            $bound,
        )),+]
    };
}

/// In the order of `reference/vmath_f64.py`.
const CASES_F64: [Case64; 14] = cases_f64![
    exp 1.0, exp2 1.0, expm1 2.0, ln 1.0, ln1p 2.0, log2 2.0, sin 2.0, cos 2.0, sin_pi 2.0, cos_pi 2.0, tanh 2.0,
    sigmoid 2.0, softplus 2.0, erf 2.0
];

/// The records of `reference/vmath_f64.py`: argument, nearest f64 to the value, and the rest in ULP.
fn records() -> Vec<(f64, f64, f64)> {
    let path = std::env::var("VMATH_F64").unwrap_or_else(|_| "tests/reference/vmath_f64.bin".into());
    let bytes = std::fs::read(&path).unwrap_or_else(|error| panic!("{path}: {error}"));
    let number = |b: &[u8]| f64::from_le_bytes(b.try_into().unwrap());
    let record =
        |b: &[u8]| (number(&b[..8]), number(&b[8..16]), f64::from(f32::from_le_bytes(b[16..].try_into().unwrap())));
    bytes.chunks_exact(20).map(record).collect()
}

#[test]
fn f64_within_its_bounds_on_samples_and_hard_cases() {
    let records = records();
    let count = records.len() / CASES_F64.len();
    assert!(count >= 900 && records.len().is_multiple_of(CASES_F64.len()));
    println!("{:<9} {:>8}  at", "f64", "max ULP");
    let mut failed = Vec::new();
    for ((name, f, bound), records) in CASES_F64.into_iter().zip(records.chunks(count)) {
        let x: Vec<f64> = records.iter().map(|r| r.0).collect();
        let (mut worst, mut at) = (0.0, 0.0);
        for (&got, &(x, y, rest)) in f(&x).as_slice().iter().zip(records) {
            let ulp = y.abs().next_up() - y.abs();
            let error = ((got - y) / ulp - rest).abs();
            if !(error <= worst) {
                (worst, at) = (error, x);
            }
        }
        println!("{name:<9} {worst:>8.4}  {at:e}");
        if !(worst <= bound) {
            failed.push(name);
        }
    }
    assert!(failed.is_empty(), "beyond their bounds: {failed:?}");
}

/// The quick reduction and the one for any argument, mixed in one block and not, on every instruction set.
#[test]
fn f64_sines_have_the_same_bits_either_way() {
    let angles: Vec<f64> = records().iter().map(|r| r.0).chain([f64::INFINITY, f64::NAN, -0.0]).collect();
    let quick: Vec<f64> = angles.iter().copied().filter(|x| x.abs() <= 1e9).collect();
    for x in [angles, quick] {
        let x = Tensor::from_vec(&[x.len()], x);
        let (sin, cos) = (map_real!([&x], &Pool::none(), |[x]| x.sin()), map_real!([&x], &Pool::none(), |[x]| x.cos()));
        for (i, &x) in x.as_slice().iter().enumerate() {
            let (sin, cos) = (sin.as_slice()[i], cos.as_slice()[i]);
            let same = |a: f64, b: f64| a.to_bits() == b.to_bits() || a.is_nan() && b.is_nan();
            assert!(same(sin, vmath::f64::sin(x)) && same(cos, vmath::f64::cos(x)), "{x:e}");
        }
    }
}
