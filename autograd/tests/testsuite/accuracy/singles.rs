//! Errors of operations in f32 against the same operations in f64, which are measured against the reference themselves.
//! An error close to the limit is measured again, against the reference.
//!
//! In the suite these are some thousand cases an operation. All 2^32 arguments of the functions of one operand, with random
//! incoming gradients, take about four minutes a function on two cores:
//!
//! ```sh
//! ACCURACY_SINGLES=4294967296 ACCURACY_OPERANDS=1 cargo test --release -p raygrad-autograd --test testsuite singles -- --nocapture
//! ```
//!
//! Operations of more operands have as many random cases. `ACCURACY_OPERANDS` selects operations by that number.

use super::operations::{Operation, operations};
use super::{Column, Format, Random, compared, constants, evaluate, gate, is_asked, place, report, setting};
use rayon::prelude::*;
use std::ops::Range;

/// Cases that are evaluated together.
const BATCH: usize = 1 << 12;

/// An odd number: its multiples modulo 2^32 are all bit patterns, and the first ones are spread evenly.
const SPREAD: u32 = 0x9e37_79b1;

/// The error of `got` in units in the last place of f32, from a result of f64.
fn quick_error(got: f64, exact: f64) -> f64 {
    const LIMIT: f64 = 2.0 * (1_u128 << 127) as f64;
    if exact.is_nan() || got.is_nan() {
        return if exact.is_nan() && got.is_nan() { 0.0 } else { f64::INFINITY };
    }
    if exact.abs() >= LIMIT && got.is_infinite() {
        return if exact.signum() == got.signum() { 0.0 } else { f64::INFINITY };
    }
    // Infinity stands for the number after the largest.
    let got = if got.is_infinite() { LIMIT.copysign(got) } else { got };
    let exponent = ((exact.to_bits() >> 52 & 0x7ff) as i64 - 1023).max(-126);
    (got - exact).abs() * f64::from_bits(((1023 + 23 - exponent) as u64) << 52)
}

/// An incoming gradient as [`Random::gradient`] has it, in less time: of any bits, or so that its product with a
/// derivative of this slope is a number of any size.
fn incoming(random: &mut Random, slope: f64) -> f64 {
    let bits = random.bits();
    let any = f32::from_bits(bits as u32);
    let exponent = (slope.to_bits() >> 52 & 0x7ff) as i64 - 1023;
    if (bits >> 32) & 1 == 0 || !(-1022..=1023).contains(&exponent) {
        return if any.is_finite() { any.into() } else { 0.0 };
    }
    let target = -149 + (((bits >> 32) * 277) >> 32) as i64;
    let power = f64::from_bits((((target - exponent).clamp(-149, 127) + 1023) as u64) << 52);
    let significand = f64::from(f32::from_bits(bits as u32 & 0x807f_ffff | 127 << 23));
    f64::from((significand * power) as f32)
}

/// The errors of the cases with these numbers, which have the same constants.
fn examine(single: &Operation<f32>, double: &Operation<f64>, cases: Range<u64>) -> Vec<Column> {
    let (n, operands) = ((cases.end - cases.start) as usize, single.operands);
    let constants = constants(single, cases.start as usize);
    let mut random = Random::of(single.name, cases.start);
    let mut x = vec![Vec::with_capacity(n); operands];
    for case in cases {
        if operands == 1 {
            x[0].push(f64::from(f32::from_bits((case as u32).wrapping_mul(SPREAD))));
        } else {
            let drawn = (0..operands).map(|_| random.argument::<f32>()).collect();
            let drawn = (single.domain)(random.related::<f32>(drawn));
            x.iter_mut().zip(drawn).for_each(|(x, drawn)| x.push(drawn));
        }
    }
    // The value and the slopes in f64.
    let references = evaluate(double, constants, x.clone(), vec![1.0; n]);
    let references: Vec<&[f64]> = references.iter().map(|reference| reference.as_slice()).collect();
    let mut g = Vec::with_capacity(n);
    for i in 0..n {
        g.push(incoming(&mut random, references[1 + i / 2 % operands][i]));
    }
    let narrow = |x: &[f64]| x.iter().map(|&x| x as f32).collect::<Vec<_>>();
    let results = evaluate(single, constants, x.iter().map(|x| narrow(x)).collect(), narrow(&g));
    let values = results[0].as_slice();
    let column = |k: usize| {
        let (results, references) = (results[k].as_slice(), references[k]);
        let (mut column, mut worst, gate) = (Column::default(), None, gate(single.name, k > 0));
        let x = |i: usize| x.iter().map(|x| x[i]).collect::<Vec<_>>();
        let mut add = |i: usize| {
            let exact = compared(&(single.reference)(&x(i), constants), g[i], values[i].into());
            if let Some((exact, term)) = exact[k] {
                let error = Format::of::<f32>().error(results[i].into(), exact, term);
                column.add(error, gate, || place(&x(i), (k > 0).then_some(g[i]), constants));
            }
        };
        let (mut sum, mut count) = (0.0, 0);
        for (i, (&got, &reference)) in results.iter().zip(references).enumerate() {
            if k > 0 && !values[i].is_finite() {
                continue;
            }
            let error = quick_error(got.into(), if k > 0 { g[i] * reference } else { reference });
            // Both may be NaN for no reason.
            let is_lost = got.is_nan() && !x(i).iter().any(|x| x.is_nan());
            if is_lost || !(error < 0.99 * gate) {
                add(i);
                continue;
            }
            (sum, count) = (sum + error, count + 1);
            if error > worst.map_or(0.0, |(most, _)| most) {
                worst = Some((error, i));
            }
        }
        // The worst of the others, which may be reported.
        if let Some((error, i)) = worst {
            (sum, count) = (sum - error, count - 1);
            add(i);
        }
        Column { sum: column.sum + sum, count: column.count + count, ..column }
    };
    (0..=operands).map(column).collect()
}

#[test]
fn singles_agree_with_doubles() {
    let cases = setting("ACCURACY_SINGLES").unwrap_or(1 << 12) as u64;
    let rows = operations::<f32>().into_iter().zip(operations::<f64>());
    let rows = rows.filter(|(row, _)| is_asked(row.name, row.operands));
    let failed: Vec<String> = rows
        .flat_map(|(single, double)| {
            let size = if single.constants.is_some() { 16 } else { BATCH as u64 };
            let columns = (0..cases.div_ceil(size))
                .into_par_iter()
                .map(|part| examine(&single, &double, part * size..((part + 1) * size).min(cases)))
                .reduce(
                    || vec![Column::default(); 1 + single.operands],
                    |a, b| a.into_iter().zip(b).map(|(a, b)| a.joined(b)).collect(),
                );
            report::<f32>(single.name, columns, cases as usize / 10)
        })
        .collect();
    assert!(failed.is_empty(), "beyond the limit:\n{}", failed.join("\n"));
}
