//! Writes `docs/library/operations.md`: the worst error of every operation of the catalogue, by check.
//!
//! ```text
//! cargo run --release -p raygrad-autograd --example check_table
//! ```

use raygrad_autograd::check::{Check, Report, catalogue, check_op};
use raygrad_nn::write_atomic;
use std::fmt::Write;
use std::path::Path;

const HEAD: &str = "# Operations and their errors

The table gives the worst error that the operation check measured for each operation of `raygrad-autograd`.
This page is generated; do not edit it by hand:

```sh
cargo run --release -p raygrad-autograd --example check_table
```

The source is `autograd/examples/check_table.rs`. The operations and their inputs come from the catalogue,
`autograd/src/check/catalogue.rs`. The inputs include scalars, empty tensors, broadcast shapes, and short and long rows.

| column | meaning | limit |
|---|---|---|
| entries | catalogue entries of the operation, one per setting | |
| checks | comparisons made | |
| first | first derivatives against central differences in f64 | 1e-7 |
| second | second derivatives against central differences of first derivatives in f64 | 1e-7 |
| f32, norm | value and gradients in f32 against f64, as a distance relative to the norm | 2e-6 |
| f32, ULP | the worst element of the same, in units in the last place of f32 | 32 |

- Errors of derivatives are relative to the norm of the gradient by the input that moves. A term is added for the
  rounding of the function's values.
- Differences use Richardson extrapolation with a step scaled to the input.
- Second derivatives differentiate the gradient by all inputs and by the output's gradient.
- Both precisions start from the same inputs, rounded to f32.
- In the ULP column, an element below its tensor's root mean square counts as that large.

Checks that only pass or fail are not in the table:

| check | limit |
|---|---|
| a second run, and a run on buffers with old values, give the same bits | exact |
| inputs from transposed or reversed arrays give the same results | 1e-14 |
| one variable as two inputs gives the sum of both gradients | 1e-12 |
| a constant input does not change the other gradients | 1e-12 |
| a fused operation agrees with its reference | 1e-12 |
| a formula agrees with dual numbers | 1e-13 (value), 1e-12 (gradient) |
| the gradient of a linear operation is its adjoint | 1e-14 |
| values and gradients at extremes agree with the exact ones | 1e-9 (f64), 5e-7 (f32) |
| value, gradient and second gradient agree with PyTorch in f64 (`autograd/tests/testsuite/peers.rs`) | 2e-14 |

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
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/library/operations.md");
    write_atomic(&path, table.as_bytes())?;
    Ok(())
}
