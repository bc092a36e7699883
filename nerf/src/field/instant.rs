//! A hash grid and two small networks.

use super::boxed_grid::BoxedGrid;
use super::{Density, Field};
use crate::Result;
use crate::encoding::hash_grid::{HashGrid, HashGridConfig};
use crate::encoding::spherical::SphericalHarmonics;
use crate::range::check_range;
use glam::DVec3;
use rand::Rng;
use raygrad_autograd::{Activation, Scalar, Segments, Tensor, Var};
use raygrad_nn::{Bound, Init, Linear, ParamId, Params};
use serde::{Deserialize, Serialize};

/// Size of an [`Instant`] field.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct InstantConfig {
    /// The grid that positions are looked up in.
    pub grid: HashGridConfig,
    /// Width of the one hidden layer between the grid and the density.
    pub density_width: usize,
    /// Outputs of the density network: the first is the logarithm of the density, all are seen by the colour network.
    pub features: usize,
    /// Width of the colour network's hidden layers.
    pub color_width: usize,
    /// Number of its hidden layers.
    pub color_depth: usize,
    /// Degree of the spherical harmonics that encode directions, 1 to 4.
    pub direction_degree: usize,
}

impl InstantConfig {
    fn check(&self) -> Result<()> {
        check_range("density_width", self.density_width, 1, 1 << 12)?;
        check_range("features", self.features, 1, 1 << 12)?;
        check_range("color_width", self.color_width, 1, 1 << 12)?;
        check_range("color_depth", self.color_depth, 1, 64)?;
        check_range("direction_degree", self.direction_degree, 1, 4)
    }
}

/// Subtracted from the logarithm of the density: a new field is a thin fog, of density about 0.4 in a box of side 1.
const LOG_DENSITY_SHIFT: f64 = 1.0;

/// A field as in Mueller et al. 2022, section 5.4: a multiresolution hash grid, a density network of one hidden layer,
/// and a colour network that sees its outputs and the direction. No layer has a bias. The density is the exponential of
/// the first output.
#[derive(Debug, Clone)]
pub struct Instant {
    grid: BoxedGrid,
    direction: SphericalHarmonics,
    density: [Linear; 2],
    color: Vec<Linear>,
}

impl Instant {
    /// A field for the box `bounds` (lower and upper corner) with new parameters `<name>...` in `params`.
    ///
    /// # Errors
    /// If the configuration is out of range.
    pub fn new<T: Scalar>(
        config: &InstantConfig,
        bounds: [DVec3; 2],
        params: &mut Params<T>,
        name: &str,
        rng: &mut impl Rng,
    ) -> Result<Self> {
        config.check()?;
        let grid = BoxedGrid::new(&config.grid, bounds, params, name, rng)?;
        let direction = SphericalHarmonics::new(config.direction_degree);
        let mut layer = |part: String, sizes, activation| {
            Linear::without_bias(params, &format!("{name}.{part}"), sizes, activation, Init::He, &mut *rng)
        };
        let InstantConfig { density_width, features, color_width, color_depth, .. } = *config;
        let density = [
            layer("density.0".into(), [grid.width(), density_width], Activation::Relu),
            layer("density.1".into(), [density_width, features], Activation::Identity),
        ];
        let mut color = Vec::with_capacity(color_depth + 1);
        for i in 0..=color_depth {
            let inputs = if i == 0 { features + direction.width() } else { color_width };
            let last = i == color_depth;
            let (outputs, activation) = if last { (3, Activation::Identity) } else { (color_width, Activation::Relu) };
            color.push(layer(format!("color.{i}"), [inputs, outputs], activation));
        }
        Ok(Instant { grid, direction, density, color })
    }
}

impl<T: Scalar> Field<T> for Instant {
    fn encode<'t>(&self, params: &Bound<'t, T>, positions: &Var<'t, T>) -> Var<'t, T> {
        self.grid.encode(params, positions)
    }

    fn encode_known<'t>(&self, params: &Bound<'t, T>, positions: &Var<'t, T>, known: Tensor<T>) -> Var<'t, T> {
        self.grid.encode_known(params, positions, known)
    }

    fn density<'t>(&self, params: &Bound<'t, T>, encoding: &Var<'t, T>) -> Density<'t, T> {
        let hidden = self.density[0].forward(params, encoding);
        let features = self.density[1].forward(params, &hidden);
        let raw = features.slice_axis(1, ..1).reshape(&[encoding.shape()[0]]);
        Density { value: raw - LOG_DENSITY_SHIFT, log: true, features }
    }

    fn color<'t>(
        &self,
        params: &Bound<'t, T>,
        features: &Var<'t, T>,
        directions: &Var<'t, T>,
        segments: &Segments,
    ) -> Var<'t, T> {
        let seen = directions.tape().apply(self.direction, &[directions]).segment_expand(segments);
        let mut hidden = Var::concat(&[features, &seen], 1);
        for layer in &self.color {
            hidden = layer.forward(params, &hidden);
        }
        hidden.sigmoid()
    }

    fn table(&self) -> Option<(ParamId, &HashGrid)> {
        Some(self.grid.table())
    }
}
