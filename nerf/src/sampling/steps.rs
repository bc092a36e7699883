//! Importance sampling along rays, and the inverse cumulative distribution function (CDF) behind it.
//!
//! Start with [`importance_sampling`]; [`invert_cdf`] is the step for one ray.

use crate::camera::rays::{Rays, Samples};
use crate::random::Jitter;
use crate::{Error, Result};
use raygrad_autograd::{Pool, Scalar, Segments};

/// Adds `count` samples per ray, drawn from the histogram of `weights`, merged with the `coarse` samples in order
/// (Mildenhall et al. 2020, section 5.2).
///
/// `weights` `[coarse samples]` has one entry per stratified sample. The density is a mixture: `1 - uniform_share` from
/// the weights, the rest uniform. A ray whose weights are all zero is sampled evenly; so is a ray with a weight that is
/// negative, infinite or NaN. `delta` of a sample reaches half way to its neighbours, of the outermost ones to near and
/// far.
///
/// # Panics
/// If there is not one weight per sample, or rays have no samples or different numbers of them.
pub fn importance_sampling<T: Scalar>(
    rays: &Rays<T>,
    coarse: &Samples<T>,
    weights: &[T],
    count: usize,
    uniform_share: f64,
    jitter: &mut Jitter<'_>,
    pool: &Pool<T>,
) -> Samples<T> {
    assert_eq!(weights.len(), coarse.len(), "weights must have one entry per coarse sample");
    let bins = if rays.is_empty() { 0 } else { coarse.len() / rays.len() };
    let is_even = coarse.segments.ranges().all(|own| own.len() == bins && bins > 0);
    assert!(is_even, "each ray must have the same number of coarse samples, and at least one");
    let segments = Segments::uniform(rays.len(), bins + count);
    let (mut t, mut delta) = (pool.tensor(&[segments.rows()]), pool.tensor(&[segments.rows()]));
    let edges = even_edges(bins);
    let mut u = vec![0.0; count];
    let mut drawn = vec![0.0; count];
    for (ray, rows) in segments.ranges().enumerate() {
        let own = coarse.segments.range(ray);
        let [near, far] = rays.spans[ray].map(T::to_f64);
        for (i, u) in u.iter_mut().enumerate() {
            *u = (i as f64 + jitter.draw()) / count as f64;
        }
        if invert_cdf(&edges, &weights[own.clone()], uniform_share, &u, &mut drawn).is_err() {
            drawn.copy_from_slice(&u);
        }
        let (t, delta) = (&mut t.as_mut_slice()[rows.clone()], &mut delta.as_mut_slice()[rows]);
        let (known, fresh) = t.split_at_mut(bins);
        known.copy_from_slice(&coarse.t.as_slice()[own]);
        fresh.iter_mut().zip(&drawn).for_each(|(t, x)| *t = T::from_f64(near + (far - near) * x));
        t.sort_by(|a, b| a.to_f64().total_cmp(&b.to_f64()));
        voronoi(t, [T::from_f64(near), T::from_f64(far)], delta);
    }
    Samples::new(rays, segments, t, delta, pool)
}

/// Voronoi lengths: of the part of `[near, far]` that is closest to each of the rising distances `t`.
fn voronoi<T: Scalar>(t: &[T], [near, far]: [T; 2], delta: &mut [T]) {
    let half = T::from_f64(0.5);
    let mut edge = near;
    for i in 0..t.len() {
        let next = match t.get(i + 1) {
            Some(&next) => half * (t[i] + next),
            None => far,
        };
        let width = next - edge;
        delta[i] = if width > T::ZERO { width } else { T::ZERO };
        edge = next;
    }
}

/// Inverts the CDF of a histogram at the rising numbers `u` in `[0, 1)`, into `out`.
///
/// `edges` are `bins + 1` rising numbers, of which neighbours may be equal. The density is `1 - uniform_share` times
/// that of the weights, constant within a bin, plus `uniform_share` times a uniform one. It is uniform if the weights
/// sum to 0. Weights need no normalisation. `out[i]` rises with `u[i]` and lies between the first and the last edge.
///
/// ```
/// use raygrad_nerf::sampling::steps::invert_cdf;
/// let mut out = [0.0; 3];
/// invert_cdf(&[0.0, 1.0, 2.0], &[1.0, 3.0], 0.0, &[0.125, 0.25, 0.625], &mut out)?;
/// assert_eq!(out, [0.5, 1.0, 1.5]);
/// # Ok::<_, raygrad_nerf::Error>(())
/// ```
///
/// # Errors
/// If a weight is negative, infinite or NaN; `out` is then unchanged.
///
/// # Panics
/// If there is no bin, or `edges` has not one entry more than `weights`.
pub fn invert_cdf<T: Scalar>(
    edges: &[f64],
    weights: &[T],
    uniform_share: f64,
    u: &[f64],
    out: &mut [f64],
) -> Result<()> {
    let bins = weights.len();
    assert!(bins > 0, "a histogram needs at least one bin");
    assert_eq!(edges.len(), bins + 1, "edges must have one entry more than weights");
    let mut largest = 0.0_f64;
    for (bin, weight) in weights.iter().enumerate() {
        if !(weight.is_finite() && *weight >= T::ZERO) {
            return Err(Error::setting(
                format!("weights[{bin}]"),
                format!("is {weight}; use finite numbers of at least 0"),
            ));
        }
        largest = largest.max(weight.to_f64());
    }
    // Relative to the largest, so that no sum overflows.
    let weight = |i: usize| if largest > 0.0 { weights[i].to_f64() / largest } else { 0.0 };
    let (total, length): (f64, f64) = ((0..bins).map(weight).sum(), edges[bins] - edges[0]);
    let share = if total > 0.0 { uniform_share } else { 1.0 };
    let width = |i: usize| if length > 0.0 { (edges[i + 1] - edges[i]) / length } else { 1.0 / bins as f64 };
    let mass = |i: usize| share * width(i) + if share < 1.0 { (1.0 - share) * (weight(i) / total) } else { 0.0 };
    let (mut bin, mut below) = (0, 0.0);
    for (&u, out) in u.iter().zip(out) {
        // The last bin takes the rounding error, and bins without mass are skipped.
        while bin + 1 < bins && below + mass(bin) <= u {
            below += mass(bin);
            bin += 1;
        }
        let mass = mass(bin);
        let inside = if mass > 0.0 { ((u - below) / mass).clamp(0.0, 1.0) } else { 0.5 };
        *out = edges[bin] + inside * (edges[bin + 1] - edges[bin]);
    }
    Ok(())
}

/// Returns the `bins + 1` edges of equal bins over `[0, 1]`.
pub fn even_edges(bins: usize) -> Vec<f64> {
    (0..=bins).map(|i| i as f64 / bins.max(1) as f64).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::pinhole::Ray;
    use crate::camera::rays::stratified;
    use glam::DVec3;
    use proptest::prelude::*;
    use rand::SeedableRng;
    use rand_pcg::Pcg64Mcg;
    use raygrad_autograd::Tensor;
    use std::panic::AssertUnwindSafe;

    fn rays(count: usize) -> Rays<f64> {
        let mut rays = Rays::new();
        for i in 0..count {
            rays.push(&Ray { origin: DVec3::ZERO, direction: DVec3::Z }, [2.0, 6.0 + i as f64]);
        }
        rays
    }

    #[test]
    fn stratified_samples_stay_in_their_bins() {
        let rays = rays(3);
        let samples = stratified(&rays, 8, &mut Jitter::Random(&mut Pcg64Mcg::seed_from_u64(1)), &Pool::new());
        for (ray, rows) in samples.segments.ranges().enumerate() {
            let [near, far] = rays.spans[ray];
            let width = (far - near) / 8.0;
            for (i, &t) in samples.t.as_slice()[rows.clone()].iter().enumerate() {
                assert!((near + i as f64 * width..near + (i + 1) as f64 * width).contains(&t));
            }
            let total: f64 = samples.delta.as_slice()[rows].iter().sum();
            assert!((total - (far - near)).abs() < 1e-12);
        }
        let middle = stratified(&rays, 4, &mut Jitter::Middle, &Pool::new());
        assert_eq!(&middle.t.as_slice()[..4], [2.5, 3.5, 4.5, 5.5]);
        assert_eq!(&middle.positions(&Pool::new()).as_slice()[..3], [0.0, 0.0, 2.5]);
    }

    #[test]
    fn importance_sampling_handles_zero_and_one_hot() {
        let u: Vec<f64> = (0..100).map(|i| (i as f64 + 0.5) / 100.0).collect();
        let mut out = vec![0.0; 100];
        invert_cdf(&even_edges(7), &[0.0_f32; 7], 0.01, &u, &mut out).unwrap();
        assert!(out.iter().zip(&u).all(|(x, u)| (x - u).abs() < 1e-12));
        for scale in [1.0, 1e-30_f32] {
            let mut weights = [0.0; 10];
            weights[3] = scale;
            invert_cdf(&even_edges(10), &weights, 0.0, &u, &mut out).unwrap();
            assert!(out.iter().all(|x| (0.3..=0.4).contains(x)), "{out:?}");
            invert_cdf(&even_edges(10), &weights, 0.1, &u, &mut out).unwrap();
            let outside = out.iter().filter(|x| !(0.3..=0.4).contains(*x)).count();
            assert!((8..=10).contains(&outside), "a tenth, less the bin's own share: {outside}");
        }
        for bad in [f32::NAN, -1.0, f32::INFINITY] {
            let error = invert_cdf(&even_edges(2), &[1.0, bad], 0.1, &u, &mut out).unwrap_err().to_string();
            assert!(error.starts_with("`weights[1]`: is "), "{error}");
        }
    }

    #[test]
    fn importance_sampling_needs_as_many_samples_on_each_ray() {
        let (rays, pool) = (rays(2), Pool::new());
        for ends in [[0, 0, 0], [0, 1, 4]] {
            let distances = Tensor::from_fn(&[ends[2] as usize], |i| 2.5 + i as f64);
            let lengths = Tensor::ones(distances.shape());
            let coarse = Samples::new(&rays, Segments::new(ends), distances, lengths, &pool);
            let weights = vec![1.0; coarse.len()];
            let draw = || importance_sampling(&rays, &coarse, &weights, 2, 0.0, &mut Jitter::Middle, &pool);
            let panic = std::panic::catch_unwind(AssertUnwindSafe(draw)).err().unwrap();
            let message = panic.downcast_ref::<&str>().unwrap();
            assert!(message.contains("the same number of coarse samples"), "{message}");
        }
    }

    proptest! {
        #[test]
        fn cdf_inversion_is_monotone_and_matches_histogram(
            weights in prop::collection::vec(0.0f32..1.0, 1..20), zeroed in 0usize..20
        ) {
            let mut weights = weights;
            if let Some(weight) = weights.get_mut(zeroed) { *weight = 0.0; }
            let n = 20_000;
            let u: Vec<f64> = (0..n).map(|i| (i as f64 + 0.5) / n as f64).collect();
            let mut out = vec![0.0; n];
            invert_cdf(&even_edges(weights.len()), &weights, 0.05, &u, &mut out).unwrap();
            prop_assert!(out.windows(2).all(|pair| pair[0] <= pair[1]));
            prop_assert!(out.iter().all(|x| (0.0..=1.0).contains(x)));
            let total: f32 = weights.iter().sum();
            for (i, &weight) in weights.iter().enumerate() {
                let bins = weights.len() as f64;
                let count = out.iter().filter(|x| (**x * bins) as usize == i).count() as f64 / n as f64;
                let share = if total > 0.0 { 0.95 * f64::from(weight / total) + 0.05 / bins } else { 1.0 / bins };
                prop_assert!((count - share).abs() < 3.0 / n as f64 + 1e-4, "bin {i}: {count} against {share}");
            }
        }

        #[test]
        fn importance_samples_are_sorted_and_cover_the_span(seed in 0u64..1000) {
            let rays = rays(2);
            let mut rng = Pcg64Mcg::seed_from_u64(seed);
            let coarse = stratified(&rays, 6, &mut Jitter::Random(&mut rng), &Pool::new());
            let weights: Vec<f64> = (0..12).map(|i| if i % 5 == 0 { 1.0 } else { 0.0 }).collect();
            let fine = importance_sampling(&rays, &coarse, &weights, 9, 0.01, &mut Jitter::Random(&mut rng), &Pool::new());
            for (ray, rows) in fine.segments.ranges().enumerate() {
                let t = &fine.t.as_slice()[rows.clone()];
                prop_assert!(t.windows(2).all(|pair| pair[0] <= pair[1]));
                let [near, far] = rays.spans[ray];
                prop_assert!(t[0] >= near && t[14] <= far);
                prop_assert!((fine.delta.as_slice()[rows].iter().sum::<f64>() - (far - near)).abs() < 1e-9);
            }
        }
    }
}
