//! Where a field is asked by a rule, and what is made of the answers.

use super::{Intervals, Quadrature, Share};
use crate::camera::rays::{Rays, Samples, stratified};
use crate::field::Density;
use crate::random::Jitter;
use crate::volume::query::Query;
use crate::volume::render::{Rendered, Weighted, accumulate};
use raygrad_autograd::{Pool, Scalar, Segments, Tensor, Var};
use std::sync::Arc;

/// Places along rays where a field is asked, and the intervals that the answers stand for.
#[derive(Debug, Clone)]
pub struct Plan<T: Scalar> {
    /// The places. Where there are intervals of two nodes, their `delta` means nothing.
    pub samples: Samples<T>,
    /// Intervals between two places each; without them every sample stands for its own `delta`.
    pub intervals: Option<Intervals<T>>,
}

/// Nodes that are added ray by ray, each `offset` intervals from the middle of a step.
struct Nodes<'a, T: Scalar> {
    steps: &'a Samples<T>,
    step: Vec<u32>,
    offset: Vec<f64>,
}

impl<T: Scalar> Nodes<'_, T> {
    fn add(&mut self, step: usize, offset: f64) -> u32 {
        self.step.push(step as u32);
        self.offset.push(offset);
        self.step.len() as u32 - 1
    }

    /// The samples at the nodes.
    fn samples(&self, offsets: Vec<u32>, pool: &Pool<T>) -> Samples<T> {
        let (t, delta) = (self.steps.t.as_slice(), self.steps.delta.as_slice());
        let count = self.step.len();
        let (mut out_t, mut out_delta) = (pool.tensor(&[count]), pool.tensor(&[count]));
        let out = out_t.as_mut_slice().iter_mut().zip(out_delta.as_mut_slice());
        for ((out, width), (&step, &offset)) in out.zip(self.step.iter().zip(&self.offset)) {
            *width = delta[step as usize];
            *out = t[step as usize] + T::from_f64(offset) * *width;
        }
        self.steps.at(Segments::new(offsets), out_t, out_delta)
    }
}

/// Places of the two nodes of Gauss's rule, from the middle of the interval.
const GAUSS: f64 = 0.288_675_134_594_812_9;

impl Quadrature {
    /// The plan for steps along rays, each sample being the middle of an interval of length `delta`. An adaptive rule
    /// begins with this one; see [`refine`](super::refine).
    pub fn plan<T: Scalar>(self, steps: &Samples<T>, pool: &Pool<T>) -> Plan<T> {
        if self == Quadrature::Midpoint {
            return Plan { samples: steps.clone(), intervals: None };
        }
        let (t, delta) = (steps.t.as_slice(), steps.delta.as_slice());
        let mut nodes = Nodes { steps, step: vec![], offset: vec![] };
        let mut ends = vec![0];
        let (mut first, mut second) = (vec![], vec![]);
        for rows in steps.segments.ranges() {
            for i in rows.clone() {
                match self {
                    Quadrature::Left | Quadrature::Midpoint => {
                        nodes.add(i, -0.5);
                    }
                    Quadrature::Gauss2 => {
                        first.push(nodes.add(i, -GAUSS));
                        second.push(nodes.add(i, GAUSS));
                    }
                    Quadrature::PiecewiseLinear | Quadrature::Adaptive { .. } => {
                        // Where a step begins at the end of the one before, they share a node.
                        let is_next = i > rows.start && {
                            let gap = (t[i] - t[i - 1]).to_f64() - 0.5 * (delta[i] + delta[i - 1]).to_f64();
                            gap < 0.25 * delta[i].to_f64()
                        };
                        let start = if is_next { nodes.step.len() as u32 - 1 } else { nodes.add(i, -0.5) };
                        first.push(start);
                        second.push(nodes.add(i, 0.5));
                    }
                }
            }
            ends.push(nodes.step.len() as u32);
        }
        let samples = nodes.samples(ends, pool);
        let share = match self {
            Quadrature::Midpoint | Quadrature::Left => return Plan { samples, intervals: None },
            Quadrature::Gauss2 => Share::Gauss,
            Quadrature::PiecewiseLinear | Quadrature::Adaptive { .. } => Share::Mean,
        };
        let (length, segments) = (steps.delta.clone(), steps.segments.clone());
        Plan { samples, intervals: Some(Intervals { nodes: [first.into(), second.into()], length, segments, share }) }
    }

    /// The plan for equal intervals over the spans of rays, with at most `evaluations` evaluations a ray and with at least
    /// one interval.
    #[inline(never)]
    pub fn even<T: Scalar>(self, rays: &Rays<T>, evaluations: usize, pool: &Pool<T>) -> Plan<T> {
        let intervals = match self {
            Quadrature::Left | Quadrature::Midpoint => evaluations,
            Quadrature::PiecewiseLinear | Quadrature::Adaptive { .. } => evaluations.saturating_sub(1),
            Quadrature::Gauss2 => evaluations / 2,
        };
        self.plan(&stratified(rays, intervals.max(1), &mut Jitter::Middle, pool), pool)
    }
}

impl<T: Scalar> Plan<T> {
    /// Number of evaluations.
    pub fn len(&self) -> usize {
        self.samples.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The weights of the plan's samples of this density.
    #[track_caller]
    #[inline(never)]
    pub fn weighted<'t>(&self, density: &Density<'t, T>) -> Weighted<'t, T> {
        match &self.intervals {
            Some(intervals) => intervals.weighted(density),
            None => Weighted::new(density, &self.samples.delta, &self.samples.segments),
        }
    }

    /// What the plan's samples show of a field.
    #[track_caller]
    pub fn render<'t>(&self, query: &Query<'_, 't, T>) -> Rendered<'t, T> {
        let positions = query.positions(&self.samples);
        let density = query.density_at(&self.samples, &positions);
        self.render_density(query, positions, density)
    }

    /// As [`render`](Self::render), of a density that is known at the samples' positions.
    #[track_caller]
    pub(crate) fn render_density<'t>(
        &self,
        query: &Query<'_, 't, T>,
        positions: Var<'t, T>,
        density: Density<'t, T>,
    ) -> Rendered<'t, T> {
        let Weighted { weights, optical_depth } = self.weighted(&density);
        let color = query.color(&density.features, &self.samples);
        let color = accumulate(&weights, &color, &self.samples.segments);
        let directions = query.directions(&self.samples);
        Rendered { samples: self.samples.clone(), positions, directions, density, weights, optical_depth, color }
    }

    /// The plan without the intervals that no more light than `least` reaches, and the numbers of the samples that are
    /// left.
    pub(crate) fn lit(
        &self,
        intervals: &Intervals<T>,
        transmittance: &Tensor<T>,
        least: T,
        pool: &Pool<T>,
    ) -> (Self, Vec<u32>) {
        let Intervals { nodes, length, segments, share } = intervals;
        let is_lit = |k: usize| transmittance.as_slice()[k] > least;
        let kept: Vec<usize> = (0..segments.rows()).filter(|&k| is_lit(k)).collect();
        const UNUSED: u32 = u32::MAX;
        let mut number = vec![UNUSED; self.len()];
        kept.iter().for_each(|&k| nodes.iter().for_each(|nodes| number[nodes[k] as usize] = 0));
        let rows: Vec<u32> = (0..number.len()).filter(|&row| number[row] != UNUSED).map(|row| row as u32).collect();
        rows.iter().enumerate().for_each(|(new, &old)| number[old as usize] = new as u32);
        let renumber = |nodes: &Arc<[u32]>| kept.iter().map(|&k| number[nodes[k] as usize]).collect();
        let ends = segments.offsets().iter().map(|&end| kept.partition_point(|&k| k < end as usize) as u32);
        let intervals = Intervals {
            nodes: nodes.each_ref().map(renumber),
            length: Tensor::from_vec(&[kept.len()], kept.iter().map(|&k| length.as_slice()[k]).collect()),
            segments: Segments::new(ends.collect::<Vec<_>>()),
            share: *share,
        };
        (Plan { samples: self.samples.select(&rows, pool), intervals: Some(intervals) }, rows)
    }
}
