//! What became of damaged files, and how many are tried.

use super::memory::peak;
use proptest::prelude::ProptestConfig;
use std::cell::Cell;
use std::time::Instant;

/// The most bytes that a parser may take: so many for each byte of its file, and so many for any.
#[derive(Debug, Clone, Copy)]
pub struct Bound {
    /// For each byte.
    pub times: usize,
    /// For any file.
    pub plus: usize,
}

impl Bound {
    /// The most for a file of that many bytes.
    pub fn of(self, length: usize) -> usize {
        self.times * length + self.plus
    }
}

/// How many files are tried: few, or what PROPTEST_CASES says.
pub fn cases() -> ProptestConfig {
    let cases = std::env::var("PROPTEST_CASES").ok().and_then(|cases| cases.parse().ok()).unwrap_or(400);
    // The least input that fails is printed, and the same seed finds it again.
    ProptestConfig { cases, failure_persistence: None, ..ProptestConfig::default() }
}

/// What became of the files.
pub struct Tally {
    name: String,
    start: Instant,
    counts: [Cell<u64>; 2],
    peak: Cell<usize>,
}

impl Tally {
    /// Nothing yet.
    pub fn new(name: &str) -> Self {
        Tally { name: name.to_owned(), start: Instant::now(), counts: Default::default(), peak: Cell::new(0) }
    }

    /// Lets a parser try a file of that many bytes; it is to take no more memory than the bound allows.
    pub fn parse<T, E>(&self, length: usize, bound: Bound, parse: impl FnOnce() -> Result<T, E>) -> Result<T, E> {
        let (result, bytes) = peak(parse);
        let which = &self.counts[usize::from(result.is_err())];
        which.set(which.get() + 1);
        self.peak.set(self.peak.get().max(bytes));
        assert!(bytes <= bound.of(length), "{}: {bytes} bytes of memory for a file of {length}", self.name);
        result
    }

    /// Files that were accepted, and those that were refused.
    pub fn counts(&self) -> [u64; 2] {
        [0, 1].map(|which| self.counts[which].get())
    }
}

impl Drop for Tally {
    fn drop(&mut self) {
        let [accepted, refused] = self.counts();
        let (name, seconds, peak) = (&self.name, self.start.elapsed().as_secs_f64(), self.peak.get());
        let inputs = accepted + refused;
        println!("campaign | {name} | {inputs} inputs | {seconds:.1} s | {accepted} | {refused} | {peak} bytes");
    }
}
