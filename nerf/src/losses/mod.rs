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

use crate::camera::rays::Rays;
use crate::component::{AnyConfig, ComponentType};
use crate::volume::render::Rendered;
use raygrad_autograd::{Scalar, Tensor, Var};
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
    /// The background of each ray, `[rays, 3]`.
    pub background: &'a Tensor<T>,
}

/// A loss term that is added to the photometric loss.
///
/// A custom term implements this trait and, for its configuration,
/// [`ComponentConfig<LossTerms>`](crate::ComponentConfig).
pub trait LossTerm<T: Scalar>: Any + Send + Sync {
    /// Computes the term as a sum over rays, a scalar, times its weight.
    ///
    /// Training minimises its mean over rays and three channels, as for the squared errors: a weight of 1 counts as
    /// three squared errors.
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
