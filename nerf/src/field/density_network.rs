//! A hash grid with a small density network.

use super::{Density, Grid, log_density_shift};
use crate::Result;
use crate::component::BuildContext;
use crate::encoding::hash_grid::HashGridConfig;
use raygrad_autograd::{Activation, Scalar, Var};
use raygrad_nn::{Bound, Init, Linear};

/// A multiresolution hash grid and a network of one hidden layer without biases. Its first output is the log density
/// (Müller et al. 2022, section 5.4).
#[derive(Debug, Clone)]
pub(crate) struct DensityNetwork {
    pub grid: Grid,
    layers: [Linear; 2],
    /// Subtracted from the log density.
    shift: f64,
}

impl DensityNetwork {
    /// With `features` outputs, the density among them, and new parameters `<name>.table` and `<name>.density...`.
    ///
    /// # Errors
    /// If the grid is out of range.
    pub fn new<T: Scalar>(
        grid: &HashGridConfig,
        width: usize,
        features: usize,
        mut site: BuildContext<'_, T>,
    ) -> Result<Self> {
        let shift = log_density_shift(site.space.unit);
        let grid = Grid::new(grid, site.child(site.name))?;
        let sizes = [([grid.width(), width], Activation::Relu), ([width, features], Activation::Identity)];
        let BuildContext { params, name, rng, .. } = site;
        let layers = [0, 1].map(|i| {
            let (sizes, activation) = sizes[i];
            Linear::without_bias(params, &format!("{name}.density.{i}"), sizes, activation, Init::He, &mut *rng)
        });
        Ok(DensityNetwork { grid, layers, shift })
    }

    /// The same with that share of the levels of its grid: see [`Grid::with_detail`].
    #[must_use]
    pub fn with_detail(&self, detail: f64) -> Self {
        DensityNetwork { grid: self.grid.with_detail(detail), ..self.clone() }
    }

    /// The density at `positions` `[samples, 3]`, in scene units; all outputs are its features.
    #[track_caller]
    pub fn density<'t, T: Scalar>(&self, params: &Bound<'t, T>, positions: &Var<'t, T>) -> Density<'t, T> {
        let hidden = self.layers[0].forward(params, &self.grid.encode(params, positions));
        let features = self.layers[1].forward(params, &hidden);
        let raw = features.slice_axis(1, ..1).reshape(&[positions.shape()[0]]);
        Density { value: raw - self.shift, log: true, features }
    }
}
