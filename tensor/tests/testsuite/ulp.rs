//! Accuracy of the functions of `vmath`: f32 against f64 references, f64 against values from 220-bit arithmetic.

use raygrad_tensor::vmath::survey::{Function, doubles, singles, ulp_error};
use raygrad_tensor::{Pool, Real, Tensor, map_real, vmath};
use rayon::prelude::*;
use std::io::Write;

/// Parts of all bit patterns that [`worst`] looks at one by one: from 0 to the largest number, and the same below 0.
const PARTS: u64 = 16;

/// The largest error over every `step`-th bit pattern of each part, with its argument.
fn worst(function: &Function<f32>, step: u64) -> Vec<(f64, f32)> {
    const CHUNK: u64 = 1 << 12;
    let count = (1_u64 << 32).div_ceil(step);
    let of_part = |part: u64| (part * count / PARTS, (part + 1) * count / PARTS);
    (0..PARTS)
        .map(of_part)
        .map(|(first, end)| {
            (first / CHUNK..end.div_ceil(CHUNK))
                .into_par_iter()
                .map(|chunk| {
                    let patterns = (chunk * CHUNK)..((chunk + 1) * CHUNK).min(count);
                    let x: Vec<f32> = patterns.map(|i| f32::from_bits((i * step) as u32)).collect();
                    let mut y = vec![0.0; x.len()];
                    (function.apply)(&x, &mut y);
                    if let "sin" | "cos" = function.name {
                        // A quick form is used where it holds, and must give the same bits.
                        assert_same_bits(&x, &y, &plain_form(function.name == "sin", &x));
                    }
                    let errors = x.iter().zip(&y).map(|(&x, &y)| (ulp_error(y, (function.reference)(x.into())), x));
                    errors.fold((0.0, 0.0), |a, b| if b.0 > a.0 { b } else { a })
                })
                .reduce(|| (0.0, 0.0), |a, b| if b.0 > a.0 { b } else { a })
        })
        .collect()
}

/// Sines or cosines by the reduction for any argument.
fn plain_form(sine: bool, x: &[f32]) -> Vec<f32> {
    let x = Tensor::from_vec(&[x.len()], x.to_vec());
    let y = if sine {
        raygrad_tensor::map(
            [&x],
            &Pool::none(),
            #[inline(always)]
            |[x]| vmath::f32::sin(x),
        )
    } else {
        raygrad_tensor::map(
            [&x],
            &Pool::none(),
            #[inline(always)]
            |[x]| vmath::f32::cos(x),
        )
    };
    y.as_slice().to_vec()
}

fn assert_same_bits(x: &[f32], y: &[f32], plain: &[f32]) {
    for ((&y, plain), &x) in y.iter().zip(plain).zip(x) {
        assert!(y.to_bits() == plain.to_bits() || y.is_nan(), "two values for {x:e}: {y:e}, {plain:e}");
    }
}

/// Adds the worst arguments of each part to the file that `VMATH_WORST` names, if it is set.
fn record(name: &str, parts: &[(f64, f32)]) {
    let Ok(path) = std::env::var("VMATH_WORST") else { return };
    let mut file = std::fs::OpenOptions::new().append(true).create(true).open(path).unwrap();
    for (error, at) in parts.iter().filter(|(error, _)| *error > 0.0) {
        writeln!(file, "{name} {:#010x} {error:.4}", at.to_bits()).unwrap();
    }
}

/// The worst arguments that surveys have found, of each function in each of 16 parts of all bit patterns.
#[test]
fn known_worst_arguments_are_within_the_bounds() {
    let functions = singles();
    let mut count = 0;
    for line in include_str!("../reference/vmath_f32_worst.txt").lines().filter(|line| !line.starts_with('#')) {
        let [name, bits, ..] = line.split(' ').collect::<Vec<_>>()[..] else { panic!("{line:?}") };
        let x = f32::from_bits(u32::from_str_radix(&bits[2..], 16).unwrap());
        let function = functions.iter().find(|function| function.name == name).unwrap();
        // In every place of a vector, and alone.
        for n in [33, 1] {
            let mut y = vec![0.0; n];
            (function.apply)(&vec![x; n], &mut y);
            for y in y {
                let error = ulp_error(y, (function.reference)(x.into()));
                assert!(error <= function.bound, "{name}({x:e}) is {y:e}, {error} ULP off");
            }
        }
        count += 1;
    }
    assert!(count >= 7 * functions.len(), "only {count} arguments");
}

/// Prints a line a function and asserts all bounds; with `VMATH_ONLY=sin,cos`, those of these functions.
fn check(step: u64) {
    let only = std::env::var("VMATH_ONLY").unwrap_or_default();
    println!("{:<9} {:>8}  at", "f32", "max ULP");
    let failed: Vec<_> = singles()
        .into_iter()
        .filter(|function| only.is_empty() || only.split(',').any(|name| name == function.name))
        .filter(|function| {
            let parts = worst(function, step);
            record(function.name, &parts);
            let (error, at) = parts.into_iter().fold((0.0, 0.0), |a, b| if b.0 > a.0 { b } else { a });
            println!("{:<9} {error:>8.4}  {at:e} = {:#010x}", function.name, at.to_bits());
            error > function.bound
        })
        .map(|function| function.name)
        .collect();
    assert!(failed.is_empty(), "beyond their bounds: {failed:?}");
}

#[test]
fn every_997th_argument() {
    check(997);
}

#[test]
#[ignore = "2^32 inputs a function: minutes; \
            run with cargo test --release -p raygrad-tensor --test testsuite ulp -- --ignored --nocapture"]
fn every_argument() {
    check(1);
}

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
    // In the order of `reference/vmath_f64.py`.
    let functions = doubles();
    let count = records.len() / functions.len();
    assert!(count >= 900 && records.len().is_multiple_of(functions.len()));
    println!("{:<9} {:>8}  at", "f64", "max ULP");
    let mut failed = Vec::new();
    for (Function { name, apply, bound, .. }, records) in functions.into_iter().zip(records.chunks(count)) {
        let x: Vec<f64> = records.iter().map(|r| r.0).collect();
        let (mut worst, mut at) = (0.0, 0.0);
        let mut found = vec![0.0; x.len()];
        apply(&x, &mut found);
        for (&got, &(x, y, rest)) in found.iter().zip(records) {
            let ulp = y.abs().next_up() - y.abs();
            let error = ((got - y) / ulp - rest).abs();
            if !(error <= worst) && !f64::is_nan(worst) {
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
