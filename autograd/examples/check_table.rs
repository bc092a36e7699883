//! The worst error of every operation of the catalogue, by check, as the table of `docs/operations.md`, which this writes.
//!
//! ```text
//! cargo run --release -p raygrad-autograd --example check_table
//! ```

use raygrad_autograd::check::{Check, Report, catalogue, check_op};
use raygrad_nn::write_atomic;
use std::fmt::Write;
use std::path::Path;

const HEAD: &str = "# Operations and their errors

Written by `cargo run --release -p raygrad-autograd --example check_table`. Every operation of the catalogue
(`autograd/src/check/catalogue.rs`) is examined on several inputs: scalars, no elements, broadcast shapes, rows short and long.

- **entries**: how often the operation is in the catalogue, with different settings; **checks**: comparisons made.
- **first**, **second**: derivatives against central differences in f64, with a step scaled to the input and Richardson's
  extrapolation; relative to the norm of the gradient of the input that moves, and to what the rounding of the function's
  values makes of a difference. The second derivatives are those of the gradient by all inputs and by the output's
  gradient. Limit: 1e-7.
- **f32**: value and gradient in f32 against f64 from the same rounded inputs, as a distance relative to the norm (limit
  2e-6), and the worst element in units in the last place (limit 32); an element smaller than the root mean square of its
  tensor counts as that large.

Not in the table, because they pass or fail: the same bits when run again and on buffers with old values; the same
results (1e-14) from transposed and reversed views; one variable as two inputs; fused operations against their references (1e-12); formulas
against dual numbers (1e-12); linear operations against their adjoints (1e-14); exact values and gradients at extremes.
`autograd/tests/testsuite/peers.rs` compares value, gradient and second gradient of each operation with PyTorch in f64, within 2e-14.

";

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut rows: Vec<(&str, usize, Report)> = vec![];
    for entry in catalogue() {
        let report = check_op(&Check::default(), &entry)?;
        match rows.iter_mut().find(|(name, ..)| *name == entry.name) {
            Some((_, entries, worst)) => {
                *entries += 1;
                worst.merge(report);
            }
            None => rows.push((entry.name, 1, report)),
        }
    }
    rows.sort_by_key(|(name, ..)| *name);
    let mut table = String::from(HEAD);
    writeln!(table, "| operation | entries | checks | first | second | f32, norm | f32, ULP |")?;
    writeln!(table, "|---|---|---|---|---|---|---|")?;
    let mut line = |name: &str, entries: usize, r: &Report| {
        let (first, second, single) = (r.first_order, r.second_order, r.single);
        let checks = r.comparisons;
        writeln!(table, "| {name} | {entries} | {checks} | {first:.0e} | {second:.0e} | {single:.0e} | {:.1} |", r.ulps)
    };
    let mut all = Report::default();
    for (name, entries, report) in &rows {
        line(&format!("`{name}`"), *entries, report)?;
        all.merge(*report);
    }
    let entries = rows.iter().map(|(_, entries, _)| entries).sum();
    line(&format!("all {}", rows.len()), entries, &all)?;
    print!("{table}");
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/operations.md");
    write_atomic(&path, table.as_bytes())?;
    Ok(())
}
