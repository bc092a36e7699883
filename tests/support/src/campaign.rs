//! Tests of a parser on damaged files: each is read or refused, without a panic and in bounded memory.
//!
//! The suite tries few. `PROPTEST_CASES=1000000 cargo test --release --workspace campaign -- --nocapture` tries a
//! million per parser, which takes hours, and prints a line for each.

use super::damage::{damage, damaged};
use super::tally::{Bound, Tally, cases};
use proptest::prelude::*;

/// Runs a parser on damaged forms of some whole files, which it must accept undamaged. `clear` checks the errors.
pub fn campaign<E: ToString>(
    name: &str,
    whole: &[Vec<u8>],
    bound: Bound,
    parse: impl Fn(&[u8]) -> Result<(), E>,
    clear: impl Fn(E),
) {
    for (i, file) in whole.iter().enumerate() {
        if let Err(error) = parse(file) {
            panic!("{name}: file {i}, which is whole: {}", error.to_string());
        }
    }
    let tally = Tally::new(name);
    let which = any::<prop::sample::Index>;
    proptest!(cases(), |(file in which(), other in which(), damage in damage())| {
        let [file, other] = [file, other].map(|which| &whole[which.index(whole.len())]);
        let bytes = damaged(file, other, &damage);
        if let Err(error) = tally.parse(bytes.len(), bound, || parse(&bytes)) {
            clear(error);
        }
    });
    let [_, refused] = tally.counts();
    assert!(refused > 0, "{name}: damage is noticed");
}
