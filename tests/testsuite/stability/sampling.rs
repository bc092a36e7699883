//! Inverse-CDF sampling.

use super::support::*;
use raygrad::nerf::Jitter;
use raygrad::nerf::camera::stratified;
use raygrad::nerf::sampling::steps::{even_edges, importance_sampling, invert_cdf};
use raygrad::{Pool, Scalar};

fn inverted<T: Scalar>(weights: &[f64], share: f64, u: &[f64]) -> Vec<f64> {
    let weights: Vec<T> = weights.iter().map(|&w| T::from_f64(w)).collect();
    let mut out = vec![f64::NAN; u.len()];
    invert_cdf(&even_edges(weights.len()), &weights, share, u, &mut out).unwrap();
    out
}

fn evenly(n: usize) -> Vec<f64> {
    (0..n).map(|i| (i as f64 + 0.5) / n as f64).collect()
}

/// Matrix: inverse CDF of zero weights, one-hot, 1e-30, NaN.
fn weights_of_every_size<T: Scalar>() {
    let u = evenly(1000);
    for zero in [0.0, -0.0] {
        let out = inverted::<T>(&[zero; 7], 0.01, &u);
        assert!(out.iter().zip(&u).all(|(x, u)| (x - u).abs() < 1e-12), "zero weights: uniform");
    }
    // Only proportions matter, from the smallest number to the largest.
    let shape = [1.0, 0.0, 3.0, 2.0, 0.0, 2.0];
    let expected = inverted::<T>(&shape, 0.05, &u);
    for scale in [1e-30, 1e30, 0.25 * greatest::<T>(), 1e20 * smallest::<T>()] {
        let out = inverted::<T>(&shape.map(|w| w * scale), 0.05, &u);
        assert!(out.iter().zip(&expected).all(|(x, y)| (x - y).abs() < by_type::<T>(1e-5, 1e-11)), "scale {scale:e}");
    }
    for scale in [1.0, 1e-30, smallest::<T>(), greatest::<T>()] {
        let mut weights = [0.0; 10];
        weights[3] = scale;
        let out = inverted::<T>(&weights, 0.0, &u);
        assert!(out.iter().all(|x| (0.3..=0.4).contains(x)), "one-hot {scale:e}: in its bin");
        let outside = inverted::<T>(&weights, 0.1, &u).iter().filter(|x| !(0.3..=0.4).contains(*x)).count();
        assert!((88..=92).contains(&outside), "but for the uniform share of a tenth, less a tenth of it: {outside}");
    }
    for bad in [f64::NAN, f64::INFINITY, -1.0] {
        let mut out = [0.5];
        let error = invert_cdf(&even_edges(2), &[T::ONE, T::from_f64(bad)], 0.01, &[0.9], &mut out).unwrap_err();
        assert!(error.to_string().starts_with("`weights[1]`"), "{error}");
        assert_eq!(out, [0.5]);
    }
}

/// Matrix: u = 0, 1 - 2^-24, equal to a tie of the CDF; duplicate edges.
fn ends_and_ties<T: Scalar>() {
    let last = 1.0 - 2.0_f64.powi(-24);
    for n in [1, 2, 62, 1024] {
        let weights: Vec<f64> = (0..n).map(|i| 0.1 + (i as f64).sin().abs()).collect();
        let out = inverted::<T>(&weights, 0.01, &[0.0, last, 1.0]);
        assert!(out[0] == 0.0 && out[1] < 1.0 && out[1] > 1.0 - 1e-5 && out[2] <= 1.0, "{n} bins: {out:?}");
    }
    // The CDF is 0.25, 0.25, 0.25, 1: at a tie bins without mass are skipped.
    let out = inverted::<T>(&[1.0, 0.0, 0.0, 3.0], 0.0, &[0.0, 0.25 - 1e-12, 0.25, 0.25 + 1e-12, last]);
    assert!(out.is_sorted() && out[1] <= 0.25 && out[2] >= 0.75 && out[4] <= 1.0, "{out:?}");
    let out = inverted::<T>(&[0.0, 0.0, 1.0], 0.0, &[0.0, 0.5, 1.0]);
    assert!((out[0] - 2.0 / 3.0).abs() < 1e-15 && (out[2] - 1.0).abs() < 1e-15, "{out:?}");
    // A span of length 0: all bin edges are equal.
    let rays = ray_along_z::<T>(0.0, [2.0, 2.0]);
    let coarse = stratified(&rays, 8, &mut Jitter::Middle, &Pool::new());
    let fine = importance_sampling(&rays, &coarse, &[T::ONE; 8], 8, 0.01, &mut Jitter::Middle, &Pool::new());
    assert!(numbers(&fine.t).iter().all(|&t| t == 2.0) && numbers(&fine.delta).iter().all(|&d| d == 0.0));
}

/// Catalogue: weights + 1e-5 make 38 % of a faint ray's samples uniform; a mixture has an explicit share.
fn uniform_share_is_exact<T: Scalar>() {
    let u = evenly(100_000);
    for (total, name) in [(1.0, "1"), (1e-3, "1e-3"), (1e-4, "1e-4"), (1e-30, "")] {
        let mut weights = [0.0; 62];
        weights[20] = total;
        let out = inverted::<T>(&weights, 0.01, &u);
        let outside = out.iter().filter(|x| !(20.0 / 62.0..=21.0 / 62.0).contains(*x)).count() as f64 / u.len() as f64;
        within(&format!("weight {total:e}"), outside, 0.01 * 61.0 / 62.0, 5e-5);
        if !name.is_empty() {
            let usual =
                constant(&format!("uniform share of weights + 1e-5 in per cent, 62 bins, weight {name}")) / 100.0;
            assert!(total == 1.0 || usual > 30.0 * 0.01, "what the usual padding would give: {usual}");
        }
    }
}

/// NaN weights of one ray neither end a run nor affect another ray.
fn ray_with_nan_weights_is_sampled_uniformly<T: Scalar>() {
    let mut rays = ray_along_z::<T>(0.0, [2.0, 6.0]);
    let second = ray_along_z::<T>(0.0, [2.0, 6.0]);
    rays.origins.extend(second.origins);
    rays.directions.extend(second.directions);
    rays.spans.extend(second.spans);
    let coarse = stratified(&rays, 4, &mut Jitter::Middle, &Pool::new());
    let mut weights = [T::ZERO; 8];
    (weights[1], weights[5]) = (T::from_f64(f64::NAN), T::ONE);
    let fine = importance_sampling(&rays, &coarse, &weights, 4, 0.0, &mut Jitter::Middle, &Pool::new());
    let t = numbers(&fine.t);
    assert_eq!(t[..8], [2.5, 2.5, 3.5, 3.5, 4.5, 4.5, 5.5, 5.5]);
    assert!(t[8..].iter().filter(|t| (3.0..=4.0).contains(*t)).count() == 5, "{t:?}");
}

both!(weights_of_every_size, ends_and_ties, uniform_share_is_exact, ray_with_nan_weights_is_sampled_uniformly);
