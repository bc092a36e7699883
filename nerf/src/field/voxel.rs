//! A voxel grid without a network.

use super::grid::Grid;
use super::{Density, Field, Fields, ViewInputs, log_density_shift};
use crate::Result;
use crate::component::{BuildContext, ComponentConfig};
use crate::encoding::hash_grid::HashGridConfig;
use crate::encoding::spherical::SphericalHarmonics;
use crate::range::check_range;
use raygrad_autograd::{Scalar, Var};
use raygrad_nn::Bound;
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// Configuration of a [`Voxel`] field.
///
/// The table has `(resolution + 1)^3` rows of `1 + 3 direction_degree^2` numbers, rounded up to a power of two: 137 MB
/// at 128 and degree 2. Training takes four times as much, for the gradient and two moments.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct VoxelConfig {
    /// Cells along the longest side of the scene box. Range: 1 to 512.
    pub resolution: usize,
    /// Degree of the spherical harmonics that represent a colour. Range: 1 to 3.
    pub direction_degree: usize,
}

impl ComponentConfig<Fields> for VoxelConfig {
    const KIND: &'static str = "voxel";

    fn check(&self) -> Result<()> {
        check_range("resolution", self.resolution, 1, 512)?;
        check_range("direction_degree", self.direction_degree, 1, 3)
    }

    fn build<T: Scalar>(&self, site: BuildContext<'_, T>) -> Result<Arc<dyn Field<T>>> {
        Ok(Arc::new(Voxel::new(self, site)?))
    }
}

/// Factor of the log density. Without a network a parameter changes by little more than the learning rate per step, and
/// log densities have a larger range than colours.
const LOG_DENSITY_GAIN: f64 = 10.0;

/// A voxel grid of densities and spherical harmonics (Fridovich-Keil et al. 2022, "Plenoxels: Radiance Fields without
/// Neural Networks", section 3.2).
///
/// Each corner of a dense grid has a log density and spherical harmonics per colour channel, interpolated trilinearly.
/// The colour is the sigmoid of the harmonics' sum. Unlike the paper, the density is an exponential, and the grid is
/// neither refined nor pruned. A row of the table is the log density, then the coefficients of red, green and blue,
/// then padding.
#[derive(Debug, Clone)]
pub struct Voxel {
    grid: Grid,
    direction: SphericalHarmonics,
    /// Subtracted from the log density.
    shift: f64,
}

impl Voxel {
    /// Creates a field with one parameter, `<name>.table`.
    ///
    /// # Errors
    /// If the configuration is out of range.
    pub fn new<T: Scalar>(config: &VoxelConfig, site: BuildContext<'_, T>) -> Result<Self> {
        config.check()?;
        let direction = SphericalHarmonics::new(config.direction_degree);
        let grid = HashGridConfig {
            levels: 1,
            features: (1 + 3 * direction.width()).next_power_of_two(),
            log2_table: HashGridConfig::MOST_LOG2_TABLE,
            coarsest: config.resolution,
            finest: config.resolution,
        };
        let shift = log_density_shift(site.space.unit);
        Ok(Voxel { grid: Grid::new(&grid, site)?, direction, shift })
    }

    /// Returns the grid.
    pub fn grid(&self) -> &Grid {
        &self.grid
    }
}

impl<T: Scalar> Field<T> for Voxel {
    fn density<'t>(&self, params: &Bound<'t, T>, positions: &Var<'t, T>) -> Density<'t, T> {
        let features = self.grid.encode(params, positions);
        let raw = features.slice_axis(1, ..1).reshape(&[positions.shape()[0]]);
        Density { value: raw * LOG_DENSITY_GAIN - self.shift, log: true, features }
    }

    fn color<'t>(&self, _params: &Bound<'t, T>, features: &Var<'t, T>, seen: &ViewInputs<'_, 't, T>) -> Var<'t, T> {
        let (samples, width) = (features.shape()[0], self.direction.width());
        let directions = features.tape().apply(self.direction, &[seen.directions]).segment_expand(seen.segments);
        let coefficients = features.slice_axis(1, 1..1 + 3 * width).reshape(&[samples, 3, width]);
        (coefficients * directions.reshape(&[samples, 1, width])).sum_over(-1).sigmoid()
    }
}
