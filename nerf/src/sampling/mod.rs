//! Samplers, which place samples along rays. Implement [`Sampler`] for a custom one.
//!
//! | sampler | samples |
//! |---|---|
//! | [`Marching`](marching::Marching) | even steps through the occupied cells of a grid (instant-ngp) |
//! | [`Hierarchical`](hierarchical::Hierarchical) | coarse, then fine by importance sampling (NeRF) |
//! | [`Proposal`](proposal::Proposal) | resampled from small density fields (mip-NeRF 360) |

pub mod hierarchical;
pub mod marching;
pub mod proposal;
pub mod steps;

use crate::Result;
use crate::camera::rays::{Rays, Samples};
use crate::component::{AnyConfig, ComponentType};
use crate::dataset::Dataset;
use crate::field::Field;
use crate::random::Jitter;
use crate::space::occupancy::{DensityFn, OccupancyGrid, Shares};
use crate::volume::quadrature::Quadrature;
use crate::volume::query::Query;
use crate::volume::render::{Evaluations, Rendered};
use raygrad_autograd::{Scalar, Segments, Var};
use std::any::Any;
use std::collections::HashMap;

/// The purpose of samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Purpose {
    /// A training step.
    Training,
    /// A render, with steps `finer` times smaller than configured; samplers without steps ignore it.
    View {
        /// The divisor of the step length, at least 1.
        finer: usize,
    },
}

/// The result of [`Sampler::sample`].
pub struct Sampled<'t, T: Scalar> {
    /// The samples of the field, each with an interval.
    pub samples: Samples<T>,
    /// Renders of the sampler's coarse fields along the same rays, which are trained on the images too.
    pub coarse: Vec<Rendered<'t, T>>,
    /// Histograms of proposal fields, which the [interlevel loss](crate::losses::interlevel) fits to the field's
    /// weights.
    pub histograms: Vec<ProposalHistogram<'t, T>>,
    /// The sampler's own evaluations, and the number of samples without skipping.
    pub evaluations: Evaluations,
}

impl<'t, T: Scalar> Sampled<'t, T> {
    /// Wraps samples that took no evaluations.
    pub fn new(steps: Samples<T>) -> Self {
        let evaluations = Evaluations { unskipped: steps.len() as u64, ..Evaluations::default() };
        Sampled { samples: steps, coarse: vec![], histograms: vec![], evaluations }
    }
}

/// The histogram of a proposal field along rays.
pub struct ProposalHistogram<'t, T: Scalar> {
    /// Bin edges of all rays, in scene units, rising along each ray: `bins + 1` per ray.
    pub edges: Vec<f64>,
    /// The weight of each bin, `[rays * bins]`.
    pub weights: Var<'t, T>,
    /// The rows of each ray's bins.
    pub segments: Segments,
}

/// The tolerances of a render, per ray.
///
/// Each changes a pixel by at most its value times the range of colours. The remaining samples are scaled to
/// compensate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RayTolerance {
    /// Early termination: a ray ends where its transmittance falls below this, 0 to 1.
    pub early_stop_eps: f32,
    /// Samples whose weights sum to at most this take no colour evaluation, 0 to 1. Quadratures with two nodes per
    /// interval ignore it.
    pub color_budget: f32,
}

impl RayTolerance {
    /// No tolerance: every sample is evaluated.
    pub const NONE: RayTolerance = RayTolerance { early_stop_eps: 0.0, color_budget: 0.0 };
}

/// The size of a training step.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BatchSize {
    /// A fixed number of rays.
    Rays {
        /// Rays per step.
        step: usize,
        /// Rays per tile: one tape, on one core.
        tile: usize,
    },
    /// The number of rays that holds about so many samples.
    Samples {
        /// Samples per step.
        step: usize,
        /// Tiles of a step: one tape each, on one core each.
        tiles: usize,
    },
}

impl BatchSize {
    /// Tiles in a step, at most. No more threads can work on them at a time.
    pub fn tile_count(self) -> usize {
        match self {
            BatchSize::Rays { step, tile } => step.div_ceil(tile.max(1)),
            BatchSize::Samples { tiles, .. } => tiles.max(1),
        }
    }
}

/// The progress of training.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Progress {
    /// Number of the next step, from 1.
    pub step: u64,
    /// Fraction of the run that is done, 0 to 1.
    pub train_frac: f64,
    /// The run's seed.
    pub seed: u64,
}

/// Places samples along rays.
///
/// Only [`sample`](Self::sample), [`batch_size`](Self::batch_size) and [`boxed`](Self::boxed) are required; the rest is
/// for samplers that learn, skip samples or have state. A custom sampler implements this trait and, for its
/// configuration, [`ComponentConfig<Samplers>`](crate::ComponentConfig). After [`register`](crate::component::register)
/// it trains, renders, saves and loads like the built-in samplers.
pub trait Sampler<T: Scalar>: Any + Send + Sync {
    /// Places samples of the field of `query` along `rays`. No gradient flows through their positions.
    fn sample<'t>(
        &self,
        query: &Query<'_, 't, T>,
        rays: &Rays<T>,
        purpose: Purpose,
        jitter: &mut Jitter<'_>,
    ) -> Sampled<'t, T>;

    /// Returns the size of a training step.
    fn batch_size(&self) -> BatchSize;

    /// Returns a boxed copy.
    fn boxed(&self) -> Box<dyn Sampler<T>>;

    /// Returns the quadrature of the volume rendering integral.
    fn quadrature(&self) -> Quadrature {
        Quadrature::Midpoint
    }

    /// Returns the transmittance below which training drops samples; it bounds the change of colours. 0 keeps all.
    fn early_stop_eps(&self) -> f64 {
        0.0
    }

    /// Returns the tolerances of renders.
    fn tolerance(&self) -> RayTolerance {
        RayTolerance::NONE
    }

    /// Returns the number of rays per tile of a render.
    fn view_tile(&self) -> usize {
        32
    }

    /// Returns the sampler's own fields.
    fn fields(&self) -> Vec<&dyn Field<T>> {
        vec![]
    }

    /// Sets the share of detail of the sampler's own fields: see [`Field::with_detail`].
    fn set_detail(&mut self, _detail: f64) {}

    /// Prepares from the images before the first step, for instance by visual hull carving.
    fn prepare(&mut self, _data: &Dataset) {}

    /// Updates from the field's densities before a training step; returns whether the [grid](Self::grid) changed.
    fn update(&mut self, _progress: &Progress, _densities: &DensityFn<'_>) -> bool {
        false
    }

    /// As [`update`](Self::update), with the evaluations shared between processes if the sampler can. Afterwards the
    /// sampler must be the same in all of them.
    fn update_shared(&mut self, progress: &Progress, densities: &DensityFn<'_>, _shares: &mut Shares<'_>) -> bool {
        self.update(progress, densities)
    }

    /// Updates from a trained field before it is rendered.
    fn finish(&mut self, _densities: &DensityFn<'_>) {}

    /// Returns the occupancy grid, if there is one.
    fn grid(&self) -> Option<&OccupancyGrid> {
        None
    }

    /// Returns named state that is saved with a model, beside the parameters.
    fn state(&self) -> Vec<(&'static str, Vec<u8>)> {
        vec![]
    }

    /// Returns named state that is saved to resume training: everything that the next steps depend on, beyond the
    /// arguments of [`update`](Self::update).
    fn training_state(&self) -> Vec<(&'static str, Vec<u8>)> {
        self.state()
    }

    /// Restores [`state`](Self::state) or [`training_state`](Self::training_state).
    ///
    /// # Errors
    /// If a part is absent, or belongs to another configuration.
    fn load_state(&mut self, _state: &HashMap<String, Vec<u8>>) -> Result<()> {
        Ok(())
    }
}

impl<T: Scalar> Clone for Box<dyn Sampler<T>> {
    fn clone(&self) -> Self {
        (**self).boxed()
    }
}

/// The [`ComponentType`] of samplers.
pub struct Samplers;

impl ComponentType for Samplers {
    const WHAT: &'static str = "sampler";
    type Built<T: Scalar> = Box<dyn Sampler<T>>;
}

/// The configuration of any sampler.
pub type SamplerConfig = AnyConfig<Samplers>;
