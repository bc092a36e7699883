//! Marching rays front to back, in rounds, until they terminate.

use super::query::Query;
use crate::camera::rays::Samples;
use crate::field::Density;
use raygrad_autograd::{Pool, Scalar, Var};
use std::ops::Range;

/// Density queries per round of a render, approximately.
const ROUND: usize = 4096;
/// The fewest samples per ray and round of a render. It is small because most rays end early.
const LEAST: usize = 8;

/// Samples along rays, in rounds. Each round takes the next samples of the rays that still have light.
pub(crate) struct FrontToBack<'a, T: Scalar> {
    samples: &'a Samples<T>,
    /// Optical depth of each ray so far.
    pub depths: Vec<f64>,
    /// The optical depth at which a ray ends.
    opaque: f64,
    /// Samples that each unfinished ray has passed.
    passed: usize,
}

/// The next samples of some rays.
pub(crate) struct Stretch<T: Scalar> {
    /// The samples: a ray for each of `pieces`.
    pub samples: Samples<T>,
    /// For each ray that still has light its number, and those of its samples; none is empty.
    pub pieces: Vec<(usize, Range<usize>)>,
}

/// A [`Stretch`] and its densities.
pub(crate) struct Round<'t, T: Scalar> {
    pub stretch: Stretch<T>,
    pub density: Density<'t, T>,
    /// Optical depth of each sample, `[samples]`.
    pub optical_depth: Var<'t, T>,
    /// Optical depth of the ray in front of each sample.
    pub in_front: Vec<f64>,
}

impl<'a, T: Scalar> FrontToBack<'a, T> {
    /// Follows rays until no more than `early_stop_eps` of their light is left.
    pub fn new(samples: &'a Samples<T>, early_stop_eps: f64) -> Self {
        // Without termination, rays end where f64 has no light left.
        let opaque = -early_stop_eps.max(5e-324).ln();
        FrontToBack { samples, depths: vec![0.0; samples.segments.len()], opaque, passed: 0 }
    }

    /// Returns true if there is light behind this optical depth.
    pub fn has_light(&self, depth: f64) -> bool {
        depth < self.opaque
    }

    /// Returns true if no light is left behind this optical depth; false for NaN.
    pub fn has_ended(&self, depth: f64) -> bool {
        depth >= self.opaque
    }

    /// The number of samples per ray in a round of a render.
    pub fn round_size(&self) -> usize {
        (ROUND / self.depths.len().max(1)).max(LEAST)
    }

    /// At most `count` samples of each ray that still has light; `None` if no ray has any. The caller adds their
    /// optical depth to `depths`.
    pub fn take(&mut self, count: usize, pool: &Pool<T>) -> Option<Stretch<T>> {
        let piece = |(ray, rows): (usize, Range<usize>)| {
            let start = rows.start + self.passed;
            (start < rows.end && self.has_light(self.depths[ray])).then(|| (ray, start..rows.end.min(start + count)))
        };
        let pieces: Vec<_> = self.samples.segments.ranges().enumerate().filter_map(piece).collect();
        self.passed += count;
        (!pieces.is_empty()).then(|| Stretch { samples: self.samples.pieces(&pieces, pool), pieces })
    }

    /// As [`take`](Self::take), with the density of the samples; their optical depth is added to `depths`.
    #[track_caller]
    pub fn round<'t>(&mut self, query: &Query<'_, 't, T>, count: usize) -> Option<Round<'t, T>> {
        let stretch = self.take(count, query.tape().pool())?;
        let density = query.density(&stretch.samples);
        let optical_depth = density.optical_depth(&stretch.samples.delta);
        let (x, mut in_front) = (optical_depth.value().as_slice(), Vec::with_capacity(stretch.samples.len()));
        for (rows, (ray, _)) in stretch.samples.segments.ranges().zip(&stretch.pieces) {
            for x in &x[rows] {
                in_front.push(self.depths[*ray]);
                self.depths[*ray] += x.to_f64();
            }
        }
        Some(Round { stretch, density, optical_depth, in_front })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::pinhole::Ray;
    use crate::camera::rays::{Rays, stratified};
    use crate::field::{Field, ViewInputs};
    use crate::random::Jitter;
    use glam::DVec3;
    use raygrad_autograd::{Tape, Tensor};
    use raygrad_nn::{Bound, Params};

    /// No density before x = 0, and 1 behind.
    struct Wall;

    impl Field<f64> for Wall {
        fn density<'t>(&self, _: &Bound<'t, f64>, positions: &Var<'t, f64>) -> Density<'t, f64> {
            let x = positions.value().as_slice();
            let value = Tensor::from_fn(&[x.len() / 3], |i| if x[3 * i] > 0.0 { 1.0 } else { 0.0 });
            Density { value: positions.tape().constant(value), log: false, features: positions.clone() }
        }
        fn color<'t>(&self, _: &Bound<'t, f64>, features: &Var<'t, f64>, _: &ViewInputs<'_, 't, f64>) -> Var<'t, f64> {
            features.clone()
        }
    }

    #[test]
    fn rays_continue_until_light_or_samples_end() {
        let mut rays = Rays::new();
        for (origin, far) in [(-8.0, 1.0), (0.0, 0.0), (-3.0, 8.0), (0.0, 8.0)] {
            rays.push(&Ray { origin: DVec3::new(origin, 0.0, 0.0), direction: DVec3::X }, [0.0, far]);
        }
        let tape = Tape::new();
        let params = Params::new().bind(&tape);
        let query = Query::new(&Wall, &params);
        let all = stratified(&rays, 8, &mut Jitter::Middle, tape.pool());
        // The second ray has no samples.
        let rows: Vec<u32> = (0..32).filter(|row| !(8..16).contains(row)).collect();
        let samples = all.select(&rows, tape.pool());
        let mut followed = FrontToBack::new(&samples, 0.02);
        let mut rounds = vec![];
        while let Some(round) = followed.round(&query, 3) {
            let pieces = round.stretch.pieces;
            rounds.push((pieces.iter().map(|(ray, rows)| (*ray, rows.len())).collect::<Vec<_>>(), round.in_front));
        }
        let seen = |rays: &[(usize, usize)], third: [f64; 3], fourth: &[f64]| {
            (rays.to_vec(), [&vec![0.0; rays[0].1][..], &third[..rays[1].1], fourth].concat())
        };
        // A depth of 3.912 leaves a fiftieth, so the fourth ray ends within its second round.
        let expected = [
            seen(&[(0, 3), (2, 3), (3, 3)], [0.0; 3], &[0.0, 1.0, 2.0]),
            seen(&[(0, 3), (2, 3), (3, 3)], [0.0, 1.0, 2.0], &[3.0, 4.0, 5.0]),
            seen(&[(0, 2), (2, 2)], [3.0, 4.0, 0.0], &[]),
        ];
        assert_eq!(rounds, expected);
        assert_eq!(followed.depths, [0.0, 0.0, 5.0, 6.0]);
        assert!(followed.has_light(3.9) && !followed.has_light(3.92));
    }
}
