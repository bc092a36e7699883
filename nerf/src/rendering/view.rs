//! Fast rendering: densities front to back in rounds until a ray terminates, colours only where they matter.

use super::pixel::Pixel;
use crate::camera::rays::{Rays, Samples};
use crate::model::Model;
use crate::sampling::RayTolerance;
use crate::volume::quadrature::Quadrature;
use crate::volume::query::Query;
use crate::volume::render::{Evaluations, accumulate};
use crate::volume::rounds::{FrontToBack, Round, Stretch};
use crate::volume::weights::Weights;
use raygrad_autograd::Pool;

/// Samples per chunk of a ray, for rules that weight intervals. Nodes at the ends of chunks are evaluated twice.
const CHUNK: usize = 16;

/// Weights of the samples of a ray so far.
#[derive(Clone, Copy, Default)]
struct Seen {
    /// The weights of samples without a colour, and of all samples.
    uncolored: f32,
    weight: f32,
}

impl Model<f32> {
    /// Renders rays without a background to `out`, whose pixels must be the default.
    pub(super) fn see(
        &self,
        rays: &Rays<f32>,
        limits: &RayTolerance,
        pool: &Pool<f32>,
        out: &mut [Pixel],
    ) -> Evaluations {
        self.along(rays, 1, pool, |query, sampled| {
            let rule = self.sampler.quadrature();
            let asked = match rule.has_intervals() {
                false => in_rounds(query, &rule.nodes(&sampled.samples), limits, out),
                true => in_chunks(query, rule, &sampled.samples, limits, out),
            };
            asked + sampled.evaluations
        })
    }
}

/// Renders with a rule of one sample per interval.
fn in_rounds(
    query: &Query<'_, '_, f32>,
    samples: &Samples<f32>,
    limits: &RayTolerance,
    out: &mut [Pixel],
) -> Evaluations {
    let (mut seen, mut evaluations) = (vec![Seen::default(); out.len()], Evaluations::default());
    let mut rays = FrontToBack::new(samples, limits.early_stop_eps.into());
    while let Some(round) = rays.round(query, rays.round_size()) {
        evaluations = evaluations + shade(query, &round, limits, &mut seen, out);
    }
    for ((out, seen), &depth) in out.iter_mut().zip(&seen).zip(&rays.depths) {
        finish(out, seen, depth, rays.has_ended(depth));
    }
    evaluations
}

/// Adds the colours of a round to its rays.
fn shade(
    query: &Query<'_, '_, f32>,
    round: &Round<'_, f32>,
    limits: &RayTolerance,
    seen: &mut [Seen],
    out: &mut [Pixel],
) -> Evaluations {
    let Round { stretch: Stretch { samples, pieces }, density, optical_depth, in_front } = round;
    let before: Vec<f64> = samples.segments.ranges().map(|rows| in_front[rows.start]).collect();
    let weights = query.tape().apply(Weights::behind(samples.segments.clone(), before), &[optical_depth]);
    let (w, t) = (weights.value().as_slice(), samples.t.as_slice());
    let mut shaded: Vec<u32> = Vec::with_capacity(samples.len());
    for (rows, (ray, _)) in samples.segments.ranges().zip(pieces) {
        let (seen, out) = (&mut seen[*ray], &mut out[*ray]);
        for row in rows {
            let weight = w[row];
            seen.weight += weight;
            out.depth += f64::from(weight * t[row]);
            // Small weights are left out in order along the ray, within the budget.
            let small = seen.uncolored + weight <= limits.color_budget && 4.0 * weight <= limits.color_budget;
            if small || weight == 0.0 {
                seen.uncolored += weight;
            } else {
                shaded.push(row as u32);
            }
        }
    }
    let count = Evaluations { density: samples.len() as u64, color: shaded.len() as u64, unskipped: 0 };
    if shaded.is_empty() {
        return count;
    }
    let samples = samples.select(&shaded, query.tape().pool());
    let color = of_rays(query, pieces.len()).color(&density.features.gather_rows(&shaded[..]), &samples);
    let color = accumulate(&weights.gather_rows(&shaded[..]), &color, &samples.segments);
    for ((ray, _), color) in pieces.iter().zip(color.value().as_slice().chunks_exact(3)) {
        out[*ray].color.iter_mut().zip(color).for_each(|(out, &color)| *out += f64::from(color));
    }
    count
}

/// The query for a number of rays; all have the same appearance.
fn of_rays<'a, 't>(query: &Query<'a, 't, f32>, rays: usize) -> Query<'a, 't, f32> {
    Query { frames: query.frames.map(|frames| &frames[..rays]), ..*query }
}

/// Renders with a rule that weights intervals, front to back in chunks of samples.
fn in_chunks(
    query: &Query<'_, '_, f32>,
    rule: Quadrature,
    steps: &Samples<f32>,
    limits: &RayTolerance,
    out: &mut [Pixel],
) -> Evaluations {
    let mut evaluations = Evaluations::default();
    let mut rays = FrontToBack::new(steps, limits.early_stop_eps.into());
    while let Some(Stretch { samples, pieces }) = rays.take(CHUNK, query.tape().pool()) {
        let seen = rule.render(&of_rays(query, pieces.len()), &samples, 0.0);
        evaluations.density += seen.density_queries as u64;
        evaluations.color +=
            if let Quadrature::Adaptive { .. } = rule { seen.density_queries } else { seen.visible } as u64;
        let (color, depth) = (seen.rendered.color.value().as_slice().chunks_exact(3), seen.rendered.depth());
        let values = color.zip(depth.value().as_slice()).zip(seen.rendered.optical_depth.value().as_slice());
        for ((ray, _), ((color, &depth), &x)) in pieces.into_iter().zip(values) {
            let (out, tau) = (&mut out[ray], &mut rays.depths[ray]);
            let left = f64::exp(-*tau);
            out.color.iter_mut().zip(color).for_each(|(out, &color)| *out += left * f64::from(color));
            out.depth += left * f64::from(depth);
            *tau += f64::from(x);
        }
    }
    for (out, &depth) in out.iter_mut().zip(&rays.depths) {
        let seen = Seen { weight: -(-depth).exp_m1() as f32, uncolored: 0.0 };
        finish(out, &seen, depth, rays.has_ended(depth));
    }
    evaluations
}

/// Compensates for samples without colour and, if the ray has `ended` early, for the rest of its light.
fn finish(out: &mut Pixel, seen: &Seen, depth: f64, ended: bool) {
    let colored = f64::from(seen.weight - seen.uncolored);
    out.transmittance = (-depth).exp();
    if colored > 0.0 {
        // The remaining light is attributed to the samples in front.
        let total = if ended { 1.0 } else { f64::from(seen.weight) };
        out.color.iter_mut().for_each(|value| *value *= total / colored);
        if ended {
            out.depth *= total / f64::from(seen.weight);
            out.transmittance = 0.0;
        }
    }
}
