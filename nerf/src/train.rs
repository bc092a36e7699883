//! Training: tiles of rays on as many cores as there are, and the same bits on any number of them.

use crate::config::{Config, SamplerConfig};
use crate::dataset::Dataset;
use crate::hash_grid::{HashGrad, TableOptimizer};
use crate::metrics::psnr_from_mse;
use crate::model::{Extent, Model, Sampler};
use crate::occupancy::Skip;
use crate::slot::{Scratch, Slot, Work, sum_slots};
use crate::{Error, Result};
use crate::{silhouette, startup};
use rand::SeedableRng;
use rand_pcg::Pcg64Mcg;
use raygrad_autograd::{Adam, Pool};
use rayon::prelude::*;
use serde::Serialize;
use std::ops::ControlFlow;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// Gradients are summed within this many slots and then in slot order: fixed, so that the sums do not depend on the
/// number of threads, and as many as threads can work at a time. A marching step has one tile for each: with more, smaller
/// ones, recording them would cost a two-core machine an eighth of its time.
const SLOTS: usize = 8;
/// Rays of a marching step: the least, and the most.
const RAYS: [usize; 2] = [256, 1 << 16];
/// Steps between updates of the occupancy grid.
const GRID_EVERY: u64 = 16;
/// Steps between the times when memory that they did not need is freed: the number of samples changes as training goes on.
const TRIM_EVERY: u64 = 256;

/// How long to train.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Budget {
    /// A number of steps.
    Steps(u64),
    /// Training time; what happens between steps does not count. The schedule stretches to it.
    Time(Duration),
}

/// What one step did, and the run so far.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct StepStats {
    /// Number of the step, from 1.
    pub step: u64,
    /// Training time so far.
    pub train_seconds: f64,
    /// Rays so far.
    pub rays: u64,
    /// Samples placed on rays so far: without a grid all, with one those in occupied cells.
    pub marched: u64,
    /// Evaluations of a density so far.
    pub samples: u64,
    /// Evaluations of a colour, and of all gradients, so far.
    pub shaded: u64,
    /// Evaluations of each that there would have been so far if nothing in the box were skipped.
    pub unskipped: u64,
    /// Rows of the field's table that were moved so far.
    pub rows: u64,
    /// The mean loss, of a hierarchical model that of the coarse field plus that of the fine one.
    pub loss: f64,
    /// PSNR on this step's rays, in dB.
    pub psnr: f64,
    /// Mean opacity of this step's rays, 0 to 1.
    pub opacity: f64,
    /// Share of the occupancy grid that is occupied; 1 without a grid.
    pub occupied: f64,
    /// The learning rate.
    pub rate: f64,
    /// Elements whose gradient was not finite, so far; they were left alone.
    pub skipped: u64,
    /// How often the start-up detector began again with another seed.
    pub restarts: u32,
}

/// A model in training.
pub struct Trainer {
    /// The model as it is now.
    pub model: Model<f32>,
    data: Arc<Dataset>,
    adam: Adam<f32>,
    /// For the table of the field, if it has one.
    table: Option<TableOptimizer>,
    slots: Vec<Slot>,
    /// What no thread is working with.
    scratch: Mutex<Vec<Scratch>>,
    /// For what happens outside of the slots.
    pool: Pool<f32>,
    /// Rays of the next step.
    batch: usize,
    elapsed: Duration,
    /// How many models of this run have collapsed.
    collapses: u32,
    done: StepStats,
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

/// The list; it is whole at every point where a panic could strike.
fn locked(scratch: &Mutex<Vec<Scratch>>) -> MutexGuard<'_, Vec<Scratch>> {
    scratch.lock().unwrap_or_else(PoisonError::into_inner)
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
        let batch = match &config.sampler {
            SamplerConfig::Hierarchical(config) => config.batch,
            SamplerConfig::Marching(_) => RAYS[0],
        };
        let done = StepStats {
            step: 0,
            train_seconds: 0.0,
            rays: 0,
            marched: 0,
            samples: 0,
            shaded: 0,
            unskipped: 0,
            rows: 0,
            loss: f64::NAN,
            psnr: f64::NAN,
            opacity: f64::NAN,
            occupied: 1.0,
            rate: 0.0,
            skipped: 0,
            restarts,
        };
        let mut trainer = Trainer {
            adam: Adam::new(config.adam),
            table: None,
            slots: (0..SLOTS).map(|_| Slot::default()).collect(),
            scratch: Mutex::default(),
            pool: Pool::new(),
            model,
            data,
            batch,
            elapsed: Duration::ZERO,
            collapses: 0,
            done,
        };
        trainer.reset_optimisers();
        trainer.carve();
        Ok(trainer)
    }

    fn reset_optimisers(&mut self) {
        let config = &self.model.config;
        self.adam = Adam::new(config.adam);
        self.table = self.model.field.table().map(|(_, grid)| TableOptimizer::new(grid.clone(), config.table_adam));
    }

    /// Leaves out what the silhouettes of the photographs show to be empty.
    fn carve(&mut self) {
        if let Sampler::Marching(marching) = &mut self.model.sampler {
            let config = marching.config.occupancy;
            if config.silhouettes && config.skip != Skip::Off {
                silhouette::carve(&mut marching.grid, &self.data);
                self.done.occupied = marching.grid.occupied_share();
            }
        }
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
                break;
            }
            self.step(fraction);
            if observe(self).is_break() {
                break;
            }
        }
        let start = Instant::now();
        self.model.finish_grid();
        self.elapsed += start.elapsed();
    }

    /// One training step; `fraction` says how much of the run is done, for the schedule.
    pub fn step(&mut self, fraction: f64) -> StepStats {
        let start = Instant::now();
        let number = self.done.step + 1;
        // A restart draws other rays too.
        let seed = self.model.config.seed.wrapping_add(u64::from(self.done.restarts) << 32);
        if let Sampler::Marching(marching) = &mut self.model.sampler {
            marching.progress = fraction;
        }
        self.update_grid(number, seed);
        let tile = match &self.model.config.sampler {
            SamplerConfig::Hierarchical(config) => config.tile,
            SamplerConfig::Marching(_) => self.batch.div_ceil(SLOTS),
        };
        let work = self.differentiate(tile, seed, number);
        if number.is_multiple_of(TRIM_EVERY) {
            locked(&self.scratch).iter().for_each(Scratch::trim);
            self.pool.trim();
        }
        let rate = self.model.config.schedule.rate(fraction);
        let skipped = self.descend(rate, tile);
        let values = 3.0 * self.batch as f64;
        self.elapsed += start.elapsed();
        self.done = StepStats {
            step: number,
            train_seconds: self.elapsed.as_secs_f64(),
            rays: self.done.rays + self.batch as u64,
            marched: self.done.marched + work.marched,
            samples: self.done.samples + work.samples,
            shaded: self.done.shaded + work.shaded,
            unskipped: self.done.unskipped + work.unskipped,
            rows: self.done.rows,
            loss: work.loss / values,
            psnr: psnr_from_mse(work.error / values),
            opacity: work.opacity / self.batch as f64,
            occupied: self.done.occupied,
            rate,
            skipped: self.done.skipped + skipped,
            restarts: self.done.restarts,
        };
        self.adapt_batch(&work);
        if startup::has_collapsed(self.adam.steps(), self.done.opacity, self.collapses) {
            self.restart();
        }
        self.done
    }

    /// All tiles' gradients, left in the slots.
    fn differentiate(&mut self, tile: usize, seed: u64, number: u64) -> Work {
        let (model, data, total, free) = (&self.model, &*self.data, self.batch, &self.scratch);
        self.slots.par_iter_mut().enumerate().for_each(|(index, slot)| {
            slot.begin();
            let mut scratch = locked(free).pop().unwrap_or_default();
            for which in (index..total.div_ceil(tile)).step_by(SLOTS) {
                let count = tile.min(total - which * tile);
                slot.tile(&mut scratch, model, data, [count, total], &mut stream(seed, [number, which as u64]));
            }
            locked(free).push(scratch);
        });
        self.slots.iter().fold(Work::default(), |sum, slot| sum + slot.work)
    }

    /// Moves the parameters; returns how many elements were left alone.
    fn descend(&mut self, rate: f64, tile: usize) -> u64 {
        let used = self.batch.div_ceil(tile).min(SLOTS);
        sum_slots(&mut self.slots[..used]);
        let table_id = self.model.field.table().map(|(id, _)| id);
        let mut skipped = 0;
        if let (Some(id), Some(table)) = (table_id, &mut self.table) {
            // Tiles in their order, whatever slot they fell to.
            let turns = self.slots[..used].iter().map(|slot| slot.tables.len()).max().unwrap_or(0);
            let parts =
                (0..turns).flat_map(|turn| self.slots[..used].iter().filter_map(move |slot| slot.tables.get(turn)));
            let parts: Vec<Arc<HashGrad<f32>>> = parts.cloned().collect();
            let dense = self.model.params.ids().zip(&self.slots[0].grads).find(|&(other, _)| other == id);
            let dense = dense.and_then(|(_, sum)| sum.as_ref());
            let moved = table.step(self.model.params.get_mut(id), &parts, dense, rate);
            self.done.rows += moved.touched as u64;
            skipped += moved.skipped as u64;
            self.slots.iter_mut().for_each(|slot| slot.tables.clear());
        }
        let grads = &self.slots[0].grads;
        let ids = self.model.params.ids();
        let pairs = ids.zip(self.model.params.values_mut()).zip(grads);
        let dense = pairs.filter(|((id, _), _)| Some(*id) != table_id).filter_map(|((_, p), g)| Some((p, g.as_ref()?)));
        skipped + self.adam.step_pairs(dense, rate) as u64
    }

    /// Chooses the number of rays so that the next step has as many samples as it should.
    fn adapt_batch(&mut self, work: &Work) {
        if let Sampler::Marching(marching) = &self.model.sampler {
            let each = (work.marched as f64 / self.batch as f64).max(0.5);
            let rays = marching.config.samples as f64 / each;
            // Not at once: the number of samples a ray is noisy.
            let rays = (0.5 * (rays + self.batch as f64)).min(2.0 * self.batch as f64) as usize;
            self.batch = rays.next_multiple_of(SLOTS).clamp(RAYS[0], RAYS[1]);
        }
    }

    fn update_grid(&mut self, number: u64, seed: u64) {
        if number % GRID_EVERY != 1 || number == 1 {
            return;
        }
        let Model { sampler, field, params, .. } = &mut self.model;
        if let Sampler::Marching(marching) = sampler {
            marching.update(&**field, params, &self.pool, number, seed);
            self.done.occupied = marching.grid.occupied_share();
        }
    }

    /// Begins again with other random parameters.
    fn restart(&mut self) {
        let config = self.model.config.clone();
        self.done.restarts += 1;
        self.collapses += 1;
        let seed = config.seed.wrapping_add(u64::from(self.done.restarts) << 32);
        if let Ok((model, _)) = startup::living_model(&config, self.model.extent, seed) {
            self.model = model;
        }
        self.carve();
        self.reset_optimisers();
    }
}
