//! A hash grid over a scene, with its table as a parameter.

use crate::Result;
use crate::component::BuildContext;
use crate::encoding::detail_weights;
use crate::encoding::hash_grid::{HashEncoding, HashGrid, HashGridConfig};
use crate::space::cube::Space;
use rand::RngExt;
use raygrad_autograd::{Scalar, Tensor, Var};
use raygrad_nn::{Bound, ParamId};
use std::sync::Arc;

/// Levels that coarse-to-fine training enables from the start, see [`Grid::with_detail`].
const FIRST_LEVELS: usize = 3;

/// A hash grid over the scene with its table parameter, shared by fields that look up positions.
#[derive(Debug, Clone)]
pub struct Grid {
    encoding: HashEncoding,
    table: ParamId,
    space: Space,
    /// The weight of each level; `None` if all are 1.
    weights: Option<Arc<[f64]>>,
}

impl Grid {
    /// Creates a grid over the scene with the parameter `<name>.table`, which sparse (lazy) Adam updates by rows.
    ///
    /// # Errors
    /// If the configuration is out of range.
    pub fn new<T: Scalar>(config: &HashGridConfig, site: BuildContext<'_, T>) -> Result<Self> {
        let grid = HashGrid::new(config)?;
        let name = format!("{}.table", site.name);
        let table = site.params.add(name.clone(), grid.init(site.rng.random()));
        site.params.set_lazy(|other| other == name, true);
        Ok(Grid { encoding: HashEncoding::new(grid), table, space: site.space, weights: None })
    }

    /// Returns the grid with a share of its levels enabled, 0 to 1, the coarsest first: see [`detail_weights`].
    #[must_use]
    pub fn with_detail(&self, detail: f64) -> Self {
        let weights = detail_weights(detail, self.grid().levels().len(), FIRST_LEVELS).map(Into::into);
        Grid { weights, ..self.clone() }
    }

    /// Returns the grid with this [gradient cut](HashEncoding::with_gradient_cut), initially 0.
    ///
    /// # Panics
    /// If `gradient_cut` is not 0 to 1.
    #[must_use]
    #[track_caller]
    pub fn with_gradient_cut(self, gradient_cut: f64) -> Self {
        Grid { encoding: self.encoding.with_gradient_cut(gradient_cut), ..self }
    }

    /// Returns the number of channels of an encoding.
    pub fn width(&self) -> usize {
        self.grid().width()
    }

    /// Returns the weight of each level's features, or `None` if all are 1.
    pub fn weights(&self) -> Option<&[f64]> {
        self.weights.as_deref()
    }

    /// Returns the table parameter.
    pub fn table(&self) -> ParamId {
        self.table
    }

    /// Returns the hash grid.
    pub fn grid(&self) -> &HashGrid {
        self.encoding.grid()
    }

    /// Encodes positions `[samples, 3]` (scene units) to features `[samples, width]`.
    #[track_caller]
    pub fn encode<'t, T: Scalar>(&self, params: &Bound<'t, T>, positions: &Var<'t, T>) -> Var<'t, T> {
        let tape = positions.tape();
        let features = tape.apply(self.encoding.clone(), &[&self.space.cube(positions), &params[self.table]]);
        let Some(weights) = &self.weights else { return features };
        let each = self.grid().features();
        features * tape.constant(Tensor::from_fn(&[self.width()], |i| T::from_f64(weights[i / each])))
    }
}
