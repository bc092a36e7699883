//! The distortion loss.

use super::support::*;
use raygrad::nerf::Distortion;
use raygrad::nerf::volume::{OpticalDepth, weights};
use raygrad::{Scalar, Segments, Tape};

/// Loss and gradients of one ray of samples of this width from `start` on, and the same by definition in f64.
fn both_ways<T: Scalar>(weights: &[f64], width: f64, start: f64) -> [(f64, Vec<f64>); 2] {
    let n = weights.len();
    let m: Vec<f64> = (0..n).map(|i| round::<T>(start + width * (i as f64 + 0.5))).collect();
    let (w, d) = (weights.iter().map(|&w| round::<T>(w)).collect::<Vec<_>>(), round::<T>(width));
    let tape = Tape::new();
    let leaf = tape.leaf(vector::<T>(&w));
    let loss = tape.apply(Distortion::new(vector(&m), vector(&vec![d; n]), Segments::uniform(1, n)), &[&leaf]).sum();
    let got = (loss.item().to_f64(), numbers(&loss.grad(&[&leaf])[0]));
    let slope = |i: usize| 2.0 * (0..n).map(|j| w[j] * (m[i] - m[j]).abs()).sum::<f64>() + 2.0 / 3.0 * w[i] * d;
    let slopes: Vec<f64> = (0..n).map(slope).collect();
    let value = 0.5 * slopes.iter().zip(&w).map(|(s, w)| s * w).sum::<f64>();
    [got, (value, slopes)]
}

/// Matrix: distortion loss at widths 1e-1 to 1e-4, one-hot, w = 0. Catalogue: the prefix form is 8e-3 off at 1e-4.
fn samples_of_every_width<T: Scalar>() {
    let mut random = noise(6);
    let tolerance = by_type::<T>(2e-6, 1e-13);
    for width in [1e-1, 1e-2, 1e-3, 1e-4] {
        for start in [0.0, 0.5, 6.0] {
            for n in [1, 2, 10, 128] {
                let weights: Vec<f64> = (0..n).map(|_| random() / n as f64).collect();
                let [(got, slopes), (expected, exact)] = both_ways::<T>(&weights, width, start);
                let what = format!("{n} samples of {width} from {start}");
                near::<T>(&what, got, expected, tolerance);
                slopes.iter().zip(&exact).for_each(|(got, exact)| near::<T>(&what, *got, *exact, tolerance));
            }
            let mut one_hot = [0.0; 64];
            one_hot[40] = 1.0;
            let [(got, slopes), (expected, exact)] = both_ways::<T>(&one_hot, width, start);
            near::<T>("one-hot", got, expected, tolerance);
            near::<T>("one-hot is a third of its width", got, round::<T>(width) / 3.0, tolerance);
            slopes.iter().zip(&exact).for_each(|(got, exact)| near::<T>("one-hot", *got, *exact, tolerance));
            let [(got, slopes), _] = both_ways::<T>(&[0.0; 64], width, start);
            assert!(got == 0.0 && slopes.iter().all(|&s| s == 0.0), "no weight: no loss");
        }
    }
}

/// With the weights of a ray, the loss and its gradient by densities are finite for empty and opaque rays.
fn of_densities<T: Scalar>() {
    let n = 16;
    let segments = || Segments::uniform(1, n);
    let m = vector::<T>(&(0..n).map(|i| (i as f64 + 0.5) / n as f64).collect::<Vec<_>>());
    let d = vector::<T>(&vec![1.0 / n as f64; n]);
    for density in [0.0, 1e-30, 1.0, 1e30] {
        let tape = Tape::new();
        let sigma = tape.leaf(vector::<T>(&vec![density; n]));
        let weights = weights(&tape.apply(OpticalDepth::new(d.clone()), &[&sigma]), &segments());
        let loss = tape.apply(Distortion::new(m.clone(), d.clone(), segments()), &[&weights]).sum();
        assert!(loss.item().to_f64() >= 0.0);
        finite("gradient", &loss.grad(&[&sigma])[0]);
    }
}

both!(samples_of_every_width, of_densities);
