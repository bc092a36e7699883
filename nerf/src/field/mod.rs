//! Fields: functions of position and direction that give density and colour.

mod classic;

pub use classic::{Classic, ClassicConfig};

use raygrad_autograd::{Bound, Scalar, Segments, Var};
use serde::{Deserialize, Serialize};

/// What a field says of positions alone.
pub struct Density<'t, T: Scalar> {
    /// Density per scene unit, `[samples]`, at least 0.
    pub sigma: Var<'t, T>,
    /// What the colour is computed from, `[samples, features]`.
    pub features: Var<'t, T>,
}

/// A radiance field. Density depends on position alone, so that surfaces stay where they are from every side; colour
/// depends on the viewing direction too.
pub trait Field<T: Scalar>: Send + Sync {
    /// Density at `positions` `[samples, 3]` in scene units.
    fn density<'t>(&self, params: &Bound<'t, T>, positions: &Var<'t, T>) -> Density<'t, T>;

    /// Colour `[samples, 3]` in 0..=1, seen along the unit `directions` `[rays, 3]`; `segments` says which samples
    /// belong to which ray.
    fn color<'t>(
        &self,
        params: &Bound<'t, T>,
        features: &Var<'t, T>,
        directions: &Var<'t, T>,
        segments: &Segments,
    ) -> Var<'t, T>;
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
