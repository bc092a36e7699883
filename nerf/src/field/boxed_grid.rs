//! A hash grid over a box of scene units, with its table among the parameters.

use crate::Result;
use crate::encoding::hash_grid::{HashEncoding, HashGrid, HashGridConfig};
use glam::DVec3;
use rand::{Rng, RngExt};
use raygrad_autograd::{Scalar, Tensor, Var};
use raygrad_nn::{Bound, ParamId, Params};

/// What fields that look positions up in a table have in common.
#[derive(Debug, Clone)]
pub(super) struct BoxedGrid {
    grid: HashGrid,
    table: ParamId,
    /// `(x - low) * scale` lies in the unit cube for x in the box.
    low: DVec3,
    scale: f64,
}

impl BoxedGrid {
    /// A grid over the box `bounds` (lower and upper corner) with a new parameter `<name>.table` in `params`.
    ///
    /// # Errors
    /// If the configuration is out of range.
    pub fn new<T: Scalar>(
        config: &HashGridConfig,
        bounds: [DVec3; 2],
        params: &mut Params<T>,
        name: &str,
        rng: &mut impl Rng,
    ) -> Result<Self> {
        let grid = HashGrid::new(config)?;
        let table = params.add(format!("{name}.table"), grid.init(rng.random()));
        let scale = 1.0 / (bounds[1] - bounds[0]).max_element();
        Ok(BoxedGrid { grid, table, low: bounds[0], scale })
    }

    /// Channels of an encoding.
    pub fn width(&self) -> usize {
        self.grid.width()
    }

    /// The table and its grid.
    pub fn table(&self) -> (ParamId, &HashGrid) {
        (self.table, &self.grid)
    }

    /// Positions in the unit cube.
    #[track_caller]
    fn local<'t, T: Scalar>(&self, positions: &Var<'t, T>) -> Var<'t, T> {
        let shift = (-self.low * self.scale).to_array().map(T::from_f64);
        positions * self.scale + positions.tape().constant(Tensor::from_vec(&[3], shift.to_vec()))
    }

    /// The features at positions in scene units, `[samples, 3]` to `[samples, width]`.
    pub fn encode<'t, T: Scalar>(&self, params: &Bound<'t, T>, positions: &Var<'t, T>) -> Var<'t, T> {
        positions.tape().apply(HashEncoding(self.grid.clone()), &[&self.local(positions), &params[self.table]])
    }

    /// As [`encode`](Self::encode), for features that are known from an unrecorded pass.
    pub fn encode_known<'t, T: Scalar>(
        &self,
        params: &Bound<'t, T>,
        positions: &Var<'t, T>,
        known: Tensor<T>,
    ) -> Var<'t, T> {
        let inputs = [&self.local(positions), &params[self.table]];
        positions.tape().apply_known(HashEncoding(self.grid.clone()), &inputs, known)
    }
}
