//! Views: densities front to back in rounds until the light is used up, colours where they matter.

use super::pixel::Pixel;
use crate::camera::rays::{Rays, Samples};
use crate::model::Model;
use crate::random::Jitter;
use crate::sampling::{Limits, Purpose};
use crate::volume::quadrature::Quadrature;
use crate::volume::query::Query;
use crate::volume::render::{Evaluations, accumulate};
use crate::volume::weights::Weights;
use raygrad_autograd::{Pool, Tape};

/// Samples that are asked together, about.
const ROUND: usize = 4096;
/// Samples that a ray takes in a round, at least: few while most rays end early.
const LEAST: usize = 8;
/// Steps that a ray takes at a time where rules weight intervals themselves: the nodes at their ends are asked twice.
const CHUNK: usize = 16;

/// What one worker keeps.
#[derive(Default)]
pub(crate) struct Viewer {
    pool: Pool<f32>,
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

impl Viewer {
    /// What is seen along rays without a background.
    pub fn see(&mut self, model: &Model<f32>, rays: &Rays<f32>, limits: &Limits, out: &mut [Pixel]) -> Evaluations {
        let tape = Tape::with_pool(self.pool.clone());
        let params = model.params.bind_constant(&tape);
        let frames = model.look.map(|look| vec![look; rays.len()]);
        let query = &Query { frames: frames.as_deref(), ..Query::new(&*model.field, &params) };
        let sampled = model.sampler.sample(query, rays, Purpose::View { finer: 1 }, &mut Jitter::Middle);
        let rule = model.sampler.quadrature();
        let asked = match rule {
            Quadrature::Midpoint | Quadrature::Left => {
                in_rounds(query, &rule.plan(&sampled.steps, tape.pool()).samples, limits, out)
            }
            _ => in_chunks(query, rule, &sampled.steps, limits, out),
        };
        asked + sampled.evaluations
    }
}

/// The view of samples that stand for an interval each.
fn in_rounds(query: &Query<'_, '_, f32>, samples: &Samples<f32>, limits: &Limits, out: &mut [Pixel]) -> Evaluations {
    let (mut states, mut evaluations) = (vec![RayState::default(); out.len()], Evaluations::default());
    out.fill(Pixel::default());
    let most = f64::from(limits.termination);
    front_to_back(samples, query.tape().pool(), |part, alive| {
        evaluations = evaluations + round(query, part, alive, limits, &mut states, out);
        alive.iter().map(|&ray| (-states[ray].depth).exp() > most).collect()
    });
    for (out, state) in out.iter_mut().zip(&states) {
        finish(out, state, limits);
    }
    evaluations
}

/// Works on samples in rounds, front to back: `round` is given the next ones of the rays that are alive and the numbers of these
/// rays, and says for each of them whether it still is.
pub(crate) fn front_to_back(
    samples: &Samples<f32>,
    pool: &Pool<f32>,
    mut round: impl FnMut(&Samples<f32>, &[usize]) -> Vec<bool>,
) {
    let rays = samples.segments.len();
    let each = (ROUND / rays.max(1)).max(LEAST);
    let range = |ray: usize| samples.segments.range(ray);
    let mut alive: Vec<usize> = (0..rays).filter(|&ray| !range(ray).is_empty()).collect();
    let mut done = 0;
    while !alive.is_empty() {
        let piece = |&ray: &usize| (ray, range(ray).start + done..(range(ray).start + done + each).min(range(ray).end));
        let pieces: Vec<_> = alive.iter().map(piece).collect();
        let mut stays = round(&samples.pieces(&pieces, pool), &alive).into_iter();
        done += each;
        alive.retain(|&ray| stays.next() == Some(true) && range(ray).len() > done);
    }
}

/// The next samples of the rays that are alive.
fn round(
    query: &Query<'_, '_, f32>,
    part: &Samples<f32>,
    alive: &[usize],
    limits: &Limits,
    states: &mut [RayState],
    out: &mut [Pixel],
) -> Evaluations {
    let pool = query.tape().pool();
    let density = query.density(part);
    let depth = density.optical_depth(&part.delta);
    let before: Vec<f64> = alive.iter().map(|&ray| states[ray].depth).collect();
    let weights = query.tape().apply(Weights::behind(part.segments.clone(), before), &[&depth]);
    let (x, w, t) = (depth.value().as_slice(), weights.value().as_slice(), part.t.as_slice());
    let mut shaded: Vec<u32> = Vec::with_capacity(part.len());
    for (rows, &ray) in part.segments.ranges().zip(alive) {
        let (state, out) = (&mut states[ray], &mut out[ray]);
        for row in rows {
            let weight = w[row];
            state.depth += f64::from(x[row]);
            state.weight += weight;
            out.depth += f64::from(weight * t[row]);
            // Small weights first come first served, within the budget.
            let small = state.uncolored + weight <= limits.color_budget && 4.0 * weight <= limits.color_budget;
            if small || weight == 0.0 {
                state.uncolored += weight;
            } else {
                shaded.push(row as u32);
            }
        }
    }
    let count = Evaluations { density: part.len() as u64, color: shaded.len() as u64, unskipped: 0 };
    if shaded.is_empty() {
        return count;
    }
    let seen = part.select(&shaded, pool);
    // Every ray has the look of the same photograph.
    let query = Query { frames: query.frames.map(|frames| &frames[..alive.len()]), ..*query };
    let color = query.color(&density.features.gather_rows(&shaded[..]), &seen);
    let color = accumulate(&weights.gather_rows(&shaded[..]), &color, &seen.segments);
    for (&ray, color) in alive.iter().zip(color.value().as_slice().chunks_exact(3)) {
        out[ray].color.iter_mut().zip(color).for_each(|(out, &color)| *out += f64::from(color));
    }
    count
}

/// The view by a rule that weights intervals itself, front to back in chunks of steps.
fn in_chunks(
    query: &Query<'_, '_, f32>,
    rule: Quadrature,
    steps: &Samples<f32>,
    limits: &Limits,
    out: &mut [Pixel],
) -> Evaluations {
    let mut evaluations = Evaluations::default();
    let mut depths = vec![0.0; out.len()];
    out.fill(Pixel::default());
    for chunk in (0..).step_by(CHUNK) {
        let left = |ray: usize| f64::exp(-depths[ray]);
        let ranges = steps.segments.ranges().enumerate().filter(|(ray, _)| left(*ray) > f64::from(limits.termination));
        let rows: Vec<u32> = ranges
            .flat_map(|(_, rows)| (rows.start + chunk).min(rows.end)..(rows.start + chunk + CHUNK).min(rows.end))
            .map(|row| row as u32)
            .collect();
        if rows.is_empty() {
            break;
        }
        let seen = rule.render(query, &steps.select(&rows, query.tape().pool()), 0.0);
        evaluations.density += seen.asked as u64;
        evaluations.color += if let Quadrature::Adaptive { .. } = rule { seen.asked } else { seen.kept } as u64;
        let rendered = &seen.rendered;
        let (depth, color) = (rendered.depth(), rendered.color.value().as_slice().chunks_exact(3));
        let values = color.zip(depth.value().as_slice()).zip(rendered.optical_depth.value().as_slice());
        for ((out, tau), ((color, &depth), &x)) in out.iter_mut().zip(&mut depths).zip(values) {
            let left = f64::exp(-*tau);
            out.color.iter_mut().zip(color).for_each(|(out, &color)| *out += left * f64::from(color));
            out.depth += left * f64::from(depth);
            *tau += f64::from(x);
        }
    }
    for (out, depth) in out.iter_mut().zip(depths) {
        finish(out, &RayState { depth, weight: -(-depth).exp_m1() as f32, uncolored: 0.0 }, limits);
    }
    evaluations
}

/// Makes up for what was left out.
fn finish(out: &mut Pixel, state: &RayState, limits: &Limits) {
    let left = (-state.depth).exp();
    let colored = f64::from(state.weight - state.uncolored);
    out.transmittance = left;
    if colored > 0.0 {
        // The light that would have gone on stays with what is in front.
        let ended = left <= f64::from(limits.termination);
        let total = if ended { 1.0 } else { f64::from(state.weight) };
        out.color.iter_mut().for_each(|value| *value *= total / colored);
        if ended {
            out.depth *= total / f64::from(state.weight);
            out.transmittance = 0.0;
        }
    }
}
