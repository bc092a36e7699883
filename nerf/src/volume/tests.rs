//! Compositing as a whole: exact integrals, extremes, and precision behind opaque samples.

use super::{OpticalDepth, accumulate, weights};
use raygrad_autograd::{Scalar, Segments, Tape, Tensor, Var};

/// Colour and remaining light, `[rays, channels]` and `[rays]`.
fn composite<'t, T: Scalar>(
    op: OpticalDepth<T>,
    segments: &Segments,
    [density, features]: [&Var<'t, T>; 2],
) -> [Var<'t, T>; 2] {
    let x = density.tape().apply(op, &[density]);
    [accumulate(&weights(&x, segments), features, segments), (-x.segment_sum(segments)).exp()]
}

/// Colour and remaining light of one ray, and the gradients of their sum by densities and colours.
fn one_ray<T: Scalar>(sigma: &[f64], delta: &[f64], colour: &[f64]) -> [Vec<f64>; 3] {
    let tensor = |x: &[f64], shape: &[usize]| Tensor::from_vec(shape, x.iter().map(|&x| T::from_f64(x)).collect());
    let n = sigma.len();
    let tape = Tape::new();
    let s = tape.leaf(tensor(sigma, &[n]));
    let c = tape.leaf(tensor(colour, &[n, 1]));
    let [seen, left] = composite(OpticalDepth::new(tensor(delta, &[n])), &Segments::uniform(1, n), [&s, &c]);
    let grads = seen.sum().grad(&[&s, &c]);
    let out = vec![seen.item().to_f64(), left.item().to_f64()];
    let [d_sigma, d_colour] = [&grads[0], &grads[1]].map(|x| x.as_slice().iter().map(|x| x.to_f64()).collect());
    [out, d_sigma, d_colour]
}

#[test]
fn log_density_gradients_are_finite() {
    // One sample of colour 1: C = 1 - e^-x, dC/dz = x e^-x with x = e^z delta.
    for z in [-200.0, -20.0, 0.0, 15.0, 16.0, 88.0, 89.0, 200.0_f64] {
        for delta in [1e-6_f32, 1e-3, 1.0] {
            let tape = Tape::new();
            let density = tape.leaf(Tensor::from_vec(&[1], vec![z as f32]));
            let feature = tape.constant(Tensor::ones(&[1, 1]));
            let op = OpticalDepth::of_log_density(Tensor::from_vec(&[1], vec![delta]));
            let [color, _] = composite(op, &Segments::uniform(1, 1), [&density, &feature]);
            let color = color.sum();
            let x = z.exp() * f64::from(delta);
            let (value, slope) = (f64::from(color.item()), f64::from(color.grad(&[&density])[0].item()));
            let expected = if x > 700.0 { 0.0 } else { x * (-x).exp() };
            assert!((value + (-x).exp_m1()).abs() <= 2e-7 * value.max(1e-30), "z {z}, delta {delta}: {value}");
            assert!((slope - expected).abs() <= 1e-5 * expected + 1e-37, "z {z}, delta {delta}: {slope} {expected}");
        }
    }
}

#[test]
fn constant_medium_is_integrated_exactly() {
    // The rendering integrals, without the background: c (1 - E) and E.
    let n = 64;
    let [out, ..] = one_ray::<f64>(&vec![1.3; n], &vec![4.0 / n as f64; n], &vec![0.8; n]);
    let e = (-5.2_f64).exp();
    assert!((out[0] - 0.8 * (1.0 - e)).abs() < 1e-14);
    assert!((out[1] - e).abs() < 1e-15);
    assert!((out[0] + out[1] - 0.801_103_312_884_152_1).abs() < 1e-14);
}

#[test]
fn rays_without_samples_or_density_are_black() {
    let [out, ..] = one_ray::<f32>(&[], &[], &[]);
    assert_eq!(out, [0.0, 1.0], "no samples: the background");
    let [out, ..] = one_ray::<f32>(&[0.0; 3], &[1.0; 3], &[0.9; 3]);
    assert_eq!(out, [0.0, 1.0], "empty space: the background");
    let [out, d_sigma, _] = one_ray::<f32>(&[1e30; 3], &[1.0; 3], &[0.25, 0.5, 0.75]);
    assert_eq!(out, [0.25, 0.0], "opaque: the first colour");
    assert_eq!(d_sigma, [0.0; 3]);
    let [out, d_sigma, _] = one_ray::<f32>(&[0.5, 0.0], &[1.0, f64::INFINITY], &[0.25, 0.5]);
    assert!((out[1] - (-0.5_f64).exp()).abs() < 1e-7 && d_sigma[1] == 0.0, "an empty infinite interval");
}

#[test]
fn tiny_optical_depths_are_precise() {
    let n = 1024;
    let [out, ..] = one_ray::<f32>(&vec![1e-3; n], &vec![1.0 / n as f64; n], &vec![1.0; n]);
    let exact = -(-1e-3_f64).exp_m1();
    assert!((out[0] / exact - 1.0).abs() < 2e-7, "{} against {exact}", out[0]);
}

#[test]
fn gradients_at_opaque_samples_are_exact() {
    // alpha = (.3, 1, .5), c = (.2, .9, .4): dC/dalpha = (-.7, .49 T, 0); dC/dx_i = (1 - alpha_i) dC/dalpha_i.
    let x = [-(0.7_f64.ln()), f64::INFINITY, 2.0_f64.ln()];
    let [out, d_sigma, d_colour] = one_ray::<f64>(&[x[0], 1e300, x[2]], &[1.0; 3], &[0.2, 0.9, 0.4]);
    assert!((out[0] - (0.3 * 0.2 + 0.7 * 0.9)).abs() < 1e-15);
    assert!((d_sigma[0] - 0.7 * -0.7).abs() < 1e-15 && d_sigma[1] == 0.0 && d_sigma[2] == 0.0);
    assert!((d_colour[1] - 0.7).abs() < 1e-15 && d_colour[2] == 0.0);
}

#[test]
fn f32_keeps_its_accuracy_behind_dense_samples() {
    let n = 192;
    let wave = |i: usize, k: f64| 0.5 + 0.5 * (i as f64 * k).sin();
    for scale in [0.5, 5.0, 40.0] {
        let round = |x: f64| f64::from(x as f32);
        let sigma: Vec<f64> = (0..n).map(|i| round(scale * wave(i, 0.13))).collect();
        let delta: Vec<f64> = (0..n).map(|i| round(4.0 / n as f64 * (0.5 + wave(i, 0.7)))).collect();
        let colour: Vec<f64> = (0..n).map(|i| round(wave(i, 0.31))).collect();
        let [single, d_single, _] = one_ray::<f32>(&sigma, &delta, &colour);
        let [double, d_double, _] = one_ray::<f64>(&sigma, &delta, &colour);
        assert!((single[0] - double[0]).abs() <= 1e-6, "scale {scale}: {} against {}", single[0], double[0]);
        let mut tau = 0.0_f64;
        for i in 0..n {
            let error = (d_single[i] - d_double[i]).abs();
            let t = (-tau).exp();
            assert!(error <= 1e-5 * delta[i] * t + 1e-38, "scale {scale}, sample {i}: {error:e}, T {t:e}");
            tau += sigma[i] * delta[i];
        }
    }
}
