//! Rays that are followed front to back, until their light is used up.

use super::query::Query;
use crate::camera::rays::Samples;
use crate::field::Density;
use raygrad_autograd::{Pool, Scalar, Var};
use std::ops::Range;

/// Density queries of a round of views, about.
const ROUND: usize = 4096;
/// Samples that a ray takes in a round of views, at least: few while most rays end early.
const LEAST: usize = 8;

/// Samples along rays, of which each round takes the next ones of the rays that still have light.
pub(crate) struct FrontToBack<'a, T: Scalar> {
    samples: &'a Samples<T>,
    /// Optical depth of each ray so far.
    pub depths: Vec<f64>,
    /// The optical depth at which a ray ends.
    opaque: f64,
    /// Samples that each ray has passed, if it has not ended.
    passed: usize,
}

/// The next samples of some rays.
pub(crate) struct Part<T: Scalar> {
    /// The samples: a ray for each of `pieces`.
    pub samples: Samples<T>,
    /// For each ray that still has light its number, and those of its samples; none is empty.
    pub pieces: Vec<(usize, Range<usize>)>,
}

/// A [`Part`], and what the field says of it.
pub(crate) struct Round<'t, T: Scalar> {
    pub part: Part<T>,
    pub density: Density<'t, T>,
    /// Optical depth of each sample, `[samples]`.
    pub optical_depth: Var<'t, T>,
    /// Optical depth of the ray in front of each sample.
    pub in_front: Vec<f64>,
}

impl<'a, T: Scalar> FrontToBack<'a, T> {
    /// Follows rays until no more than `termination` of their light is left.
    pub fn new(samples: &'a Samples<T>, termination: f64) -> Self {
        // Without a termination rays end where f64 has no light left.
        let opaque = -termination.max(5e-324).ln();
        FrontToBack { samples, depths: vec![0.0; samples.segments.len()], opaque, passed: 0 }
    }

    /// Whether there is light behind this optical depth.
    pub fn has_light(&self, depth: f64) -> bool {
        depth < self.opaque
    }

    /// How many samples each ray takes in a round of views.
    pub fn round_size(&self) -> usize {
        (ROUND / self.depths.len().max(1)).max(LEAST)
    }

    /// At most `count` samples of each ray that still has light; `None` if no ray has any. Who takes them adds their
    /// optical depth to `depths`.
    pub fn take(&mut self, count: usize, pool: &Pool<T>) -> Option<Part<T>> {
        let piece = |(ray, rows): (usize, Range<usize>)| {
            let start = rows.start + self.passed;
            (start < rows.end && self.has_light(self.depths[ray])).then(|| (ray, start..rows.end.min(start + count)))
        };
        let pieces: Vec<_> = self.samples.segments.ranges().enumerate().filter_map(piece).collect();
        self.passed += count;
        (!pieces.is_empty()).then(|| Part { samples: self.samples.pieces(&pieces, pool), pieces })
    }

    /// As [`take`](Self::take), of samples whose density the field is asked for.
    #[track_caller]
    pub fn round<'t>(&mut self, query: &Query<'_, 't, T>, count: usize) -> Option<Round<'t, T>> {
        let part = self.take(count, query.tape().pool())?;
        let density = query.density(&part.samples);
        let optical_depth = density.optical_depth(&part.samples.delta);
        let (x, mut in_front) = (optical_depth.value().as_slice(), Vec::with_capacity(part.samples.len()));
        for (rows, (ray, _)) in part.samples.segments.ranges().zip(&part.pieces) {
            for x in &x[rows] {
                in_front.push(self.depths[*ray]);
                self.depths[*ray] += x.to_f64();
            }
        }
        Some(Round { part, density, optical_depth, in_front })
    }
}
