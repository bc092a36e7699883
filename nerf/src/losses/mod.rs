//! Losses: the photometric [`Loss`], the [`interlevel`] loss of proposals, and further [loss terms](LossTerm).
//!
//! A configuration lists terms such as [`DistortionConfig`] and [`DepthConfig`] in
//! [`Config::loss_terms`](crate::Config::loss_terms). Implement [`LossTerm`] for a custom one.

pub(crate) mod interlevel;
pub(crate) mod photometric;
pub(crate) mod terms;
pub(crate) mod variation;

pub use interlevel::interlevel;
pub use photometric::Loss;
pub use terms::{DepthConfig, DistortionConfig, EntropyConfig, OrientationConfig};
pub use variation::TotalVariationConfig;

use crate::camera::rays::{Rays, stratified};
use crate::component::{AnyConfig, ComponentType};
use crate::field::Field;
use crate::random::Jitter;
use crate::volume::quadrature::Quadrature;
use crate::volume::query::Query;
use crate::volume::render::Rendered;
use raygrad_autograd::{Pool, Scalar, Tensor, Var};
use raygrad_nn::Bound;
use std::any::Any;
use std::sync::Arc;

/// The inputs of a loss term: rendered rays and their targets.
#[derive(Clone, Copy)]
pub struct LossInputs<'a, 't, T: Scalar> {
    /// The parameters.
    pub params: &'a Bound<'t, T>,
    /// The sampled rays.
    pub rays: &'a Rays<T>,
    /// The image index of each ray, `[rays]`.
    pub frames: &'a [u32],
    /// The pixel (column, row) of each ray, `[rays]`.
    pub pixels: &'a [[u32; 2]],
    /// The measured distance along each ray, `[rays]`, in scene units; 0 where there is none.
    pub distances: &'a [f32],
    /// A random seed that differs for each term, tile and step.
    pub seed: u64,
    /// Fraction of the run that is done, 0 to 1.
    pub train_frac: f64,
    /// The rendered rays of the field.
    pub rendered: &'a Rendered<'t, T>,
    /// The images' colours, `[rays, 3]`, over the background where they have alpha.
    pub target: &'a Tensor<T>,
    /// The background of each ray, `[rays, 3]`. It is grey for [`Background::Expected`](crate::Background::Expected): a
    /// term that compares colours needs another one, such as `Random`.
    pub background: &'a Tensor<T>,
}

impl<'t, T: Scalar> LossInputs<'_, 't, T> {
    /// Renders rays through a field and passes them to `evaluate` as loss inputs, for tests of loss terms.
    ///
    /// The middles of `samples` equal bins of each ray are sampled, and integrated with the midpoint rule. Positions
    /// are variables, so that terms can read [normals](Rendered::normals). Targets and backgrounds are black; images,
    /// pixels, distances, the seed and `train_frac` are 0. The closure can replace any of them.
    ///
    /// ```
    /// use raygrad_autograd::check::{Check, check_function};
    /// use raygrad_nerf::losses::{EntropyConfig, LossInputs};
    /// use raygrad_nerf::{LossTerm, Ray, Rays, VoxelConfig, glam::DVec3};
    /// # use raygrad_nerf::{BuildContext, ComponentConfig, Space};
    /// # use raygrad_nn::Params;
    /// # use rand::SeedableRng;
    /// # let mut params = Params::<f64>::new();
    /// # let rng = &mut rand_pcg::Pcg64Mcg::seed_from_u64(0);
    /// # let space = Space::within([DVec3::splat(-1.0), DVec3::ONE]);
    /// # let config = VoxelConfig { resolution: 4, direction_degree: 1 };
    /// # let field = config.build(BuildContext { space, frames: 0, params: &mut params, name: "field", rng })?;
    /// let mut rays = Rays::new();
    /// rays.push(&Ray { origin: DVec3::new(0.1, 0.2, -2.0), direction: DVec3::Z }, [1.0, 3.0]);
    /// let term = EntropyConfig { weight: 0.5 };
    /// let report = check_function(&Check::default(), params.values(), |x| {
    ///     let params = params.layout().bind(x.to_vec());
    ///     LossInputs::render(&*field, &params, &rays, 8, |inputs| term.loss(&inputs))
    /// });
    /// assert!(report.is_ok());
    /// # Ok::<(), raygrad_nerf::Error>(())
    /// ```
    #[track_caller]
    pub fn render<R>(
        field: &dyn Field<T>,
        params: &Bound<'t, T>,
        rays: &Rays<T>,
        samples: usize,
        evaluate: impl FnOnce(LossInputs<'_, 't, T>) -> R,
    ) -> R {
        let query = Query { position_grad: true, ..Query::new(field, params) };
        let samples = stratified(rays, samples, &mut Jitter::Middle, &Pool::new());
        let black = &Tensor::zeros(&[rays.len(), 3]);
        evaluate(LossInputs {
            params,
            rays,
            frames: &vec![0; rays.len()],
            pixels: &vec![[0; 2]; rays.len()],
            distances: &vec![0.0; rays.len()],
            seed: 0,
            train_frac: 0.0,
            rendered: &Quadrature::Midpoint.render_nodes(&query, samples),
            target: black,
            background: black,
        })
    }
}

/// A loss term that is added to the photometric loss.
///
/// A custom term implements this trait and, for its configuration,
/// [`ComponentConfig<LossTerms>`](crate::ComponentConfig).
pub trait LossTerm<T: Scalar>: Any + Send + Sync {
    /// Computes the term as a sum over rays, a scalar, times its weight.
    ///
    /// The trainer divides the sum by three times the number of rays, like the squared errors of three channels. A term
    /// of 1 on every ray adds 1/3 to the loss at weight 1. Where others take the mean over rays with weight λ, the
    /// weight here is 3 λ.
    fn loss<'t>(&self, seen: &LossInputs<'_, 't, T>) -> Var<'t, T>;

    /// Returns whether it reads [normals](Rendered::normals), for which positions must be on the tape.
    fn needs_normals(&self) -> bool {
        false
    }

    /// Returns whether it needs measured [distances](LossInputs::distances); training a dataset without them is then an
    /// error.
    fn needs_distances(&self) -> bool {
        false
    }
}

/// The [`ComponentType`] of loss terms.
pub struct LossTerms;

impl ComponentType for LossTerms {
    const WHAT: &'static str = "loss term";
    type Built<T: Scalar> = Arc<dyn LossTerm<T>>;
}

/// The configuration of any loss term.
pub type LossTermConfig = AnyConfig<LossTerms>;
