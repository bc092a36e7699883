//! Fields: functions of position and direction that give density and colour.

mod boxed_grid;
mod classic;
mod instant;
mod voxel;

pub use classic::{Classic, ClassicConfig};
pub use instant::{Instant, InstantConfig};
pub use voxel::{Voxel, VoxelConfig};

use crate::Result;
use crate::encoding::hash_grid::HashGrid;
use crate::volume::composite::Composite;
use glam::DVec3;
use rand::Rng;
use raygrad_autograd::{Scalar, Segments, Tensor, Var};
use raygrad_nn::{Bound, ParamId, Params};
use serde::{Deserialize, Serialize};

/// What a field says of positions alone.
pub struct Density<'t, T: Scalar> {
    /// Density per scene unit, at least 0, or its natural logarithm, `[samples]`.
    pub value: Var<'t, T>,
    /// Whether `value` is the logarithm.
    pub log: bool,
    /// What the colour is computed from, `[samples, features]`.
    pub features: Var<'t, T>,
}

impl<'t, T: Scalar> Density<'t, T> {
    /// Density per scene unit, `[samples]`.
    #[track_caller]
    pub fn sigma(&self) -> Var<'t, T> {
        if self.log { self.value.exp() } else { self.value.clone() }
    }

    /// The operation that composites samples of this density over intervals `delta` `[samples]`.
    ///
    /// # Panics
    /// As [`Composite::new`].
    #[track_caller]
    pub fn composite(&self, delta: Tensor<T>, segments: Segments) -> Composite<T> {
        if self.log { Composite::of_log_density(delta, segments) } else { Composite::new(delta, segments) }
    }
}

/// A radiance field. Density depends on position alone, so that surfaces stay where they are from every side; colour
/// depends on the viewing direction too.
pub trait Field<T: Scalar>: Send + Sync {
    /// The encoding of `positions` `[samples, 3]`, in scene units, that the network sees: `[samples, channels]`.
    fn encode<'t>(&self, params: &Bound<'t, T>, positions: &Var<'t, T>) -> Var<'t, T>;

    /// As [`encode`](Self::encode), for an encoding that is known from an unrecorded pass.
    fn encode_known<'t>(&self, params: &Bound<'t, T>, positions: &Var<'t, T>, known: Tensor<T>) -> Var<'t, T>;

    /// Density for an encoding.
    fn density<'t>(&self, params: &Bound<'t, T>, encoding: &Var<'t, T>) -> Density<'t, T>;

    /// Colour `[samples, 3]` in 0..=1, seen along the unit `directions` `[rays, 3]`; `segments` says which samples
    /// belong to which ray.
    fn color<'t>(
        &self,
        params: &Bound<'t, T>,
        features: &Var<'t, T>,
        directions: &Var<'t, T>,
        segments: &Segments,
    ) -> Var<'t, T>;

    /// The parameter that is a table with sparse gradients, and the grid that it belongs to.
    fn table(&self) -> Option<(ParamId, &HashGrid)> {
        None
    }
}

/// Which field, and its size.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "lowercase")]
pub enum FieldConfig {
    /// The network of the NeRF paper.
    Classic(ClassicConfig),
    /// A hash grid with two small networks.
    Instant(InstantConfig),
    /// A grid of voxels without a network.
    Voxel(VoxelConfig),
}

impl FieldConfig {
    /// A field for the box `bounds` with new parameters `<name>...` in `params`.
    ///
    /// # Errors
    /// If the configuration is out of range.
    pub fn build<T: Scalar>(
        &self,
        bounds: [DVec3; 2],
        params: &mut Params<T>,
        name: &str,
        rng: &mut impl Rng,
    ) -> Result<std::sync::Arc<dyn Field<T>>> {
        Ok(match self {
            FieldConfig::Classic(config) => std::sync::Arc::new(Classic::new(config, bounds, params, name, rng)?),
            FieldConfig::Instant(config) => std::sync::Arc::new(Instant::new(config, bounds, params, name, rng)?),
            FieldConfig::Voxel(config) => std::sync::Arc::new(Voxel::new(config, bounds, params, name, rng)?),
        })
    }
}

/// How a network's raw output becomes a density.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum DensityActivation {
    /// `softplus(x - 1)`: smooth, and never without a gradient.
    Softplus,
    /// `max(x, 0)`, as in the paper: empty space is exactly empty, but a network may start with no density anywhere.
    Relu,
}

impl DensityActivation {
    /// The density for the raw output `x`.
    #[track_caller]
    pub fn apply<'t, T: Scalar>(self, x: &Var<'t, T>) -> Var<'t, T> {
        match self {
            DensityActivation::Softplus => (x - 1.0).softplus(),
            DensityActivation::Relu => x.relu(),
        }
    }
}
