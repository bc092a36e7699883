//! Where rays are sampled.
//!
//! A [`Sampler`] gives steps along rays, and may ask the field, or fields of its own, where to look:
//! [`Marching`](marching::Marching) takes even steps through the occupied cells of a grid,
//! [`Hierarchical`](hierarchical::Hierarchical) more samples where a coarse field of its own found something, and
//! [`Proposal`](proposal::Proposal) resamples what small density fields of its own propose.

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
use crate::space::occupancy::{DensityFn, OccupancyGrid};
use crate::volume::quadrature::Quadrature;
use crate::volume::query::Query;
use crate::volume::render::{Evaluations, Rendered};
use raygrad_autograd::{Scalar, Segments, Var};
use std::any::Any;
use std::collections::HashMap;

/// What samples are for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Purpose {
    /// A training step.
    Training,
    /// A view, with steps so many times smaller than the configured ones, at least 1: where a sampler has steps.
    View {
        /// How many times.
        finer: usize,
    },
}

/// Where the field is sampled, and what else was found out on the way.
pub struct Sampled<'t, T: Scalar> {
    /// The steps: each sample is the middle of an interval, or stands for it.
    pub samples: Samples<T>,
    /// What fields of the sampler's own showed: pictures of the same rays, to be fitted as well.
    pub coarse: Vec<Rendered<'t, T>>,
    /// Histograms that density fields of the sampler's own proposed, to be pulled towards the weights of the field.
    pub histograms: Vec<ProposalHistogram<'t, T>>,
    /// How often the sampler asked, and how many steps there would be if nothing in the box were skipped.
    pub evaluations: Evaluations,
}

impl<'t, T: Scalar> Sampled<'t, T> {
    /// Steps that nobody was asked for.
    pub fn new(steps: Samples<T>) -> Self {
        let evaluations = Evaluations { unskipped: steps.len() as u64, ..Evaluations::default() };
        Sampled { samples: steps, coarse: vec![], histograms: vec![], evaluations }
    }
}

/// A histogram along rays that a density field proposed.
pub struct ProposalHistogram<'t, T: Scalar> {
    /// The edges of the bins of all rays, in scene units, rising along each ray: one more than bins a ray.
    pub edges: Vec<f64>,
    /// The weight of each bin, `[rays * bins]`.
    pub weights: Var<'t, T>,
    /// The bins of each ray.
    pub segments: Segments,
}

/// What may be left out along one ray of a view.
///
/// Each changes a pixel by at most its value times the range of colours; what is left out is made up for by scaling the
/// rest.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RayTolerance {
    /// A ray ends where less light than this is left, 0 to 1.
    pub early_stop_eps: f32,
    /// Samples whose weights add up to at most this have no colour of their own, 0 to 1. Quadratures of two nodes an
    /// interval colour every sample.
    pub color_budget: f32,
}

impl RayTolerance {
    /// Nothing is left out.
    pub const NONE: RayTolerance = RayTolerance { early_stop_eps: 0.0, color_budget: 0.0 };
}

/// How much a training step works on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BatchSize {
    /// So many rays, in tiles of so many.
    Rays {
        /// Rays of a step.
        step: usize,
        /// Rays of a tile: one tape, on one core.
        tile: usize,
    },
    /// So many rays that about so many samples lie on them.
    Samples(usize),
}

/// How far training is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Progress {
    /// The number of the step that comes next, from 1.
    pub step: u64,
    /// How much of the run is done, 0 to 1.
    pub train_frac: f64,
    /// The run's seed.
    pub seed: u64,
}

/// Chooses where rays are sampled. Only [`sample`](Self::sample), [`batch_size`](Self::batch_size) and [`boxed`](Self::boxed) are
/// needed; the rest is for samplers that learn, leave out, or remember.
///
/// A sampler of one's own implements this and, for its configuration, [`ComponentConfig<Samplers>`](crate::ComponentConfig); with
/// [`register`](crate::component::register) it is trained, rendered, saved and loaded like those of this crate.
pub trait Sampler<T: Scalar>: Any + Send + Sync {
    /// Where the field of `query` is sampled along `rays`. No gradient flows through the choice of places.
    fn sample<'t>(
        &self,
        query: &Query<'_, 't, T>,
        rays: &Rays<T>,
        purpose: Purpose,
        jitter: &mut Jitter<'_>,
    ) -> Sampled<'t, T>;

    /// How much a training step works on.
    fn batch_size(&self) -> BatchSize;

    /// A copy.
    fn boxed(&self) -> Box<dyn Sampler<T>>;

    /// How the integral over the steps is approximated.
    fn quadrature(&self) -> Quadrature {
        Quadrature::Midpoint
    }

    /// Samples with less light than this in front of them are dropped in training: the colour changes by at most as much.
    fn early_stop_eps(&self) -> f64 {
        0.0
    }

    /// What views leave out.
    fn tolerance(&self) -> RayTolerance {
        RayTolerance::NONE
    }

    /// Rays of a view that are worked out together.
    fn view_tile(&self) -> usize {
        32
    }

    /// Fields of the sampler's own.
    fn fields(&self) -> Vec<&dyn Field<T>> {
        vec![]
    }

    /// Gives fields of the sampler's own that share of their detail: see [`Field::with_detail`].
    fn set_detail(&mut self, _detail: f64) {}

    /// Learns from the photographs what can be known before the first step.
    fn prepare(&mut self, _data: &Dataset) {}

    /// Learns from the field's densities, before a training step; says whether the [grid](Self::grid) has changed.
    fn update(&mut self, _progress: &Progress, _densities: &DensityFn<'_>) -> bool {
        false
    }

    /// Looks closely at a field that is finished, before it is rendered.
    fn finish(&mut self, _densities: &DensityFn<'_>) {}

    /// The occupancy grid, if there is one.
    fn grid(&self) -> Option<&OccupancyGrid> {
        None
    }

    /// What is stored with a model, beside the parameters, under names.
    fn state(&self) -> Vec<(&'static str, Vec<u8>)> {
        vec![]
    }

    /// What is written down of a run that is to go on: all that the next steps depend on and that
    /// [`update`](Self::update) is not told.
    fn training_state(&self) -> Vec<(&'static str, Vec<u8>)> {
        self.state()
    }

    /// Takes back what [`state`](Self::state) or [`training_state`](Self::training_state) gave.
    ///
    /// # Errors
    /// If something is absent, or of a sampler of another configuration.
    fn load_state(&mut self, _state: &HashMap<String, Vec<u8>>) -> Result<()> {
        Ok(())
    }
}

impl<T: Scalar> Clone for Box<dyn Sampler<T>> {
    fn clone(&self) -> Self {
        (**self).boxed()
    }
}

/// The family of samplers.
pub struct Samplers;

impl ComponentType for Samplers {
    const WHAT: &'static str = "sampler";
    type Built<T: Scalar> = Box<dyn Sampler<T>>;
}

/// Which sampler, and its numbers.
pub type SamplerConfig = AnyConfig<Samplers>;
