//! Hierarchical sampling with a coarse and a fine field (NeRF).

use super::steps::importance_sampling;
use super::{BatchSize, Purpose, Sampled, Sampler, Samplers};
use crate::Result;
use crate::camera::rays::{Rays, stratified};
use crate::component::{BuildContext, ComponentConfig};
use crate::field::{Classic, ClassicConfig, Field};
use crate::random::Jitter;
use crate::range::check_range;
use crate::volume::quadrature::Quadrature;
use crate::volume::query::Query;
use crate::volume::render::Evaluations;
use raygrad_autograd::Scalar;
use serde::{Deserialize, Serialize};

/// Configuration of a [`Hierarchical`] sampler.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HierarchicalConfig {
    /// The coarse field.
    pub proposal: ClassicConfig,
    /// Stratified samples a ray for the coarse network. Range: 1 to 4096.
    pub coarse: usize,
    /// Further samples a ray, placed by importance sampling from the weights of the coarse network. Range: 0 to
    /// 4096.
    pub fine: usize,
    /// Share of the further samples that is spread evenly. Range: 0 to 1.
    pub uniform_share: f64,
    /// Rays in a training step. Range: 1 to 1048576.
    pub batch: usize,
    /// Rays in a tile, which one core computes on one tape. Range: 1 to 65536.
    pub tile: usize,
}

impl Default for HierarchicalConfig {
    /// The paper's values: a coarse network as large as the fine one, 64 + 128 samples.
    fn default() -> Self {
        let proposal = ClassicConfig::paper();
        HierarchicalConfig { proposal, coarse: 64, fine: 128, uniform_share: 0.01, batch: 1024, tile: 8 }
    }
}

impl ComponentConfig<Samplers> for HierarchicalConfig {
    const KIND: &'static str = "hierarchical";

    fn check(&self) -> Result<()> {
        check_range("coarse", self.coarse, 1, 1 << 12)?;
        check_range("fine", self.fine, 0, 1 << 12)?;
        check_range("batch", self.batch, 1, 1 << 20)?;
        check_range("tile", self.tile, 1, 1 << 16)?;
        check_range("uniform_share", self.uniform_share, 0.0, 1.0)
    }

    fn build<T: Scalar>(&self, site: BuildContext<'_, T>) -> Result<Box<dyn Sampler<T>>> {
        let proposal = Classic::new(&self.proposal, BuildContext { name: "proposal", ..site })?;
        Ok(Box::new(Hierarchical { config: self.clone(), proposal }))
    }
}

/// Hierarchical sampling (Mildenhall et al. 2020, section 5.2). The coarse field is trained on the images too.
#[derive(Debug, Clone)]
pub struct Hierarchical {
    /// The configuration.
    pub config: HierarchicalConfig,
    /// The coarse field.
    pub proposal: Classic,
}

impl<T: Scalar> Sampler<T> for Hierarchical {
    fn sample<'t>(
        &self,
        query: &Query<'_, 't, T>,
        rays: &Rays<T>,
        _: Purpose,
        jitter: &mut Jitter<'_>,
    ) -> Sampled<'t, T> {
        let HierarchicalConfig { coarse, fine, uniform_share, .. } = self.config;
        let pool = query.tape().pool();
        let first = stratified(rays, coarse, jitter, pool);
        let seen = Quadrature::Midpoint.render_nodes(&query.of(&self.proposal), first);
        let weights = seen.weights.value().as_slice();
        let steps = importance_sampling(rays, &seen.samples, weights, fine, uniform_share, jitter, pool);
        let asked = weights.len() as u64;
        let evaluations = Evaluations { density: asked, color: asked, unskipped: asked + steps.len() as u64 };
        Sampled { samples: steps, coarse: vec![seen], histograms: vec![], evaluations }
    }

    fn batch_size(&self) -> BatchSize {
        BatchSize::Rays { step: self.config.batch, tile: self.config.tile }
    }

    fn boxed(&self) -> Box<dyn Sampler<T>> {
        Box::new(self.clone())
    }

    fn fields(&self) -> Vec<&dyn Field<T>> {
        vec![&self.proposal]
    }

    fn set_detail(&mut self, detail: f64) {
        self.proposal = self.proposal.coarsened(detail);
    }
}
