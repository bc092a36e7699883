//! Softmax, log-softmax, log-sum-exp and cross-entropy.

use super::{ROW_ELEMENT, block, blocks, check_rows, check_whole, fold_lanes, total, totals_of};
use crate::parallel::chunks;
use crate::scale::power_of_two;
use crate::{Pool, Scalar, Tensor, Wide, simd};

/// The largest element of a row without NaN; a row with NaN results in NaN anyway.
#[inline(always)]
fn top<T: Scalar>(x: &[T]) -> T {
    fold_lanes(
        x,
        #[inline(always)]
        |a, b| if b > a { b } else { a },
    )
}

/// The smallest element of a row without NaN.
#[inline(always)]
fn bottom<T: Scalar>(x: &[T]) -> T {
    fold_lanes(
        x,
        #[inline(always)]
        |a, b| if b < a { b } else { a },
    )
}

/// `out = x - shift` for each row of the block. `shift` is the row's largest element, or 0 if that is infinite and
/// `limits` is set. The shifts go to `shifts`.
#[inline(always)]
fn shifted<T: Scalar>(x: &[T], n: usize, out: &mut [T], shifts: &mut [T], limits: bool) {
    for ((x, out), shift) in x.chunks_exact(n).zip(out.chunks_exact_mut(n)).zip(shifts) {
        let greatest = top(x);
        let by = if limits && !greatest.is_finite() { T::ZERO } else { greatest };
        *shift = by;
        for (out, &x) in out.iter_mut().zip(x) {
            *out = x - by;
        }
    }
}

/// `e^x` of every element, in place.
#[inline(always)]
fn exponentials<T: Scalar>(x: &mut [T]) {
    for x in x {
        *x = x.exp();
    }
}

/// `power`, which is `e^(x - shift)`, with the rounding error of the difference (Knuth's two-sum). Without it, a power is
/// off by as many units as its exponent is large.
#[doc(hidden)]
#[inline(always)]
pub fn corrected<T: Scalar>(power: T, x: T, shift: T) -> T {
    let difference = x - shift;
    let back = difference + shift;
    let low = (x - back) + ((back - difference) - shift);
    // The error of an infinity is no number, and its power is 0 or infinite.
    power.mul_add(if low < T::ONE { low } else { T::ONE }, power)
}

/// The powers of the rows that [`shifted`] has shifted, in their place.
#[inline(always)]
fn exponentials_of_shifted<T: Scalar>(x: &[T], n: usize, out: &mut [T], shifts: &[T]) {
    exponentials(out);
    for ((x, out), &shift) in x.chunks_exact(n).zip(out.chunks_exact_mut(n)).zip(shifts) {
        // Up to there, the rounding error is at most two units of the power.
        if shift - bottom(x) > T::from_f64(8.0) {
            for (out, &x) in out.iter_mut().zip(x) {
                *out = corrected(*out, x, shift);
            }
        }
    }
}

/// `ln sum x` of powers of which at least one is 1, unless the row was not shifted by a finite element. It leaves one 1
/// out of the sum and uses `ln(1 + x)`, so that small contributions of the others are not rounded off.
#[inline(always)]
fn ln_total<T: Scalar>(powers: &[T]) -> T {
    let [rest, ones] = totals_of(
        powers,
        powers,
        #[inline(always)]
        |x, _| if x == T::ONE { [T::ZERO, T::ONE] } else { [x, T::ZERO] },
    );
    (rest + (ones - T::ONE)).ln1p()
}

/// The smallest normal number.
#[inline(always)]
fn least_normal<T: Scalar>() -> T {
    T::from_f64(power_of_two(if size_of::<T>() == 4 { -126 } else { -1022 }))
}

/// Whether `factor` times a power of a row may be in range although the power is not.
#[inline(always)]
fn lifts<T: Scalar>(factor: T, powers: &[T]) -> bool {
    factor.abs() > T::ONE && bottom(powers) < least_normal()
}

/// `e^(x - shift) * factor`, where the power may underflow and the factor brings it back.
#[inline(always)]
fn large_multiple<T: Scalar>(x: T, shift: T, factor: T) -> T {
    let root = (T::from_f64(0.5) * (x - shift)).exp();
    corrected(root * factor * root, x, shift)
}

/// `out = e^(x - shift) * factor`, where powers may underflow.
#[cold]
#[inline(never)]
fn large_multiples<T: Scalar>(x: &[T], shift: T, factor: T, out: &mut [T]) {
    simd::dispatch(
        #[inline(always)]
        || {
            for (out, &x) in out.iter_mut().zip(x) {
                *out = large_multiple(x, shift, factor);
            }
        },
    );
}

/// A row whose powers are known up to a factor.
struct Powers<'a, T> {
    x: &'a [T],
    /// The largest element.
    greatest: T,
    /// The reciprocal of the sum of the powers `e^(x - greatest)`.
    scale: T,
}

impl<T: Scalar> Powers<'_, T> {
    /// Replaces the powers in `row` with `g` times the softmax.
    #[inline(always)]
    fn multiply(&self, row: &mut [T], g: T) {
        let factor = g * self.scale;
        if lifts(g, row) {
            large_multiples(self.x, self.greatest, factor, row);
        } else {
            for out in row {
                *out *= factor;
            }
        }
    }
}

/// Calls `finish(row number, the row, powers)` for each row of `out`, which holds `e^(x - greatest)`.
#[track_caller]
fn softmaxes<T: Scalar>(
    x: &[T],
    n: usize,
    out: &mut [T],
    pool: &Pool<T>,
    finish: impl Fn(usize, &Powers<'_, T>, &mut [T]) + Sync,
) {
    check_whole(x.len(), n);
    if x.is_empty() {
        return;
    }
    blocks(&mut out[..x.len()], n, block(n) / n, pool, &|shifts, start, out| {
        let (x, first) = (&x[start..][..out.len()], start / n);
        simd::dispatch(
            #[inline(always)]
            || {
                shifted(x, n, out, shifts, false);
                exponentials_of_shifted(x, n, out, shifts);
                let rows = x.chunks_exact(n).zip(out.chunks_exact_mut(n)).zip(&*shifts);
                for (i, ((x, row), &greatest)) in rows.enumerate() {
                    let scale = T::ONE / total(row);
                    finish(first + i, &Powers { x, greatest, scale }, row);
                }
            },
        );
    });
}

/// Softmax of each row of `n` elements: `e^(x - max) / sum e^(x - max)`.
///
/// # Panics
/// If `x` is not whole rows of `n`, or `out` is shorter than `x`.
#[track_caller]
pub fn softmax_rows<T: Scalar>(x: &[T], n: usize, out: &mut [T], pool: &Pool<T>) {
    softmaxes(
        x,
        n,
        out,
        pool,
        #[inline(always)]
        |_, powers, row| powers.multiply(row, T::ONE),
    );
}

/// The gradient of softmax of a row where a probability has underflowed, or `sum g y` or a difference from it may be out
/// of range.
#[cold]
#[inline(never)]
fn large_softmax_grad<T: Scalar>(x: &[T], g: &[T], out: &mut [T]) {
    simd::dispatch(
        #[inline(always)]
        || {
            let [down, up] = [0.25, 4.0].map(T::from_f64);
            let greatest = top(x);
            let [sum] = totals_of(x, x, |x, _| [large_multiple(x, greatest, T::ONE)]);
            let scale = T::ONE / sum;
            let [mean] = totals_of(x, g, |x, g| [large_multiple(x, greatest, g * down * scale)]);
            for i in 0..x.len() {
                out[i] = large_multiple(x[i], greatest, (g[i] * down - mean) * scale) * up;
            }
        },
    );
}

/// The gradient of softmax from its output `y`: `y (g - sum g y)` in each row. The input `x` counts where a probability
/// has underflowed and a large `g` brings it back into range.
///
/// # Panics
/// If `x` is not whole rows of `n`, or `y`, `g` or `out` is shorter than `x`.
#[track_caller]
pub fn softmax_rows_grad<T: Scalar>(x: &[T], y: &[T], g: &[T], n: usize, out: &mut [T]) {
    check_whole(x.len(), n);
    if x.is_empty() {
        return;
    }
    // Up to this size, no difference from a mean overflows.
    let largest_mean = T::from_f64(power_of_two(if size_of::<T>() == 4 { 100 } else { 960 }));
    blocks(&mut out[..x.len()], n, 0, &Pool::none(), &|_, start, out| {
        let len = out.len();
        let [x, y, g] = [x, y, g].map(|x| &x[start..][..len]);
        simd::dispatch(
            #[inline(always)]
            || {
                let largest = fold_lanes(
                    g,
                    #[inline(always)]
                    |a, b| if b.abs() > a.abs() { b } else { a },
                );
                // It may also be NaN, of another row.
                let may_lift = !(largest.abs() <= T::ONE);
                let rows = y.chunks_exact(n).zip(g.chunks_exact(n)).zip(out.chunks_exact_mut(n));
                for (i, ((y, g), out)) in rows.enumerate() {
                    let [mean] = totals_of(
                        y,
                        g,
                        #[inline(always)]
                        |y, g| [y * g],
                    );
                    if may_lift && (lifts(top(g), y) || lifts(bottom(g), y)) || !(mean.abs() <= largest_mean) {
                        large_softmax_grad(&x[i * n..][..n], g, out);
                        continue;
                    }
                    for i in 0..n {
                        out[i] = y[i] * (g[i] - mean);
                    }
                }
            },
        );
    });
}

/// Log-softmax of each row: `x - max - ln sum e^(x - max)`.
///
/// # Panics
/// If `x` is not whole rows of `n`, or `out` is shorter than `x`.
#[track_caller]
pub fn log_softmax_rows<T: Scalar>(x: &[T], n: usize, out: &mut [T], pool: &Pool<T>) {
    check_whole(x.len(), n);
    if x.is_empty() {
        return;
    }
    blocks(&mut out[..x.len()], n, block(n) + block(n) / n, pool, &|scratch, start, out| {
        let (powers, shifts) = scratch.split_at_mut(block(n));
        let x = &x[start..][..out.len()];
        simd::dispatch(
            #[inline(always)]
            || {
                let powers = &mut powers[..out.len()];
                shifted(x, n, out, shifts, false);
                powers.copy_from_slice(out);
                exponentials_of_shifted(x, n, powers, shifts);
                for (out, powers) in out.chunks_exact_mut(n).zip(powers.chunks_exact(n)) {
                    let ln = ln_total(powers);
                    for out in out {
                        *out -= ln;
                    }
                }
            },
        );
    });
}

/// The gradient of log-softmax, `g - softmax(x) sum g` in each row.
///
/// # Panics
/// If `x` is not whole rows of `n`, or `g` or `out` is shorter than `x`.
#[track_caller]
pub fn log_softmax_rows_grad<T: Scalar>(x: &[T], g: &[T], n: usize, out: &mut [T], pool: &Pool<T>) {
    /// `g - softmax(x) sum g` of a row, of which the sum is out of range.
    #[cold]
    #[inline(never)]
    fn large_differences<T: Scalar>(powers: &Powers<'_, T>, g: &[T], out: &mut [T]) {
        let exponent = 1 + i64::from(g.len().ilog2());
        let [down, up] = [-exponent, exponent].map(|exponent| T::from_f64(power_of_two(exponent)));
        let [sum] = totals_of(g, g, |g, _| [g * down]);
        let factor = powers.scale.wide() * sum.wide();
        for (i, &x) in powers.x.iter().enumerate() {
            let shift = powers.greatest;
            let small = T::Wide::exp(x - shift, T::ZERO) * corrected(T::ONE, x, shift).wide() * factor;
            let product = (small * up.wide()).narrow();
            out[i] = if product.is_finite() { g[i] - product } else { (g[i] * down - small.narrow()) * up };
        }
    }
    softmaxes(
        x,
        n,
        out,
        pool,
        #[inline(always)]
        |i, powers, row| {
            let g = &g[i * n..][..row.len()];
            let sum = total(g);
            if !sum.is_finite() {
                return large_differences(powers, g, row);
            }
            powers.multiply(row, sum);
            for i in 0..row.len() {
                row[i] = g[i] - row[i];
            }
        },
    );
}

/// `ln sum e^x` of each row of `n` elements. It is -inf for an empty row and for a row of -inf alone.
///
/// # Panics
/// If `x` is not `out.len()` rows of `n`.
#[track_caller]
pub fn logsumexp_rows<T: Scalar>(x: &[T], n: usize, out: &mut [T], pool: &Pool<T>) {
    ln_sums(x, n, out, pool, |_, shift, ln| shift + ln);
}

/// `out[i] = finish(i, shift, ln sum e^(x - shift))` for row `i`.
#[track_caller]
fn ln_sums<T: Scalar>(x: &[T], n: usize, out: &mut [T], pool: &Pool<T>, finish: impl Fn(usize, T, T) -> T + Sync) {
    check_rows(x.len(), n, out.len());
    if x.is_empty() {
        out.fill(T::from_f64(f64::NEG_INFINITY));
        return;
    }
    let rows = block(n) / n;
    let scratch = || pool.tensor(&[block(n) + rows]);
    chunks(out, rows, ROW_ELEMENT * x.len(), scratch, &|scratch: &mut Tensor<T>, chunk, out| {
        let (powers, shifts) = scratch.as_mut_slice().split_at_mut(block(n));
        let first = chunk * rows;
        simd::dispatch(
            #[inline(always)]
            || {
                let powers = &mut powers[..n * out.len()];
                let x = &x[n * first..][..n * out.len()];
                shifted(x, n, powers, shifts, true);
                exponentials_of_shifted(x, n, powers, shifts);
                for (out, powers) in out.iter_mut().zip(powers.chunks_exact(n)) {
                    *out = ln_total(powers);
                }
            },
        );
        for (i, (out, &shift)) in out.iter_mut().zip(&*shifts).enumerate() {
            *out = finish(first + i, shift, *out);
        }
    });
}

/// The cross-entropy of each row of `n` logits: `ln sum e^x - x[class]`.
///
/// # Panics
/// If `x` is not a row for each class, `out` has another length than `classes`, or a class is not below `n`.
#[track_caller]
pub fn cross_entropy_rows<T: Scalar>(x: &[T], n: usize, classes: &[u32], out: &mut [T], pool: &Pool<T>) {
    assert_eq!(classes.len(), out.len(), "a class for each row");
    assert!(n > 0 || classes.is_empty(), "there are 0 classes");
    // The distance from the greatest logit first: where that is the class, nothing cancels.
    ln_sums(x, n, out, pool, |row, shift, ln| (shift - x[row * n..][..n][classes[row] as usize]) + ln);
}

/// The gradient of [`logsumexp_rows`]: `g` times the softmax of each row; 0 for a row of -inf alone.
///
/// # Panics
/// If `x` is not `g.len()` rows of `n`, or `out` is shorter than `x`.
#[track_caller]
pub fn logsumexp_rows_grad<T: Scalar>(x: &[T], n: usize, g: &[T], out: &mut [T], pool: &Pool<T>) {
    check_rows(x.len(), n, g.len());
    softmaxes(
        x,
        n,
        out,
        pool,
        #[inline(always)]
        |i, powers, row| {
            powers.multiply(row, g[i]);
            if powers.greatest == T::from_f64(f64::NEG_INFINITY) {
                row.fill(T::ZERO);
            }
        },
    );
}

/// The gradient of [`cross_entropy_rows`]: `g (softmax - 1 at the class)`. Where 1 minus the probability of the class
/// would lose digits, it sums the probabilities of the other classes.
///
/// # Panics
/// If `x` is not a row for each class, or a class is not below `n`. If `g` has another length than `classes`, or `out`
/// is shorter than `x`.
#[track_caller]
pub fn cross_entropy_rows_grad<T: Scalar>(x: &[T], n: usize, classes: &[u32], g: &[T], out: &mut [T], pool: &Pool<T>) {
    assert_eq!(classes.len(), g.len(), "a class for each gradient");
    check_rows(x.len(), n, g.len());
    softmaxes(
        x,
        n,
        out,
        pool,
        #[inline(always)]
        |i, powers, row| {
            powers.multiply(row, g[i]);
            row[classes[i] as usize] = T::ZERO;
            row[classes[i] as usize] = -total(row);
        },
    );
}

#[cfg(test)]
mod tests {
    use super::super::tests::{LENGTHS, assert_close, assert_panics, matrix};
    use super::*;

    #[test]
    fn softmax_and_its_relatives_agree_with_plain_loops() {
        let pool = Pool::new();
        for n in LENGTHS {
            let rows = 9;
            let x = matrix(rows, n);
            let sums: Vec<f64> = x.chunks(n).map(|row| row.iter().map(|&x| f64::from(x).exp()).sum()).collect();
            let mut y = vec![0.0; x.len()];
            softmax_rows(&x, n, &mut y, &pool);
            let mut all = vec![0.0; x.len()];
            assert_close(&y, x.iter().enumerate().map(|(i, &x)| f64::from(x).exp() / sums[i / n]), 3e-6);
            log_softmax_rows(&x, n, &mut all, &pool);
            let exact = |(i, &x): (usize, &f32)| f64::from(x) - sums[i / n].ln();
            assert_close(&all, x.iter().enumerate().map(exact), 5e-6);
            let mut ln = vec![0.0; rows];
            logsumexp_rows(&x, n, &mut ln, &pool);
            assert_close(&ln, sums.iter().map(|sum| sum.ln()), 1e-6);
            let g: Vec<f32> = matrix(rows, n).into_iter().rev().collect();
            softmax_rows_grad(&x, &y, &g, n, &mut all);
            let wide = |i: usize| f64::from(y[i]) * f64::from(g[i]);
            let inner = |i: usize| (i / n * n..i / n * n + n).map(wide).sum::<f64>();
            assert_close(&all, (0..x.len()).map(|i| wide(i) - f64::from(y[i]) * inner(i)), 1e-3);
        }
    }

    #[test]
    fn infinite_logits_have_their_limits() {
        let (pool, inf) = (Pool::new(), f32::INFINITY);
        let mut out = [0.0; 4];
        logsumexp_rows(&[-inf, -inf, inf, 0.0, -inf, 2.0, f32::NAN, inf], 2, &mut out, &pool);
        assert_eq!(out[..3], [-inf, inf, 2.0]);
        assert!(out[3].is_nan());
        let mut out = [0.0; 3];
        softmax_rows(&[-inf, 1e30, -1e30], 3, &mut out, &pool);
        assert_eq!(out, [0.0, 1.0, 0.0]);
        logsumexp_rows(&[], 0, &mut out, &pool);
        assert_eq!(out, [-inf; 3]);
    }

    #[test]
    fn cross_entropy_rows_missing_class_panics() {
        let (pool, x) = (Pool::<f32>::none(), [0.0; 6]);
        let loss = |x: &[f32], n, classes: &[u32], rows| {
            cross_entropy_rows(x, n, classes, &mut vec![0.0; rows], &pool);
        };
        let grad = |x: &[f32], n, classes: &[u32], rows| {
            cross_entropy_rows_grad(x, n, classes, &vec![1.0; rows], &mut [0.0; 6], &pool);
        };
        // Row 0 has no class 3: the loss read the first number of row 1.
        for (n, classes, rows, expected) in [
            (3, &[3, 0][..], 2, "the len is 3 but the index is 3"),
            (3, &[0, 3], 2, "the len is 3 but the index is 3"),
            (3, &[0], 1, "6 numbers are not 1 rows of 3"),
            (4, &[0, 0], 2, "6 numbers are not 2 rows of 4"),
            (3, &[0, 0], 1, "a class for each"),
            (3, &[0, 0], 3, "a class for each"),
        ] {
            assert_panics(|| loss(&x, n, classes, rows), expected);
            assert_panics(|| grad(&x, n, classes, rows), expected);
        }
        assert_panics(|| loss(&[], 0, &[0], 1), "there are 0 classes");
        loss(&[], 3, &[], 0);
        grad(&[], 3, &[], 0);
    }

    #[test]
    fn rows_of_another_length_panic() {
        let (pool, x) = (Pool::<f32>::none(), [0.0; 7]);
        // The last number belonged to no row, and its result was whatever stood there.
        assert_panics(|| softmax_rows(&x, 3, &mut [0.0; 7], &pool), "7 numbers are not whole rows of 3");
        assert_panics(|| softmax_rows_grad(&x, &x, &x, 3, &mut [0.0; 7]), "7 numbers are not whole rows of 3");
        assert_panics(|| log_softmax_rows(&x, 3, &mut [0.0; 7], &pool), "7 numbers are not whole rows of 3");
        assert_panics(|| log_softmax_rows_grad(&x, &x, 3, &mut [0.0; 7], &pool), "7 numbers are not whole rows of 3");
        assert_panics(|| softmax_rows(&x, 0, &mut [0.0; 7], &pool), "7 numbers are not whole rows of 0");
        assert_panics(|| softmax_rows_grad(&x, &x, &x, 0, &mut [0.0; 7]), "7 numbers are not whole rows of 0");
        assert_panics(|| log_softmax_rows(&x, 0, &mut [0.0; 7], &pool), "7 numbers are not whole rows of 0");
        assert_panics(|| log_softmax_rows_grad(&x, &x, 0, &mut [0.0; 7], &pool), "7 numbers are not whole rows of 0");
        assert_panics(|| logsumexp_rows(&x, 3, &mut [0.0; 2], &pool), "7 numbers are not 2 rows of 3");
        // 2^63 times 2 wraps to the 0 numbers that there are.
        assert_panics(|| logsumexp_rows(&[], 1 << 63, &mut [0.0_f32; 2], &pool), "0 numbers are not 2 rows of");
    }

    #[test]
    fn a_confident_prediction_keeps_its_gradient() {
        let mut loss = [0.0];
        cross_entropy_rows(&[0.0_f32, 20.0, 0.0], 3, &[1], &mut loss, &Pool::new());
        assert_close(&loss, [(2.0 * (-20.0_f64).exp()).ln_1p()].into_iter(), 1e-12);
        let mut out = [0.0_f32; 3];
        cross_entropy_rows_grad(&[0.0, 20.0, 0.0], 3, &[1], &[1.0], &mut out, &Pool::new());
        let p = (-20.0_f64).exp();
        assert_close(&out, [p, -2.0 * p, p].into_iter(), 1e-12);
        assert!(out[1] < -3.9e-9, "{out:?}");
    }
}
