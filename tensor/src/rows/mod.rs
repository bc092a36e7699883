//! Kernels on the rows of a matrix: softmax, log-softmax, log-sum-exp, cross-entropy, layer normalisation. Start with
//! [`softmax_rows`].
//!
//! A matrix is processed in blocks of whole rows that fit in a core's nearest cache. Elementwise parts (an exponential)
//! run over the whole block, so that rows shorter than a register are as fast as long ones.

mod moments;
mod softmax;

pub use moments::{RowUnits, layer_norm_rows, layer_norm_rows_grad, variance_rows};
pub(crate) use moments::{at_least_zero, in_units};
pub use softmax::{
    corrected, cross_entropy_rows, cross_entropy_rows_grad, log_softmax_rows, log_softmax_rows_grad, logsumexp_rows,
    logsumexp_rows_grad, softmax_rows, softmax_rows_grad,
};

use crate::parallel::chunks;
use crate::reduce::{Pairs, chunk, sum};
use crate::{Pool, Scalar, Tensor};

/// Elements of a block: 16 kB of f32.
const BLOCK: usize = 4096;
/// Independent partial results: two 512-bit registers of f32.
const LANES: usize = 32;

/// Elements of a block of whole rows of `n`.
fn block(n: usize) -> usize {
    n * (BLOCK / n).max(1)
}

/// Operations for an element of a row: an exponential, and a few passes over cached data.
const ROW_ELEMENT: usize = 16;

/// Checks that `len` numbers are whole rows of `n`, since elements after the last whole row would keep their old
/// values.
#[track_caller]
fn check_whole(len: usize, n: usize) {
    assert!(len == 0 || (n > 0 && len.is_multiple_of(n)), "{len} numbers are not whole rows of {n}");
}

/// Checks that `len` numbers are `rows` rows of `n`.
#[track_caller]
fn check_rows(len: usize, n: usize, rows: usize) {
    assert_eq!(Some(len), n.checked_mul(rows), "{len} numbers are not {rows} rows of {n}");
}

/// See [`blocks`].
type Kernel<'a, T> = &'a (dyn Fn(&mut [T], usize, &mut [T]) + Sync);

/// Calls `f(scratch, start, rows)` for blocks of rows of `out`. Each row has `n` elements, each block begins at element
/// `start`, and `scratch` is space of this many elements.
fn blocks<T: Scalar>(out: &mut [T], n: usize, scratch: usize, pool: &Pool<T>, f: Kernel<'_, T>) {
    let (len, work) = (block(n), ROW_ELEMENT * out.len());
    let each = |scratch: &mut Tensor<T>, i: usize, out: &mut [T]| f(scratch.as_mut_slice(), i * len, out);
    chunks(out, len, work, || pool.tensor(&[scratch]), &each);
}

/// Folds all elements with `pick`, in any order. There must be at least one.
#[inline(always)]
pub(crate) fn fold_lanes<T: Scalar>(x: &[T], pick: impl Fn(T, T) -> T) -> T {
    if x.len() < LANES {
        let mut best = x[0];
        for &x in &x[1..] {
            best = pick(best, x);
        }
        return best;
    }
    let mut lanes = [T::ZERO; LANES];
    lanes.copy_from_slice(&x[..LANES]);
    let mut rows = x[LANES..].chunks_exact(LANES);
    for row in &mut rows {
        for i in 0..LANES {
            lanes[i] = pick(lanes[i], row[i]);
        }
    }
    for (lane, &x) in lanes.iter_mut().zip(rows.remainder()) {
        *lane = pick(*lane, x);
    }
    let mut width = LANES / 2;
    while width > 0 {
        for i in 0..width {
            lanes[i] = pick(lanes[i], lanes[i + width]);
        }
        width /= 2;
    }
    lanes[0]
}

/// The sum of a row: inlined if it is short, pairwise if it is long.
#[inline(always)]
fn total<T: Scalar>(x: &[T]) -> T {
    if x.len() < LANES {
        let mut sum = T::ZERO;
        for &x in x {
            sum += x;
        }
        sum
    } else if x.len() <= BLOCK {
        chunk(x)
    } else {
        sum(x)
    }
}

/// The sums of the values of `f` of the elements of `a` and `b` at each index, in one pass.
#[inline(always)]
fn totals_of<T: Scalar, const K: usize>(a: &[T], b: &[T], f: impl Fn(T, T) -> [T; K]) -> [T; K] {
    let b = &b[..a.len()];
    if a.len() < LANES {
        let mut sums = [T::ZERO; K];
        for i in 0..a.len() {
            let values = f(a[i], b[i]);
            for k in 0..K {
                sums[k] += values[k];
            }
        }
        return sums;
    }
    if a.len() <= BLOCK {
        return block_totals(a, b, &f);
    }
    let mut pairs = Pairs::<T, K, 40>::new();
    for (a, b) in a.chunks(BLOCK).zip(b.chunks(BLOCK)) {
        pairs.push(block_totals(a, b, &f));
    }
    pairs.finish()
}

/// [`totals_of`] a block.
#[inline(always)]
fn block_totals<T: Scalar, const K: usize>(a: &[T], b: &[T], f: &impl Fn(T, T) -> [T; K]) -> [T; K] {
    let mut lanes = [[T::ZERO; LANES]; K];
    let whole = a.len() - a.len() % LANES;
    let mut start = 0;
    while start < whole {
        let (a, b) = (&a[start..start + LANES], &b[start..start + LANES]);
        for i in 0..LANES {
            let values = f(a[i], b[i]);
            for k in 0..K {
                lanes[k][i] += values[k];
            }
        }
        start += LANES;
    }
    let (a, b) = (&a[whole..], &b[whole..]);
    for i in 0..a.len() {
        let values = f(a[i], b[i]);
        for k in 0..K {
            lanes[k][i] += values[k];
        }
    }
    let mut sums = [T::ZERO; K];
    for k in 0..K {
        sums[k] = chunk(&lanes[k]);
    }
    sums
}

#[cfg(test)]
mod tests {
    /// Lengths around the widths of lanes and blocks.
    pub(super) const LENGTHS: [usize; 8] = [1, 2, 7, 31, 32, 33, 1000, 5000];

    pub(super) fn matrix(rows: usize, n: usize) -> Vec<f32> {
        (0..rows * n).map(|i| ((i * 7919) % 1013) as f32 * 0.02 - 10.0).collect()
    }

    /// Asserts that `f` panics with a message that contains `expected`.
    #[track_caller]
    pub(super) fn assert_panics(f: impl FnOnce(), expected: &str) {
        let error = std::panic::catch_unwind(std::panic::AssertUnwindSafe(f)).expect_err("no panic");
        let words = error.downcast_ref::<String>().map(String::as_str);
        let message = words.or(error.downcast_ref::<&str>().copied()).unwrap_or_default();
        assert!(message.contains(expected), "{message:?} instead of {expected:?}");
    }

    pub(super) fn assert_close(got: &[f32], expected: impl Iterator<Item = f64>, tolerance: f64) {
        for (i, (&got, expected)) in got.iter().zip(expected).enumerate() {
            let error = (f64::from(got) - expected).abs() / expected.abs().max(1e-3);
            assert!(error <= tolerance, "{i}: {got} for {expected}");
        }
    }
}
