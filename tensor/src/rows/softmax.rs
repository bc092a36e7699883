//! Softmax, log-softmax, log-sum-exp and cross-entropy.

use super::{ROW_ELEMENT, block, blocks, check_rows, check_whole, fold_lanes, total, totals_of};
use crate::parallel::chunks;
use crate::scale::power_of_two;
use crate::{Pool, Scalar, Tensor, simd};

/// The largest element of a row without NaN; a row with NaN results in NaN anyway.
#[inline(always)]
fn top<T: Scalar>(x: &[T]) -> T {
    fold_lanes(
        x,
        #[inline(always)]
        |a, b| if b > a { b } else { a },
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

/// Whether `factor` times a power of a row may be in range although the power is not. `least` is the least element in
/// range of a row of powers or of their logarithms.
#[inline(always)]
fn lifts<T: Scalar>(factor: T, row: &[T], least: [f64; 2]) -> bool {
    if factor.abs() <= T::ONE {
        return false;
    }
    let least = T::from_f64(least[usize::from(size_of::<T>() == 8)]);
    let smallest = fold_lanes(
        row,
        #[inline(always)]
        |a, b| if b < a { b } else { a },
    );
    smallest < least
}

/// `out = e^logarithm * factor`, where the power may underflow and the factor brings it back.
#[cold]
#[inline(never)]
fn large_multiples<T: Scalar>(logarithms: &[T], factor: T, out: &mut [T]) {
    simd::dispatch(
        #[inline(always)]
        || {
            for (out, &logarithm) in out.iter_mut().zip(logarithms) {
                let root = (T::from_f64(0.5) * logarithm).exp();
                *out = root * factor * root;
            }
        },
    );
}

/// `g - powers * sum g` in place of the powers, where the sum is out of range.
#[cold]
#[inline(never)]
fn large_differences<T: Scalar>(g: &[T], powers: &mut [T]) {
    let [down, up] = [-40, 40].map(|exponent| T::from_f64(power_of_two(exponent)));
    let small: Vec<T> = g.iter().map(|&g| g * down).collect();
    let sum = total(&small);
    for (out, &g) in powers.iter_mut().zip(&small) {
        *out = (g - *out * sum) * up;
    }
}

/// Softmax of each row of `n` elements: `e^(x - max) / sum e^(x - max)`.
///
/// # Panics
/// If `x` is not whole rows of `n`, or `out` is shorter than `x`.
#[track_caller]
pub fn softmax_rows<T: Scalar>(x: &[T], n: usize, out: &mut [T], pool: &Pool<T>) {
    check_whole(x.len(), n);
    if x.is_empty() {
        return;
    }
    blocks(&mut out[..x.len()], n, block(n) / n, pool, &|shifts, start, out| {
        simd::dispatch(
            #[inline(always)]
            || {
                shifted(&x[start..][..out.len()], n, out, shifts, false);
                exponentials(out);
                for row in out.chunks_exact_mut(n) {
                    let scale = T::ONE / total(row);
                    for out in row {
                        *out *= scale;
                    }
                }
            },
        );
    });
}

/// The gradient of softmax from its output: `y (g - sum g y)` in each row. A probability that has underflowed has
/// gradient 0, also where a large `g` would bring it back into range.
///
/// # Panics
/// If `y` is not whole rows of `n`, or `g` or `out` is shorter than `y`.
#[track_caller]
pub fn softmax_rows_grad<T: Scalar>(y: &[T], g: &[T], n: usize, out: &mut [T]) {
    check_whole(y.len(), n);
    if y.is_empty() {
        return;
    }
    // Up to this size, no difference from a mean overflows.
    let largest_mean = T::from_f64(power_of_two(if size_of::<T>() == 4 { 100 } else { 960 }));
    let quarter = [0.25, 4.0].map(T::from_f64);
    blocks(&mut out[..y.len()], n, 0, &Pool::none(), &|_, start, out| {
        let len = out.len();
        let (y, g) = (&y[start..][..len], &g[start..][..len]);
        simd::dispatch(
            #[inline(always)]
            || {
                for ((y, g), out) in y.chunks_exact(n).zip(g.chunks_exact(n)).zip(out.chunks_exact_mut(n)) {
                    let [mean] = totals_of(
                        y,
                        g,
                        #[inline(always)]
                        |y, g| [y * g],
                    );
                    let [down, up] = if mean.abs() > largest_mean { quarter } else { [T::ONE; 2] };
                    for i in 0..n {
                        out[i] = y[i] * (g[i] * down - mean * down) * up;
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
        simd::dispatch(
            #[inline(always)]
            || {
                let powers = &mut powers[..out.len()];
                shifted(&x[start..][..out.len()], n, out, shifts, false);
                powers.copy_from_slice(out);
                exponentials(powers);
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

/// The gradient of log-softmax from its output: `g - e^y sum g` in each row.
///
/// # Panics
/// If `y` is not whole rows of `n`, or `g` or `out` is shorter than `y`.
#[track_caller]
pub fn log_softmax_rows_grad<T: Scalar>(y: &[T], g: &[T], n: usize, out: &mut [T]) {
    check_whole(y.len(), n);
    if y.is_empty() {
        return;
    }
    blocks(&mut out[..y.len()], n, 0, &Pool::none(), &|_, start, out| {
        let g = &g[start..][..out.len()];
        simd::dispatch(
            #[inline(always)]
            || {
                let y = &y[start..][..out.len()];
                out.copy_from_slice(y);
                exponentials(out);
                for ((out, y), g) in out.chunks_exact_mut(n).zip(y.chunks_exact(n)).zip(g.chunks_exact(n)) {
                    let sum = total(g);
                    if !sum.is_finite() {
                        large_differences(g, out);
                        continue;
                    }
                    let mut factor = sum;
                    if lifts(sum, y, [-87.0, -708.0]) {
                        large_multiples(y, sum, out);
                        factor = T::ONE;
                    }
                    for i in 0..n {
                        out[i] = g[i] - out[i] * factor;
                    }
                }
            },
        );
    });
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
                shifted(&x[n * first..][..n * out.len()], n, powers, shifts, true);
                exponentials(powers);
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
    softmax_multiples(x, n, g, out, pool, |_, row, is_lost| {
        if is_lost {
            row.fill(T::ZERO);
        }
    });
}

/// `g` times the softmax of each row, which `finish(row number, multiples, whether all elements are -inf)` may change.
#[track_caller]
fn softmax_multiples<T: Scalar>(
    x: &[T],
    n: usize,
    g: &[T],
    out: &mut [T],
    pool: &Pool<T>,
    finish: impl Fn(usize, &mut [T], bool) + Sync,
) {
    check_rows(x.len(), n, g.len());
    softmax_rows(x, n, out, pool);
    if x.is_empty() {
        return;
    }
    blocks(&mut out[..x.len()], n, 0, pool, &|_, start, out| {
        let first = start / n;
        simd::dispatch(
            #[inline(always)]
            || {
                let rows = out.chunks_exact_mut(n).zip(x[start..].chunks_exact(n));
                for (i, ((row, x), &g)) in rows.zip(&g[first..]).enumerate() {
                    let greatest = top(x);
                    if lifts(g, row, [f32::MIN_POSITIVE.into(), f64::MIN_POSITIVE]) {
                        // The power of the greatest logit is 1.
                        let scale = top(row);
                        let shifted: Vec<T> = x.iter().map(|&x| x - greatest).collect();
                        large_multiples(&shifted, g * scale, row);
                    } else {
                        for out in &mut *row {
                            *out *= g;
                        }
                    }
                    finish(first + i, row, greatest == T::from_f64(f64::NEG_INFINITY));
                }
            },
        );
    });
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
    softmax_multiples(x, n, g, out, pool, |i, row, _| {
        row[classes[i] as usize] = T::ZERO;
        row[classes[i] as usize] = -total(row);
    });
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
            softmax_rows_grad(&y, &g, n, &mut all);
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
        assert_panics(|| softmax_rows_grad(&x, &x, 3, &mut [0.0; 7]), "7 numbers are not whole rows of 3");
        assert_panics(|| log_softmax_rows(&x, 3, &mut [0.0; 7], &pool), "7 numbers are not whole rows of 3");
        assert_panics(|| log_softmax_rows_grad(&x, &x, 3, &mut [0.0; 7]), "7 numbers are not whole rows of 3");
        assert_panics(|| softmax_rows(&x, 0, &mut [0.0; 7], &pool), "7 numbers are not whole rows of 0");
        assert_panics(|| softmax_rows_grad(&x, &x, 0, &mut [0.0; 7]), "7 numbers are not whole rows of 0");
        assert_panics(|| log_softmax_rows(&x, 0, &mut [0.0; 7], &pool), "7 numbers are not whole rows of 0");
        assert_panics(|| log_softmax_rows_grad(&x, &x, 0, &mut [0.0; 7]), "7 numbers are not whole rows of 0");
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
