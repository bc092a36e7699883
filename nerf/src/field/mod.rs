//! Fields: functions of position and direction that give density and colour.

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

/// Logarithms of densities are cut here: `e^80 delta` is opaque for any interval above 1e-32, and finite.
pub(crate) const MOST_LOG_DENSITY: f64 = 80.0;

/// What fields whose density is an exponential subtract from its logarithm, in a space of this unit, in scene units: a new one is a
/// thin fog, of density about 0.4 in the space's unit.
pub fn log_density_shift(unit: f64) -> f64 {
    1.0 + unit.ln()
}

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
    /// Density per scene unit, `[samples]`; a logarithm counts as at most 80.
    #[track_caller]
    pub fn sigma(&self) -> Var<'t, T> {
        if self.log { self.value.minimum(MOST_LOG_DENSITY).exp() } else { self.value.clone() }
    }
}

/// From where samples are seen.
#[derive(Clone, Copy)]
pub struct ViewInputs<'a, 't, T: Scalar> {
    /// Unit directions of the rays, `[rays, 3]`.
    pub directions: &'a Var<'t, T>,
    /// Which samples belong to which ray.
    pub segments: &'a Segments,
    /// The number of the photograph that each ray belongs to, `[rays]`: for a field with a code for each photograph. There
    /// is none in views, unless they are to have the [look](crate::Model::appearance_image) of one.
    pub frames: Option<&'a [u32]>,
}

/// A radiance field. Density depends on position alone, so that surfaces stay where they are from every side; colour
/// depends on the viewing direction too.
///
/// A field of one's own implements this and, for its configuration, [`ComponentConfig<Fields>`](crate::ComponentConfig); with
/// [`register`](crate::component::register) it is trained, rendered, saved and loaded like those of this crate.
pub trait Field<T: Scalar>: Any + Send + Sync {
    /// The density at `positions` `[samples, 3]`, in scene units. What it says of one position must not depend on the
    /// others: training asks of many and goes on with some, and takes the outputs of operations that
    /// [are kept](raygrad_autograd::Op::is_cacheable), row by row, from the first time (if they have a row for each position).
    fn density<'t>(&self, params: &Bound<'t, T>, positions: &Var<'t, T>) -> Density<'t, T>;

    /// Colour `[samples, 3]` in 0..=1, for the features that [`density`](Self::density) gave, some rows of them or all.
    fn color<'t>(&self, params: &Bound<'t, T>, features: &Var<'t, T>, seen: &ViewInputs<'_, 't, T>) -> Var<'t, T>;

    /// The same field, with the same parameters, as it is with that share of its detail, 0 to 1: while cameras are learned,
    /// detail comes in [from coarse to fine](crate::model::CameraOptimizerConfig::coarse). `None` for a field that has all of it at
    /// once.
    fn with_detail(&self, _detail: f64) -> Option<Arc<dyn Field<T>>> {
        None
    }
}

/// The family of fields.
pub struct Fields;

impl ComponentType for Fields {
    const WHAT: &'static str = "field";
    type Built<T: Scalar> = Arc<dyn Field<T>>;
}

/// Which field, and its size.
pub type FieldConfig = AnyConfig<Fields>;

/// How a network's raw output becomes a density.
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
    /// The density for the raw output `x`.
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
    fn a_new_field_is_a_thin_fog_in_its_own_unit() {
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
