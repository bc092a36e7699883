//! Training: tiles of rays on as many cores as there are, and the same bits on any number of them.

use crate::bounds::clip_span;
use crate::config::Config;
use crate::dataset::Dataset;
use crate::metrics::psnr_from_mse;
use crate::model::{Extent, Model, squared_error};
use crate::rays::Rays;
use crate::sampler::Jitter;
use crate::startup;
use crate::{Error, Result, background};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use raygrad_autograd::{Adam, Tape, Tensor};
use raygrad_tensor::add_assign;
use rayon::prelude::*;
use serde::Serialize;
use std::ops::{ControlFlow, Range};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Gradients are summed within this many slots and then in slot order: fixed, so that the sums do not depend on the
/// number of threads, and as many as threads can work at a time.
const SLOTS: usize = 16;

/// How long to train.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Budget {
    /// A number of steps.
    Steps(u64),
    /// Training time; what happens between steps does not count. The schedule stretches to it.
    Time(Duration),
}

/// What one step did.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct StepStats {
    /// Number of the step, from 1.
    pub step: u64,
    /// Training time so far.
    pub train_seconds: f64,
    /// Rays so far.
    pub rays: u64,
    /// Evaluations of a field so far.
    pub samples: u64,
    /// The loss: mean squared error of the coarse field plus that of the fine field.
    pub loss: f64,
    /// PSNR of the fine field on this step's rays, in dB.
    pub psnr: f64,
    /// Mean opacity that the fine field gives this step's rays, 0 to 1.
    pub opacity: f64,
    /// The learning rate.
    pub rate: f64,
    /// Elements whose gradient was not finite, so far; they were left alone.
    pub skipped: u64,
    /// How often the start-up detector began again with another seed.
    pub restarts: u32,
}

/// One slot's tape and sums, kept from step to step so that nothing is allocated.
struct Slot {
    tape: Tape<f32>,
    grads: Vec<Tensor<f32>>,
    /// Summed squared errors of the coarse and the fine field, and summed opacity.
    sums: [f64; 3],
}

/// A model in training.
pub struct Trainer {
    /// The model as it is now.
    pub model: Model<f32>,
    data: Arc<Dataset>,
    adam: Adam<f32>,
    slots: Vec<Slot>,
    elapsed: Duration,
    done: StepStats,
    /// How many models of this run have collapsed.
    collapses: u32,
}

/// One step's rays and what they should show.
struct Batch {
    rays: Rays<f32>,
    target: Vec<[f32; 3]>,
    background: Vec<[f32; 3]>,
}

/// A generator for one purpose: mixes the parts so that neighbouring numbers give unrelated streams.
pub(crate) fn stream(seed: u64, parts: [u64; 2]) -> Pcg64Mcg {
    let mut state = seed ^ 0x9e37_79b9_7f4a_7c15;
    for part in parts {
        // The finaliser of SplitMix64 (Steele, Lea, Flood 2014).
        state = state.wrapping_add(part).wrapping_add(0x9e37_79b9_7f4a_7c15);
        state = (state ^ (state >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        state = (state ^ (state >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        state ^= state >> 31;
    }
    Pcg64Mcg::seed_from_u64(state)
}

impl Trainer {
    /// A new model for a dataset.
    ///
    /// # Errors
    /// If the configuration is out of range or the dataset has no frame.
    pub fn new(config: Config, data: Arc<Dataset>) -> Result<Self> {
        if data.frames.is_empty() {
            return Err(Error::setting("dataset", "has no frames to train on"));
        }
        let extent = Extent { bounds: data.bounds, span: [data.near, data.far] };
        let (model, restarts) = startup::living_model(&config, extent, config.seed)?;
        let grads = || model.params.values().iter().map(|value| Tensor::zeros(value.shape())).collect();
        let slots = (0..SLOTS).map(|_| Slot { tape: Tape::new(), grads: grads(), sums: [0.0; 3] }).collect();
        let done = StepStats {
            step: 0,
            train_seconds: 0.0,
            rays: 0,
            samples: 0,
            loss: f64::NAN,
            psnr: f64::NAN,
            opacity: f64::NAN,
            rate: 0.0,
            skipped: 0,
            restarts,
        };
        Ok(Trainer { adam: Adam::new(config.adam), model, data, slots, elapsed: Duration::ZERO, done, collapses: 0 })
    }

    /// What the last step did.
    pub fn stats(&self) -> StepStats {
        self.done
    }

    /// Trains until the budget is used up or `observe`, which is called after every step, breaks. The time that
    /// `observe` takes does not count.
    pub fn run(&mut self, budget: Budget, mut observe: impl FnMut(&Trainer) -> ControlFlow<()>) {
        loop {
            let fraction = match budget {
                Budget::Steps(steps) => self.done.step as f64 / steps.max(1) as f64,
                Budget::Time(time) => self.elapsed.as_secs_f64() / time.as_secs_f64().max(1e-9),
            };
            if fraction >= 1.0 {
                return;
            }
            self.step(fraction);
            if observe(self).is_break() {
                return;
            }
        }
    }

    /// One training step; `fraction` says how much of the run is done, for the schedule.
    pub fn step(&mut self, fraction: f64) -> StepStats {
        let start = Instant::now();
        let config = &self.model.config;
        let (batch_size, tile) = (config.batch, config.tile);
        let number = self.done.step + 1;
        // A restart draws other rays too.
        let seed = config.seed.wrapping_add(u64::from(self.done.restarts) << 32);
        let batch = draw(&self.data, batch_size, config, &mut stream(seed, [number, 0]));
        let tiles = batch_size.div_ceil(tile);
        let model = &self.model;
        self.slots.par_iter_mut().enumerate().for_each(|(index, slot)| {
            slot.sums = [0.0; 3];
            for (turn, which) in (index..tiles).step_by(SLOTS).enumerate() {
                let rays = which * tile..((which + 1) * tile).min(batch_size);
                slot.tile(model, &batch, rays, turn == 0, &mut stream(seed, [number, 1 + which as u64]));
            }
        });
        let used = &mut self.slots[..tiles.min(SLOTS)];
        sum_slots(used);
        let rate = config.schedule.rate(fraction);
        let skipped = self.adam.step(self.model.params.values_mut(), &used[0].grads, rate);
        let sums = used.iter().fold([0.0; 3], |sum, slot| std::array::from_fn(|i| sum[i] + slot.sums[i]));
        let values = 3.0 * batch_size as f64;
        let config = &self.model.config;
        let samples = batch_size * (2 * config.coarse_samples + config.fine_samples);
        self.elapsed += start.elapsed();
        self.done = StepStats {
            step: number,
            train_seconds: self.elapsed.as_secs_f64(),
            rays: self.done.rays + batch_size as u64,
            samples: self.done.samples + samples as u64,
            loss: (sums[0] + sums[1]) / values,
            psnr: psnr_from_mse(sums[1] / values),
            opacity: sums[2] / batch_size as f64,
            rate,
            skipped: self.done.skipped + skipped as u64,
            restarts: self.done.restarts,
        };
        if startup::has_collapsed(self.adam.steps(), self.done.opacity, self.collapses) {
            self.restart();
        }
        self.done
    }

    /// Begins again with other random parameters.
    fn restart(&mut self) {
        let config = self.model.config.clone();
        self.collapses += 1;
        self.done.restarts += 1;
        let seed = config.seed.wrapping_add(u64::from(self.done.restarts) << 32);
        if let Ok((model, _)) = startup::living_model(&config, self.model.extent, seed) {
            self.model = model;
        }
        self.adam = Adam::new(config.adam);
    }
}

impl Slot {
    /// Adds one tile's gradients to the slot's; `first` replaces what the last step left there.
    fn tile(&mut self, model: &Model<f32>, batch: &Batch, rays: Range<usize>, first: bool, rng: &mut Pcg64Mcg) {
        let tape = &self.tape;
        let params = model.params.bind(tape);
        let part = batch.rays.slice(rays.clone());
        let copy = |values: &[[f32; 3]]| tape.pool().copy_of(&[part.len(), 3], values.as_flattened());
        let (target, background) = (copy(&batch.target[rays.clone()]), copy(&batch.background[rays]));
        let rendered = model.render(tape, &params, &part, &mut Jitter::Random(rng), false);
        let coarse = squared_error(&rendered.coarse, &target, &background);
        let fine = squared_error(&rendered.fine, &target, &background);
        self.sums[0] += f64::from(coarse.item());
        self.sums[1] += f64::from(fine.item());
        let left = rendered.fine.value().as_slice().chunks_exact(rendered.fine.shape()[1]);
        self.sums[2] += left.map(|ray| 1.0 - f64::from(ray[ray.len() - 1])).sum::<f64>();
        let loss = (coarse + fine) * (1.0 / (3.0 * batch.rays.len() as f64));
        drop(rendered);
        let grads = loss.grad_once(&params.vars());
        for (sum, grad) in self.grads.iter_mut().zip(&grads) {
            if first {
                sum.as_mut_slice().copy_from_slice(grad.as_slice());
            } else {
                add_assign(sum.as_mut_slice(), grad.as_slice());
            }
        }
        drop((grads, loss, params, target, background));
        self.tape.clear();
    }
}

/// Adds the gradients of all slots, in order, to those of the first; parallel over parameters.
fn sum_slots(slots: &mut [Slot]) {
    let Some((first, rest)) = slots.split_first_mut() else { return };
    // A tape cannot be shared between threads, but the sums beside it can.
    let rest: Vec<&[Tensor<f32>]> = rest.iter().map(|slot| &slot.grads[..]).collect();
    first.grads.par_iter_mut().enumerate().for_each(|(i, sum)| {
        for grads in &rest {
            add_assign(sum.as_mut_slice(), grads[i].as_slice());
        }
    });
}

/// Random pixels of random photographs.
fn draw(data: &Dataset, count: usize, config: &Config, rng: &mut Pcg64Mcg) -> Batch {
    let mut batch =
        Batch { rays: Rays::new(), target: Vec::with_capacity(count), background: Vec::with_capacity(count) };
    for _ in 0..count {
        let frame = &data.frames[rng.random_range(0..data.frames.len())];
        let (x, y) = (rng.random_range(0..frame.image.width), rng.random_range(0..frame.image.height));
        let ray = frame.camera.pixel_ray(x, y);
        let color = config.background.draw(rng);
        batch.rays.push(&ray, clip_span(&ray, data.bounds, [data.near, data.far]));
        batch.target.push(background::over(frame.image.pixel(x, y), color));
        batch.background.push(color);
    }
    batch
}
