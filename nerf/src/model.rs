//! The classic NeRF: a coarse field finds where to look, a fine field is rendered.

use crate::composite::Composite;
use crate::config::Config;
use crate::field::{Classic, Field};
use crate::rays::{Rays, Samples};
use crate::sampler::{Jitter, importance, stratified};
use crate::{Error, Result};
use glam::DVec3;
use rand::SeedableRng;
use rand_pcg::Pcg64Mcg;
use raygrad_autograd::{Bound, Params, Pool, Scalar, Tape, Tensor, Var};

/// The scene's extent, stored with the model.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Extent {
    /// Lower and upper corner of the box that holds the scene.
    pub bounds: [DVec3; 2],
    /// Distances along a ray between which it is sampled.
    pub span: [f64; 2],
}

/// A coarse and a fine field with their parameters.
#[derive(Debug, Clone)]
pub struct Model<T: Scalar> {
    /// How it was made.
    pub config: Config,
    /// What it covers.
    pub extent: Extent,
    /// Its parameters.
    pub params: Params<T>,
    coarse: Classic,
    fine: Classic,
}

/// What a forward pass gives for each ray.
pub struct Rendered<'t, T: Scalar> {
    /// Composited features and the transmittance that is left, `[rays, features + 1]`, from the coarse field.
    pub coarse: Var<'t, T>,
    /// The same from the fine field.
    pub fine: Var<'t, T>,
}

impl<T: Scalar> Model<T> {
    /// A model with random parameters; the same seed gives the same parameters.
    ///
    /// # Errors
    /// If the configuration is out of range.
    pub fn new(config: Config, extent: Extent, seed: u64) -> Result<Self> {
        config.check()?;
        let [low, high] = extent.bounds;
        if !(low.is_finite() && high.is_finite() && low.cmplt(high).all()) {
            return Err(Error::setting("bounds", format!("{low} to {high} is no box")));
        }
        let mut rng = Pcg64Mcg::seed_from_u64(seed);
        let mut params = Params::new();
        let coarse = Classic::new(&config.coarse, extent.bounds, &mut params, "coarse", &mut rng)?;
        let fine = Classic::new(&config.fine, extent.bounds, &mut params, "fine", &mut rng)?;
        Ok(Model { config, extent, params, coarse, fine })
    }

    /// Both fields, coarse and fine.
    pub fn fields(&self) -> [&dyn Field<T>; 2] {
        [&self.coarse, &self.fine]
    }

    /// The field that is rendered.
    pub fn field(&self) -> &dyn Field<T> {
        &self.fine
    }

    /// Colour (and distance, if `with_depth`) of samples, composited along their rays.
    fn composite<'t>(
        &self,
        field: &dyn Field<T>,
        params: &Bound<'t, T>,
        samples: &Samples<T>,
        with_depth: bool,
        tape: &'t Tape<T>,
    ) -> (Var<'t, T>, Tensor<T>) {
        let density = field.density(params, &tape.constant(samples.positions.clone()));
        let directions = tape.constant(samples.directions.clone());
        let mut features = field.color(params, &density.features, &directions, &samples.segments);
        if with_depth {
            features = Var::concat(&[&features, &tape.constant(samples.t.reshape(&[samples.len(), 1]))], 1);
        }
        let composite = Composite::new(samples.delta.clone(), samples.segments.clone());
        let sigma = density.sigma.value().clone();
        (tape.apply(composite, &[&density.sigma, &features]), sigma)
    }

    /// The whole forward pass: stratified samples through the coarse field, importance samples through the fine one.
    ///
    /// With `with_depth` there is a fourth feature, the distance.
    pub fn render<'t>(
        &self,
        tape: &'t Tape<T>,
        params: &Bound<'t, T>,
        rays: &Rays<T>,
        jitter: &mut Jitter<'_>,
        with_depth: bool,
    ) -> Rendered<'t, T> {
        let first = stratified(rays, self.config.coarse_samples, jitter, tape.pool());
        let (coarse, sigma) = self.composite(&self.coarse, params, &first, with_depth, tape);
        // No gradient flows through the choice of places.
        let second = self.refine(rays, &first, &sigma, jitter, tape.pool());
        let (fine, _) = self.composite(&self.fine, params, &second, with_depth, tape);
        Rendered { coarse, fine }
    }

    fn refine(
        &self,
        rays: &Rays<T>,
        first: &Samples<T>,
        sigma: &Tensor<T>,
        jitter: &mut Jitter<'_>,
        pool: &Pool<T>,
    ) -> Samples<T> {
        let composite = Composite::new(first.delta.clone(), first.segments.clone());
        let [_, weights] = composite.transmittance_and_weights(sigma, pool);
        let Config { fine_samples, uniform_share, .. } = self.config;
        importance(rays, first, weights.as_slice(), fine_samples, uniform_share, jitter, pool)
    }

    /// The samples of [`render`](Self::render) for the coarse and the fine field, as the parameters are now.
    pub fn samples(&self, rays: &Rays<T>, jitter: &mut Jitter<'_>) -> [Samples<T>; 2] {
        let tape = Tape::new();
        let params = self.params.bind_constant(&tape);
        let first = stratified(rays, self.config.coarse_samples, jitter, tape.pool());
        let sigma = self.coarse.density(&params, &tape.constant(first.positions.clone())).sigma;
        let second = self.refine(rays, &first, sigma.value(), jitter, tape.pool());
        [first, second]
    }

    /// The training loss at given samples, a differentiable function of the parameters alone: the sum over rays and
    /// channels of both fields' squared errors against `target` `[rays, 3]` over `background` `[rays, 3]`.
    pub fn loss_at<'t>(
        &self,
        params: &Bound<'t, T>,
        samples: &[Samples<T>; 2],
        target: &Tensor<T>,
        background: &Tensor<T>,
    ) -> Var<'t, T> {
        let tape = params.vars()[0].tape();
        let error = |field: &dyn Field<T>, samples| {
            let (rendered, _) = self.composite(field, params, samples, false, tape);
            squared_error(&rendered, target, background)
        };
        error(&self.coarse, &samples[0]) + error(&self.fine, &samples[1])
    }
}

/// The colour of composited features `[rays, 3 or more, + 1]` over a background `[rays, 3]`.
pub fn over_background<'t, T: Scalar>(rendered: &Var<'t, T>, background: &Tensor<T>) -> Var<'t, T> {
    let channels = rendered.shape()[1];
    let left = rendered.slice(1, channels - 1, 1);
    rendered.slice(1, 0, 3) + left * rendered.tape().constant(background.clone())
}

/// The sum of squared differences between composited colours and `target` `[rays, 3]`.
pub fn squared_error<'t, T: Scalar>(rendered: &Var<'t, T>, target: &Tensor<T>, background: &Tensor<T>) -> Var<'t, T> {
    (over_background(rendered, background) - rendered.tape().constant(target.clone())).square().sum()
}
