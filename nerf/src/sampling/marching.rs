//! Marching: even steps through the occupied cells of a grid, and as little work as possible on each.

use crate::Result;
use crate::camera::rays::{Rays, Samples};
use crate::field::Field;
use crate::random::Jitter;
use crate::range::check_range;
use crate::space::occupancy::{MarchBuffer, OccupancyConfig, OccupancyGrid, Skip, Step, Threshold, Update};
use crate::volume::quadrature::Quadrature;
use raygrad_autograd::{Pool, Scalar, Segments, Tape};
use raygrad_nn::Params;
use serde::{Deserialize, Serialize};

/// Numbers of a [`Marching`] sampler.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MarchingConfig {
    /// The occupancy grid, and what may be skipped with it.
    pub occupancy: OccupancyConfig,
    /// Length of a training step along a ray, as a share of the longest side of the box.
    pub step: f64,
    /// The same at the end of training, if it changes: evenly on a logarithmic scale. Long steps leave samples for more
    /// rays, short ones show fine detail as it is.
    #[serde(default)]
    pub last_step: Option<f64>,
    /// The same in rendering. Training starts each ray at random, so it fits what finer steps show.
    #[serde(default = "view_step")]
    pub view_step: f64,
    /// Samples that a training step places on its rays; the number of rays follows.
    pub samples: usize,
    /// Samples with less light than this in front of them are dropped in training: the colour changes by at most as
    /// much.
    pub termination: f64,
    /// How the integral along a ray is approximated; a step is an interval.
    #[serde(default)]
    pub quadrature: Quadrature,
}

/// Figures are in docs/benchmarks.md, section Rendering.
const fn view_step() -> f64 {
    1.0 / 600.0
}

impl Default for MarchingConfig {
    fn default() -> Self {
        let occupancy = OccupancyConfig { skip: Skip::Fast, ..OccupancyConfig::default() };
        MarchingConfig {
            occupancy,
            step: 1.0 / 200.0,
            last_step: None,
            view_step: view_step(),
            samples: 24576,
            termination: 1e-3,
            quadrature: Quadrature::Midpoint,
        }
    }
}

impl MarchingConfig {
    pub(crate) fn check(&self) -> Result<()> {
        self.occupancy.check()?;
        check_range("step", self.step, 1e-5, 1.0)?;
        self.last_step.map_or(Ok(()), |step| check_range("last_step", step, 1e-5, 1.0))?;
        check_range("view_step", self.view_step, 1e-5, 1.0)?;
        check_range("samples", self.samples, 1, 1 << 24)?;
        self.quadrature.check()?;
        check_range("termination", self.termination, 0.0, 1.0)
    }
}

/// In training, cells whose optical depth a step is below this (or below the mean) are passed over.
const TRAINING_DEPTH: f32 = 0.01;
/// Training steps in which all cells are looked at.
const WARM_UP: u64 = 256;

/// The occupancy grid and the numbers.
#[derive(Debug, Clone)]
pub struct Marching {
    /// The numbers.
    pub config: MarchingConfig,
    /// Which cells hold something.
    pub grid: OccupancyGrid,
    /// How much of training is done, 0 to 1.
    pub progress: f64,
}

impl Marching {
    /// The length of a training step in scene units, now.
    pub fn step(&self) -> f32 {
        let first = self.config.step;
        let last = self.config.last_step.unwrap_or(first);
        self.length(first * (last / first).powf(self.progress))
    }

    /// The length of a step in scene units when rendering.
    pub fn view_step(&self) -> f32 {
        self.length(self.config.view_step)
    }

    fn length(&self, share: f64) -> f32 {
        let [low, high] = self.grid.outer_bounds();
        (share * (high - low).max_element()) as f32
    }

    /// Samples in occupied cells, at even steps from a random start in each ray's span.
    pub fn samples<T: Scalar>(
        &self,
        rays: &Rays<T>,
        jitter: &mut Jitter<'_>,
        buffer: &mut MarchBuffer,
        pool: &Pool<T>,
    ) -> Samples<T> {
        self.grid.march(&rays.cast(), &Step::uniform(self.step()), jitter, buffer);
        let tensor = |values: &[f32]| {
            let mut out = pool.tensor(&[values.len()]);
            out.as_mut_slice().iter_mut().zip(values).for_each(|(out, &x)| *out = T::from_f64(x.into()));
            out
        };
        Samples::new(rays, Segments::new(&buffer.offsets[..]), tensor(&buffer.t), tensor(&buffer.delta), pool)
    }

    /// Looks at some cells of a field in training and passes over those that hold little. `step` counts training steps.
    pub(crate) fn update(
        &mut self,
        field: &dyn Field<f32>,
        params: &Params<f32>,
        pool: &Pool<f32>,
        step: u64,
        seed: u64,
    ) {
        if self.config.occupancy.skip == Skip::Off {
            return;
        }
        let plan = if step < WARM_UP { Update::ALL } else { Update::PARTIAL };
        self.grid.update(&plan, seed, step, &|points, out| densities(field, params, pool, points, out));
        let min_sigma = TRAINING_DEPTH / self.step();
        self.grid.threshold(&Threshold { min_sigma, or_mean: true, dilate: false });
    }

    /// Looks closely at what is occupied, and leaves out what rendering may leave out by the configuration's error bound.
    ///
    /// What training passed over stays empty: the field was never asked there, and what it would say is not part of the
    /// scene that was fitted.
    pub(crate) fn finish(&mut self, field: &dyn Field<f32>, params: &Params<f32>, pool: &Pool<f32>) {
        let skip = self.config.occupancy.skip;
        if skip != Skip::Off {
            let min_sigma = skip.min_sigma(self.grid.diagonal());
            self.grid.prune(min_sigma, &|points, out| densities(field, params, pool, points, out));
        }
    }
}

/// A field's densities, for the occupancy grid.
pub(crate) fn densities(
    field: &dyn Field<f32>,
    params: &Params<f32>,
    pool: &Pool<f32>,
    points: &[[f32; 3]],
    out: &mut [f32],
) {
    let tape = Tape::with_pool(pool.clone());
    let params = params.bind_constant(&tape);
    let positions = tape.constant(pool.copy_of(&[points.len(), 3], points.as_flattened()));
    let density = field.density(&params, &field.encode(&params, &positions));
    out.copy_from_slice(density.sigma().value().as_slice());
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;

    #[test]
    fn steps_shrink_evenly_from_the_first_to_the_last() {
        let config = MarchingConfig { step: 0.01, last_step: Some(0.0025), ..MarchingConfig::default() };
        let grid = OccupancyGrid::new([DVec3::ZERO, DVec3::new(1.0, 4.0, 2.0)], &config.occupancy).unwrap();
        let mut marching = Marching { config, grid, progress: 0.0 };
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
        assert!(wrong.check().unwrap_err().to_string().starts_with("`last_step`"));
    }
}
