//! The interlevel loss.

use crate::camera::rays::Samples;
use crate::sampling::ProposalHistogram;
use raygrad_autograd::{Scalar, Tensor, Var};

/// Computes the interlevel loss of a proposal, a sum over rays (Barron et al. 2022, equation 13).
///
/// Each sample adds `max(0, w - bound)^2 / w` for its weight `w` `[samples]`. The bound is the sum of the proposal's
/// bins that the sample's interval touches. The weights are constants: the proposal follows the field, not the reverse.
///
/// # Panics
/// If there is not one weight per sample, or the samples belong to other rays.
#[track_caller]
pub fn interlevel<'t, T: Scalar>(
    level: &ProposalHistogram<'t, T>,
    samples: &Samples<T>,
    weights: &Tensor<T>,
) -> Var<'t, T> {
    assert_eq!(weights.shape(), [samples.len()], "weights must have one entry per sample");
    assert_eq!(samples.segments.len(), level.segments.len(), "samples and proposal must have the same rays");
    let (t, delta) = (samples.t.as_slice(), samples.delta.as_slice());
    let [mut first, mut last] = [vec![], vec![]];
    for (ray, rows) in samples.segments.ranges().enumerate() {
        let bins = level.segments.range(ray);
        if bins.is_empty() {
            assert!(rows.is_empty(), "the proposal has no bins for ray {ray}, which has samples");
            continue;
        }
        let edges = &level.edges[bins.start + ray..=bins.end + ray];
        for row in rows {
            let (middle, half) = (t[row].to_f64(), 0.5 * delta[row].to_f64());
            // The bins of the ends, clamped because rounding may leave the histogram.
            let low = edges.partition_point(|&edge| edge <= middle - half).clamp(1, bins.len());
            let high = edges.partition_point(|&edge| edge < middle + half).clamp(low, bins.len());
            first.push((bins.start + low - 1) as u32);
            last.push((bins.start + high - 1) as u32);
        }
    }
    let before = level.weights.segment_cumsum(&level.segments, true).gather_rows(first);
    let bound = level.weights.segment_cumsum(&level.segments, false).gather_rows(last) - before;
    let weights = bound.tape().constant(weights.clone());
    ((&weights - bound).relu().square() / (weights + 1e-7)).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::pinhole::Ray;
    use crate::camera::rays::Rays;
    use glam::DVec3;
    use raygrad_autograd::check::{Check, check_function};
    use raygrad_autograd::{Pool, Segments, Tape};

    fn rays(count: usize) -> Rays<f64> {
        let mut rays = Rays::new();
        for i in 0..count {
            rays.push(&Ray { origin: DVec3::ZERO, direction: DVec3::Z }, [2.0, 6.0 + i as f64]);
        }
        rays
    }

    #[test]
    fn interlevel_loss_is_zero_where_proposal_covers() {
        let tape = Tape::<f64>::new();
        let edges = vec![0.0, 1.0, 2.0, 4.0, 0.0, 0.5, 1.0, 4.0];
        let segments = Segments::uniform(2, 3);
        let level = |weights: [f64; 6]| ProposalHistogram {
            edges: edges.clone(),
            weights: tape.leaf(Tensor::from(weights)),
            segments: segments.clone(),
        };
        let pool = Pool::new();
        let samples = |t: [f64; 3], delta: [f64; 3]| {
            Samples::new(&rays(2), Segments::new([0, 2, 3]), Tensor::from(t), Tensor::from(delta), &pool)
        };
        // The first ray has [0.5, 1.5] and [2, 4]; the second has [0.5, 1], which is exactly a bin.
        let at = samples([1.0, 3.0, 0.75], [1.0, 2.0, 0.5]);
        let weights = Tensor::from([0.5, 0.25, 0.75]);
        let good = level([0.25, 0.25, 0.25, 0.0, 0.75, 0.0]);
        assert_eq!(interlevel(&good, &at, &weights).item(), 0.0);
        let bad = level([0.125, 0.125, 0.5, 0.5, 0.25, 0.5]);
        let loss = interlevel(&bad, &at, &weights);
        let expected = 0.25_f64.powi(2) / 0.5 + 0.5_f64.powi(2) / 0.75;
        assert!((loss.item() - expected).abs() < 1e-6, "{}", loss.item());
        let slopes = loss.grad(&[&bad.weights]).remove(0);
        let signs: Vec<bool> = slopes.as_slice().iter().map(|&x| x < -1e-9).collect();
        assert_eq!(signs, [true, true, false, false, true, false], "only what is too small grows: {slopes:?}");
        let report = check_function(&Check::default(), &[Tensor::from([0.125, 0.125, 0.5, 0.5, 0.25, 0.5])], |x| {
            let level = ProposalHistogram { edges: edges.clone(), weights: x[0].clone(), segments: segments.clone() };
            interlevel(&level, &at, &weights)
        });
        assert!(report.unwrap().comparisons >= 6);
    }
}
