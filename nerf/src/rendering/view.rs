//! Rendering by marching: densities front to back in rounds until the light is used up, colours where they matter.

use crate::camera::rays::Rays;
use crate::model::Model;
use crate::random::Jitter;
use crate::rendering::picture::{Evaluations, RayValues};
use crate::sampling::marching::Marching;
use crate::space::occupancy::{MarchBuffer, Skip, Step};
use crate::volume::quadrature::Quadrature;
use raygrad_autograd::{Pool, Segments, Tape};
use std::sync::Arc;

/// Samples that a ray takes in a round: few while most rays end early.
const ROUND: usize = 8;
/// Steps that a ray takes at a time where rules composite intervals themselves: the nodes at their ends are asked twice.
const CHUNK: usize = 16;

/// What may be left out along one ray when rendering with an occupancy grid.
///
/// Each changes a pixel by at most its value times the range of colours; what is left out is made up for by scaling the
/// rest.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Limits {
    /// A ray ends where less light than this is left, 0 to 1.
    pub termination: f32,
    /// Samples whose weights add up to at most this have no colour of their own, 0 to 1. Quadratures of two nodes an
    /// interval colour every sample.
    pub color_budget: f32,
}

impl Limits {
    /// What goes with skipping that much empty space.
    pub fn of(skip: Skip) -> Self {
        match skip {
            Skip::Off => Limits { termination: 0.0, color_budget: 0.0 },
            Skip::Lossless => Limits { termination: 1e-4, color_budget: 1e-4 },
            Skip::Fast => Limits { termination: 1e-3, color_budget: 2e-3 },
        }
    }
}

/// Buffers of one worker.
#[derive(Default)]
pub(crate) struct Viewer {
    pub pool: Pool<f32>,
    marched: MarchBuffer,
    rays: Vec<RayState>,
}

/// How far a ray has come.
#[derive(Clone, Copy, Default)]
struct RayState {
    /// Optical depth so far.
    depth: f64,
    /// Weight of samples without a colour, and of all samples.
    uncolored: f32,
    weight: f32,
}

/// A sample of a round that gets a colour.
struct Shaded {
    row: u32,
    weight: f32,
}

impl Viewer {
    /// Colour, distance and remaining transmittance of each ray.
    pub fn march(
        &mut self,
        model: &Model<f32>,
        sampler: &Marching,
        rays: &Rays<f32>,
        limits: &Limits,
        out: &mut [RayValues],
    ) -> Evaluations {
        let step = Step::uniform(sampler.view_step());
        sampler.grid.march(rays, &step, &mut Jitter::Middle, &mut self.marched);
        match sampler.config.quadrature {
            Quadrature::Midpoint => {}
            Quadrature::Left => {
                let MarchBuffer { t, delta, .. } = &mut self.marched;
                t.iter_mut().zip(delta).for_each(|(t, delta)| *t -= 0.5 * *delta);
            }
            rule => return self.composite(model, rule, rays, limits, out),
        }
        self.rays.clear();
        self.rays.resize(rays.len(), RayState::default());
        let range = |ray: usize| self.marched.offsets[ray] as usize..self.marched.offsets[ray + 1] as usize;
        let mut alive: Vec<u32> = (0..rays.len() as u32).filter(|&ray| !range(ray as usize).is_empty()).collect();
        let mut evaluations = Evaluations { unskipped: self.marched.steps, ..Evaluations::default() };
        let mut round = 0;
        while !alive.is_empty() {
            evaluations = evaluations + self.round(model, rays, &alive, round, limits, out);
            round += 1;
            let most = f64::from(limits.termination);
            alive.retain(|&ray| {
                let samples = self.marched.offsets[ray as usize + 1] - self.marched.offsets[ray as usize];
                (samples as usize) > round * ROUND && (-self.rays[ray as usize].depth).exp() > most
            });
        }
        for (out, state) in out.iter_mut().zip(&self.rays) {
            finish(out, state, limits);
        }
        evaluations
    }

    /// The view by a rule that composites intervals itself, front to back in chunks of steps.
    fn composite(
        &mut self,
        model: &Model<f32>,
        rule: Quadrature,
        rays: &Rays<f32>,
        limits: &Limits,
        out: &mut [RayValues],
    ) -> Evaluations {
        let steps = self.marched.samples(rays, &self.pool);
        let tape = Tape::with_pool(self.pool.clone());
        let params = model.params.bind_constant(&tape);
        let mut evaluations = Evaluations { unskipped: self.marched.steps, ..Evaluations::default() };
        let mut left = vec![1.0_f32; rays.len()];
        for chunk in (0..).step_by(CHUNK) {
            let ranges = steps.segments.ranges().enumerate().filter(|(ray, _)| left[*ray] > limits.termination);
            let rows: Vec<u32> = ranges
                .flat_map(|(_, rows)| (rows.start + chunk).min(rows.end)..(rows.start + chunk + CHUNK).min(rows.end))
                .map(|row| row as u32)
                .collect();
            if rows.is_empty() {
                break;
            }
            let seen = rule.render(&*model.field, &params, &steps.select(&rows, &self.pool), 0.0, true, &tape);
            evaluations.density += seen.asked as u64;
            evaluations.color += if let Quadrature::Adaptive { .. } = rule { seen.asked } else { seen.kept } as u64;
            let values = seen.rendered.value().as_slice().chunks_exact(5);
            for ((out, left), values) in out.iter_mut().zip(&mut left).zip(values) {
                out[..4].iter_mut().zip(values).for_each(|(out, value)| *out += *left * value);
                *left *= values[4];
            }
        }
        for (out, left) in out.iter_mut().zip(left) {
            let state = RayState { depth: -f64::from(left).ln(), weight: 1.0 - left, uncolored: 0.0 };
            finish(out, &state, limits);
        }
        evaluations
    }

    /// The next samples of all rays that are alive.
    fn round(
        &mut self,
        model: &Model<f32>,
        rays: &Rays<f32>,
        alive: &[u32],
        round: usize,
        limits: &Limits,
        out: &mut [RayValues],
    ) -> Evaluations {
        let MarchBuffer { t, delta, offsets, .. } = &self.marched;
        let tape = Tape::with_pool(self.pool.clone());
        let params = model.params.bind_constant(&tape);
        let mut rows = Vec::with_capacity(alive.len() * ROUND);
        let mut ends = Vec::with_capacity(alive.len());
        let mut positions = Vec::with_capacity(3 * alive.len() * ROUND);
        for &ray in alive {
            let ray = ray as usize;
            let start = offsets[ray] as usize + round * ROUND;
            for row in start..(start + ROUND).min(offsets[ray + 1] as usize) {
                rows.push(row);
                positions.extend((0..3).map(|axis| rays.origins[ray][axis] + t[row] * rays.directions[ray][axis]));
            }
            ends.push(rows.len());
        }
        let positions = tape.constant(tape.pool().copy_of(&[rows.len(), 3], &positions));
        let density = model.field.density(&params, &model.field.encode(&params, &positions));
        let sigma = density.sigma();
        let sigma = sigma.value().as_slice();
        let (mut shaded, mut shaded_ends) = (Vec::with_capacity(rows.len()), vec![0_u32]);
        let mut start = 0;
        for (&ray, &end) in alive.iter().zip(&ends) {
            let state = &mut self.rays[ray as usize];
            for row in start..end {
                let depth = f64::from(sigma[row]) * f64::from(delta[rows[row]]);
                let weight = ((-state.depth).exp() * -(-depth).exp_m1()) as f32;
                state.depth += depth;
                state.weight += weight;
                out[ray as usize][3] += weight * t[rows[row]];
                // Small weights first come first served, within the budget.
                if state.uncolored + weight <= limits.color_budget && 4.0 * weight <= limits.color_budget
                    || weight == 0.0
                {
                    state.uncolored += weight;
                } else {
                    shaded.push(Shaded { row: row as u32, weight });
                }
            }
            start = end;
            shaded_ends.push(shaded.len() as u32);
        }
        let count = Evaluations { density: rows.len() as u64, color: shaded.len() as u64, unskipped: 0 };
        if shaded.is_empty() {
            return count;
        }
        let index: Arc<[u32]> = shaded.iter().map(|shaded| shaded.row).collect();
        let directions: Vec<[f32; 3]> = alive.iter().map(|&ray| rays.directions[ray as usize]).collect();
        let directions = tape.constant(tape.pool().copy_of(&[alive.len(), 3], directions.as_flattened()));
        let segments = Segments::new(shaded_ends);
        let color = model.field.color(&params, &density.features.gather_rows(&index), &directions, &segments);
        for (&ray, range) in alive.iter().zip(segments.ranges()) {
            for i in range {
                for channel in 0..3 {
                    out[ray as usize][channel] += shaded[i].weight * color.value().as_slice()[3 * i + channel];
                }
            }
        }
        count
    }
}

/// Makes up for what was left out.
fn finish(out: &mut RayValues, state: &RayState, limits: &Limits) {
    let left = (-state.depth).exp() as f32;
    let colored = state.weight - state.uncolored;
    if colored > 0.0 {
        // The light that would have gone on stays with what is in front.
        let ended = left <= limits.termination;
        let total = if ended { 1.0 } else { state.weight };
        out[..3].iter_mut().for_each(|value| *value *= total / colored);
        if ended {
            out[3] *= total / state.weight;
        }
        out[4] = if ended { 0.0 } else { left };
    } else {
        out[4] = left;
    }
}
