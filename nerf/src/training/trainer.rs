//! Training: tiles of rays on as many cores as there are, and the same bits on any number of them.

use super::groups::Groups;
use super::pass::{Work, rays_loss};
use super::startup;
use super::stats::{Budget, StepStats};
use crate::camera::Camera;
use crate::dataset::batch::Batch;
use crate::dataset::{Dataset, Scope};
use crate::model::config::Config;
use crate::model::{Extent, Model, densities};
use crate::pictures::metrics::psnr_from_mse;
use crate::random::{Jitter, stream};
use crate::sampling::{Load, Progress};
use crate::{Error, Result};
use raygrad_autograd::{Error as GraphError, Pool, Tape, Var};
use raygrad_nn::{Bound, SLOTS, Tiles};
use std::ops::{Add, ControlFlow};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Rays of a step that is to have a number of samples: the least, and the most.
const RAYS: [usize; 2] = [256, 1 << 16];
/// Steps between the times when memory that they did not need is freed: the number of samples changes as training goes on.
const TRIM_EVERY: u64 = 256;

/// A model in training.
pub struct Trainer {
    /// The model as it is now.
    pub model: Model<f32>,
    data: Arc<Dataset>,
    pub(super) groups: Groups,
    tiles: Tiles<f32>,
    /// For what happens outside of the tiles.
    pool: Pool<f32>,
    /// Rays of the next step.
    pub(super) batch: usize,
    /// What time it is.
    clock: Box<dyn Fn() -> Duration + Send + Sync>,
    pub(super) elapsed: Duration,
    /// How many models of this run have collapsed.
    pub(super) collapses: u32,
    /// What all learning rates are multiplied by.
    pub(super) pace: f64,
    pub(super) done: StepStats,
}

/// The rays of a step, which are drawn tile by tile.
struct Draw<'a> {
    model: &'a Model<f32>,
    data: &'a Dataset,
    seed: u64,
    /// The number of the step.
    number: u64,
    fraction: f64,
    /// Rays of the step, and of a tile.
    total: usize,
    tile: usize,
}

impl Draw<'_> {
    fn tiles(&self) -> usize {
        self.total.div_ceil(self.tile)
    }

    /// The share of a tile in the mean loss of the step, and what it took.
    fn loss<'t>(&self, which: usize, params: &Bound<'t, f32>) -> (Var<'t, f32>, Work) {
        let Draw { model, data, seed, number, fraction, total, tile } = *self;
        let rng = &mut stream(seed, [number, which as u64]);
        let count = tile.min(total - which * tile);
        let batch = Batch::draw(data, count, model.reach(), model.config.background, rng);
        let (loss, work) = rays_loss(model, params, &batch, fraction, &mut Jitter::Random(rng));
        (loss * (1.0 / (3.0 * total as f64)), work)
    }
}

impl Trainer {
    /// A new model for a dataset.
    ///
    /// # Errors
    /// If the configuration is out of range or not for a scene that [goes so far](Dataset::scope), the dataset has no frame, or no
    /// ray of it [meets the scene's box](Dataset::check_reach).
    pub fn new(config: Config, data: Arc<Dataset>) -> Result<Self> {
        let start = Instant::now();
        Trainer::with_clock(config, data, move || start.elapsed())
    }

    /// As [`new`](Self::new), with a clock of one's own: the time since some moment, which training time is measured by.
    ///
    /// # Errors
    /// As [`new`](Self::new).
    pub fn with_clock(
        config: Config,
        data: Arc<Dataset>,
        clock: impl Fn() -> Duration + Send + Sync + 'static,
    ) -> Result<Self> {
        if data.scope.goes_on() && !config.unbounded {
            let what = "is false, and the photographs show what lies beyond the scene's box; use `Config::with_scope` with \
                        the scope of the dataset";
            return Err(Error::setting("unbounded", what));
        }
        let ndc = data.ndc.filter(|_| data.scope == Scope::Forward);
        if data.scope == Scope::Forward && ndc.is_none() {
            let what =
                "forward needs what all photographs show, `Dataset::ndc`, which `Ndc::around` finds; use unbounded";
            return Err(Error::setting("scope", what));
        }
        let extent = Extent { placement: data.placement, ndc, ..Extent::new(data.bounds, [data.near, data.far]) };
        Trainer::within(config, data, extent, clock)
    }

    /// As [`new`](Self::new), for a scene that lies as `extent` says, whatever the dataset says: to
    /// [go on](Self::load_state) with a run of which no more is known than its model.
    ///
    /// # Errors
    /// As [`new`](Self::new).
    pub fn with_extent(config: Config, data: Arc<Dataset>, extent: Extent) -> Result<Self> {
        let start = Instant::now();
        Trainer::within(config, data, extent, move || start.elapsed())
    }

    /// The same, with a clock.
    pub(super) fn within(
        config: Config,
        data: Arc<Dataset>,
        extent: Extent,
        clock: impl Fn() -> Duration + Send + Sync + 'static,
    ) -> Result<Self> {
        if data.frames.is_empty() {
            return Err(Error::setting("dataset", "has no frames to train on"));
        }
        let extent = Extent { frames: data.frames.len(), ..extent };
        let cameras: Vec<Camera> = data.frames.iter().map(|frame| frame.camera.clone()).collect();
        let (model, restarts) = startup::living_model(&config, extent, &cameras, config.seed)?;
        data.check_reach(model.reach())?;
        data.check_distances(model.terms.iter().any(|term| term.reads_distances()))?;
        let mut trainer = Trainer {
            groups: Groups::new(&model.config, &model.params)?,
            tiles: Tiles::new(),
            pool: Pool::new(),
            batch: match model.sampler.load() {
                Load::Rays { step, .. } => step,
                Load::Samples(_) => RAYS[0],
            },
            model,
            data,
            clock: Box::new(clock),
            elapsed: Duration::ZERO,
            collapses: 0,
            pace: 1.0,
            done: StepStats { restarts, ..StepStats::default() },
        };
        trainer.prepare();
        Ok(trainer)
    }

    /// Lets the sampler learn from the photographs. That is training too.
    fn prepare(&mut self) {
        let start = (self.clock)();
        // Not from cameras that are to be corrected: what is carved away never comes back.
        if self.model.refine.is_none() {
            self.model.sampler.prepare(&self.data);
        }
        self.count_occupied();
        self.elapsed += (self.clock)().saturating_sub(start);
    }

    fn count_occupied(&mut self) {
        self.done.occupied = self.model.sampler.grid().map_or(1.0, |grid| grid.occupied_share());
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
        let start = (self.clock)();
        // What the last look at the field takes is not to stand beside what steps took.
        (self.tiles, self.pool) = (Tiles::new(), Pool::new());
        // A model of numbers that are none has nothing to look at.
        if !self.done.has_diverged() {
            self.model.finish();
        }
        self.count_occupied();
        self.elapsed += (self.clock)().saturating_sub(start);
    }

    /// One training step; `fraction` says how much of the run is done, for the schedule.
    pub fn step(&mut self, fraction: f64) -> StepStats {
        let start = (self.clock)();
        if self.model.config.refine.coarse > 0.0 {
            self.model.set_detail(self.model.config.refine.detail(fraction));
        }
        // Of a model that began again, from its own beginning.
        self.update_sampler(&Progress { step: self.groups.steps() + 1, fraction, seed: self.seed() });
        let mut tiles = std::mem::take(&mut self.tiles);
        let draw = self.draw(fraction);
        let number = draw.number;
        let step = tiles.differentiate(&self.model.params, draw.tiles(), |which, params, ()| draw.loss(which, params));
        let report = self.groups.update(&mut self.model.params, &step.grads, fraction, self.pace);
        tiles.take_back(step.grads);
        self.tiles = tiles;
        if number.is_multiple_of(TRIM_EVERY) {
            self.tiles.trim();
            self.pool.trim();
        }
        let work = step.results.into_iter().fold(Work::default(), Work::add);
        let values = 3.0 * self.batch as f64;
        self.elapsed += (self.clock)().saturating_sub(start);
        self.done = StepStats {
            step: number,
            train_seconds: self.elapsed.as_secs_f64(),
            rays: self.done.rays + self.batch as u64,
            marched: self.done.marched + work.marched,
            samples: self.done.samples + work.samples,
            shaded: self.done.shaded + work.shaded,
            unskipped: self.done.unskipped + work.unskipped,
            moved: self.done.moved + report.moved as u64,
            loss: work.loss / values,
            psnr: psnr_from_mse(work.error / values),
            opacity: work.opacity / self.batch as f64,
            occupied: self.done.occupied,
            rate: self.pace * self.model.config.schedule.rate(fraction),
            skipped: self.done.skipped + report.skipped as u64,
            // A network may turn NaN into gradients of 0, with which parameters do move.
            stuck: if report.is_stuck() || !work.loss.is_finite() { self.done.stuck + 1 } else { 0 },
            restarts: self.done.restarts,
        };
        self.adapt_batch(&work);
        if startup::has_collapsed(self.groups.steps(), self.done.opacity, self.collapses) {
            self.restart();
        }
        self.done
    }

    /// A restart draws other rays too.
    fn seed(&self) -> u64 {
        self.model.config.seed.wrapping_add(u64::from(self.done.restarts) << 32)
    }

    /// The rays of the next step.
    fn draw(&self, fraction: f64) -> Draw<'_> {
        let (number, total) = (self.done.step + 1, self.batch);
        let tile = match self.model.sampler.load() {
            Load::Rays { tile, .. } => tile,
            // With more, smaller tiles, recording them would cost a two-core machine an eighth of its time.
            Load::Samples(_) => total.div_ceil(SLOTS),
        };
        Draw { model: &self.model, data: &self.data, seed: self.seed(), number, fraction, total, tile }
    }

    /// What the learning rates of all schedules are multiplied by; 1 at first.
    pub fn pace(&self) -> f64 {
        self.pace
    }

    /// Multiplies the learning rates of all schedules by `pace`, from the next step on; part of the [state](Self::state).
    ///
    /// # Panics
    /// If it is negative or not finite.
    pub fn set_pace(&mut self, pace: f64) {
        assert!(pace >= 0.0 && pace.is_finite(), "rates times {pace}");
        self.pace = pace;
    }

    /// What would be infinite or NaN first if the next step were taken, `fraction` as in [`step`](Self::step): the operation
    /// or the gradient, the line that recorded it and the element, as the [NaN finder](Tape::check_finite) names them.
    /// Nothing if nothing would. Of a run that [has diverged](StepStats::has_diverged) it is the reason.
    pub fn first_non_finite(&self, fraction: f64) -> Option<GraphError> {
        let draw = self.draw(fraction);
        let find = |which| {
            let tape = Tape::with_pool(self.pool.clone());
            tape.check_finite(true);
            let run = || {
                let params = self.model.params.bind(&tape);
                let vars = params.vars();
                let loss = draw.loss(which, &params).0.tracked();
                if !vars.is_empty() {
                    loss.backward(&vars);
                }
            };
            tape.try_run(run).err()
        };
        (0..draw.tiles()).find_map(find)
    }

    /// Chooses the number of rays so that the next step has as many samples as it should.
    fn adapt_batch(&mut self, work: &Work) {
        if let Load::Samples(samples) = self.model.sampler.load() {
            let each = (work.marched as f64 / self.batch as f64).max(0.5);
            let rays = samples as f64 / each;
            // Not at once: the number of samples a ray is noisy.
            let rays = (0.5 * (rays + self.batch as f64)).min(2.0 * self.batch as f64) as usize;
            self.batch = rays.next_multiple_of(SLOTS).clamp(RAYS[0], RAYS[1]);
        }
    }

    fn update_sampler(&mut self, progress: &Progress) {
        let Model { sampler, field, params, .. } = &mut self.model;
        let pool = &self.pool;
        if sampler.update(progress, &|points, out| densities(&**field, params, pool, points, out)) {
            self.count_occupied();
        }
    }

    /// Begins again with other random parameters.
    fn restart(&mut self) {
        let config = self.model.config.clone();
        self.done.restarts += 1;
        self.collapses += 1;
        let seed = config.seed.wrapping_add(u64::from(self.done.restarts) << 32);
        if let Ok((mut model, _)) = startup::living_model(&config, self.model.extent, self.model.cameras(), seed) {
            // What was loaded and frozen is not thrown away, and rates are not forgotten.
            model.params.inherit(&self.model.params);
            self.model = model;
        }
        self.prepare();
        if let Ok(groups) = Groups::new(&self.model.config, &self.model.params) {
            self.groups = groups;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::{
        Split,
        sample::{ball, ball_ahead},
    };
    use crate::encoding::hash_grid::HashGridConfig;
    use crate::field::{ClassicConfig, InstantConfig};
    use crate::model::Refined;
    use crate::sampling::SamplerConfig;
    use crate::sampling::hierarchical::HierarchicalConfig;
    use crate::sampling::marching::MarchingConfig;
    use crate::training::stats::STUCK;
    use crate::{FieldConfig, Preset};
    use glam::DVec3;
    use raygrad_autograd::Tensor;
    use raygrad_nn::Schedule;

    #[test]
    fn cameras_from_which_nothing_of_the_box_is_seen_are_an_error() {
        let mut data = ball(Split::Train, 8);
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
        assert!(data.check_reach(data.bounds).is_err());
    }

    #[test]
    fn fields_live_in_the_picture_of_all_that_photographs_show() {
        let data = ball_ahead(8);
        let ndc = data.ndc.unwrap();
        assert!(data.frames.iter().all(|frame| ndc.pixels(&frame.camera, DVec3::ZERO) < 20.0));
        assert!((data.footprints() - ndc.pixels(&data.frames[2].camera, DVec3::ZERO)).abs() < 2.0);
        let config = tiny_table().with_scope(data.scope);
        let trainer = Trainer::new(config.clone(), Arc::new(data.clone())).unwrap();
        assert_eq!(trainer.model.extent.ndc, Some(ndc));
        // Before its near plane all places of a line from the eye are one, and beside it not.
        let places = [0.5, 0.9, 1.5].map(|depth| ndc.eye - depth * ndc.near * ndc.axes.z_axis);
        let places = places.map(|place| place.as_vec3().to_array());
        let densities = |trainer: &Trainer| {
            let mut densities = [0.0; 3];
            trainer.model.densities(&places, &mut densities);
            densities
        };
        let [a, b, c] = densities(&trainer);
        assert!((a - b).abs() < 1e-7 && (a - c).abs() > 1e-6, "{a} {b} {c}");
        let unbounded = Dataset { scope: Scope::Unbounded, ..data.clone() };
        assert!(unbounded.footprints() != data.footprints());
        let other = Trainer::new(config.clone(), Arc::new(unbounded)).unwrap();
        assert_eq!(other.model.extent.ndc, None);
        let [a, b, _] = densities(&other);
        assert!((a - b).abs() > 1e-6, "{a} {b}");
        let refused = |config: &Config, data: &Dataset| {
            Trainer::new(config.clone(), Arc::new(data.clone())).err().unwrap().to_string()
        };
        assert!(refused(&tiny_table(), &data).contains("`unbounded`"));
        assert!(refused(&config, &Dataset { ndc: None, ..data.clone() }).contains("Ndc::around"));
        // The rest of its state goes with it.
        let mut trainer = trainer;
        trainer.step(0.0);
        let state = trainer.state().unwrap();
        let mut later = Trainer::new(config, Arc::new(data)).unwrap();
        later.load_state(&state).unwrap();
        assert_eq!(later.step(0.5).loss, trainer.step(0.5).loss);
        assert_eq!(trainer.model.cast::<f64>().unwrap().extent.ndc, Some(ndc));
    }

    #[test]
    fn what_steps_did_adds_up_and_an_error_is_of_one_of_them() {
        let mut data = ball(Split::Train, 8);
        data.frames.truncate(3);
        let config = Config { background: crate::Background::White, ..tiny_table() };
        let mut trainer = Trainer::new(config, Arc::new(data)).unwrap();
        let counts = |trainer: &mut Trainer| {
            trainer.step(0.0);
            let StepStats { rays, marched, samples, shaded, unskipped, moved, loss, psnr, .. } = trainer.stats();
            assert!((psnr - psnr_from_mse(loss)).abs() < 1e-9 && psnr > 1.0, "{psnr} {loss}");
            [rays, marched, samples, shaded, unskipped, moved]
        };
        let [first, second, third] = [(); 3].map(|()| counts(&mut trainer));
        for i in 0..6 {
            // A step is not much larger than another.
            let [a, b, c] = [first[i], second[i] - first[i], third[i] - second[i]].map(|count| count as f64);
            assert!(a > 0.0 && (0.5..2.0).contains(&(b / a)) && (0.5..2.0).contains(&(c / b)), "{i}: {a} {b} {c}");
        }
    }

    #[test]
    fn the_last_tile_of_a_step_has_the_rays_that_are_left() {
        let mut data = ball(Split::Train, 8);
        data.frames.truncate(2);
        let data = Arc::new(data);
        let marched = |batch: usize| {
            let mut config = tiny();
            config.sampler.get_mut::<HierarchicalConfig>().unwrap().batch = batch;
            let mut trainer = Trainer::new(config, data.clone()).unwrap();
            let stats = trainer.step(0.0);
            assert_eq!(stats.rays, batch as u64);
            stats.marched
        };
        assert!(marched(8) > 0);
        // Every ray takes as many steps; tiles are of eight.
        assert_eq!(8 * marched(21), 21 * marched(8));
    }

    #[test]
    fn a_restart_keeps_what_was_said_of_parameters() {
        let mut data = ball(Split::Train, 8);
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

    #[test]
    fn a_restart_knows_the_cameras_that_it_corrects() {
        let mut data = ball(Split::Train, 8);
        data.frames.truncate(3);
        let config = tiny().with_refined(&[Refined::Poses, Refined::Focal, Refined::Exposure]);
        let mut trainer = Trainer::new(config, Arc::new(data.clone())).unwrap();
        trainer.step(0.0);
        trainer.restart();
        let cameras: Vec<Camera> = data.frames.iter().map(|frame| frame.camera.clone()).collect();
        assert_eq!(trainer.model.cameras(), cameras);
        assert!(trainer.model.tone.is_some() && trainer.model.refine.is_some());
        // They are as they were given, and move on.
        let moved = |trainer: &Trainer| trainer.model.learned_camera(1, &cameras[1]) != cameras[1];
        assert!(!moved(&trainer));
        let before = trainer.stats().step;
        for fraction in [0.3, 0.4, 0.5] {
            trainer.step(fraction);
        }
        assert!(trainer.stats().step == before + 3 && moved(&trainer));
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
        let (field, sampler) = (FieldConfig::new(field), SamplerConfig::new(sampler));
        Config { field, sampler, ..Config::preset(Preset::Small) }
    }

    /// A small hash grid.
    fn tiny_table() -> Config {
        let mut config = Config::preset(Preset::Instant);
        if let Some(field) = config.field.get_mut::<InstantConfig>() {
            field.grid = HashGridConfig { levels: 3, features: 2, log2_table: 8, coarsest: 4, finest: 16 };
        }
        if let Some(sampler) = config.sampler.get_mut::<MarchingConfig>() {
            sampler.occupancy.resolution = 16;
        }
        config
    }

    #[test]
    fn frozen_parameters_rest_and_others_have_their_own_rates() {
        let data = Arc::new(ball(Split::Train, 12));
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
        let data = Arc::new(ball(Split::Train, 12));
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
        let data = Arc::new(ball(Split::Train, 12));
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
    fn what_is_not_finite_first_is_named() {
        let data = Arc::new(ball(Split::Train, 12));
        for config in [tiny(), tiny_table(), tiny().with_refined(&[Refined::Poses, Refined::Focal, Refined::Exposure])]
        {
            let mut trainer = Trainer::new(config, data.clone()).unwrap();
            for _ in 0..3 {
                assert!(trainer.first_non_finite(0.5).is_none());
                trainer.step(0.5);
            }
            // What comes of the last weights of the colours.
            let ids: Vec<_> = trainer.model.params.ids().collect();
            let last = ids.into_iter().rfind(|id| trainer.model.params.name(*id).contains("color")).unwrap();
            trainer.model.params.get_mut(last).as_mut_slice()[0] = f32::NAN;
            let error = trainer.first_non_finite(0.5).unwrap();
            let GraphError::NonFinite { value, at, .. } = &error else { panic!("{error}") };
            assert!(!value.is_finite() && at.file().ends_with(".rs") && at.line() > 0, "{error}");
            assert!(trainer.step(0.5).stuck > 0 && trainer.first_non_finite(0.5).is_some());
        }
    }

    #[test]
    fn a_slower_run_moves_less() {
        let data = Arc::new(ball(Split::Train, 12));
        let config = tiny_table().with_refined(&[Refined::Exposure]);
        let [whole, half, none] = [1.0, 0.5, 0.0].map(|factor| {
            let mut trainer = Trainer::new(config.clone(), data.clone()).unwrap();
            trainer.set_pace(factor);
            let before = trainer.model.params.clone();
            let rate = trainer.step(0.3).rate;
            let after = trainer.model.params.values().iter();
            let moved = |(a, b): (&Tensor<f32>, &Tensor<f32>)| {
                let moves = a.as_slice().iter().zip(b.as_slice()).map(|(a, b)| f64::from(a - b).abs());
                moves.fold(0.0, f64::max)
            };
            (rate, after.zip(before.values()).map(moved).collect::<Vec<f64>>())
        });
        assert!(whole.0 == 2.0 * half.0 && none.0 == 0.0 && whole.1.iter().all(|moved| *moved > 0.0), "{whole:?}");
        // Adam's first step is the rate.
        for ((whole, half), none) in whole.1.iter().zip(&half.1).zip(&none.1) {
            assert!((half / whole - 0.5).abs() < 1e-3 && *none == 0.0, "{whole} {half} {none}");
        }
    }

    #[test]
    fn steps_get_as_many_rays_as_have_the_samples_that_are_wanted() {
        let mut trainer = Trainer::new(tiny_table(), Arc::new(ball(Split::Train, 12))).unwrap();
        let mut next = |batch: usize, marched: u64| {
            trainer.batch = batch;
            trainer.adapt_batch(&Work { marched, ..Work::default() });
            trainer.batch
        };
        // 24576 samples of 8 each are 3072 rays: half of the way there.
        assert_eq!(next(1024, 8 * 1024), 2048);
        assert_eq!(next(5120, 8 * 5120), 4096);
        // At most twice as many, whole slots, and within bounds.
        assert_eq!([next(1024, 1024), next(1024, 0)], [2048; 2]);
        assert_eq!(next(1500, 8 * 1500), 2288);
        assert_eq!(next(256, 10_000_000), 256);
    }

    #[test]
    fn a_restart_draws_other_rays() {
        let data = Arc::new(ball(Split::Train, 12));
        let [one, other] = [0, 1].map(|restarts| {
            let mut trainer = Trainer::new(tiny_table(), data.clone()).unwrap();
            trainer.done.restarts = restarts;
            trainer.step(0.0).loss
        });
        assert!(one != other && one.is_finite() && other.is_finite(), "{one} {other}");
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
        assert!(Trainer::new(config, Arc::new(ball(Split::Train, 12))).is_err());
    }
}
