//! Counts of accepted and refused files, and the number of tests.

use super::memory::peak;
use proptest::prelude::ProptestConfig;
use std::cell::Cell;
use std::sync::LazyLock;
use std::time::Instant;

/// The most bytes that a parser may allocate: some per byte of its file, plus a constant.
#[derive(Debug, Clone, Copy)]
pub struct Bound {
    /// Bytes per byte of the file.
    pub times: usize,
    /// The constant.
    pub plus: usize,
}

impl Bound {
    /// The limit for a file of `length` bytes.
    pub fn of(self, length: usize) -> usize {
        self.times * length + self.plus
    }
}

/// The number of files to try: few, or `PROPTEST_CASES`.
pub fn cases() -> ProptestConfig {
    let cases = std::env::var("PROPTEST_CASES").ok().and_then(|cases| cases.parse().ok()).unwrap_or(400);
    // The smallest failing input is printed, and the fixed seed reproduces it.
    ProptestConfig { cases, failure_persistence: None, ..ProptestConfig::default() }
}

/// Counts of the results.
pub struct Tally {
    name: String,
    start: Instant,
    counts: [Cell<u64>; 2],
    peak: Cell<usize>,
    longest: Cell<f64>,
}

/// The most seconds of the processor that a parser may take for a file of a test, which has some kilobytes.
const LONGEST: f64 = 2.0;

/// Seconds that this thread has run; the time where the system does not count them.
fn worked() -> f64 {
    static START: LazyLock<Instant> = LazyLock::new(Instant::now);
    let count = std::fs::read_to_string("/proc/thread-self/schedstat").ok();
    let nanoseconds = count.and_then(|text| text.split(' ').next()?.parse::<f64>().ok());
    nanoseconds.map_or_else(|| START.elapsed().as_secs_f64(), |count| 1e-9 * count)
}

impl Tally {
    /// Starts at 0.
    pub fn new(name: &str) -> Self {
        let (counts, peak, longest) = Default::default();
        Tally { name: name.to_owned(), start: Instant::now(), counts, peak, longest }
    }

    /// Runs a parser on a file of `length` bytes and checks its memory and its time.
    pub fn parse<T, E>(&self, length: usize, bound: Bound, parse: impl FnOnce() -> Result<T, E>) -> Result<T, E> {
        let start = worked();
        let (result, bytes) = peak(parse);
        let seconds = worked() - start;
        self.longest.set(seconds.max(self.longest.get()));
        let which = &self.counts[usize::from(result.is_err())];
        which.set(which.get() + 1);
        self.peak.set(self.peak.get().max(bytes));
        assert!(bytes <= bound.of(length), "{}: {bytes} bytes of memory for a file of {length}", self.name);
        assert!(seconds <= LONGEST, "{}: {seconds} s for a file of {length} bytes", self.name);
        result
    }

    /// The numbers of accepted and refused files.
    pub fn counts(&self) -> [u64; 2] {
        [0, 1].map(|which| self.counts[which].get())
    }
}

impl Drop for Tally {
    fn drop(&mut self) {
        let [accepted, refused] = self.counts();
        let (name, seconds, peak) = (&self.name, self.start.elapsed().as_secs_f64(), self.peak.get());
        let inputs = accepted + refused;
        let longest = 1e3 * self.longest.get();
        println!(
            "campaign | {name} | {inputs} inputs | {seconds:.1} s | {accepted} | {refused} | {peak} bytes | {longest:.1} ms"
        );
    }
}
