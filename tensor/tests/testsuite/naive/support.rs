//! Numbers, sizes and comparisons.

use raygrad_tensor::Scalar;

/// The variable that says in how many threads of a pool of their own the tests are to run.
pub const INSTALLED: &str = "RAYGRAD_TEST_INSTALLED";

/// Runs a check, in both precisions if it is generic, where [`INSTALLED`] says.
pub fn run(check: impl FnOnce() + Send) {
    match std::env::var(INSTALLED).ok().and_then(|threads| threads.parse().ok()) {
        Some(threads) => rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(check),
        None => check(),
    }
}

/// Runs a generic check in both precisions.
macro_rules! in_both {
    ($check:ident) => {
        crate::naive::support::run(|| {
            $check::<f32>();
            $check::<f64>();
        })
    };
}
pub(crate) use in_both;

/// Just below a limit, at it, just above, and a few times as much with a remainder.
pub fn around(limit: usize) -> [usize; 4] {
    [limit - 1, limit, limit + 1, 3 * limit + 5]
}

/// Numbers of 11 bits between -4 and 4, without a short pattern: products of two have 22 bits, and a million of these have
/// an exact sum in f64. A product and a number more is exact in f32 too.
pub fn values<T: Scalar>(n: usize, seed: usize) -> Vec<T> {
    let value = |i: usize| ((i * 7919 + i / 1013 * 31 + seed * 10_007) % 2003) as f64 - 1001.0;
    (0..n).map(|i| T::from_f64(value(i) / 256.0)).collect()
}

pub fn wide<T: Scalar>(x: &[T]) -> Vec<f64> {
    x.iter().map(|x| x.to_f64()).collect()
}

/// The sum of numbers that are not round, with what each addition loses carried along.
pub fn sum(x: impl Iterator<Item = f64>) -> f64 {
    let (mut sum, mut lost) = (0.0, 0.0);
    for x in x {
        let next: f64 = sum + x;
        lost += if f64::abs(sum) >= x.abs() { (sum - next) + x } else { (x - next) + sum };
        sum = next;
    }
    sum + lost
}

/// That each number is the exact one, rounded.
#[track_caller]
pub fn same<T: Scalar>(what: &str, got: &[T], exact: impl IntoIterator<Item = f64>) {
    let mut count = 0;
    for (i, exact) in exact.into_iter().enumerate() {
        assert!(got[i] == T::from_f64(exact), "{what} in {}: element {i} is {} for {exact}", T::NAME, got[i]);
        count += 1;
    }
    assert_eq!(got.len(), count, "{what}");
}

/// That each number is within `units * EPSILON * size` of the exact one, for pairs of exact numbers and sizes.
#[track_caller]
pub fn close<T: Scalar>(what: &str, got: &[T], units: f64, exact: impl IntoIterator<Item = [f64; 2]>) {
    let mut count = 0;
    for (i, [exact, size]) in exact.into_iter().enumerate() {
        let error = (got[i].to_f64() - exact).abs();
        let within = error <= units * T::EPSILON * size;
        assert!(within, "{what} in {}: element {i} is {} for {exact}, size {size:e}", T::NAME, got[i]);
        count += 1;
    }
    assert_eq!(got.len(), count, "{what}");
}

/// Sums of round numbers: exact in f64, and within `units` of the sum of sizes in f32.
#[track_caller]
pub fn summed<T: Scalar>(what: &str, got: &[T], units: f64, exact: impl IntoIterator<Item = [f64; 2]>) {
    close(what, got, if T::EPSILON < 1e-10 { 0.0 } else { units }, exact);
}
