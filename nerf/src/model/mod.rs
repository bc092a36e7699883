//! A model: a field, where it is sampled, and its parameters.

#[doc(hidden)]
pub mod compiled;
pub(crate) mod config;
mod store;

pub use config::{Config, Preset, SamplerConfig};

use crate::camera::rays::{Rays, Samples};
use crate::field::Field;
use crate::random::Jitter;
use crate::sampling::hierarchical::Hierarchical;
use crate::sampling::marching::{Marching, densities};
use crate::space::occupancy::{MarchBuffer, OccupancyGrid, Skip};
use crate::volume::pass::composite_samples;
use crate::{Error, Result};
use glam::DVec3;
use rand::SeedableRng;
use rand_pcg::Pcg64Mcg;
use raygrad_autograd::{Pool, Scalar, Tape, Tensor, Var};
use raygrad_nn::{Bound, Params};
use std::sync::Arc;

/// The scene's extent, stored with the model.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Extent {
    /// Lower and upper corner of the box that holds the scene.
    pub bounds: [DVec3; 2],
    /// Distances along a ray between which it is sampled.
    pub span: [f64; 2],
}

/// Where rays are sampled, with what it takes.
#[derive(Debug, Clone)]
pub enum Sampler {
    /// A coarse field, then importance sampling.
    Hierarchical(Hierarchical),
    /// An occupancy grid.
    Marching(Marching),
}

/// A field with its sampler and parameters.
#[derive(Clone)]
pub struct Model<T: Scalar> {
    /// How it was made.
    pub config: Config,
    /// What it covers.
    pub extent: Extent,
    /// Its parameters.
    pub params: Params<T>,
    /// What is rendered.
    pub field: Arc<dyn Field<T>>,
    /// Where it is sampled.
    pub sampler: Sampler,
}

impl<T: Scalar> Model<T> {
    /// A model with random parameters; the same seed gives the same parameters.
    ///
    /// # Errors
    /// If the configuration is out of range.
    #[inline(never)]
    pub fn new(config: Config, extent: Extent, seed: u64) -> Result<Self> {
        config.check()?;
        let [low, high] = extent.bounds;
        if !(low.is_finite() && high.is_finite() && low.cmplt(high).all()) {
            return Err(Error::setting("bounds", format!("{low} to {high} is no box")));
        }
        let mut rng = Pcg64Mcg::seed_from_u64(seed);
        let mut params = Params::new();
        let sampler = match &config.sampler {
            SamplerConfig::Hierarchical(config) => Sampler::Hierarchical(Hierarchical {
                config: config.clone(),
                proposal: crate::field::Classic::new(
                    &config.proposal,
                    extent.bounds,
                    &mut params,
                    "proposal",
                    &mut rng,
                )?,
            }),
            SamplerConfig::Marching(config) => Sampler::Marching(Marching {
                config: config.clone(),
                grid: OccupancyGrid::new(extent.bounds, &config.occupancy)?,
                progress: 0.0,
            }),
        };
        let field = config.field.build(extent.bounds, &mut params, "field", &mut rng)?;
        Ok(Model { config, extent, params, field, sampler })
    }

    /// All fields: that of the sampler, if it has one, and the one that is rendered.
    pub fn fields(&self) -> Vec<&dyn Field<T>> {
        let proposal = match &self.sampler {
            Sampler::Hierarchical(sampler) => Some(&sampler.proposal as &dyn Field<T>),
            Sampler::Marching(_) => None,
        };
        proposal.into_iter().chain([&*self.field]).collect()
    }

    /// For each of [`fields`](Self::fields) where it is sampled along `rays`, as the parameters are now.
    pub fn samples(&self, rays: &Rays<T>, jitter: &mut Jitter<'_>) -> Vec<Samples<T>> {
        let tape = Tape::new();
        let params = self.params.bind_constant(&tape);
        match &self.sampler {
            Sampler::Hierarchical(sampler) => sampler.samples(&params, rays, jitter).into(),
            Sampler::Marching(sampler) => vec![sampler.samples(rays, jitter, &mut MarchBuffer::default(), tape.pool())],
        }
    }

    /// The training loss at given samples, a differentiable function of the parameters alone: the sum over fields, rays
    /// and channels of the configured loss against `target` `[rays, 3]` over `background` `[rays, 3]`.
    ///
    /// # Panics
    /// If there is not one set of samples for each of [`fields`](Self::fields).
    pub fn loss_at<'t>(
        &self,
        params: &Bound<'t, T>,
        samples: &[Samples<T>],
        target: &Tensor<T>,
        background: &Tensor<T>,
    ) -> Var<'t, T> {
        let tape = params.tape();
        assert_eq!(samples.len(), self.fields().len(), "one set of samples for each field");
        let error = |(field, samples): (&dyn Field<T>, &Samples<T>)| {
            let rendered = match &self.sampler {
                Sampler::Hierarchical(_) => composite_samples(field, params, samples, false, tape).0,
                Sampler::Marching(sampler) => {
                    let rule = sampler.config.quadrature;
                    rule.plan_for(field, params, samples, 0.0, tape).plan.render(field, params, false, tape)
                }
            };
            self.config.loss.sum(&rendered, target, background)
        };
        let errors = self.fields().into_iter().zip(samples).map(error);
        errors.reduce(|sum, error| sum + error).unwrap_or_else(|| tape.constant(Tensor::scalar(T::ZERO)))
    }
}

impl<T: Scalar> Model<T> {
    /// Chooses what [`view`](Model::view) may leave out from now on. A model without an occupancy grid leaves out nothing.
    pub fn set_skip(&mut self, skip: Skip) {
        if let Sampler::Marching(marching) = &mut self.sampler {
            marching.config.occupancy.skip = skip;
        }
    }
}

impl<T: Scalar> Model<T> {
    /// The same model in another precision: the same samples, occupied cells and parameters, the latter rounded if need
    /// be.
    ///
    /// # Errors
    /// If the configuration is out of range, which that of a model in use is not.
    #[inline(never)]
    pub fn cast<U: Scalar>(&self) -> Result<Model<U>> {
        let mut model = Model::new(self.config.clone(), self.extent, 0)?;
        model.params.assign(&self.params);
        // The other sampler has nothing but its configuration and handles of the new store.
        if let Sampler::Marching(_) = &self.sampler {
            model.sampler = self.sampler.clone();
        }
        Ok(model)
    }
}

impl Model<f32> {
    /// The field's density at each of these positions (scene units), in 1 / scene unit, into the slot of the same number:
    /// what an [`OccupancyGrid`] asks for.
    ///
    /// # Panics
    /// If there are not as many slots as positions.
    pub fn densities(&self, points: &[[f32; 3]], out: &mut [f32]) {
        densities(&*self.field, &self.params, &Pool::new(), points, out);
    }

    /// Looks closely at everything that the occupancy grid, if there is one, may hold: for rendering within the error
    /// bound of the configuration. [`Trainer::run`](crate::Trainer::run) ends with it.
    pub fn finish_grid(&mut self) {
        if let Sampler::Marching(marching) = &mut self.sampler {
            marching.finish(&*self.field, &self.params, &Pool::new());
        }
    }
}
