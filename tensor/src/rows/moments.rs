//! Mean and variance of rows, and layer normalisation.

use super::{total, total_of};
use crate::{Pool, Scalar, simd};

/// Rows whose gradients are added up in their own type before they go into f64 sums.
const GROUP: usize = 16;

/// Mean and mean squared deviation of a row, the mean in two parts: their sum is accurate beyond the type's digits.
///
/// Two passes. The second measures from the rounded mean, and takes out what the rounding of the mean adds to the sum.
#[inline(always)]
fn moments<T: Scalar>(x: &[T]) -> ([T; 2], T) {
    let count = T::from_f64(x.len() as f64);
    let mean = total(x) / count;
    let rest = total_of(
        x,
        x,
        #[inline(always)]
        |x, _| x - mean,
    ) / count;
    let square = total_of(
        x,
        x,
        #[inline(always)]
        |x, _| (x - mean) * (x - mean),
    ) / count;
    ([mean, rest], square - rest * rest)
}

/// The mean squared deviation from the mean, of each row of `n` elements; NaN for an empty row.
///
/// # Panics
/// If `x` is not `out.len()` rows of `n`.
pub fn variance_rows<T: Scalar>(x: &[T], n: usize, out: &mut [T]) {
    assert_eq!(x.len(), n * out.len(), "{} rows of {n}", out.len());
    if n == 0 {
        out.fill(T::from_f64(f64::NAN));
        return;
    }
    simd::dispatch(
        #[inline(always)]
        || {
            for (x, out) in x.chunks_exact(n).zip(out) {
                *out = moments(x).1;
            }
        },
    );
}

/// Layer normalisation of each row: `(x - mean) / sqrt(variance + eps) * gain + bias`, with the variance divided by
/// `n`.
///
/// # Panics
/// If `gain` and `bias` have different lengths or a row has another one, or `out` is shorter than `x`.
pub fn layer_norm_rows<T: Scalar>(x: &[T], gain: &[T], bias: &[T], eps: f64, out: &mut [T]) {
    let n = gain.len();
    assert_eq!(bias.len(), n, "gain and bias of one length");
    if x.is_empty() {
        return;
    }
    let (eps, len) = (T::from_f64(eps), x.len());
    simd::dispatch(
        #[inline(always)]
        || {
            let (gain, bias) = (&gain[..n], &bias[..n]);
            for (x, out) in x.chunks_exact(n).zip(out[..len].chunks_exact_mut(n)) {
                let ([mean, rest], variance) = moments(x);
                let scale = T::ONE / (variance + eps).sqrt();
                for i in 0..n {
                    out[i] = ((x[i] - mean) - rest) * scale * gain[i] + bias[i];
                }
            }
        },
    );
}

/// The gradients of [`layer_norm_rows`]: that of `x` to `dx`, those of gain and bias to `dgain` and `dbias`.
///
/// With u the normalised row and h = g gain: dx = (h - mean h - u mean(h u)) / sqrt(variance + eps), dgain = sum of g u
/// and dbias = sum of g over the rows. These sums are carried in f64.
///
/// # Panics
/// If a slice is shorter than its counterpart.
pub fn layer_norm_rows_grad<T: Scalar>(
    x: &[T],
    gain: &[T],
    g: &[T],
    eps: f64,
    [dx, dgain, dbias]: [&mut [T]; 3],
    pool: &Pool<T>,
) {
    let n = gain.len();
    let mut sums = vec![0.0_f64; 2 * n];
    let mut scratch = pool.take(3 * n);
    let (eps, len) = (T::from_f64(eps), x.len());
    let count = T::from_f64(n as f64);
    for ((x, g), dx) in
        x.chunks(GROUP * n.max(1)).zip(g[..len].chunks(GROUP * n.max(1))).zip(dx[..len].chunks_mut(GROUP * n.max(1)))
    {
        simd::dispatch(
            #[inline(always)]
            || {
                let (unit, group) = scratch[..3 * n].split_at_mut(n);
                group.fill(T::ZERO);
                let (group_gain, group_bias) = group.split_at_mut(n);
                let gain = &gain[..n];
                for ((x, g), dx) in x.chunks_exact(n).zip(g.chunks_exact(n)).zip(dx.chunks_exact_mut(n)) {
                    let ([mean, rest], variance) = moments(x);
                    let scale = T::ONE / (variance + eps).sqrt();
                    for i in 0..n {
                        unit[i] = ((x[i] - mean) - rest) * scale;
                        dx[i] = g[i] * gain[i];
                        group_gain[i] += g[i] * unit[i];
                        group_bias[i] += g[i];
                    }
                    let level = total(dx) / count;
                    let slope = total_of(
                        dx,
                        unit,
                        #[inline(always)]
                        |h, u| h * u,
                    ) / count;
                    for i in 0..n {
                        dx[i] = ((dx[i] - level) - unit[i] * slope) * scale;
                    }
                }
                for (sum, &part) in sums.iter_mut().zip(&*group) {
                    *sum += part.to_f64();
                }
            },
        );
    }
    pool.give(scratch);
    for (out, &sum) in dgain.iter_mut().chain(dbias).zip(&sums) {
        *out = T::from_f64(sum);
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::{LENGTHS, matrix};
    use super::*;

    #[test]
    fn the_variance_survives_a_large_offset() {
        for n in LENGTHS.into_iter().filter(|&n| n > 1) {
            let x: Vec<f32> = matrix(1, n).iter().map(|x| x + 30_000.0).collect();
            let mean = x.iter().map(|&x| f64::from(x)).sum::<f64>() / n as f64;
            let exact = x.iter().map(|&x| (f64::from(x) - mean).powi(2)).sum::<f64>() / n as f64;
            let mut out = [0.0];
            variance_rows(&x, n, &mut out);
            assert!((f64::from(out[0]) / exact - 1.0).abs() < 1e-5, "{n}: {} for {exact}", out[0]);
            // Normalised, the row has mean 0 and variance 1 to the last digits.
            let mut unit = vec![0.0; n];
            layer_norm_rows(&x, &vec![1.0; n], &vec![0.0; n], 0.0, &mut unit);
            let mean = unit.iter().map(|&x| f64::from(x)).sum::<f64>() / n as f64;
            assert!(mean.abs() < 2e-7, "{n}: {mean}");
        }
    }
}
