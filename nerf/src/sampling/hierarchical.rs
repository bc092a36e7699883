//! Hierarchical sampling: a coarse field finds where to look, and the field proper is sampled there.

use crate::Result;
use crate::camera::rays::stratified;
use crate::camera::rays::{Rays, Samples};
use crate::field::{Classic, ClassicConfig, Field};
use crate::random::Jitter;
use crate::range::check_range;
use crate::sampling::steps::importance;
use crate::volume::pass::composite_samples;
use raygrad_autograd::{Pool, Scalar, Tape, Tensor, Var};
use raygrad_nn::Bound;
use serde::{Deserialize, Serialize};

/// Numbers of a [`Hierarchical`] sampler.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HierarchicalConfig {
    /// The coarse network.
    pub proposal: ClassicConfig,
    /// Stratified samples a ray, through the coarse network.
    pub coarse: usize,
    /// Further samples a ray where the coarse network found something.
    pub fine: usize,
    /// Share of the further samples that is spread evenly, in 0..=1.
    pub uniform_share: f64,
    /// Rays in a training step.
    pub batch: usize,
    /// Rays in a tile: one tape, on one core.
    pub tile: usize,
}

impl Default for HierarchicalConfig {
    /// The paper's: a coarse network as large as the fine one, 64 + 128 samples.
    fn default() -> Self {
        let proposal = ClassicConfig::paper();
        HierarchicalConfig { proposal, coarse: 64, fine: 128, uniform_share: 0.01, batch: 1024, tile: 8 }
    }
}

impl HierarchicalConfig {
    pub(crate) fn check(&self) -> Result<()> {
        check_range("coarse", self.coarse, 1, 1 << 12)?;
        check_range("fine", self.fine, 0, 1 << 12)?;
        check_range("batch", self.batch, 1, 1 << 20)?;
        check_range("tile", self.tile, 1, 1 << 16)?;
        check_range("uniform_share", self.uniform_share, 0.0, 1.0)
    }

    /// Evaluations of both networks for a ray.
    pub fn evaluations(&self) -> usize {
        2 * self.coarse + self.fine
    }
}

/// The coarse field and the numbers (Mildenhall et al. 2020, section 5.2).
#[derive(Debug, Clone)]
pub struct Hierarchical {
    /// The numbers.
    pub config: HierarchicalConfig,
    /// The coarse field.
    pub proposal: Classic,
}

/// What a forward pass gives for each ray: features and the transmittance that is left, `[rays, features + 1]`.
pub struct Rendered<'t, T: Scalar> {
    /// From the coarse field.
    pub coarse: Var<'t, T>,
    /// From the field proper.
    pub fine: Var<'t, T>,
}

impl Hierarchical {
    /// The whole forward pass of `field` and the coarse field. With `with_depth` there is a fourth feature, the distance.
    pub fn render<'t, T: Scalar>(
        &self,
        field: &dyn Field<T>,
        params: &Bound<'t, T>,
        rays: &Rays<T>,
        jitter: &mut Jitter<'_>,
        with_depth: bool,
        tape: &'t Tape<T>,
    ) -> Rendered<'t, T> {
        let first = stratified(rays, self.config.coarse, jitter, tape.pool());
        let (coarse, weights) = composite_samples(&self.proposal, params, &first, with_depth, tape);
        // No gradient flows through the choice of places.
        let second = self.refine(rays, &first, &weights, jitter, tape.pool());
        let (fine, _) = composite_samples(field, params, &second, with_depth, tape);
        Rendered { coarse, fine }
    }

    fn refine<T: Scalar>(
        &self,
        rays: &Rays<T>,
        first: &Samples<T>,
        weights: &Tensor<T>,
        jitter: &mut Jitter<'_>,
        pool: &Pool<T>,
    ) -> Samples<T> {
        let HierarchicalConfig { fine, uniform_share, .. } = self.config;
        importance(rays, first, weights.as_slice(), fine, uniform_share, jitter, pool)
    }

    /// The samples of [`render`](Self::render) for the coarse field and for the field proper.
    pub fn samples<T: Scalar>(
        &self,
        params: &Bound<'_, T>,
        rays: &Rays<T>,
        jitter: &mut Jitter<'_>,
    ) -> [Samples<T>; 2] {
        let tape = params.tape();
        let first = stratified(rays, self.config.coarse, jitter, tape.pool());
        let (_, weights) = composite_samples(&self.proposal, params, &first, false, tape);
        let second = self.refine(rays, &first, &weights, jitter, tape.pool());
        [first, second]
    }
}
