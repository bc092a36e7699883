//! PSNR and SSIM. Metrics are computed in f64 from images of f32.

use super::support::*;
use raygrad::nerf::Image;
use raygrad::nerf::imaging::metrics::{mse, psnr, psnr_from_mse, ssim};

fn image(size: usize, mut f: impl FnMut(usize) -> f32) -> Image {
    Image { width: size, height: size, channels: 3, data: (0..3 * size * size).map(&mut f).collect() }
}

/// Matrix: PSNR and SSIM of identical images, and of a constant .6 against + 1e-7.
#[test]
fn identical_and_nearly_identical_images() {
    let mut random = noise(2);
    let any = image(32, |_| random() as f32);
    for image in [&any, &image(32, |_| 0.6), &image(32, |_| 0.0)] {
        assert_eq!((psnr(image, image), ssim(image, image)), (f64::INFINITY, 1.0));
    }
    let (a, b) = (image(32, |_| 0.6), image(32, |_| 0.6 + 1e-7));
    assert!(ssim(&a, &b) <= 1.0 && ssim(&a, &b) > 1.0 - 1e-9);
    let step = f64::from(0.6_f32 + 1e-7) - f64::from(0.6_f32);
    within("psnr", psnr(&a, &b), -20.0 * step.log10(), 1e-9);
    // Catalogue: E[x^2] - mu^2 at 0.9 is negative in 36 % of the windows at a noise of 1e-5.
    for scale in [1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2] {
        let noisy = image(32, |_| 0.9 + scale * (random() as f32 - 0.5));
        let flat = image(32, |_| 0.9);
        let got = ssim(&flat, &noisy);
        assert!(got <= 1.0 && got > 0.9, "{scale:e}: {got}");
    }
}

/// Matrix: images in the range 255 give the same values as images in the range 1.
#[test]
fn range_255_equals_range_1() {
    let mut random = noise(8);
    let bytes: Vec<[u8; 2]> = (0..3 * 24 * 24).map(|i| [(i % 251) as u8, (256.0 * random()) as u8]).collect();
    let [a, b] = [0, 1].map(|k| image(24, |i| f32::from(bytes[i][k]) / 255.0));
    // PSNR and SSIM with the constants of the range 255, by definition.
    let squares: f64 = bytes.iter().map(|[a, b]| (f64::from(*a) - f64::from(*b)).powi(2)).sum();
    let expected = 10.0 * (255.0_f64.powi(2) * bytes.len() as f64 / squares).log10();
    within("psnr", psnr(&a, &b), expected, 1e-6);
    let (c1, c2) = ((0.01_f64 * 255.0).powi(2), (0.03_f64 * 255.0).powi(2));
    let weight = |d: usize| (-(d as f64 - 5.0).powi(2) / 4.5).exp();
    let total: f64 = (0..11).map(weight).sum();
    let mut sum = 0.0;
    for (y, x, c) in (0..14 * 14 * 3).map(|i| (i / 42, i / 3 % 14, i % 3)) {
        let mean = |f: &dyn Fn(f64, f64) -> f64| -> f64 {
            let at = |k: usize| {
                let [a, b] = bytes[((y + k / 11) * 24 + x + k % 11) * 3 + c].map(f64::from);
                weight(k / 11) * weight(k % 11) / (total * total) * f(a, b)
            };
            (0..121).map(at).sum()
        };
        let (ma, mb) = (mean(&|a, _| a), mean(&|_, b| b));
        let (va, vb) = (mean(&|a, _| (a - ma).powi(2)), mean(&|_, b| (b - mb).powi(2)));
        let both = mean(&|a, b| (a - ma) * (b - mb));
        sum += (2.0 * ma * mb + c1) * (2.0 * both + c2) / ((ma * ma + mb * mb + c1) * (va + vb + c2));
    }
    within("ssim", ssim(&a, &b), sum / (14.0 * 14.0 * 3.0), 1e-6);
}

/// Catalogue: the mean of PSNRs is not the PSNR of the mean, 8 bits limit the PSNR, and MSE over 1.92 million pixels.
#[test]
fn means_ceilings_and_large_images() {
    let [a, b] = [20.0, 40.0].map(|psnr: f64| 10.0_f64.powf(-psnr / 10.0));
    let mean = 0.5 * (psnr_from_mse(a) + psnr_from_mse(b));
    within("mean of PSNR", mean, constant("mean PSNR of 20 and 40 dB"), 1e-9);
    within("PSNR of mean", psnr_from_mse(0.5 * (a + b)), constant("PSNR of the mean error of 20 and 40 dB"), 1e-9);
    let mut random = noise(4);
    let exact = image(400, |_| random() as f32);
    let stored = image(400, |i| (exact.data[i] * 255.0).round() / 255.0);
    within("8 bits", psnr(&exact, &stored), constant("PSNR of rounding to 8 bits"), 0.02);
    let (a, b) = (image(800, |_| 0.25), image(800, |i| 0.25 + if i % 2 == 0 { 0.01 } else { -0.01 }));
    near::<f32>("1.92 million values", mse(&a, &b), 1e-4, 1e-6);
}

/// A single NaN makes the metric NaN.
#[test]
fn metrics_of_one_nan_are_nan() {
    let (good, mut bad) = (image(16, |_| 0.5), image(16, |_| 0.5));
    bad.data[77] = f32::NAN;
    assert!(psnr(&good, &bad).is_nan() && ssim(&good, &bad).is_nan());
    bad.data[77] = f32::INFINITY;
    assert!(!(psnr(&good, &bad) > 0.0) && !(ssim(&good, &bad) > 0.0));
}
