//! Mean and variance of rows, and layer normalisation.

use super::{ROW_ELEMENT, block, blocks, check_rows, check_whole, total, totals_of};
use crate::parallel::chunks;
use crate::scale::{is_safe, largest, powers};
use crate::{Pool, Scalar, Tensor, simd};

/// Rows whose gradients are summed in their own type before they are added to f64 sums.
const GROUP: usize = 16;
/// Largest number of parts of a matrix that have separate sums.
const PARTS: usize = 16;

/// Mean and mean squared deviation of a row. The mean has two parts, whose sum is accurate beyond the type's digits.
///
/// It takes two passes. The second measures deviations from the rounded mean, and corrects for the rounding of the
/// mean.
#[inline(always)]
fn moments<T: Scalar>(x: &[T]) -> ([T; 2], T) {
    let count = T::from_f64(x.len() as f64);
    let mean = total(x) / count;
    let [rest, square] = totals_of(
        x,
        x,
        #[inline(always)]
        |x, _| [x - mean, (x - mean) * (x - mean)],
    );
    let rest = rest / count;
    ([mean, rest], at_least_zero(square / count - rest * rest))
}

/// 0 in place of a negative number, as rounding makes of the variance of equal numbers. NaN stays.
#[inline(always)]
pub(crate) fn at_least_zero<T: Scalar>(x: T) -> T {
    if x < T::ZERO { T::ZERO } else { x }
}

/// `variance * ratio`, or its square root, of numbers in units of the power of two `unit`.
#[inline(always)]
pub(crate) fn in_units<T: Scalar>(variance: T, ratio: T, unit: T, root: bool) -> T {
    let variance = variance * ratio;
    if root { variance.sqrt() * unit } else { variance * unit * unit }
}

/// The row times a power of two.
fn times<T: Scalar>(x: &[T], power: T) -> Vec<T> {
    x.iter().map(|&x| x * power).collect()
}

/// The variance of each row of `n` elements, or with `root` the standard deviation; NaN for an empty row. The sum of
/// squared deviations is divided by `n` and multiplied by `ratio`. It overflows or underflows only if the result does.
///
/// # Panics
/// If `x` is not `out.len()` rows of `n`.
#[track_caller]
pub fn variance_rows<T: Scalar>(x: &[T], n: usize, ratio: T, root: bool, out: &mut [T]) {
    #[cold]
    #[inline(never)]
    fn scaled<T: Scalar>(x: &[T], ratio: T, root: bool) -> T {
        let [down, unit] = powers(largest(x));
        in_units(moments(&times(x, down)).1, ratio, unit, root)
    }
    check_rows(x.len(), n, out.len());
    if n == 0 {
        out.fill(T::from_f64(f64::NAN));
        return;
    }
    let rows = block(n) / n;
    chunks(out, rows, ROW_ELEMENT * x.len(), || (), &|_, i, out| {
        simd::dispatch(
            #[inline(always)]
            || {
                for (x, out) in x[i * rows * n..].chunks_exact(n).zip(out) {
                    let variance = moments(x).1;
                    *out = if is_safe(variance) {
                        in_units(variance, ratio, T::ONE, root)
                    } else {
                        scaled(x, ratio, root)
                    };
                }
            },
        );
    });
}

/// What normalises a row: `((x - mean[0]) - mean[1]) * scale`, for the elements times the power of two `down`.
struct Standard<T> {
    mean: [T; 2],
    scale: T,
    down: T,
}

/// The row, and what normalises it. Where squares leave the range of the type, it is a multiple of the row in `space`.
#[inline(always)]
fn standard<'a, T: Scalar>(x: &'a [T], eps: f64, space: &'a mut Vec<T>) -> (&'a [T], Standard<T>) {
    #[cold]
    #[inline(never)]
    fn scaled<T: Scalar>(x: &[T], eps: f64, space: &mut Vec<T>) -> Standard<T> {
        let [down, _] = powers(largest(x).maximum(T::from_f64(eps.sqrt().min(1e38))));
        *space = times(x, down);
        let (mean, variance) = moments(space);
        // In f64, where epsilon is not rounded to 0. One factor after the other: the square of `down` may overflow.
        let eps = eps * down.to_f64() * down.to_f64();
        Standard { mean, scale: T::ONE / (variance + T::from_f64(eps)).sqrt(), down }
    }
    let (mean, variance) = moments(x);
    let sum = variance + T::from_f64(eps);
    if is_safe(sum) {
        return (x, Standard { mean, scale: T::ONE / sum.sqrt(), down: T::ONE });
    }
    let standard = scaled(x, eps, space);
    (space, standard)
}

/// Layer normalisation of each row: `(x - mean) / sqrt(variance + eps) * gain + bias`, with the variance divided by
/// `n`. It is right wherever the result is in range, whatever the squares.
///
/// # Panics
/// If `gain` and `bias` have different lengths, `x` is not whole rows of that length, or `out` is shorter than `x`.
#[track_caller]
pub fn layer_norm_rows<T: Scalar>(x: &[T], gain: &[T], bias: &[T], eps: f64, out: &mut [T]) {
    let n = gain.len();
    assert_eq!(bias.len(), n, "gain and bias of one length");
    check_whole(x.len(), n);
    if x.is_empty() {
        return;
    }
    blocks(&mut out[..x.len()], n, 0, &Pool::none(), &|_, start, out| {
        let mut space = vec![];
        simd::dispatch(
            #[inline(always)]
            || {
                let (gain, bias) = (&gain[..n], &bias[..n]);
                for (x, out) in x[start..].chunks_exact(n).zip(out.chunks_exact_mut(n)) {
                    let (x, Standard { mean: [mean, rest], scale, .. }) = standard(x, eps, &mut space);
                    let x = &x[..n];
                    for i in 0..n {
                        out[i] = ((x[i] - mean) - rest) * scale * gain[i] + bias[i];
                    }
                }
            },
        );
    });
}

/// The gradients of [`layer_norm_rows`]: that of `x` in `dx`, and those of gain and bias in `sums` if wanted.
///
/// With u the normalised row and h = g gain: dx = (h - mean h - u mean(h u)) / sqrt(variance + eps). Over the rows,
/// dgain = sum of g u and dbias = sum of g. These sums are in f64.
///
/// # Panics
/// If `x` is not whole rows of the length of `gain`, `g` or `dx` is shorter than `x`, or `sums` have other lengths than
/// `gain`.
#[track_caller]
pub fn layer_norm_rows_grad<T: Scalar>(
    x: &[T],
    gain: &[T],
    g: &[T],
    eps: f64,
    dx: &mut [T],
    sums: Option<[&mut [T]; 2]>,
    pool: &Pool<T>,
) {
    let n = gain.len();
    check_whole(x.len(), n);
    assert!(g.len() >= x.len(), "{} gradients of {} numbers", g.len(), x.len());
    let fits = sums.iter().flatten().all(|sum| sum.len() == n);
    assert!(fits, "sums of other lengths than gain and bias, {n}");
    let wanted = if sums.is_some() { 2 * n } else { 0 };
    if !x.is_empty() {
        // Parts of whole groups, so that the order of sums depends on the sizes alone.
        let len = n * (x.len() / n).div_ceil(PARTS).max(4 * GROUP).next_multiple_of(GROUP);
        let mut parts: Vec<_> = dx[..x.len()].chunks_mut(len).map(|dx| (dx, vec![0.0_f64; wanted])).collect();
        chunks(
            &mut parts,
            1,
            2 * ROW_ELEMENT * x.len(),
            || pool.tensor(&[n + wanted]),
            &|scratch: &mut Tensor<T>, i, part| {
                for (dx, sums) in part {
                    let (x, g) = (&x[i * len..][..dx.len()], &g[i * len..][..dx.len()]);
                    layer_norm_grad(x, gain, g, eps, dx, sums, scratch.as_mut_slice());
                }
            },
        );
        if let Some([dgain, dbias]) = sums {
            let total = |j: usize| parts.iter().map(|(_, sums)| sums[j]).sum::<f64>();
            dgain.iter_mut().chain(dbias).enumerate().for_each(|(j, out)| *out = T::from_f64(total(j)));
        }
    } else if let Some([dgain, dbias]) = sums {
        dgain.iter_mut().chain(dbias).for_each(|out| *out = T::ZERO);
    }
}

/// One part of [`layer_norm_rows_grad`]; `sums`, of gain and bias, may be empty.
fn layer_norm_grad<T: Scalar>(
    x: &[T],
    gain: &[T],
    g: &[T],
    eps: f64,
    dx: &mut [T],
    sums: &mut [f64],
    scratch: &mut [T],
) {
    let n = gain.len();
    let (count, mut space) = (T::from_f64(n as f64), vec![]);
    for ((x, g), dx) in x.chunks(GROUP * n).zip(g.chunks(GROUP * n)).zip(dx.chunks_mut(GROUP * n)) {
        simd::dispatch(
            #[inline(always)]
            || {
                let (unit, group) = scratch.split_at_mut(n);
                group.fill(T::ZERO);
                let gain = &gain[..n];
                for ((x, g), dx) in x.chunks_exact(n).zip(g.chunks_exact(n)).zip(dx.chunks_exact_mut(n)) {
                    let (x, Standard { mean: [mean, rest], scale, down }) = standard(x, eps, &mut space);
                    let x = &x[..n];
                    for i in 0..n {
                        unit[i] = ((x[i] - mean) - rest) * scale;
                        dx[i] = g[i] * gain[i];
                    }
                    if !sums.is_empty() {
                        let (group_gain, group_bias) = group.split_at_mut(n);
                        for i in 0..n {
                            group_gain[i] += g[i] * unit[i];
                            group_bias[i] += g[i];
                        }
                    }
                    let [level, slope] = totals_of(
                        dx,
                        unit,
                        #[inline(always)]
                        |h, u| [h, h * u],
                    );
                    let (level, slope) = (level / count, slope / count);
                    for i in 0..n {
                        dx[i] = ((dx[i] - level) - unit[i] * slope) * scale * down;
                    }
                }
                for (sum, &part) in sums.iter_mut().zip(&*group) {
                    *sum += part.to_f64();
                }
            },
        );
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::{LENGTHS, assert_panics, matrix};
    use super::*;

    #[test]
    fn layer_norm_rows_other_lengths_panic() {
        let pool = Pool::none();
        assert_panics(|| variance_rows(&[0.0_f32; 7], 3, 1.0, false, &mut [0.0; 2]), "7 numbers are not 2 rows of 3");
        let forward = |len: usize, n: usize| {
            layer_norm_rows(&vec![0.0; len], &vec![1.0; n], &vec![0.0; n], 1e-5, &mut [0.0_f32; 7])
        };
        assert_panics(|| forward(7, 3), "7 numbers are not whole rows of 3");
        assert_panics(|| forward(7, 0), "7 numbers are not whole rows of 0");
        let backward = |[len, n, g, gain, bias]: [usize; 5]| {
            let (mut dgain, mut dbias) = (vec![0.0_f32; gain], vec![0.0; bias]);
            let (x, ones, sums) = (vec![0.0; len], vec![1.0; n], Some([&mut dgain[..], &mut dbias[..]]));
            layer_norm_rows_grad(&x, &ones, &vec![1.0; g], 1e-5, &mut [0.0; 7], sums, &pool);
        };
        backward([6, 3, 6, 3, 3]);
        assert_panics(|| backward([7, 3, 7, 3, 3]), "7 numbers are not whole rows of 3");
        assert_panics(|| backward([6, 3, 5, 3, 3]), "5 gradients of 6 numbers");
        // What gain had no room for was written over the sums of the bias.
        assert_panics(|| backward([6, 3, 6, 2, 4]), "sums of other lengths");
        assert_panics(|| backward([6, 3, 6, 3, 2]), "sums of other lengths");
    }

    #[test]
    fn the_variance_survives_a_large_offset() {
        for n in LENGTHS.into_iter().filter(|&n| n > 1) {
            let x: Vec<f32> = matrix(1, n).iter().map(|x| x + 30_000.0).collect();
            let mean = x.iter().map(|&x| f64::from(x)).sum::<f64>() / n as f64;
            let exact = x.iter().map(|&x| (f64::from(x) - mean).powi(2)).sum::<f64>() / n as f64;
            let mut out = [0.0];
            variance_rows(&x, n, 1.0, false, &mut out);
            assert!((f64::from(out[0]) / exact - 1.0).abs() < 1e-5, "{n}: {} for {exact}", out[0]);
            // Normalised, the row has mean 0 and variance 1 to the last digits.
            let mut unit = vec![0.0; n];
            layer_norm_rows(&x, &vec![1.0; n], &vec![0.0; n], 0.0, &mut unit);
            let mean = unit.iter().map(|&x| f64::from(x)).sum::<f64>() / n as f64;
            assert!(mean.abs() < 2e-7, "{n}: {mean}");
        }
    }
}
