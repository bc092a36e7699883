//! Ray marching through the occupied cells of a grid (instant-ngp).

use super::{BatchSize, Progress, Purpose, RayTolerance, Sampled, Sampler, Samplers};
use crate::camera::rays::{Rays, Samples};
use crate::component::{BuildContext, ComponentConfig};
use crate::dataset::Dataset;
use crate::random::Jitter;
use crate::range::check_range;
use crate::space::occupancy::{
    DensityFn, MarchBuffer, OccupancyConfig, OccupancyGrid, Shares, Skip, Skipping, Step, Threshold, Update,
};
use crate::space::{silhouette, visibility};
use crate::volume::quadrature::Quadrature;
use crate::volume::query::Query;
use crate::volume::render::Evaluations;
use crate::{Error, Result};
use raygrad_autograd::{Pool, Scalar};
use raygrad_tensor::parallel::Scratch;
use serde::{Deserialize, Serialize};
use std::collections::HashMap;
use std::sync::Arc;

/// Cascades of an unbounded scene; each is twice as large as the one before.
const CASCADES: usize = 6;
/// Cells along each axis of a cascade.
const CASCADE_RESOLUTION: usize = 32;
/// Step lengths in an unbounded scene, in training and in renders, as shares of the box's side.
const CASCADE_STEP: f64 = 1.0 / 100.0;
const CASCADE_VIEW_STEP: f64 = 1.0 / 150.0;
/// Growth of the steps per unit of distance.
const CASCADE_CONE: f64 = 1.0 / 64.0;
/// The same values of a long training, whose steps shorten to the last one.
const LONG_LAST_STEP: f64 = 1.0 / 250.0;
const LONG_VIEW_STEP: f64 = 1.0 / 200.0;
const LONG_CONE: f64 = 1.0 / 100.0;

/// Configuration of a [`Marching`] sampler.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MarchingConfig {
    /// Occupancy grid, and what rendering may skip with it.
    pub occupancy: OccupancyConfig,
    /// Distance between samples along a ray in training. Unit: longest side of the scene box. Range: 0.00001 to 1.
    pub step: f64,
    /// The same at the end of training, approached evenly on a logarithmic scale; null keeps it constant. Long
    /// intervals leave samples for more rays, short ones resolve fine detail. Unit: longest side of the scene box.
    /// Range: 0.00001 to 1.
    pub last_step: Option<f64>,
    /// The same in rendering. Training starts each ray at a random offset, so finer intervals fit. Unit: longest
    /// side of the scene box. Range: 0.00001 to 1.
    pub view_step: f64,
    /// Growth of the interval with distance from the camera, a number without unit: at distance t an interval is
    /// `step + cone t` long. 0 keeps intervals even. [Cascades](Self::cascaded) use 1/64, or 1/100 in a long
    /// training, for the 1/256 of instant-ngp. Renders scale it by `view_step / step`. See [`Step::cone`]. Range: 0 to 1.
    pub cone: f64,
    /// Samples in a training step. The number of rays follows from it. Range: 1 to 16777216.
    pub samples: usize,
    /// Tiles of a training step: parts that are computed at the same time, each by one core. More tiles keep more cores
    /// busy, and cost time for recording. Another number gives another model, as another seed does. Range: 1 to 4096.
    pub tiles: usize,
    /// Early termination in training: samples are dropped where the transmittance is below this. A colour changes
    /// by at most as much. Range: 0 to 1.
    #[serde(alias = "termination")]
    pub early_stop_eps: f64,
    /// Quadrature rule for the integral along a ray.
    pub quadrature: Quadrature,
}

/// Tiles of a training step, unless more cores are there.
pub(crate) const TILES: usize = 8;

impl Default for MarchingConfig {
    fn default() -> Self {
        let occupancy = OccupancyConfig { skip: Skip::Fast.into(), ..OccupancyConfig::default() };
        MarchingConfig {
            occupancy,
            step: 1.0 / 200.0,
            last_step: None,
            // docs/benchmarks/results.md, section Rendering, has the figures.
            view_step: 1.0 / 600.0,
            cone: 0.0,
            samples: 24576,
            tiles: TILES,
            early_stop_eps: 1e-3,
            quadrature: Quadrature::Midpoint,
        }
    }
}

impl MarchingConfig {
    /// Returns the configuration for an unbounded scene: cascades of boxes, and steps that grow with the distance. If
    /// steps shorten during training, they do so here, to a finer last step. The other values stay.
    pub fn cascaded(mut self) -> Self {
        (self.occupancy.cascades, self.occupancy.resolution) = (CASCADES, CASCADE_RESOLUTION);
        self.step = CASCADE_STEP;
        (self.last_step, self.cone, self.view_step) = match self.last_step {
            Some(_) => (Some(LONG_LAST_STEP), LONG_CONE, LONG_VIEW_STEP),
            None => (None, CASCADE_CONE, CASCADE_VIEW_STEP),
        };
        self
    }
}

impl ComponentConfig<Samplers> for MarchingConfig {
    const KIND: &'static str = "marching";

    fn check(&self) -> Result<()> {
        self.occupancy.check()?;
        check_range("step", self.step, 1e-5, 1.0)?;
        self.last_step.map_or(Ok(()), |step| check_range("last_step", step, 1e-5, 1.0))?;
        check_range("view_step", self.view_step, 1e-5, 1.0)?;
        check_range("cone", self.cone, 0.0, 1.0)?;
        check_range("samples", self.samples, 1, 1 << 24)?;
        check_range("tiles", self.tiles, 1, 4096)?;
        self.quadrature.check()?;
        check_range("early_stop_eps", self.early_stop_eps, 0.0, 1.0)
    }

    fn build<T: Scalar>(&self, site: BuildContext<'_, T>) -> Result<Box<dyn Sampler<T>>> {
        let grid = OccupancyGrid::new(site.space.bounds, &self.occupancy)?;
        Ok(Box::new(Marching::new(self.clone(), grid)))
    }
}

/// Training skips cells with an optical depth per step below this, or below the mean.
const TRAINING_DEPTH: f32 = 0.01;
/// Training steps in which all cells are updated.
const WARM_UP: u64 = 256;
/// Steps between updates of the occupancy grid.
const GRID_EVERY: u64 = 16;
/// The name of the occupancy grid in a file.
const GRID: &str = "occupancy";

/// Ray marching with an occupancy grid (Mueller et al. 2022, instant-ngp).
#[derive(Debug, Clone)]
pub struct Marching {
    /// The configuration.
    pub config: MarchingConfig,
    /// The occupancy grid of training, saved with the model.
    pub grid: OccupancyGrid,
    /// The occupancy grid of renders, if it has fewer cells: see [`Sampler::finish`].
    pruned: Option<OccupancyGrid>,
    /// Fraction of training that is done, 0 to 1.
    pub progress: f64,
    /// Unused buffers.
    buffers: Arc<Scratch<MarchBuffer>>,
}

impl Marching {
    /// Creates a sampler at the start of training.
    pub fn new(config: MarchingConfig, grid: OccupancyGrid) -> Self {
        Marching { config, grid, pruned: None, progress: 0.0, buffers: Arc::default() }
    }

    /// Returns the current step length of training, in scene units.
    pub fn step(&self) -> f32 {
        let first = self.config.step;
        let last = self.config.last_step.unwrap_or(first);
        self.length(first * (last / first).powf(self.progress))
    }

    /// Returns the step length of renders, in scene units.
    pub fn view_step(&self) -> f32 {
        self.length(self.config.view_step)
    }

    /// Returns the spacing of samples in renders.
    pub fn view_spacing(&self) -> Step {
        self.spacing(self.view_step())
    }

    /// Steps of an initial length. Steps shorter than training's stay so, in proportion, along the whole ray.
    fn spacing(&self, length: f32) -> Step {
        let cone = (self.config.cone as f32 * length / self.length(self.config.step)).min(1.0);
        Step { cone, ..Step::uniform(length) }
    }

    fn length(&self, share: f64) -> f32 {
        let [low, high] = self.grid.bounds();
        (share * (high - low).max_element()) as f32
    }

    /// Returns the occupancy grid of renders.
    pub fn view_grid(&self) -> &OccupancyGrid {
        self.pruned.as_ref().unwrap_or(&self.grid)
    }

    /// Places samples in the occupied cells of a grid, at even steps from each ray's near end; also returns their
    /// number if all cells were occupied. Positions are computed in f32, so they are the same in every precision.
    pub fn march<T: Scalar>(
        &self,
        grid: &OccupancyGrid,
        rays: &Rays<T>,
        step: &Step,
        jitter: &mut Jitter<'_>,
        pool: &Pool<T>,
    ) -> (Samples<T>, u64) {
        self.buffers.with(|buffer| {
            grid.march(&rays.cast(), step, jitter, buffer);
            (buffer.samples(rays, pool), buffer.steps)
        })
    }
}

impl<T: Scalar> Sampler<T> for Marching {
    fn sample<'t>(
        &self,
        query: &Query<'_, 't, T>,
        rays: &Rays<T>,
        purpose: Purpose,
        jitter: &mut Jitter<'_>,
    ) -> Sampled<'t, T> {
        let (grid, length) = match purpose {
            Purpose::Training => (&self.grid, self.step()),
            Purpose::View { finer } => (self.view_grid(), self.view_step() / finer as f32),
        };
        let (steps, unskipped) = self.march(grid, rays, &self.spacing(length), jitter, query.tape().pool());
        Sampled { evaluations: Evaluations { unskipped, ..Evaluations::default() }, ..Sampled::new(steps) }
    }

    fn batch_size(&self) -> BatchSize {
        BatchSize::Samples { step: self.config.samples, tiles: self.config.tiles }
    }

    fn boxed(&self) -> Box<dyn Sampler<T>> {
        Box::new(self.clone())
    }

    fn quadrature(&self) -> Quadrature {
        self.config.quadrature
    }

    fn early_stop_eps(&self) -> f64 {
        self.config.early_stop_eps
    }

    fn tolerance(&self) -> RayTolerance {
        RayTolerance::of(&self.config.occupancy.skip)
    }

    fn view_tile(&self) -> usize {
        512
    }

    /// Marks cells empty that no camera sees, and carves the visual hull.
    fn prepare(&mut self, data: &Dataset) {
        if self.config.occupancy.skip.grid {
            visibility::carve_unseen(&mut self.grid, data);
        }
        silhouette::carve(&mut self.grid, data, self.config.occupancy.skip.carving);
    }

    /// Updates some cells from the field's densities.
    fn update(&mut self, progress: &Progress, densities: &DensityFn<'_>) -> bool {
        let alone = &mut |own, _: &[usize]| Some(vec![own]);
        Sampler::<T>::update_shared(self, progress, densities, &mut Shares { rank: 0, ranks: 1, gather: alone })
    }

    fn update_shared(&mut self, progress: &Progress, densities: &DensityFn<'_>, shares: &mut Shares<'_>) -> bool {
        let Progress { step, train_frac: fraction, seed } = *progress;
        self.progress = fraction;
        if step % GRID_EVERY != 1 || step == 1 || !self.config.occupancy.skip.grid {
            return false;
        }
        let plan = if step < WARM_UP { Update::ALL } else { Update::PARTIAL };
        // Counts updates instead of steps, so that every cell has its turn.
        self.grid.update_shared(&plan, seed, step / GRID_EVERY, densities, shares);
        let min_sigma = TRAINING_DEPTH / self.step();
        self.grid.threshold(&Threshold { min_sigma, or_mean: true, dilate: false });
        true
    }

    /// Samples the occupied cells densely and finds those that renders may skip within the configured error bound. The
    /// saved grid of training does not change.
    ///
    /// Cells that training skipped stay empty: the field was never trained there.
    fn finish(&mut self, densities: &DensityFn<'_>) {
        let pruning = self.config.occupancy.skip.pruning;
        self.pruned = (pruning > 0.0).then(|| {
            let mut grid = self.grid.clone();
            grid.prune((pruning / grid.longest_path()) as f32, densities);
            grid
        });
    }

    fn grid(&self) -> Option<&OccupancyGrid> {
        Some(&self.grid)
    }

    fn state(&self) -> Vec<(&'static str, Vec<u8>)> {
        vec![(GRID, self.grid.occupied_to_bytes())]
    }

    /// Includes the moving averages of the cells' densities.
    fn training_state(&self) -> Vec<(&'static str, Vec<u8>)> {
        vec![(GRID, self.grid.to_bytes())]
    }

    fn load_state(&mut self, state: &HashMap<String, Vec<u8>>) -> Result<()> {
        let Some(bytes) = state.get(GRID) else {
            return Err(Error::setting(GRID, "is missing in the file; save the model again"));
        };
        let grid = OccupancyGrid::from_bytes(bytes)?;
        if grid.bounds() != self.grid.bounds() || grid.cells() != self.grid.cells() {
            return Err(Error::setting(GRID, "belongs to another configuration; use the one that it was saved with"));
        }
        (self.grid, self.pruned) = (grid, None);
        Ok(())
    }
}

impl RayTolerance {
    /// Returns the tolerances that a skipping configuration sets for renders.
    pub fn of(skip: &Skipping) -> Self {
        RayTolerance { early_stop_eps: skip.early_stop_eps as f32, color_budget: skip.colors as f32 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::analytic::{AnalyticField, scenes};
    use crate::dataset::{Split, sample::ball};
    use raygrad_autograd::{Tape, Tensor};
    use raygrad_nn::Params;
    use std::sync::Mutex;

    /// A ball beyond the box is visible in the outer cascades, with uniform and with growing steps.
    #[test]
    fn cascades_show_beyond_the_box_in_fewer_steps() {
        let scene = scenes().into_iter().find(|scene| scene.name == "sphere").unwrap();
        let mut params = Params::<f64>::new();
        let field = AnalyticField::new(scene.medium.clone(), &mut params);
        let tape = Tape::new();
        let bound = params.bind_constant(&tape);
        let query = Query::new(&field, &bound);
        let seen = |cascades: usize, cone: f64| {
            let occupancy = OccupancyConfig { resolution: 32, cascades, skip: Skip::Off.into() };
            let grid = OccupancyGrid::new([DVec3::NEG_ONE, DVec3::ONE], &occupancy).unwrap();
            let reach = grid.outer_bounds();
            let config = MarchingConfig { occupancy, cone, view_step: 1e-3, ..MarchingConfig::default() };
            let sampler = Marching::new(config, grid);
            let mut rays = Rays::new();
            rays.push(&scene.ray, crate::camera::bounds::clip_near_far(&scene.ray, reach, [0.0, scene.length]));
            let steps = sampler.sample(&query, &rays, Purpose::View { finer: 1 }, &mut Jitter::Middle).samples;
            let count = steps.len();
            let color = Quadrature::Midpoint.render_nodes(&query, steps).over(&Tensor::full(&[1, 3], 1.0));
            (color.value().as_slice()[1], count)
        };
        assert_eq!(seen(1, 0.0).0, 1.0, "within the box there is nothing");
        let (even, many) = seen(3, 0.0);
        let (growing, few) = seen(3, 0.02);
        assert!((even - scene.exact.color).abs() < 2e-3, "{even} for {}", scene.exact.color);
        assert!((growing - scene.exact.color).abs() < 1e-2, "{growing} for {}", scene.exact.color);
        assert!(many == 2000 && few < many / 3, "{many} and {few} steps");
    }
    use glam::DVec3;

    #[test]
    fn updates_reach_every_cell_after_the_warm_up() {
        let occupancy = OccupancyConfig { resolution: 16, ..OccupancyConfig::default() };
        let grid = OccupancyGrid::new([DVec3::ZERO, DVec3::ONE], &occupancy).unwrap();
        let mut sampler: Box<dyn Sampler<f32>> =
            Box::new(Marching::new(MarchingConfig { occupancy, ..Default::default() }, grid));
        let seen = Mutex::new(std::collections::HashSet::new());
        let look = |points: &[[f32; 3]], out: &mut [f32]| {
            out.fill(0.0);
            seen.lock().unwrap().extend(points.iter().map(|point| point.map(|x| (x * 16.0) as u32)));
        };
        for step in 1..=WARM_UP + 16 * GRID_EVERY + 1 {
            if step == WARM_UP {
                assert_eq!(seen.lock().unwrap().len(), 4096, "all in the warm-up");
                seen.lock().unwrap().clear();
            }
            sampler.update(&Progress { step, train_frac: 0.0, seed: 1 }, &look);
        }
        assert_eq!(seen.lock().unwrap().len(), 4096, "one in sixteen each time, and another one each time");
    }

    #[test]
    fn unseen_space_is_skipped() {
        let mut data = ball(Split::Train, 16);
        data.frames.truncate(1);
        data.bounds = [DVec3::splat(-0.6), DVec3::splat(0.6)];
        let occupied = |grid: bool, data: &Dataset| {
            let mut config = MarchingConfig::default();
            (config.occupancy.resolution, config.occupancy.skip.carving, config.occupancy.skip.grid) = (16, 0, grid);
            let grid = OccupancyGrid::new(data.bounds, &config.occupancy).unwrap();
            let mut marching = Marching::new(config, grid);
            Sampler::<f32>::prepare(&mut marching, data);
            marching.grid.occupied_share()
        };
        // The camera sees the whole box; then, from nearby, a part of it. Without the grid nothing is skipped.
        assert_eq!(occupied(true, &data), 1.0);
        data.frames[0].camera.pose.translation *= 0.4;
        assert!((0.05..0.8).contains(&occupied(true, &data)), "{}", occupied(true, &data));
        assert_eq!(occupied(false, &data), 1.0);
    }

    #[test]
    fn steps_shrink_geometrically_to_the_last() {
        let config = MarchingConfig { step: 0.01, last_step: Some(0.0025), ..MarchingConfig::default() };
        let grid = OccupancyGrid::new([DVec3::ZERO, DVec3::new(1.0, 4.0, 2.0)], &config.occupancy).unwrap();
        let mut marching = Marching::new(config, grid);
        let mut at = |progress: f64| {
            marching.progress = progress;
            [marching.step(), marching.view_step()]
        };
        for (progress, step) in [(0.0, 0.04), (0.5, 0.02), (1.0, 0.01)] {
            let [now, view] = at(progress);
            assert!((now / step - 1.0).abs() < 1e-6, "{progress}: {now}");
            assert_eq!(view, 4.0 / 600.0);
        }
        let wrong = MarchingConfig { last_step: Some(0.0), ..MarchingConfig::default() };
        assert!(ComponentConfig::check(&wrong).unwrap_err().to_string().starts_with("`last_step`"));
    }
}
