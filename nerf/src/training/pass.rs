//! The forward pass of a tile of a training step: from rays to a loss.

use crate::dataset::Background;
use crate::dataset::batch::Batch;
use crate::losses::LossInputs;
use crate::losses::interlevel::interlevel;
use crate::losses::photometric::Loss;
use crate::model::Model;
use crate::random::{Jitter, mixed};
use crate::sampling::{Purpose, Sampled};
use crate::volume::early_termination::VisibleSamples;
use crate::volume::query::Query;
use crate::volume::render::{Evaluations, Rendered};
use raygrad_autograd::{Scalar, Var};
use raygrad_nn::Bound;
use serde::{Deserialize, Serialize};
use std::ops::Add;

/// Counts and errors, summed over rays.
#[derive(Debug, Clone, Copy, Default, Serialize, Deserialize)]
pub(crate) struct Work {
    /// Samples placed on rays.
    pub marched: u64,
    /// Field evaluations.
    pub evaluations: Evaluations,
    /// The loss, before the mean over rays and channels.
    pub loss: f64,
    /// Squared error of the field.
    pub error: f64,
    /// Opacity.
    pub opacity: f64,
}

impl Add for Work {
    type Output = Work;
    fn add(self, other: Work) -> Work {
        Work {
            marched: self.marched + other.marched,
            evaluations: self.evaluations + other.evaluations,
            loss: self.loss + other.loss,
            error: self.error + other.error,
            opacity: self.opacity + other.opacity,
        }
    }
}

/// The loss of a batch, a sum over rays and channels, and its counts.
pub(crate) fn rays_loss<'t>(
    model: &Model<f32>,
    params: &Bound<'t, f32>,
    batch: &Batch,
    fraction: f64,
    jitter: &mut Jitter<'_>,
) -> (Var<'t, f32>, Work) {
    let (tape, sampler) = (params.tape(), &*model.sampler);
    let slopes = model.loss_terms.iter().any(|term| term.needs_normals());
    let seen = (&batch.frames[..], &batch.pixels[..]);
    let moved = model
        .camera_optimizer
        .as_ref()
        .map(|refine| refine.rays(params, &batch.rays, seen, model.reach(), model.scene_box.near_far));
    let (vars, rays) = moved.as_ref().map_or((None, &batch.rays), |(vars, rays)| (Some(vars), rays));
    let near = model.config.gradient_scaling_distance * model.scene_box.unit;
    let query = Query {
        frames: Some(&batch.frames),
        rays: vars,
        position_grad: slopes,
        gradient_scaling_distance: near,
        ..Query::new(&*model.field, params)
    };
    let rows = |values: &[[f32; 3]]| tape.pool().copy_of(&[values.len(), 3], values.as_flattened());
    let (target, background) = (rows(&batch.target), rows(&batch.background));
    let Sampled { samples: steps, coarse, histograms: levels, evaluations } =
        sampler.sample(&query, rays, Purpose::Training, jitter);
    let VisibleSamples { rendered, density_queries: asked, visible: kept } =
        sampler.quadrature().render(&query, &steps, sampler.early_stop_eps());
    let gains = model.exposure.as_ref().map(|tone| tone.gains(params, batch));
    // Gains apply to the scene, not to the background.
    let shown = |seen: &Rendered<'t, f32>| match &gains {
        Some(gains) => seen.over(&background) + &seen.color * (gains - 1.0),
        None => seen.over(&background),
    };
    let color = shown(&rendered);
    let is_expected = model.config.training_background() == Background::Expected;
    let behind: Vec<f32> = batch.alpha.iter().map(|alpha| 1.0 - alpha).collect();
    let photometric = |seen: &Rendered<'t, f32>, color: &Var<'t, f32>| {
        let loss = model.config.loss.sum(color, &target);
        // A colour's error is linear in the background `b`: `e + d b`, with `d` the error of the transmittance. Its mean
        // square over `b` in 0 to 1 is `(e + d / 2)^2 + d^2 / 12`; the first term is the error over grey.
        if is_expected {
            let missed = seen.transmittance() - tape.constant(tape.pool().copy_of(&[behind.len()], &behind));
            loss + missed.square().sum() * (3.0 / 12.0)
        } else {
            loss
        }
    };
    let fine = photometric(&rendered, &color);
    let error = match model.config.loss {
        Loss::Mse => fine.item(),
        // PSNR needs squared errors, for any loss.
        _ => tape.no_grad(|| Loss::Mse.sum(&color, &target).item()),
    };
    let coarse = coarse.iter().map(|seen| photometric(seen, &shown(seen)));
    let weights = rendered.weights.value();
    let levels = levels.iter().map(|level| interlevel(level, &rendered.samples, weights));
    let (frames, pixels, distances) = (&batch.frames[..], &batch.pixels[..], &batch.distances[..]);
    let (rendered, target, background) = (&rendered, &target, &background);
    let seed = if model.loss_terms.is_empty() { 0 } else { jitter.seed() };
    let seen = LossInputs {
        params,
        rays,
        frames,
        pixels,
        distances,
        seed,
        train_frac: fraction,
        rendered,
        target,
        background,
    };
    let terms =
        (0..).zip(&model.loss_terms).map(|(i, term)| term.loss(&LossInputs { seed: mixed(seed, [i, 0]), ..seen }));
    let loss = coarse.chain(levels).chain(terms).fold(fine, |sum, term| term + sum);
    let left: f64 = tape.no_grad(|| rendered.transmittance().value().as_slice().iter().map(|x| x.to_f64()).sum());
    let work = Work {
        marched: evaluations.density + steps.len() as u64,
        evaluations: evaluations + Evaluations { density: asked as u64, color: kept as u64, unskipped: 0 },
        loss: f64::from(loss.item()),
        error: f64::from(error),
        opacity: batch.rays.len() as f64 - left,
    };
    (loss, work)
}
