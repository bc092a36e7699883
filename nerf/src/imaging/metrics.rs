//! Image metrics: mean squared error, PSNR and SSIM.
//!
//! All take two images of one shape with values of 0 to 1, sum in f64, and return NaN if a value is NaN.

use raygrad_tensor::parallel;

use crate::dataset::image::Image;

/// Computes the mean squared error over all pixels and channels; NaN for images without pixels.
///
/// # Panics
/// If the images differ in size or channels.
#[track_caller]
pub fn mse(a: &Image, b: &Image) -> f64 {
    weighted_mse(a, b, |_, _| 1.0)
}

/// Computes the mean squared error with a weight for each pixel (column, row), at least 0. Pixels of weight 0 are not
/// compared; without others it is NaN.
///
/// With the weights of a [frame](crate::dataset::Frame::weight) its [PSNR](psnr_from_mse) leaves out masked pixels. For
/// a panorama it is then the WS-PSNR (Sun, Lu and Yu 2017), which weights pixels by their solid angle.
///
/// # Panics
/// If the images differ in size or channels.
#[track_caller]
pub fn weighted_mse(a: &Image, b: &Image, weight: impl Fn(usize, usize) -> f64) -> f64 {
    a.assert_same_shape(b);
    let (mut sum, mut total) = (0.0, 0.0);
    for (x, y) in (0..a.height).flat_map(|y| (0..a.width).map(move |x| (x, y))) {
        let weight = weight(x, y);
        if weight > 0.0 {
            let squares = a.pixel(x, y).iter().zip(b.pixel(x, y)).map(|(&a, &b)| (f64::from(a) - f64::from(b)).powi(2));
            squares.for_each(|square| sum += weight * square);
            total += weight;
        }
    }
    sum / (total * a.channels as f64)
}

/// Computes the peak signal-to-noise ratio in dB for a peak of 1: `-10 log10(mse)`. Identical images give +infinity.
///
/// The published PSNR of a test set is the mean over images, not the PSNR of the mean error.
///
/// # Panics
/// If the images differ in size or channels.
#[track_caller]
pub fn psnr(a: &Image, b: &Image) -> f64 {
    psnr_from_mse(mse(a, b))
}

/// Computes the PSNR in dB from a mean squared error, for a peak of 1; 0 gives +infinity.
pub fn psnr_from_mse(mse: f64) -> f64 {
    // The reciprocal instead of a minus sign: an error of 1 is 0 dB, not -0.
    10.0 * mse.recip().log10()
}

/// Side of the window of [`ssim`] in pixels, and so the smallest side of its images.
pub const SSIM_WINDOW: usize = 11;

/// Computes the structural similarity (Wang, Bovik, Sheikh and Simoncelli 2004), at most 1; 1 for identical images.
///
/// An 11x11 Gaussian window with standard deviation 1.5 pixels moves over all positions inside the image. With the
/// window's means `mu`, variances and covariance (weights that sum to 1, no sample correction), C1 = 0.01^2 and C2 =
/// 0.03^2,
///
/// ```text
/// ssim = (2 mu_a mu_b + C1) (2 cov_ab + C2) / ((mu_a^2 + mu_b^2 + C1) (var_a + var_b + C2))
/// ```
///
/// and the result is the mean over positions and channels.
///
/// # Panics
/// If the images differ in size or channels, or are smaller than the window.
#[track_caller]
pub fn ssim(a: &Image, b: &Image) -> f64 {
    const C1: f64 = 0.01 * 0.01;
    const C2: f64 = 0.03 * 0.03;
    a.assert_same_shape(b);
    let fits = a.width >= SSIM_WINDOW && a.height >= SSIM_WINDOW;
    assert!(fits, "SSIM needs at least {SSIM_WINDOW}x{SSIM_WINDOW} pixels, the images have {}x{}", a.width, a.height);

    // With s = a + b and d = a - b, 2 mu_a mu_b = (mu_s^2 - mu_d^2) / 2 and mu_a^2 + mu_b^2 = (mu_s^2 + mu_d^2) / 2;
    // the same holds for variances. This takes two moments instead of five. No term is negative, so rounding cannot
    // lift the quotient above 1.
    let weights = gaussian();
    let sums = row_moments(a, b, &weights, |a, b| a + b);
    let differences = row_moments(a, b, &weights, |a, b| a - b);
    let row_total = |y: usize| {
        let window = |rows: &[Moments]| combine(&weights, std::array::from_fn(|k| rows[y + k].as_slices()));
        let (s, d) = (window(&sums), window(&differences));
        let similarity = |i: usize| {
            let (mu_s, mu_d) = (s.mean[i].powi(2), d.mean[i].powi(2));
            let (var_s, var_d) = (s.variance[i], d.variance[i]);
            let numerator = (mu_s - mu_d + 2.0 * C1) * (var_s - var_d + 2.0 * C2);
            numerator / ((mu_s + mu_d + 2.0 * C1) * (var_s + var_d + 2.0 * C2))
        };
        (0..s.mean.len()).map(similarity).sum::<f64>()
    };
    // Rows are added in order, so that the result does not depend on the number of threads.
    let places = [a.width + 1 - SSIM_WINDOW, a.height + 1 - SSIM_WINDOW];
    let totals = parallel::collect(places[1], row_total);
    totals.iter().sum::<f64>() / (places[0] * places[1] * a.channels) as f64
}

/// Weighted means and variances, per position and channel of a row.
struct Moments {
    mean: Vec<f64>,
    variance: Vec<f64>,
}

impl Moments {
    fn as_slices(&self) -> (&[f64], &[f64]) {
        (&self.mean, &self.variance)
    }
}

/// The moments of `f(a, b)` in windows of one row, for every row.
///
/// The Gaussian window is separable: this is the pass along rows, and [`combine`] also does the one along columns.
fn row_moments(a: &Image, b: &Image, weights: &Weights, f: fn(f64, f64) -> f64) -> Vec<Moments> {
    let row_length = a.width * a.channels;
    let out_length = row_length - (SSIM_WINDOW - 1) * a.channels;
    let zeros = vec![0.0; out_length];
    let moments = |y: usize| {
        let [a_row, b_row] = [a, b].map(|image| &image.data[y * row_length..][..row_length]);
        let row: Vec<f64> = a_row.iter().zip(b_row).map(|(&a, &b)| f(a.into(), b.into())).collect();
        combine(weights, std::array::from_fn(|k| (&row[k * a.channels..][..out_length], &zeros[..])))
    };
    parallel::collect(a.height, moments)
}

/// Weights of the window along one axis, with the sum 1.
type Weights = [f64; SSIM_WINDOW];

/// The Gaussian window with a standard deviation of 1.5.
fn gaussian() -> Weights {
    const SIGMA: f64 = 1.5;
    let centre = (SSIM_WINDOW / 2) as f64;
    let weights: Weights = std::array::from_fn(|k| (-0.5 * ((k as f64 - centre) / SIGMA).powi(2)).exp());
    let total: f64 = weights.iter().sum();
    weights.map(|w| w / total)
}

/// Element-wise moments of a whole from the means and variances of its parts.
///
/// The variance of a whole is the mean of the variances of its parts plus the variance of their means. The textbook's
/// E[x^2] - mu^2 would cancel and become negative in flat regions.
fn combine(weights: &Weights, parts: [(&[f64], &[f64]); SSIM_WINDOW]) -> Moments {
    let length = parts[0].0.len();
    let (mut mean, mut variance) = (vec![0.0; length], vec![0.0; length]);
    for (&weight, (part_mean, _)) in weights.iter().zip(parts) {
        for (mean, part_mean) in mean.iter_mut().zip(part_mean) {
            *mean += weight * part_mean;
        }
    }
    for (&weight, (part_mean, part_variance)) in weights.iter().zip(parts) {
        let part = part_mean.iter().zip(part_variance);
        for ((variance, mean), (part_mean, part_variance)) in variance.iter_mut().zip(&mean).zip(part) {
            *variance += weight * (part_variance + (part_mean - mean) * (part_mean - mean));
        }
    }
    Moments { mean, variance }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use rand::rngs::StdRng;
    use rand::{RngExt, SeedableRng};

    fn constant(value: f32) -> Image {
        Image { width: 16, height: 13, channels: 3, data: vec![value; 16 * 13 * 3] }
    }

    fn noise(seed: u64, base: &Image, scale: f32) -> Image {
        let mut rng = StdRng::seed_from_u64(seed);
        let data = base.data.iter().map(|v| v + scale * (rng.random::<f32>() - 0.5)).collect();
        Image { data, ..*base }
    }

    /// SSIM by its definition, window by window in two dimensions.
    fn ssim_by_definition(a: &Image, b: &Image) -> f64 {
        let weight = |dx: usize, dy: usize| {
            let squared = (dx as f64 - 5.0).powi(2) + (dy as f64 - 5.0).powi(2);
            (-squared / (2.0 * 1.5 * 1.5)).exp()
        };
        let window: Vec<(usize, usize)> = (0..121).map(|i| (i % 11, i / 11)).collect();
        let total: f64 = window.iter().map(|&(dx, dy)| weight(dx, dy)).sum();
        let mut all = Vec::new();
        for y in 0..=a.height - 11 {
            for x in 0..=a.width - 11 {
                for c in 0..a.channels {
                    let mean = |f: &dyn Fn(f64, f64) -> f64| {
                        let value = |i: &Image, dx, dy| f64::from(i.pixel(x + dx, y + dy)[c]);
                        let term = |&(dx, dy): &_| weight(dx, dy) / total * f(value(a, dx, dy), value(b, dx, dy));
                        window.iter().map(term).sum::<f64>()
                    };
                    let (mu_a, mu_b) = (mean(&|a, _| a), mean(&|_, b| b));
                    let var_a = mean(&|a, _| (a - mu_a).powi(2));
                    let var_b = mean(&|_, b| (b - mu_b).powi(2));
                    let cov = mean(&|a, b| (a - mu_a) * (b - mu_b));
                    let luminance = (2.0 * mu_a * mu_b + 1e-4) / (mu_a * mu_a + mu_b * mu_b + 1e-4);
                    all.push(luminance * (2.0 * cov + 9e-4) / (var_a + var_b + 9e-4));
                }
            }
        }
        all.iter().sum::<f64>() / all.len() as f64
    }

    #[test]
    fn psnr_of_known_errors_is_exact() {
        let close = |a: f64, b: f64| assert!((a - b).abs() < 1e-5, "{a} for {b}");
        close(psnr(&constant(0.5), &constant(0.6)), 20.0);
        close(psnr(&constant(0.25), &constant(0.26)), 40.0);
        assert_eq!(psnr(&constant(0.0), &constant(1.0)).to_bits(), 0.0f64.to_bits());
        assert_eq!(psnr(&constant(0.3), &constant(0.3)), f64::INFINITY);
        assert_eq!(mse(&constant(0.25), &constant(0.75)), 0.25);
        assert_eq!(psnr_from_mse(0.01), 20.0);
        assert_eq!(psnr_from_mse(0.0), f64::INFINITY);
    }

    #[test]
    fn weighted_error_is_that_of_the_weighted_pixels() {
        let (a, mut b) = (constant(0.5), noise(1, &constant(0.5), 1.0));
        assert_eq!(weighted_mse(&a, &b, |_, _| 1.0).to_bits(), mse(&a, &b).to_bits());
        assert!((weighted_mse(&a, &b, |_, _| 0.3) / mse(&a, &b) - 1.0).abs() < 1e-12);
        // Two pixels of weights 1 and 3, errors .1 and .2; another one is left out.
        b.data.fill(0.5);
        b.pixel_mut(2, 1).fill(0.6);
        b.pixel_mut(15, 12).fill(0.7);
        b.pixel_mut(0, 0).fill(f32::NAN);
        let weight =
            |x: usize, y: usize| [([2, 1], 1.0), ([15, 12], 3.0)].iter().find(|w| w.0 == [x, y]).map_or(0.0, |w| w.1);
        assert!((weighted_mse(&a, &b, weight) - (0.01 + 3.0 * 0.04) / 4.0).abs() < 1e-7);
        assert!(weighted_mse(&a, &b, |_, _| 0.0).is_nan());
    }

    #[test]
    fn ssim_of_identical_images_is_one() {
        let image = noise(1, &constant(0.5), 1.0);
        assert_eq!(ssim(&image, &image), 1.0);
        assert_eq!(ssim(&constant(0.0), &constant(0.0)), 1.0);
    }

    #[test]
    fn ssim_of_constants_is_the_luminance_term() {
        // Variances are 0, so the luminance term alone remains.
        let got = ssim(&constant(0.25), &constant(0.75));
        assert!((got - (2.0 * 0.25 * 0.75 + 1e-4) / (0.0625 + 0.5625 + 1e-4)).abs() < 1e-12, "{got}");
    }

    #[test]
    fn ssim_never_exceeds_one() {
        let base = constant(0.6);
        let nearly = ssim(&base, &constant(0.6 + 1e-7));
        assert!(nearly <= 1.0 && nearly > 1.0 - 1e-9, "{nearly}");
        for scale in [1e-7, 1e-6, 1e-5, 1e-4, 1e-3] {
            let noisy = ssim(&base, &noise(7, &base, scale));
            assert!(noisy <= 1.0 && noisy > 0.9, "{scale}: {noisy}");
        }
    }

    #[test]
    fn ssim_equals_its_definition() {
        for (seed, scale) in [(1, 1.0), (2, 0.3), (3, 1e-2), (4, 1e-5)] {
            let a = noise(seed, &constant(0.5), 1.0);
            let b = noise(seed + 100, &a, scale);
            let (fast, slow) = (ssim(&a, &b), ssim_by_definition(&a, &b));
            assert!((fast - slow).abs() < 1e-12, "{scale}: {fast} for {slow}");
        }
    }

    #[test]
    fn metrics_of_nan_are_nan() {
        let (good, mut bad) = (constant(0.5), constant(0.5));
        bad.data[100] = f32::NAN;
        for metric in [mse, psnr, ssim] {
            assert!(metric(&good, &bad).is_nan() && metric(&bad, &bad).is_nan());
        }
    }

    #[test]
    #[should_panic(expected = "images must have the same height, width and channels")]
    fn metrics_of_different_shapes_panic() {
        psnr(&Image::new(2, 3, 3), &Image::new(3, 2, 3));
    }

    #[test]
    #[should_panic(expected = "SSIM needs at least 11x11 pixels, the images have 12x10")]
    fn ssim_of_too_small_images_panics() {
        ssim(&Image::new(12, 10, 1), &Image::new(12, 10, 1));
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(32))]
        #[test]
        fn ssim_is_symmetric_and_bounded(seed: u64, scale in 0.0f32..1.0) {
            let a = noise(seed, &constant(0.5), 1.0);
            let b = noise(!seed, &a, scale);
            let forward = ssim(&a, &b);
            prop_assert_eq!(forward, ssim(&b, &a));
            prop_assert!((-1.0..=1.0).contains(&forward));
        }
    }
}
