//! The sparse gradient of the table, which an optimizer sums level by level.

use super::grid::HashGrid;
use super::grid::HashGridConfig;
use raygrad_autograd::{RowShare, RowSums, Scalar, SparseGrad, SparseParts, Tensor};
use std::sync::Arc;

/// The sparse gradient of a hash grid's table from one tile: positions of samples and gradients of their features.
#[derive(Debug, Clone)]
pub struct HashGrad<T: Scalar> {
    /// The grid.
    pub grid: HashGrid,
    /// Positions in the unit cube, `[samples, 3]`.
    pub positions: Tensor<T>,
    /// Gradient of the encoding, `[samples, width]`.
    pub d_out: Tensor<T>,
    /// For each level, the largest gradient that [is dropped](super::HashEncoding::with_gradient_cut).
    pub cuts: Vec<T>,
}

impl<T: Scalar> HashGrad<T> {
    /// The name of its [parts](SparseGrad::to_parts).
    pub const KIND: &'static str = "hash grid";

    /// Reads a contribution from its [parts](SparseGrad::to_parts).
    pub fn read(shape: &[usize], parts: SparseParts<T>) -> Option<Arc<dyn SparseGrad<T>>> {
        let [levels, features, log2_table, coarsest, finest] = *parts.integers else { return None };
        let [levels, features, coarsest, finest] = [levels, features, coarsest, finest].map(|x| x as usize);
        let grid = HashGrid::new(&HashGridConfig { levels, features, log2_table, coarsest, finest }).ok()?;
        let [positions, d_out, cuts] = <[_; 3]>::try_from(parts.tensors).ok()?;
        let samples = *positions.shape().first()?;
        let fits = grid.shape() == shape
            && positions.shape() == [samples, 3]
            && d_out.shape() == [samples, grid.width()]
            && cuts.shape() == [grid.levels().len()];
        fits.then(|| Arc::new(HashGrad { grid, positions, d_out, cuts: cuts.as_slice().to_vec() }) as _)
    }
}

impl<T: Scalar> SparseGrad<T> for HashGrad<T> {
    fn shape(&self) -> &[usize] {
        self.grid.shape()
    }

    fn add_to(&self, dense: &mut Tensor<T>) {
        let mut sums = RowSums::new(self.grid.rows(), self.grid.features());
        self.scatter(&mut sums);
        sums.add_to(dense.as_mut_slice());
    }

    fn as_rows(&self) -> Option<&dyn RowShare<T>> {
        Some(self)
    }

    fn to_parts(&self) -> Option<SparseParts<T>> {
        let HashGridConfig { levels, features, log2_table, coarsest, finest } = *self.grid.config();
        let [levels, features, coarsest, finest] = [levels, features, coarsest, finest].map(|x| x as u32);
        Some(SparseParts {
            kind: HashGrad::<T>::KIND.into(),
            integers: [levels, features, log2_table, coarsest, finest].into(),
            tensors: vec![
                self.positions.clone(),
                self.d_out.clone(),
                Tensor::from_vec(&[self.cuts.len()], self.cuts.clone()),
            ],
        })
    }
}

impl<T: Scalar> RowShare<T> for HashGrad<T> {
    fn scatter(&self, sums: &mut RowSums<T>) {
        let features = self.grid.features();
        assert_eq!(
            [sums.table_rows(), sums.features()],
            [self.grid.rows(), features],
            "sums must have the grid's rows"
        );
        for (number, level) in self.grid.levels().iter().enumerate() {
            let mut part = RowSums::new(level.rows.len(), features);
            self.scatter_part(number, &mut part);
            for (&row, sum) in part.rows().iter().zip(part.sums().chunks_exact(features)) {
                sums.add(level.rows.start + row as usize, sum);
            }
        }
    }

    fn parts(&self) -> Vec<usize> {
        self.grid.levels().iter().map(|level| level.rows.len()).collect()
    }

    fn scatter_part(&self, part: usize, sums: &mut RowSums<T>) {
        self.grid.scatter_level(part, self.positions.as_slice(), self.d_out.as_slice(), self.cuts[part], sums);
    }
}
