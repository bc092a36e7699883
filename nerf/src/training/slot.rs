//! A share of a training step: sums of the gradients of some tiles, and what a tile is worked out with.

use crate::dataset::Dataset;
use crate::dataset::batch::draw;
use crate::encoding::hash_grid::HashGrad;
use crate::model::{Model, Sampler};
use crate::random::Jitter;
use crate::space::occupancy::MarchBuffer;
use rand_pcg::Pcg64Mcg;
use raygrad_autograd::{Tape, Tensor, Var};
use raygrad_tensor::add_assign;
use rayon::prelude::*;
use std::ops::Add;
use std::sync::Arc;

/// What was done and what came out, summed over rays.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Work {
    /// Samples placed on rays.
    pub marched: u64,
    /// Evaluations of a density.
    pub samples: u64,
    /// Evaluations of a colour.
    pub shaded: u64,
    /// Samples there would be of either if nothing in the box were skipped.
    pub unskipped: u64,
    /// What is minimised, before the mean over rays and channels.
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
            samples: self.samples + other.samples,
            shaded: self.shaded + other.shaded,
            unskipped: self.unskipped + other.unskipped,
            loss: self.loss + other.loss,
            error: self.error + other.error,
            opacity: self.opacity + other.opacity,
        }
    }
}

/// What one tile at a time is worked out with, kept so that nothing is allocated. There are as many as threads, so that
/// memory does not grow with the number of slots.
#[derive(Default)]
pub(crate) struct Scratch {
    tape: Tape<f32>,
    buffer: MarchBuffer,
}

impl Scratch {
    /// Frees memory that no tile since the last call has needed.
    pub fn trim(&self) {
        self.tape.pool().trim();
    }
}

/// Sums over tiles, kept from step to step.
#[derive(Default)]
pub(crate) struct Slot {
    /// Whether a tile of this step is in the sums.
    started: bool,
    /// Summed gradient of each parameter; None for a table whose gradient has no dense share.
    pub grads: Vec<Option<Tensor<f32>>>,
    /// The table's gradients, tile by tile.
    pub tables: Vec<Arc<HashGrad<f32>>>,
    pub work: Work,
}

impl Slot {
    /// Forgets the last step.
    pub fn begin(&mut self) {
        self.started = false;
        self.work = Work::default();
    }

    /// Draws a tile of `count` of the step's `total` rays and adds its gradients to the sums.
    pub fn tile(
        &mut self,
        scratch: &mut Scratch,
        model: &Model<f32>,
        data: &Dataset,
        [count, total]: [usize; 2],
        rng: &mut Pcg64Mcg,
    ) {
        let Slot { grads, tables, work, started } = self;
        let Scratch { tape, buffer } = scratch;
        let params = model.params.bind(tape);
        let batch = draw(data, count, model.config.background, rng);
        let rays = &batch.rays;
        let copy = |values: &[[f32; 3]]| tape.pool().copy_of(&[count, 3], values.as_flattened());
        let (target, background) = (copy(&batch.target), copy(&batch.background));
        let jitter = &mut Jitter::Random(rng);
        let loss = match &model.sampler {
            Sampler::Hierarchical(sampler) => {
                let rendered = sampler.render(&*model.field, &params, rays, jitter, false, tape);
                let coarse = model.config.loss.sum(&rendered.coarse, &target, &background);
                let fine = model.config.loss.sum(&rendered.fine, &target, &background);
                let error = model.config.loss.squared_error(&fine, &rendered.fine, &target, &background);
                let evaluations = (count * sampler.config.evaluations()) as u64;
                let loss = coarse + fine;
                work.count([evaluations; 4], loss.item(), error, &rendered.fine);
                loss
            }
            Sampler::Marching(sampler) => {
                let samples = sampler.samples(rays, jitter, buffer, tape.pool());
                let (rule, termination) = (sampler.config.quadrature, sampler.config.termination);
                let marched = rule.render(&*model.field, &params, &samples, termination, false, tape);
                let loss = model.config.loss.sum(&marched.rendered, &target, &background);
                let error = model.config.loss.squared_error(&loss, &marched.rendered, &target, &background);
                let [all, asked, kept] = [samples.len(), marched.asked, marched.kept].map(|n| n as u64);
                let evaluations = [all, asked, kept, buffer.steps];
                work.count(evaluations, loss.item(), error, &marched.rendered);
                loss
            }
        };
        let loss = loss * (1.0 / (3.0 * total as f64));
        // Where rays meet nothing, the loss may be a constant: its gradients are zero.
        let mut given = loss.tracked().backward(&params.vars()).into_iter();
        grads.resize_with(model.params.len(), || None);
        let table = model.field.table().map(|(id, _)| id);
        for (id, sum) in model.params.ids().zip(grads) {
            // A frozen parameter has no gradient.
            let gradient = if model.params.is_frozen(id) { None } else { given.next() };
            let Some(mut gradient) = gradient else {
                *sum = None;
                continue;
            };
            if table == Some(id) {
                tables.extend(gradient.take());
            }
            // What no ray reached has no share and rests.
            if gradient.is_zero() {
                *sum = sum.take().filter(|_| *started);
                continue;
            }
            match (gradient.into_dense(tape.pool()), sum) {
                (grad, Some(sum)) if *started => add_assign(sum.as_mut_slice(), grad.as_slice()),
                (grad, Some(sum)) => sum.as_mut_slice().copy_from_slice(grad.as_slice()),
                (grad, sum) => *sum = Some(grad),
            }
        }
        *started = true;
        drop((loss, params, target, background));
        tape.clear();
    }
}

impl Work {
    /// `evaluations`: samples placed, those asked for a density, those asked for a colour, and samples if nothing were
    /// skipped.
    fn count(&mut self, evaluations: [u64; 4], loss: f32, error: f32, rendered: &Var<'_, f32>) {
        let left = rendered.value().as_slice().chunks_exact(rendered.shape()[1]);
        let opacity = left.map(|ray| 1.0 - f64::from(ray[ray.len() - 1])).sum();
        let (loss, error) = (f64::from(loss), f64::from(error));
        let [marched, samples, shaded, unskipped] = evaluations;
        *self = *self + Work { marched, samples, shaded, unskipped, loss, error, opacity };
    }
}

/// Adds the gradients of all slots, in order, to those of the first; parallel over parameters.
pub(crate) fn sum_slots(slots: &mut [Slot]) {
    let Some((first, rest)) = slots.split_first_mut() else { return };
    first.grads.par_iter_mut().enumerate().for_each(|(i, sum)| {
        for slot in &*rest {
            match (&mut *sum, &slot.grads[i]) {
                (Some(sum), Some(grad)) => add_assign(sum.as_mut_slice(), grad.as_slice()),
                (sum @ None, Some(grad)) => *sum = Some(grad.clone()),
                (_, None) => {}
            }
        }
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::{Split, embedded};
    use crate::random::stream;
    use crate::{Config, Extent, Preset};

    #[test]
    fn a_slot_holds_the_sum_of_its_tiles() {
        let data = embedded(Split::Train, 12);
        let extent = Extent { bounds: data.bounds, span: [data.near, data.far] };
        let model = Model::new(Config::preset(Preset::Instant), extent, 1).unwrap();
        let mut scratch = Scratch::default();
        let mut slot = Slot::default();
        // The second step finds the sums of the first.
        let mut run = |tiles: &[u64]| {
            slot.begin();
            for &tile in tiles {
                slot.tile(&mut scratch, &model, &data, [4, 8], &mut stream(7, [0, tile]));
            }
            let dense: Vec<Vec<f32>> = slot.grads.iter().flatten().map(|grad| grad.as_slice().to_vec()).collect();
            (dense, slot.work.loss)
        };
        let [first, second, both] = [run(&[0]), run(&[1]), run(&[0, 1])];
        assert!(!both.0.is_empty() && first.0 != second.0);
        for ((a, b), sum) in first.0.iter().flatten().zip(second.0.iter().flatten()).zip(both.0.iter().flatten()) {
            assert_eq!(a + b, *sum);
        }
        assert_eq!(first.1 + second.1, both.1);
    }
}
