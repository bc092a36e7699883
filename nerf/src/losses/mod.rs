//! What training minimises: the [photometric loss](Loss) of every picture of the rays, what fits the sampler's proposals
//! ([`interlevel`]), and any number of further [terms](LossTerm) of what is rendered.

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

/// What a term may use: what is rendered of some rays, and what photographs show along them.
#[derive(Clone, Copy)]
pub struct LossInputs<'a, 't, T: Scalar> {
    /// The parameters.
    pub params: &'a Bound<'t, T>,
    /// The rays, as they were sampled.
    pub rays: &'a Rays<T>,
    /// The number of the photograph of each ray.
    pub frames: &'a [u32],
    /// Column and row of its pixel.
    pub pixels: &'a [[u32; 2]],
    /// The distance along each ray, in scene units, at which what it meets was measured to be; 0 where it was not.
    pub distances: &'a [f32],
    /// A random number, another one for each term, tile and step: what a term that draws begins from.
    pub seed: u64,
    /// How much of the run is done, 0 to 1.
    pub train_frac: f64,
    /// What is seen of the field, with a name for everything.
    pub rendered: &'a Rendered<'t, T>,
    /// What the photographs show, `[rays, 3]`, over the background where they have alpha.
    pub target: &'a Tensor<T>,
    /// The background of each ray, `[rays, 3]`.
    pub background: &'a Tensor<T>,
}

/// A term of the loss beside that of the colours.
///
/// A term of one's own implements this and, for its configuration, [`ComponentConfig<LossTerms>`](crate::ComponentConfig).
pub trait LossTerm<T: Scalar>: Any + Send + Sync {
    /// The term as a sum over rays, a scalar, times its weight. (The mean of it is minimised, beside that of the squared
    /// errors of three channels: so a weight of 1 stands for three squared errors.)
    fn loss<'t>(&self, seen: &LossInputs<'_, 't, T>) -> Var<'t, T>;

    /// Whether it reads [normals](Rendered::normals), for which positions have to be on the tape.
    fn needs_normals(&self) -> bool {
        false
    }

    /// Whether it needs [distances](LossInputs::distances) that were measured: an error where a dataset has none.
    fn needs_distances(&self) -> bool {
        false
    }
}

/// The family of terms.
pub struct LossTerms;

impl ComponentType for LossTerms {
    const WHAT: &'static str = "term";
    type Built<T: Scalar> = Arc<dyn LossTerm<T>>;
}

/// Which term, and its weight.
pub type LossTermConfig = AnyConfig<LossTerms>;
