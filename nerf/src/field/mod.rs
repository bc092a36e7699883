//! Radiance fields: density and colour as functions of position and direction.
//!
//! [`Instant`] is a hash grid, [`Classic`] the NeRF paper's network, [`Voxel`] a voxel grid. Implement [`Field`] for a
//! custom one; see docs/library/custom-field.md.

mod classic;
mod density_network;
mod grid;
mod instant;
mod voxel;

pub use classic::{Classic, ClassicConfig};
pub(crate) use density_network::DensityNetwork;
pub use grid::Grid;
pub use instant::{Instant, InstantConfig};
pub use voxel::{Voxel, VoxelConfig};

use crate::component::{AnyConfig, ComponentType};
use raygrad_autograd::{Scalar, Segments, Var};
use raygrad_nn::Bound;
use serde::{Deserialize, Serialize};
use std::any::Any;
use std::sync::Arc;

/// The largest log density: `e^80 delta` is opaque for any interval above 1e-32, and finite.
pub(crate) const MOST_LOG_DENSITY: f64 = 80.0;

/// Returns the shift that fields with an exponential density subtract from its logarithm; `unit` is
/// [`Space::unit`](crate::Space::unit), in scene units.
///
/// With it a new field is a thin fog, of density about 0.4 per unit.
pub fn log_density_shift(unit: f64) -> f64 {
    1.0 + unit.ln()
}

/// The density of samples, with the features that their colour is computed from.
pub struct Density<'t, T: Scalar> {
    /// Density sigma per scene unit, at least 0, or its natural logarithm, `[samples]`.
    pub value: Var<'t, T>,
    /// Whether `value` is the logarithm.
    pub log: bool,
    /// Input of [`Field::color`], `[samples, features]`.
    pub features: Var<'t, T>,
}

impl<'t, T: Scalar> Density<'t, T> {
    /// Returns the density sigma per scene unit, `[samples]`; a logarithm is clamped at 80.
    #[track_caller]
    pub fn sigma(&self) -> Var<'t, T> {
        if self.log { self.value.minimum(MOST_LOG_DENSITY).exp() } else { self.value.clone() }
    }
}

/// The viewing rays of samples, as input of [`Field::color`].
#[derive(Clone, Copy)]
pub struct ViewInputs<'a, 't, T: Scalar> {
    /// Unit directions of the rays, `[rays, 3]`.
    pub directions: &'a Var<'t, T>,
    /// The rows of each ray's samples.
    pub segments: &'a Segments,
    /// The image index of each ray, `[rays]`, for fields with appearance embeddings. `None` in renders without an
    /// [`appearance_image`](crate::Model::appearance_image).
    pub frames: Option<&'a [u32]>,
}

/// A radiance field: density from position, colour from position and viewing direction.
///
/// A custom field implements this trait and, for its configuration,
/// [`ComponentConfig<Fields>`](crate::ComponentConfig). After [`register`](crate::component::register) it trains,
/// renders, saves and loads like the built-in fields.
pub trait Field<T: Scalar>: Any + Send + Sync {
    /// Computes the density at `positions` `[samples, 3]`, in scene units.
    ///
    /// Each row must depend on its own position only. Training evaluates many positions, keeps some, and reuses the
    /// rows of [cacheable](raygrad_autograd::Op::is_cacheable) operations from the first pass.
    fn density<'t>(&self, params: &Bound<'t, T>, positions: &Var<'t, T>) -> Density<'t, T>;

    /// Computes colours `[samples, 3]`, 0 to 1, from rows of the features that [`density`](Self::density) returned.
    fn color<'t>(&self, params: &Bound<'t, T>, features: &Var<'t, T>, seen: &ViewInputs<'_, 't, T>) -> Var<'t, T>;

    /// Returns the field with a share of its detail, 0 to 1, and the same parameters.
    ///
    /// Pose refinement enables detail [from coarse to fine](crate::model::CameraOptimizerConfig::coarse). `None`, the
    /// default, is for fields without levels of detail.
    fn with_detail(&self, _detail: f64) -> Option<Arc<dyn Field<T>>> {
        None
    }
}

/// The [`ComponentType`] of fields.
pub struct Fields;

impl ComponentType for Fields {
    const WHAT: &'static str = "field";
    type Built<T: Scalar> = Arc<dyn Field<T>>;
}

/// The configuration of any field.
pub type FieldConfig = AnyConfig<Fields>;

/// The activation from a network's raw output to a density.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum DensityActivation {
    /// `softplus(x - 1)`: smooth, with a gradient everywhere.
    Softplus,
    /// `max(x, 0)`, as in the NeRF paper. Empty space is exactly empty, but a network may start without any
    /// density.
    Relu,
}

impl DensityActivation {
    /// Applies the activation to the raw output `x`, of any shape.
    #[track_caller]
    pub fn apply<'t, T: Scalar>(self, x: &Var<'t, T>) -> Var<'t, T> {
        match self {
            DensityActivation::Softplus => (x - 1.0).softplus(),
            DensityActivation::Relu => x.relu(),
        }
    }
}

#[cfg(test)]
mod tests {
    use crate::{Config, Model, Preset, SceneBox};
    use glam::DVec3;

    #[test]
    fn new_field_is_a_thin_fog_in_its_unit() {
        for preset in [Preset::Instant, Preset::Voxel] {
            for unit in [1.0, 4.0] {
                let extent = SceneBox { unit, ..SceneBox::new([DVec3::NEG_ONE, DVec3::ONE], [0.0, 10.0]) };
                let model = Model::<f32>::new(Config::preset(preset), extent, 0).unwrap();
                let (mut seen, expected) = ([0.0], (-1.0_f64).exp() / unit);
                model.densities(&[[0.1, -0.2, 0.3]], &mut seen);
                assert!((f64::from(seen[0]) / expected - 1.0).abs() < 0.05, "{preset} {unit}: {seen:?} {expected}");
            }
        }
    }
}
