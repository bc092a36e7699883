//! Every operation in the catalogue is examined, and every operation in the sources is in the catalogue.

use raygrad_autograd::check::{Check, catalogue, check_op};
use std::collections::BTreeSet;

#[test]
fn every_operation_passes_every_check() {
    let mut failures = vec![];
    println!("{:<24} {:>12} {:>12} {:>12}", "operation", "first order", "second order", "f32 - f64");
    let mut comparisons = 0;
    for entry in catalogue() {
        match check_op(&Check::default(), &entry) {
            Ok(report) => {
                println!(
                    "{:<24} {:>12.1e} {:>12.1e} {:>12.1e}",
                    entry.name, report.first_order, report.second_order, report.single
                );
                comparisons += report.comparisons;
            }
            Err(error) => failures.push(error),
        }
    }
    println!("{} entries, {comparisons} comparisons", catalogue().len());
    assert!(failures.is_empty(), "{}", failures.join("\n"));
    assert!(comparisons >= 20_000, "samples were lost: {comparisons} comparisons");
}

#[test]
fn the_table_of_errors_has_every_operation() {
    let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/library/operations.md");
    let table = std::fs::read_to_string(path).unwrap();
    let rows: BTreeSet<_> = catalogue().iter().map(|entry| format!("| `{}` |", entry.name)).collect();
    let total = format!("| all {} | {} |", rows.len(), catalogue().len());
    let missing: Vec<_> = rows.into_iter().chain([total]).filter(|row| !table.contains(row.as_str())).collect();
    assert!(missing.is_empty(), "run the example check_table: docs/library/operations.md has no rows {missing:?}");
}

#[test]
fn no_operation_is_missing() {
    let known: BTreeSet<_> = catalogue().iter().map(|entry| entry.name.to_string()).collect();
    let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("src/ops");
    let mut written = BTreeSet::new();
    for file in std::fs::read_dir(folder).unwrap() {
        let text = std::fs::read_to_string(file.unwrap().path()).unwrap();
        let mut lines = text.lines().peekable();
        while let Some(line) = lines.next() {
            let name =
                line.trim().strip_prefix("const NAME: &'static str = \"").and_then(|rest| rest.strip_suffix("\";"));
            let method = (line.trim() == "fn name(&self) -> &'static str {").then(|| lines.peek()).flatten();
            // An operation with a flag has two names.
            let method = method.into_iter().flat_map(|line| line.split('"').skip(1).step_by(2));
            written.extend(name.into_iter().chain(method).map(String::from));
            // Those of an operation and of its adjoint.
            let names = line.split_once("names: [\"").and_then(|(_, rest)| rest.split_once("\"]"));
            written.extend(names.into_iter().flat_map(|(names, _)| names.split("\", \"")).map(String::from));
        }
    }
    assert!(written.len() > 20, "found only {written:?}");
    let missing: Vec<_> = written.difference(&known).collect();
    assert!(missing.is_empty(), "not in the catalogue: {missing:?}");
}
