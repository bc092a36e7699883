//! Where a field is asked by a rule, and what is made of the answers.

use super::{CompositeIntervals, Intervals, Quadrature, Refined, Share, refine};
use crate::camera::rays::stratified;
use crate::camera::rays::{Rays, Samples};
use crate::field::{Density, Field};
use crate::random::Jitter;
use crate::volume::pass::features;
use crate::volume::visible::{Marched, composite_visible};
use raygrad_autograd::{Pool, Scalar, Segments, Tape, Tensor, Var};
use raygrad_nn::Bound;
use std::sync::Arc;

/// Places along rays where a field is asked, and the intervals that the answers stand for.
#[derive(Debug, Clone)]
pub struct Plan<T: Scalar> {
    /// The places. Where there are intervals of two nodes, their `delta` means nothing.
    pub samples: Samples<T>,
    /// Intervals between two places each; without them every sample stands for its own `delta`.
    pub intervals: Option<Intervals<T>>,
}

/// What is seen, and what it took.
pub struct Composited<'t, T: Scalar> {
    /// `[rays, 4 or 5]`: colour, distance if asked for, and the transmittance that is left.
    pub rendered: Var<'t, T>,
    /// Evaluations of a density alone.
    pub asked: usize,
    /// Samples that had light left in front of them, which were evaluated with colour and for gradients.
    pub kept: usize,
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
        let Samples { positions, directions, t, delta, .. } = self.steps;
        let count = self.step.len();
        let (mut out_p, mut out_t, mut out_delta) =
            (pool.tensor(&[count, 3]), pool.tensor(&[count]), pool.tensor(&[count]));
        let segments = Segments::new(offsets);
        let (p, out, width) = (out_p.as_mut_slice(), out_t.as_mut_slice(), out_delta.as_mut_slice());
        for (ray, nodes) in segments.ranges().enumerate() {
            let direction = &directions.as_slice()[3 * ray..3 * ray + 3];
            for node in nodes {
                let step = self.step[node] as usize;
                width[node] = delta.as_slice()[step];
                let shift = T::from_f64(self.offset[node]) * width[node];
                out[node] = t.as_slice()[step] + shift;
                for axis in 0..3 {
                    p[3 * node + axis] = positions.as_slice()[3 * step + axis] + shift * direction[axis];
                }
            }
        }
        Samples { positions: out_p, directions: directions.clone(), t: out_t, delta: out_delta, segments }
    }
}

/// Places of the two nodes of Gauss's rule, from the middle of the interval.
const GAUSS: f64 = 0.288_675_134_594_812_9;

impl Quadrature {
    /// The plan for steps along rays, each sample being the middle of an interval of length `delta`. An adaptive rule
    /// begins with this one; see [`refine`].
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

    /// The plan for steps along rays that is made for this field: an adaptive rule asks it where to look, and leaves out
    /// what no more light than `least` reaches.
    pub fn plan_for<'t, T: Scalar>(
        self,
        field: &dyn Field<T>,
        params: &Bound<'t, T>,
        steps: &Samples<T>,
        least: f64,
        tape: &'t Tape<T>,
    ) -> Refined<T> {
        if let Quadrature::Adaptive { tolerance } = self {
            return refine(field, params, steps, tolerance, least, tape);
        }
        let plan = self.plan(steps, tape.pool());
        Refined { evaluations: plan.len(), plan }
    }

    /// What steps along rays show of a field. What no more light than `termination` reaches is left out: a pixel changes
    /// by at most as much times the range of colours.
    pub fn render<'t, T: Scalar>(
        self,
        field: &dyn Field<T>,
        params: &Bound<'t, T>,
        steps: &Samples<T>,
        termination: f64,
        with_depth: bool,
        tape: &'t Tape<T>,
    ) -> Composited<'t, T> {
        if let Quadrature::Adaptive { .. } = self {
            let Refined { plan, evaluations } = self.plan_for(field, params, steps, termination, tape);
            let rendered = plan.render(field, params, with_depth, tape);
            return Composited { rendered, asked: evaluations, kept: plan.len() };
        }
        let plan = self.plan(steps, tape.pool());
        if let Some(intervals) = &plan.intervals {
            return plan.render_lit(intervals, field, params, termination, with_depth, tape);
        }
        let Marched { rendered, evaluated, kept } =
            composite_visible(field, params, &plan.samples, termination, with_depth, tape);
        Composited { rendered, asked: evaluated, kept }
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

    /// The features of the plan's samples, composited along their rays: `[rays, channels + 1]` as
    /// [`Composite`](crate::Composite) gives it.
    #[track_caller]
    #[inline(never)]
    pub fn composite<'t>(&self, density: &Density<'t, T>, features: &Var<'t, T>) -> Var<'t, T> {
        let tape = features.tape();
        let inputs = [&density.value, features];
        match &self.intervals {
            Some(intervals) => tape.apply(CompositeIntervals::new(intervals.clone(), self.len(), density.log), &inputs),
            None => tape.apply(density.composite(self.samples.delta.clone(), self.samples.segments.clone()), &inputs),
        }
    }

    /// Colour (and distance, if `with_depth`) of a field at the plan's samples, composited: `[rays, 4 or 5]`.
    pub fn render<'t>(
        &self,
        field: &dyn Field<T>,
        params: &Bound<'t, T>,
        with_depth: bool,
        tape: &'t Tape<T>,
    ) -> Var<'t, T> {
        let encoding = field.encode(params, &tape.constant(self.samples.positions.clone()));
        self.render_encoded(field, params, &encoding, with_depth, tape)
    }

    /// As [`render`](Self::render), from the encoding of the samples' positions.
    fn render_encoded<'t>(
        &self,
        field: &dyn Field<T>,
        params: &Bound<'t, T>,
        encoding: &Var<'t, T>,
        with_depth: bool,
        tape: &'t Tape<T>,
    ) -> Var<'t, T> {
        let density = field.density(params, encoding);
        let features = features(field, params, &self.samples, &density, with_depth, tape);
        self.composite(&density, &features)
    }

    /// As [`render`](Self::render) in two passes, for a plan with these intervals: an unrecorded one for the densities, and
    /// a recorded one on the intervals that more than `termination` of the light reaches, which takes its encodings from
    /// the first.
    fn render_lit<'t>(
        &self,
        intervals: &Intervals<T>,
        field: &dyn Field<T>,
        params: &Bound<'t, T>,
        termination: f64,
        with_depth: bool,
        tape: &'t Tape<T>,
    ) -> Composited<'t, T> {
        let (encoding, transmittance) = tape.no_grad(|| {
            let encoding = field.encode(params, &tape.constant(self.samples.positions.clone()));
            let density = field.density(params, &encoding);
            let composite = CompositeIntervals::new(intervals.clone(), self.len(), density.log);
            let [transmittance, _] = composite.transmittance_and_weights(density.value.value(), tape.pool());
            (encoding.into_value(), transmittance)
        });
        let (lit, rows) = self.lit(intervals, &transmittance, T::from_f64(termination), tape.pool());
        let known = select_rows(&encoding, &rows, tape.pool());
        let encoding = field.encode_known(params, &tape.constant(lit.samples.positions.clone()), known);
        let rendered = lit.render_encoded(field, params, &encoding, with_depth, tape);
        Composited { rendered, asked: self.len(), kept: rows.len() }
    }

    /// The plan without the intervals that no more light than `least` reaches, and the numbers of the samples that are
    /// left.
    fn lit(&self, intervals: &Intervals<T>, transmittance: &Tensor<T>, least: T, pool: &Pool<T>) -> (Self, Vec<u32>) {
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

/// The rows of a matrix with these numbers.
fn select_rows<T: Scalar>(x: &Tensor<T>, rows: &[u32], pool: &Pool<T>) -> Tensor<T> {
    let width = x.shape()[1];
    let mut out = pool.tensor(&[rows.len(), width]);
    for (out, &row) in out.as_mut_slice().chunks_exact_mut(width.max(1)).zip(rows) {
        out.copy_from_slice(&x.as_slice()[row as usize * width..(row as usize + 1) * width]);
    }
    out
}
