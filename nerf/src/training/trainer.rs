//! Training: tiles of rays on as many cores as there are, and the same bits on any number of them.

use crate::dataset::Dataset;
use crate::encoding::hash_grid::{HashGrad, TableOptimizer};
use crate::model::config::{Config, SamplerConfig};
use crate::model::{Extent, Model, Sampler};
use crate::pictures::metrics::psnr_from_mse;
use crate::random::stream;
use crate::space::occupancy::Skip;
use crate::space::silhouette;
use crate::training::slot::{Scratch, Slot, Work, sum_slots};
use crate::training::startup;
use crate::{Error, Result};
use raygrad_autograd::{Gradient, Pool, Tensor};
use raygrad_nn::{Adam, Optimizer, ParamId, RowStats, UpdateReport};
use raygrad_tensor::parallel;
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

/// Steps in a row without a finite gradient after which a run has diverged: an overflow of one batch passes.
const STUCK: u64 = 100;

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
    /// Elements, of the table rows, whose gradient was not finite, so far; they were left alone.
    pub skipped: u64,
    /// Steps in a row, up to this one, that moved nothing because no gradient was finite: the run has diverged if they
    /// go on.
    pub stuck: u64,
    /// How often the start-up detector began again with another seed.
    pub restarts: u32,
}

impl StepStats {
    /// Whether the run has diverged: for 100 steps in a row no gradient was finite, so that nothing moves any more. Its
    /// model is of no use.
    pub fn has_diverged(&self) -> bool {
        self.stuck >= STUCK
    }
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

/// The list; it is whole at every point where a panic could strike.
fn locked(scratch: &Mutex<Vec<Scratch>>) -> MutexGuard<'_, Vec<Scratch>> {
    scratch.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Trainer {
    /// A new model for a dataset.
    ///
    /// # Errors
    /// If the configuration is out of range, the dataset has no frame, or no ray of it
    /// [meets the scene's box](Dataset::check_reach).
    pub fn new(config: Config, data: Arc<Dataset>) -> Result<Self> {
        if data.frames.is_empty() {
            return Err(Error::setting("dataset", "has no frames to train on"));
        }
        data.check_reach()?;
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
            stuck: 0,
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

    /// Trains until the budget is used up or `observe`, which is called after every step, breaks, or until the run has
    /// [diverged](StepStats::has_diverged). The time that `observe` takes does not count.
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
            if observe(self).is_break() || self.done.has_diverged() {
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
        let report = self.descend(rate, tile);
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
            skipped: self.done.skipped + report.skipped as u64,
            // A network may turn NaN into gradients of 0, with which parameters do move.
            stuck: if report.is_stuck() || !work.loss.is_finite() { self.done.stuck + 1 } else { 0 },
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
                let rng = &mut stream(seed, [number, which as u64]);
                parallel::serial(|| slot.tile(&mut scratch, model, data, [count, total], rng));
            }
            locked(free).push(scratch);
        });
        self.slots.iter().fold(Work::default(), |sum, slot| sum + slot.work)
    }

    /// Moves the parameters.
    fn descend(&mut self, rate: f64, tile: usize) -> UpdateReport {
        let used = self.batch.div_ceil(tile).min(SLOTS);
        sum_slots(&mut self.slots[..used]);
        let params = &mut self.model.params;
        let table_id = self.model.field.table().map(|(id, _)| id);
        let mut of_table = RowStats::default();
        if let (Some(id), Some(table)) = (table_id.filter(|&id| !params.is_frozen(id)), &mut self.table) {
            // Tiles in their order, whatever slot they fell to.
            let turns = self.slots[..used].iter().map(|slot| slot.tables.len()).max().unwrap_or(0);
            let parts =
                (0..turns).flat_map(|turn| self.slots[..used].iter().filter_map(move |slot| slot.tables.get(turn)));
            let parts: Vec<Arc<HashGrad<f32>>> = parts.cloned().collect();
            let dense = params.ids().zip(&self.slots[0].grads).find(|&(other, _)| other == id);
            let (dense, rate) = (dense.and_then(|(_, sum)| sum.as_ref()), rate * params.rate(id));
            of_table = table.step(params.get_mut(id), &parts, dense, rate);
            self.done.rows += of_table.touched as u64;
            self.slots.iter_mut().for_each(|slot| slot.tables.clear());
        }
        // The sums are lent to the optimiser. A gradient without a share stands for the table, which has its own.
        let sums = &mut self.slots[0].grads;
        let lend = |(id, sum): (ParamId, &mut Option<Tensor<f32>>)| match sum.take_if(|_| Some(id) != table_id) {
            Some(sum) => Gradient::from(sum),
            None => Gradient::zero(params.get(id).shape()),
        };
        let free = |(id, _): &(ParamId, &mut Option<Tensor<f32>>)| !params.is_frozen(*id);
        let grads: Vec<_> = params.ids().zip(&mut *sums).filter(free).map(lend).collect();
        let mut report = self.adam.update(params, &grads, rate);
        let free = params.ids().zip(sums).filter(|(id, _)| !params.is_frozen(*id));
        for ((_, sum), grad) in free.zip(grads).filter(|(_, grad)| !grad.is_zero()) {
            *sum = Some(grad.into_dense(&self.pool));
        }
        if let Some(id) = table_id {
            report.count(params.name(id), of_table.touched, of_table.skipped);
        }
        report
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
        if let Ok((mut model, _)) = startup::living_model(&config, self.model.extent, seed) {
            // What was loaded and frozen is not thrown away, and rates are not forgotten.
            model.params.inherit(&self.model.params);
            self.model = model;
        }
        self.carve();
        self.reset_optimisers();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::{Split, embedded};
    use crate::encoding::hash_grid::HashGridConfig;
    use crate::field::ClassicConfig;
    use crate::sampling::hierarchical::HierarchicalConfig;
    use crate::{FieldConfig, Preset};
    use raygrad_nn::Schedule;

    #[test]
    fn cameras_from_which_nothing_of_the_box_is_seen_are_an_error() {
        let mut data = embedded(Split::Train, 8);
        data.frames.truncate(3);
        for frame in &mut data.frames {
            frame.camera.pose.translation *= 3.0;
        }
        let message = Trainer::new(tiny(), Arc::new(data.clone())).err().unwrap().to_string();
        let expected = "no ray of the 3 photographs meets the box";
        assert!(message.contains(expected) && message.contains("on average"), "{message}");
        // One that sees a part is enough.
        data.frames[2].camera.pose.translation /= 3.0;
        Trainer::new(tiny(), Arc::new(data.clone())).unwrap();
        // Near enough, and looking away.
        data.frames.drain(..2);
        data.frames[0].camera.pose.matrix3 = -data.frames[0].camera.pose.matrix3;
        assert!(data.check_reach().is_err());
    }

    #[test]
    fn a_restart_keeps_what_was_said_of_parameters() {
        let mut data = embedded(Split::Train, 8);
        data.frames.truncate(2);
        let mut trainer = Trainer::new(tiny(), Arc::new(data)).unwrap();
        let params = &mut trainer.model.params;
        let ids: Vec<_> = params.ids().collect();
        let frozen = params.name(ids[0]).to_owned();
        params.get_mut(ids[0]).as_mut_slice().fill(0.25);
        params.freeze(|name| name == frozen);
        params.set_rate(|name| name != frozen, 0.5);
        let before: Vec<_> = params.values().to_vec();
        trainer.restart();
        let params = &trainer.model.params;
        let ids: Vec<_> = params.ids().collect();
        assert!(params.is_frozen(ids[0]) && params.rate(ids[1]) == 0.5 && !params.is_frozen(ids[1]));
        assert_eq!(params.values()[0], before[0]);
        assert!(params.values().iter().zip(&before).skip(1).any(|(new, old)| new != old), "other numbers");
    }

    /// Two tiny networks, and few rays of few samples.
    fn tiny() -> Config {
        let paper = ClassicConfig::paper();
        let field = ClassicConfig { depth: 2, width: 16, skips: vec![], view_width: 8, position_levels: 3, ..paper };
        let sampler = HierarchicalConfig {
            proposal: field.clone(),
            coarse: 6,
            fine: 4,
            batch: 16,
            tile: 8,
            ..HierarchicalConfig::default()
        };
        let (field, sampler) = (FieldConfig::Classic(field), SamplerConfig::Hierarchical(sampler));
        Config { field, sampler, ..Config::preset(Preset::Small) }
    }

    /// A small hash grid.
    fn tiny_table() -> Config {
        let mut config = Config::preset(Preset::Instant);
        if let FieldConfig::Instant(field) = &mut config.field {
            field.grid = HashGridConfig { levels: 3, features: 2, log2_table: 8, coarsest: 4, finest: 16 };
        }
        config
    }

    #[test]
    fn frozen_parameters_rest_and_others_have_their_own_rates() {
        let data = Arc::new(embedded(Split::Train, 12));
        for config in [tiny(), tiny_table()] {
            for round in 0..3 {
                let mut trainer = Trainer::new(config.clone(), data.clone()).unwrap();
                let params = &mut trainer.model.params;
                let names: Vec<String> = params.names().map(String::from).collect();
                let rests = |name: &str| names.iter().position(|other| other == name).is_some_and(|i| i % 3 == round);
                if round == 1 {
                    params.set_rate(rests, 0.0)
                } else {
                    params.freeze(rests)
                };
                let before = params.clone();
                for _ in 0..2 {
                    trainer.step(0.1);
                }
                assert!(trainer.stats().skipped == 0 && !trainer.stats().has_diverged());
                for ((name, before), after) in before.iter().zip(trainer.model.params.values()) {
                    assert_eq!(before == after, rests(name), "{name}, round {round}");
                }
                // What was frozen is moved again.
                trainer.model.params.unfreeze(|_| true);
                let before = trainer.model.params.clone();
                trainer.step(0.1);
                let moved = |(before, after)| before != after;
                let count =
                    before.values().iter().zip(trainer.model.params.values()).filter(|&pair| moved(pair)).count();
                assert_eq!(count == before.len(), round != 1, "round {round}");
            }
        }
    }

    #[test]
    fn a_run_whose_networks_overflow_ends_although_parameters_move() {
        let data = Arc::new(embedded(Split::Train, 12));
        let mut trainer = Trainer::new(tiny_table(), data).unwrap();
        trainer.step(0.0);
        let ids: Vec<_> = trainer.model.params.ids().collect();
        for id in ids {
            if trainer.model.params.name(id).contains("color.0") {
                let weights = trainer.model.params.get_mut(id).as_mut_slice();
                weights.iter_mut().enumerate().for_each(|(i, x)| *x = if i % 2 == 0 { 3e38 } else { -3e38 });
            }
        }
        trainer.run(Budget::Steps(1000), |_| ControlFlow::Continue(()));
        assert!(trainer.stats().has_diverged() && trainer.stats().step < 200, "{:?}", trainer.stats());
    }

    #[test]
    fn a_run_that_has_diverged_ends() {
        let data = Arc::new(embedded(Split::Train, 12));
        for config in [tiny(), tiny_table()] {
            let mut trainer = Trainer::new(config, data.clone()).unwrap();
            trainer.step(0.0);
            trainer.model.params.values_mut().iter_mut().for_each(|x| x.as_mut_slice().fill(f32::NAN));
            trainer.run(Budget::Steps(1000), |trainer| {
                assert!(trainer.stats().stuck + 1 == trainer.stats().step && trainer.stats().skipped > 0);
                ControlFlow::Continue(())
            });
            assert!(trainer.stats().has_diverged() && trainer.stats().step == 1 + STUCK);
        }
    }

    #[test]
    fn settings_of_optimisers_are_checked() {
        let mut config = Config { schedule: Schedule::Constant { rate: 1e300 }, ..tiny() };
        let message = |config: &Config| config.check().unwrap_err().to_string();
        assert_eq!(message(&config), "`schedule.constant.rate`: is 1e300; use 0 to 1e30");
        config.schedule = Schedule::Constant { rate: 0.1 };
        config.adam.beta1 = 1.0;
        assert_eq!(message(&config), "`adam.beta1`: is 1.0; use at least 0 and less than 1");
        config.adam.beta1 = 0.0;
        config.table_adam.beta2 = 2.0;
        assert!(message(&config).contains("`table_adam.beta2`: is 2.0"));
        assert!(Trainer::new(config, Arc::new(embedded(Split::Train, 12))).is_err());
    }
}
