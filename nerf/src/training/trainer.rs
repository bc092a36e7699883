//! The trainer: tiles of rays on all cores, with the same bits on any number of threads.

use super::across::Across;
use super::groups::Groups;
use super::pass::{Work, rays_loss};
use super::startup;
use super::stats::{Budget, MOST_RAYS, StepStats};
use crate::camera::Camera;
use crate::dataset::batch::Batch;
use crate::dataset::{Dataset, SceneType};
use crate::encoding::hash_grid::HashGrad;
use crate::imaging::metrics::psnr_from_mse;
use crate::model::config::Config;
use crate::model::{Model, POSES, SceneBox, densities};
use crate::random::{Jitter, stream};
use crate::sampling::marching::TILES;
use crate::sampling::{BatchSize, Progress};
use crate::space::occupancy::Shares;
use crate::{Error, Result};
use raygrad_autograd::{Error as GraphError, Pool, Tape, Var};
use raygrad_nn::{Bound, Exchange, ExchangeError, Tiles};
use std::ops::{Add, ControlFlow};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// The fewest rays per step, if a number of samples is configured.
const FEWEST_RAYS: usize = 256;
/// Steps between releases of unused memory: the number of samples changes during training.
const TRIM_EVERY: u64 = 256;
/// The most time that counts for a step: so many times the mean of the steps before, and no less than this.
const STOPPED_SHARE: u32 = 20;
const STOPPED: Duration = Duration::from_secs(10);
/// The fewest steps of a model, and rays of an image, after which poses are checked: they begin at 0 and need time to
/// move.
const CHECKED_STEPS: u64 = 100;
/// The factor of the poses' learning rate once the given poses are right.
const RIGHT_LR_SCALE: f64 = 0.02;

/// Trains a model on a dataset: [`run`](Self::run) for a budget, or [`step`](Self::step) by step.
///
/// Results have the same bits on any number of threads. The [state](Self::state) saves a run to resume it.
pub struct Trainer {
    /// The current model.
    pub model: Model<f32>,
    data: Arc<Dataset>,
    pub(super) groups: Groups,
    tiles: Tiles<f32>,
    /// Other processes that train this model.
    pub(super) across: Option<Across>,
    /// Memory for work outside of tiles.
    pool: Pool<f32>,
    /// Rays of the next step.
    pub(super) batch: usize,
    /// The clock.
    clock: Box<dyn Fn() -> Duration + Send + Sync>,
    pub(super) elapsed: Duration,
    /// Collapsed models of this run.
    pub(super) collapses: u32,
    /// The lr scale.
    pub(super) lr_scale: f64,
    pub(super) done: StepStats,
    /// Whether only cameras are fitted, to a model that stays as it is.
    pub(super) is_fixed: bool,
}

/// Tiles that read the table gradients of other processes.
fn new_tiles() -> Tiles<f32> {
    Tiles::new().with_reader(HashGrad::<f32>::KIND, HashGrad::read)
}

/// The rays of a step, drawn tile by tile.
struct Draw<'a> {
    model: &'a Model<f32>,
    data: &'a Dataset,
    seed: u64,
    /// The step's number.
    number: u64,
    fraction: f64,
    /// Rays of the step, and of a tile.
    total: usize,
    tile: usize,
}

impl<'a> Draw<'a> {
    fn new(model: &'a Model<f32>, data: &'a Dataset, seed: u64, number: u64, fraction: f64, total: usize) -> Self {
        let size = model.sampler.batch_size();
        let tile = match size {
            BatchSize::Rays { tile, .. } => tile,
            BatchSize::Samples { .. } => total.div_ceil(size.tile_count()),
        };
        Draw { model, data, seed, number, fraction, total, tile }
    }

    fn tiles(&self) -> usize {
        self.total.div_ceil(self.tile)
    }

    /// A tile's part of the step's mean loss, and its counts.
    fn loss<'t>(&self, which: usize, params: &Bound<'t, f32>) -> (Var<'t, f32>, Work) {
        let Draw { model, data, seed, number, fraction, total, tile } = *self;
        let rng = &mut stream(seed, [number, which as u64]);
        let count = tile.min(total - which * tile);
        let batch = Batch::draw(data, count, model.reach(), model.config.training_background(), rng);
        let (loss, work) = rays_loss(model, params, &batch, fraction, &mut Jitter::Random(rng));
        (loss * (1.0 / (3.0 * total as f64)), work)
    }
}

impl Trainer {
    /// Creates a model and its trainer for a dataset.
    ///
    /// # Errors
    /// If the configuration is out of range or does not fit the [type of scene](Dataset::scene_type). If the dataset
    /// has no frame, or none of its rays [meets the scene box](Dataset::check_reach).
    pub fn new(config: Config, data: Arc<Dataset>) -> Result<Self> {
        if data.scene_type.is_unbounded() && !config.unbounded {
            let what = "is false, but the dataset is unbounded; use `Config::with_scene_type` with the dataset's type";
            return Err(Error::setting("unbounded", what));
        }
        let ndc = data.ndc.filter(|_| data.scene_type == SceneType::ForwardFacing);
        if data.scene_type == SceneType::ForwardFacing && ndc.is_none() {
            let what = "forward-facing needs `Dataset::ndc`, which `Ndc::around` finds; otherwise use unbounded";
            return Err(Error::setting("scene-type", what));
        }
        let extent = SceneBox { transform: data.transform, ndc, ..SceneBox::new(data.bounds, [data.near, data.far]) };
        Trainer::with_scene_box(config, data, extent)
    }

    /// Creates a trainer as [`new`](Self::new), with this scene box instead of the dataset's: for instance to
    /// [resume](Self::load_state) a run with that of its model.
    ///
    /// # Errors
    /// As [`new`](Self::new).
    pub fn with_scene_box(config: Config, data: Arc<Dataset>, extent: SceneBox) -> Result<Self> {
        let start = Instant::now();
        Trainer::with_clock(config, data, extent, move || start.elapsed())
    }

    /// Creates a trainer as [`with_scene_box`](Self::with_scene_box), with a clock for training time, which returns the
    /// time since a fixed moment.
    ///
    /// # Errors
    /// As [`new`](Self::new).
    pub fn with_clock(
        config: Config,
        data: Arc<Dataset>,
        extent: SceneBox,
        clock: impl Fn() -> Duration + Send + Sync + 'static,
    ) -> Result<Self> {
        if data.frames.is_empty() {
            return Err(Error::setting("dataset", "has no frames; load a split that has images"));
        }
        let extent = SceneBox { frames: data.frames.len(), ..extent };
        let cameras: Vec<Camera> = data.frames.iter().map(|frame| frame.camera.clone()).collect();
        let (model, restarts) = startup::living_model(&config, extent, &cameras, config.seed)?;
        data.check_reach(model.reach())?;
        data.check_distances(model.loss_terms.iter().any(|term| term.needs_distances()))?;
        let mut trainer = Trainer {
            groups: Groups::new(&model.config, &model.params)?,
            tiles: new_tiles(),
            across: None,
            pool: Pool::new(),
            batch: match model.sampler.batch_size() {
                BatchSize::Rays { step, .. } => step,
                BatchSize::Samples { .. } => FEWEST_RAYS,
            },
            model,
            data,
            clock: Box::new(clock),
            elapsed: Duration::ZERO,
            collapses: 0,
            lr_scale: 1.0,
            done: StepStats { restarts, ..StepStats::default() },
            is_fixed: false,
        };
        trainer.prepare();
        Ok(trainer)
    }

    /// Lets the sampler prepare from the images; the time counts as training.
    fn prepare(&mut self) {
        let start = (self.clock)();
        // Carved space never comes back, so cameras must be right.
        let camera = self.model.config.camera_optimizer;
        let only_poses = camera.focal.is_none() && camera.lens.is_none();
        if self.model.camera_optimizer.is_none() || (only_poses && self.done.given_poses_are_right()) {
            self.model.sampler.prepare(&self.data);
        }
        self.count_occupied();
        self.elapsed += (self.clock)().saturating_sub(start);
    }

    fn count_occupied(&mut self) {
        self.done.occupied = self.model.sampler.grid().map_or(1.0, |grid| grid.occupied_share());
    }

    /// Returns the statistics of the last step.
    pub fn stats(&self) -> StepStats {
        self.done
    }

    /// Shares all further steps with other processes. Each has a trainer with the same configuration, images and
    /// [state](Self::state), and calls the same methods. The steps have the bits of a single process.
    ///
    /// A [time budget](Budget::Time) is counted by rank 0. A run ends in all processes if one of them breaks it. If a
    /// process is lost, [`run`](Self::run) ends, and [`exchange_error`](Self::exchange_error) says why.
    ///
    /// # Errors
    /// If a process is lost, or differs from rank 0. The error says in what. Then nothing is shared.
    pub fn share(&mut self, exchange: Box<dyn Exchange>) -> Result<()> {
        let mut state = self.groups.state(&self.model.params)?;
        self.model.sampler.training_state().into_iter().for_each(|(_, bytes)| state.extend(bytes));
        let place = (self.done.step, self.batch);
        self.across = Some(Across::new(exchange, (&self.model, &state), &self.data, place)?);
        Ok(())
    }

    /// The exchange with the other processes, if steps are [shared](Self::share): for messages between runs.
    pub fn exchange_mut(&mut self) -> Option<&mut dyn Exchange> {
        match &mut self.across {
            Some(across) => Some(&mut *across.exchange),
            None => None,
        }
    }

    /// The reason that a [shared](Self::share) run has ended early.
    pub fn exchange_error(&self) -> Option<&ExchangeError> {
        self.across.as_ref()?.error.as_ref()
    }

    /// Agrees with the other processes on the training time, and whether to continue the run.
    fn agrees_to_go_on(&mut self, budget: Budget) -> bool {
        let Some(across) = &mut self.across else { return true };
        let place = (self.done.step, self.elapsed);
        let agreed = across.begin(place, (budget, self.lr_scale), &self.model.params);
        self.elapsed = agreed.unwrap_or(self.elapsed);
        agreed.is_some()
    }

    /// Trains until the budget is used up, `observe` breaks, or the run has [diverged](StepStats::has_diverged).
    ///
    /// `observe` is called after every step; its time does not count.
    pub fn run(&mut self, budget: Budget, mut observe: impl FnMut(&Trainer) -> ControlFlow<()>) {
        self.across.iter_mut().for_each(|across| across.stops = false);
        while self.agrees_to_go_on(budget) {
            let fraction = match budget {
                Budget::Steps(0) => 1.0,
                Budget::Steps(steps) => self.done.step as f64 / steps as f64,
                Budget::Time(time) => self.elapsed.as_secs_f64() / time.as_secs_f64().max(1e-9),
            };
            if fraction >= 1.0 {
                break;
            }
            self.step(fraction);
            if self.exchange_error().is_some() {
                break;
            }
            let breaks = observe(self).is_break();
            match &mut self.across {
                // The others learn of it before the next step.
                Some(across) => across.stops = breaks,
                None if breaks => break,
                None => {}
            }
            if self.done.has_diverged() {
                break;
            }
        }
        let start = (self.clock)();
        // Frees the memory of steps before the last grid update, which needs its own.
        (self.tiles, self.pool) = (new_tiles(), Pool::new());
        // A model with non-finite parameters cannot update the grid.
        if !self.done.has_diverged() {
            self.model.finish();
        }
        self.count_occupied();
        self.elapsed += (self.clock)().saturating_sub(start);
    }

    /// The part of a step's time that counts as training: the process may have been stopped meanwhile, by a terminal or a
    /// batch system.
    fn counted(&self, time: Duration) -> Duration {
        match u32::try_from(self.done.step) {
            Ok(steps @ 1..) => time.min((STOPPED_SHARE * self.elapsed / steps).max(STOPPED)),
            _ => time,
        }
    }

    /// Performs one training step; `fraction` of the run (0 to 1) sets the schedules. If the step is
    /// [shared](Self::share) and a process is lost, no gradient step is made, and the statistics stay as they are.
    pub fn step(&mut self, fraction: f64) -> StepStats {
        if self.exchange_error().is_some() {
            return self.done;
        }
        self.check_poses(fraction);
        let start = (self.clock)();
        if self.model.config.camera_optimizer.coarse > 0.0 {
            let detail = self.model.config.camera_optimizer.detail(fraction);
            self.model.set_detail(if self.done.given_poses_are_right() { 1.0 } else { detail });
        }
        // After a restart, steps of the new model count.
        if !self.is_fixed {
            self.update_sampler(&Progress { step: self.groups.steps() + 1, train_frac: fraction, seed: self.seed() });
        }
        if self.exchange_error().is_some() {
            return self.done;
        }
        let number = self.done.step + 1;
        let draw = Draw::new(&self.model, &self.data, self.seed(), number, fraction, self.batch);
        let (params, count, tiles) = (&self.model.params, draw.tiles(), &self.tiles);
        let step = match &mut self.across {
            None => tiles.differentiate(params, count, |which, params, ()| draw.loss(which, params)),
            Some(Across { exchange, error, .. }) => {
                let step = tiles
                    .differentiate_across(&mut **exchange, params, count, |which, params, ()| draw.loss(which, params));
                match step {
                    Ok(step) => step,
                    Err(lost) => {
                        *error = Some(lost);
                        return self.done;
                    }
                }
            }
        };
        let report = self.groups.update(&mut self.model.params, &step.grads, fraction, self.lr_scale);
        if number.is_multiple_of(TRIM_EVERY) {
            self.tiles.trim();
            self.pool.trim();
        }
        let work = step.results.into_iter().fold(Work::default(), Work::add);
        let values = 3.0 * self.batch as f64;
        self.elapsed += self.counted((self.clock)().saturating_sub(start));
        self.done = StepStats {
            step: number,
            train_seconds: self.elapsed.as_secs_f64(),
            rays: self.done.rays + self.batch as u64,
            placed_samples: self.done.placed_samples + work.marched,
            density_queries: self.done.density_queries + work.evaluations.density,
            color_queries: self.done.color_queries + work.evaluations.color,
            unskipped: self.done.unskipped + work.evaluations.unskipped,
            moved: self.done.moved + report.updated as u64,
            loss: work.loss / values,
            psnr: psnr_from_mse(work.error / values),
            opacity: work.opacity / self.batch as f64,
            occupied: self.done.occupied,
            lr: self.lr_scale * self.model.config.schedule.lr(fraction),
            non_finite: self.done.non_finite + report.skipped as u64,
            // A network may turn NaN into gradients of 0, which still move parameters.
            non_finite_steps: if report.has_only_non_finite() || !work.loss.is_finite() {
                self.done.non_finite_steps + 1
            } else {
                0
            },
            restarts: self.done.restarts,
            pose_motion: self.done.pose_motion,
        };
        self.adapt_batch(&work);
        if !self.is_fixed && startup::has_collapsed(self.groups.steps(), self.done.opacity, self.collapses) {
            self.restart();
        }
        self.done
    }

    /// Checks the poses, once in a run. If refinement hardly moved them, the given ones are right. Training then
    /// continues from them as with fixed cameras, except for a low learning rate of the poses.
    fn check_poses(&mut self, fraction: f64) {
        let check_at = self.model.config.camera_optimizer.check_at;
        // The steps are those of the model, as a restart begins with the given poses.
        let updates = self.groups.steps().min(self.done.rays / self.data.frames.len().max(1) as u64);
        let is_due = check_at > 0.0 && fraction >= check_at && updates >= CHECKED_STEPS;
        let Some(optimizer) = self.model.camera_optimizer.as_ref().filter(|_| is_due) else { return };
        if self.done.pose_motion.is_some() {
            return;
        }
        self.done.pose_motion = optimizer.pose_motion(&self.model.params);
        if self.done.given_poses_are_right() {
            optimizer.reset_poses(&mut self.model.params);
            if let Some(poses) = self.model.params.find(POSES) {
                let scale = RIGHT_LR_SCALE * self.model.params.lr_scale(poses);
                self.model.params.set_lr_scale(|name| name == POSES, scale);
            }
            self.prepare();
        }
    }

    /// The seed of the current model: a restart draws other rays too.
    fn seed(&self) -> u64 {
        self.model.config.seed.wrapping_add(u64::from(self.done.restarts) << 32)
    }

    /// The rays of the next step.
    fn draw(&self, fraction: f64) -> Draw<'_> {
        Draw::new(&self.model, &self.data, self.seed(), self.done.step + 1, fraction, self.batch)
    }

    /// Returns the lr scale, initially 1.
    pub fn lr_scale(&self) -> f64 {
        self.lr_scale
    }

    /// Sets the lr scale, which multiplies all learning rates from the next step on. It is part of the
    /// [state](Self::state).
    ///
    /// # Panics
    /// If it is negative or not finite.
    pub fn set_lr_scale(&mut self, lr_scale: f64) {
        assert!(lr_scale >= 0.0 && lr_scale.is_finite(), "the lr scale must be finite and at least 0, is {lr_scale}");
        self.lr_scale = lr_scale;
    }

    /// Finds the first infinite or NaN value that the next step would compute, with `fraction` as in
    /// [`step`](Self::step).
    ///
    /// The error names the operation or gradient, the source line that recorded it and the element; see
    /// [`Tape::check_finite`]. Returns `None` if all values are finite. It explains why a run [has
    /// diverged](StepStats::has_diverged).
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

    /// Chooses the number of rays for the configured number of samples per step.
    fn adapt_batch(&mut self, work: &Work) {
        if let BatchSize::Samples { step: samples, .. } = self.model.sampler.batch_size() {
            let each = (work.marched as f64 / self.batch as f64).max(0.5);
            let rays = samples as f64 / each;
            // Averaged, since the number of samples per ray is noisy.
            let rays = (0.5 * (rays + self.batch as f64)).min(2.0 * self.batch as f64) as usize;
            self.batch = rays.next_multiple_of(TILES).clamp(FEWEST_RAYS, MOST_RAYS);
        }
    }

    fn update_sampler(&mut self, progress: &Progress) {
        let Model { sampler, field, params, .. } = &mut self.model;
        let pool = &self.pool;
        let density = |points: &[[f32; 3]], out: &mut [f32]| densities(&**field, params, pool, points, out);
        let has_changed = match &mut self.across {
            None => sampler.update(progress, &density),
            Some(across) => {
                let (rank, ranks) = (across.exchange.rank(), across.exchange.ranks());
                let gather = &mut |own: Vec<f32>, counts: &[usize]| across.gather(&own, counts);
                sampler.update_shared(progress, &density, &mut Shares { rank, ranks, gather })
            }
        };
        if has_changed {
            self.count_occupied();
        }
    }

    /// Restarts with other random parameters.
    fn restart(&mut self) {
        self.done.restarts += 1;
        self.collapses += 1;
        let Model { config, scene_box: extent, .. } = &self.model;
        if let Ok((mut model, _)) = startup::living_model(config, *extent, self.model.cameras(), self.seed()) {
            // Loaded and frozen values, and lr scales, are kept.
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
mod tests;
