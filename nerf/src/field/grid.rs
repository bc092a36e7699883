//! A hash grid over a scene, with its table among the parameters.

use crate::Result;
use crate::component::BuildContext;
use crate::encoding::detail_weights;
use crate::encoding::hash_grid::{HashEncoding, HashGrid, HashGridConfig};
use crate::space::cube::Space;
use rand::RngExt;
use raygrad_autograd::{Scalar, Tensor, Var};
use raygrad_nn::{Bound, ParamId};
use std::sync::Arc;

/// Levels that are there from the start where [detail](Grid::with_detail) comes in.
const FIRST_LEVELS: usize = 3;

/// What fields that look positions up in a table have in common.
#[derive(Debug, Clone)]
pub struct Grid {
    grid: HashGrid,
    table: ParamId,
    space: Space,
    /// The weight of each level, if they are not all 1.
    weights: Option<Arc<[f64]>>,
}

impl Grid {
    /// A grid over the scene with a new parameter `<name>.table`. Its gradient is sparse, and only rows that got one are
    /// moved.
    ///
    /// # Errors
    /// If the configuration is out of range.
    pub fn new<T: Scalar>(config: &HashGridConfig, site: BuildContext<'_, T>) -> Result<Self> {
        let grid = HashGrid::new(config)?;
        let name = format!("{}.table", site.name);
        let table = site.params.add(name.clone(), grid.init(site.rng.random()));
        site.params.set_lazy(|other| other == name, true);
        Ok(Grid { grid, table, space: site.space, weights: None })
    }

    /// The same grid with that share of its levels, 0 to 1, the coarsest first: see [`detail_weights`].
    #[must_use]
    pub fn with_detail(&self, detail: f64) -> Self {
        let weights = detail_weights(detail, self.grid.levels().len(), FIRST_LEVELS).map(Into::into);
        Grid { weights, ..self.clone() }
    }

    /// Channels of an encoding.
    pub fn width(&self) -> usize {
        self.grid.width()
    }

    /// What the features of each level are multiplied by, if not all of them count in full.
    pub fn weights(&self) -> Option<&[f64]> {
        self.weights.as_deref()
    }

    /// The parameter.
    pub fn table(&self) -> ParamId {
        self.table
    }

    /// The grid.
    pub fn grid(&self) -> &HashGrid {
        &self.grid
    }

    /// The features at positions in scene units, `[samples, 3]` to `[samples, width]`.
    #[track_caller]
    pub fn encode<'t, T: Scalar>(&self, params: &Bound<'t, T>, positions: &Var<'t, T>) -> Var<'t, T> {
        let tape = positions.tape();
        let features = tape.apply(HashEncoding(self.grid.clone()), &[&self.space.cube(positions), &params[self.table]]);
        let Some(weights) = &self.weights else { return features };
        let each = self.grid.features();
        features * tape.constant(Tensor::from_fn(&[self.width()], |i| T::from_f64(weights[i / each])))
    }
}
