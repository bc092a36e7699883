//! Mean and variance of rows, and layer normalisation.

use super::{ROW_ELEMENT, block, blocks, check_rows, check_whole, total, totals_of};
use crate::parallel::chunks;
use crate::scale::{exponent, is_safe, largest, power_of_two, powers, wide_power};
use crate::{Pool, Scalar, Tensor, Wide, simd};

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

/// What normalises a row: `((x - mean[0]) - mean[1]) * scale`.
struct Standard<T> {
    mean: [T; 2],
    scale: T,
}

/// What normalises a row, unless squares or deviations leave the range of the type: see [`scaled`].
#[inline(always)]
fn standard<T: Scalar>(x: &[T], eps: f64) -> Option<Standard<T>> {
    /// Whether no deviation loses digits as a subnormal number, before and after it is scaled. All may be 0.
    #[cold]
    #[inline(never)]
    fn has_digits<T: Scalar>(x: &[T], scale: T) -> bool {
        let least = T::from_f64(power_of_two(if size_of::<T>() == 4 { -102 } else { -970 }));
        let largest = largest(x);
        largest == T::ZERO || largest.minimum(largest * scale) >= least
    }
    let (mean, variance) = moments(x);
    let sum = variance + T::from_f64(eps);
    let scale = T::ONE / sum.sqrt();
    let is_quick = is_safe(sum) && (is_safe(variance) || has_digits(x, scale));
    is_quick.then_some(Standard { mean, scale })
}

/// Powers of two with which the layer normalisation of a row stays in range.
#[doc(hidden)]
pub struct RowUnits<T> {
    /// Subtracted from the elements: what they are if they are equal, since these deviate by nothing. Otherwise 0.
    pub first: T,
    /// Multiplies the elements, whose squares are in range afterwards.
    pub down: T,
    /// The exponent of a power that multiplies deviations afterwards, which then are in units of `unit`.
    pub rest: i64,
    /// The exponent of the unit of `sqrt(variance + eps)`.
    pub unit: i64,
    /// Epsilon in units of the square.
    pub eps: T,
}

impl<T: Scalar> RowUnits<T> {
    /// The units of this row.
    pub fn new(x: &[T], eps: f64) -> Self {
        let equal = x.first().copied().filter(|&first| x.iter().all(|&x| x == first));
        let [down, up] = powers(if equal.is_some() { T::from_f64(eps.sqrt()) } else { largest(x) });
        let own = exponent(up);
        let of_eps = if eps > 0.0 { exponent(eps.sqrt()) } else { own };
        let unit = if equal.is_some() { of_eps } else { of_eps.max(own) };
        // In f64, where epsilon is not rounded to 0. One factor after the other: the square of a power may overflow.
        let eps = T::from_f64(eps * power_of_two(-unit) * power_of_two(-unit));
        RowUnits { first: equal.unwrap_or(T::ZERO), down, rest: own - unit, unit, eps }
    }
}

/// A row in units of a power of two, with factors that may be out of the range of the type.
struct Scaled<T: Scalar> {
    /// The deviations from the mean.
    apart: Vec<T>,
    /// What normalises them.
    scale: T::Wide,
    /// `1 / sqrt(variance + eps)` of the row itself.
    slope: T::Wide,
}

impl<T: Scalar> Scaled<T> {
    fn new(x: &[T], eps: f64) -> Self {
        let RowUnits { first, down, rest, unit, eps } = RowUnits::new(x, eps);
        let mut apart: Vec<T> = x.iter().map(|&x| (x - first) * down).collect();
        let ([mean, low], variance) = moments(&apart);
        apart.iter_mut().for_each(|x| *x = (*x - mean) - low);
        let power = power_of_two(rest);
        let sum = T::from_f64(variance.to_f64() * power * power) + eps;
        let scale = (T::ONE / sum.sqrt()).wide();
        Scaled { apart, scale: scale * wide_power::<T>(rest), slope: scale * wide_power::<T>(-unit) }
    }
}

/// Layer normalisation of a row that [`standard`] leaves out.
#[cold]
#[inline(never)]
fn scaled<T: Scalar>(x: &[T], gain: &[T], bias: &[T], eps: f64, out: &mut [T]) {
    let Scaled { apart, scale, .. } = Scaled::new(x, eps);
    for i in 0..x.len() {
        out[i] = (apart[i].wide() * scale * gain[i].wide()).narrow() + bias[i];
    }
}

/// The gradient of a row where squares, deviations, `g gain` or their sums leave the range of the type. Shares of gain
/// and bias are added to `group`, which may be empty.
#[cold]
#[inline(never)]
fn scaled_grad<T: Scalar>(x: &[T], gain: &[T], g: &[T], eps: f64, dx: &mut [T], group: &mut [T]) {
    let (n, Scaled { apart, scale, slope }) = (x.len(), Scaled::new(x, eps));
    let (group_gain, group_bias) = group.split_at_mut(group.len() / 2);
    for (i, (of_gain, of_bias)) in group_gain.iter_mut().zip(group_bias).enumerate() {
        *of_gain += (g[i].wide() * apart[i].wide() * scale).narrow();
        *of_bias += g[i];
    }
    // h = g gain in units of the largest one.
    let top = (0..n).map(|i| exponent(g[i]) + exponent(gain[i])).fold(-20_000, i64::max);
    let [down, up] = [-top, top].map(wide_power::<T>);
    let unit: Vec<T> = apart.iter().map(|x| (x.wide() * scale).narrow()).collect();
    for i in 0..n {
        dx[i] = (g[i].wide() * gain[i].wide() * down).narrow();
    }
    let count = T::from_f64(n as f64);
    let [level, along] = totals_of(dx, &unit, |h, u| [h, h * u]).map(|sum| sum / count);
    for i in 0..n {
        dx[i] = (((dx[i] - level) - unit[i] * along).wide() * slope * up).narrow();
    }
}

/// Whether means of `h` and `h u` and all that they are computed from are in range, or `g` or `gain` is 0.
#[inline(always)]
fn are_in_range<T: Scalar>(level: T, slope: T, gain: &[T], g: &[T]) -> bool {
    let [least, most] = if size_of::<T>() == 4 { [-90, 100] } else { [-900, 1000] };
    let size = level.abs().maximum(slope.abs());
    let is_within = size >= T::from_f64(power_of_two(least)) && size <= T::from_f64(power_of_two(most));
    is_within || size == T::ZERO && (largest(g) == T::ZERO || largest(gain) == T::ZERO)
}

/// Layer normalisation of each row: `(x - mean) / sqrt(variance + eps) * gain + bias`, with the variance divided by
/// `n`. It is right wherever the result is in range, whatever the squares. So are its gradients.
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
        simd::dispatch(
            #[inline(always)]
            || {
                let (gain, bias) = (&gain[..n], &bias[..n]);
                for (x, out) in x[start..].chunks_exact(n).zip(out.chunks_exact_mut(n)) {
                    let Some(Standard { mean: [mean, rest], scale }) = standard(x, eps) else {
                        scaled(x, gain, bias, eps, out);
                        continue;
                    };
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
            let mut totals: Vec<f64> = (0..2 * n).map(|j| parts.iter().map(|(_, sums)| sums[j]).sum()).collect();
            if !totals.iter().all(|total| total.is_finite()) {
                let again = sums_in_range(x, n, g, eps);
                totals.iter_mut().zip(again).filter(|(total, _)| !total.is_finite()).for_each(|(out, sum)| *out = sum);
            }
            dgain.iter_mut().chain(dbias).zip(totals).for_each(|(out, total)| *out = T::from_f64(total));
        }
    } else if let Some([dgain, dbias]) = sums {
        dgain.iter_mut().chain(dbias).for_each(|out| *out = T::ZERO);
    }
}

/// The gradients of gain and bias, one after the other, where sums on the way leave the range of the type.
#[cold]
#[inline(never)]
fn sums_in_range<T: Scalar>(x: &[T], n: usize, g: &[T], eps: f64) -> Vec<f64> {
    /// The exponent by which the summands are smaller.
    const DOWN: i64 = -64;
    let (down, mut sums) = (wide_power::<T>(DOWN), vec![0.0; 2 * n]);
    for (x, g) in x.chunks_exact(n).zip(g.chunks_exact(n)) {
        let Scaled { apart, scale, .. } = Scaled::new(x, eps);
        let (of_gain, of_bias) = sums.split_at_mut(n);
        for i in 0..n {
            let g = g[i].wide() * down;
            of_gain[i] += (g * apart[i].wide() * scale).narrow().to_f64();
            of_bias[i] += g.narrow().to_f64();
        }
    }
    sums.into_iter().map(|sum| sum * power_of_two(-DOWN)).collect()
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
    let count = T::from_f64(n as f64);
    for ((x, g), dx) in x.chunks(GROUP * n).zip(g.chunks(GROUP * n)).zip(dx.chunks_mut(GROUP * n)) {
        simd::dispatch(
            #[inline(always)]
            || {
                let (unit, group) = scratch.split_at_mut(n);
                group.fill(T::ZERO);
                let gain = &gain[..n];
                for ((x, g), dx) in x.chunks_exact(n).zip(g.chunks_exact(n)).zip(dx.chunks_exact_mut(n)) {
                    let Some(Standard { mean: [mean, rest], scale }) = standard(x, eps) else {
                        scaled_grad(x, gain, g, eps, dx, group);
                        continue;
                    };
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
                    if !are_in_range(level, slope, gain, g) {
                        scaled_grad(x, gain, g, eps, dx, &mut []);
                        continue;
                    }
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
