//! Training the table: gradients of samples are added level by level, and only rows that got one are updated.

use super::HashGrid;
use raygrad_autograd::{RowShare, RowSums, Scalar, SparseGrad, Tensor};
use raygrad_nn::{AdamConfig, RowAdam, RowStats};
use std::sync::Arc;

/// What a tile leaves for the table: where its samples are, and the gradients of their features.
#[derive(Debug, Clone)]
pub struct HashGrad<T: Scalar> {
    /// The grid.
    pub grid: HashGrid,
    /// Positions in the unit cube, `[samples, 3]`.
    pub positions: Tensor<T>,
    /// Gradient of the encoding, `[samples, width]`.
    pub d_out: Tensor<T>,
}

impl<T: Scalar> SparseGrad<T> for HashGrad<T> {
    fn shape(&self) -> &[usize] {
        self.grid.shape()
    }

    fn add_to(&self, dense: &mut Tensor<T>) {
        let features = self.grid.features();
        for (number, level) in self.grid.levels().iter().enumerate() {
            let part = &mut dense.as_mut_slice()[level.rows.start * features..level.rows.end * features];
            let mut sums = RowSums::new(level.rows.len(), features);
            self.grid.scatter_level(number, self.positions.as_slice(), self.d_out.as_slice(), &mut sums);
            sums.add_to(part);
        }
    }

    fn as_rows(&self) -> Option<&dyn RowShare<T>> {
        Some(self)
    }
}

impl<T: Scalar> RowShare<T> for HashGrad<T> {
    fn scatter(&self, sums: &mut RowSums<T>) {
        let features = self.grid.features();
        assert_eq!([sums.table_rows(), sums.features()], [self.grid.rows(), features], "sums of the grid's rows");
        for (number, level) in self.grid.levels().iter().enumerate() {
            let mut part = RowSums::new(level.rows.len(), features);
            self.grid.scatter_level(number, self.positions.as_slice(), self.d_out.as_slice(), &mut part);
            for (&row, sum) in part.rows().iter().zip(part.sums().chunks_exact(features)) {
                sums.add(level.rows.start + row as usize, sum);
            }
        }
    }
}

/// What a step of [`TableOptimizer`] did, in rows of the table.
pub type TableStats = RowStats;

/// Lazy Adam for the table of a hash grid, straight from the gradients of encoded samples.
///
/// Levels are independent and run in parallel on the current rayon pool; within a level everything happens in the order
/// of the tiles and their samples, so the same bits come out at any number of threads. All buffers are made at the start:
/// a step allocates nothing.
#[derive(Debug, Clone)]
pub struct TableOptimizer {
    grid: HashGrid,
    levels: Vec<Level>,
}

/// The state of one level.
#[derive(Debug, Clone)]
struct Level {
    adam: RowAdam<f32>,
    /// Nothing between steps.
    sums: RowSums<f32>,
}

impl TableOptimizer {
    /// An optimiser that has seen nothing. The paper's constants are 0.9, 0.99 and 1e-15 (section 4): a large epsilon
    /// would stall rows that are seldom visited.
    ///
    /// # Panics
    /// If [`AdamConfig::check`] finds something.
    #[track_caller]
    pub fn new(grid: HashGrid, config: AdamConfig) -> Self {
        let adam = RowAdam::new(config, 0, grid.features());
        let level =
            |rows| Level { adam: adam.fresh([rows, grid.features()]), sums: RowSums::new(rows, grid.features()) };
        TableOptimizer { levels: grid.levels().iter().map(|l| level(l.rows.len())).collect(), grid }
    }

    /// Adds up the gradients of all tiles, in their order, and after them a dense one if there is one, and moves the rows
    /// whose gradient is not zero with learning rate `rate`.
    ///
    /// # Panics
    /// If the table or the dense gradient is not `[rows, features]`, positions are not `[samples, 3]` or gradients not
    /// `[samples, width]`.
    #[track_caller]
    pub fn step(
        &mut self,
        table: &mut Tensor<f32>,
        grads: &[Arc<HashGrad<f32>>],
        dense: Option<&Tensor<f32>>,
        rate: f64,
    ) -> TableStats {
        let shape = [self.grid.rows(), self.grid.features()];
        assert_eq!(table.shape(), shape, "the table of the grid");
        assert!(dense.is_none_or(|dense| dense.shape() == shape), "a dense gradient of the table");
        for grad in grads {
            let samples = grad.positions.shape()[0];
            assert_eq!(grad.positions.shape(), [samples, 3], "positions");
            assert_eq!(grad.d_out.shape(), [samples, self.grid.width()], "gradients of {samples} encoded positions");
        }
        let dense = dense.map(Tensor::as_slice);
        Step { grid: &self.grid, grads, dense, rate }.run(0, &mut self.levels, table.as_mut_slice())
    }
}

/// What the levels share during a step.
struct Step<'a> {
    grid: &'a HashGrid,
    grads: &'a [Arc<HashGrad<f32>>],
    dense: Option<&'a [f32]>,
    rate: f64,
}

impl Step<'_> {
    /// Updates the levels from number `first` on, whose rows `table` holds, by halves.
    fn run(&self, first: usize, levels: &mut [Level], table: &mut [f32]) -> TableStats {
        if let [level] = levels {
            for grad in self.grads {
                let (positions, d_out) = (grad.positions.as_slice(), grad.d_out.as_slice());
                self.grid.scatter_level(first, positions, d_out, &mut level.sums);
            }
            if let Some(dense) = self.dense {
                let (features, rows) = (self.grid.features(), self.grid.levels()[first].rows.clone());
                let shares = dense[rows.start * features..rows.end * features].chunks_exact(features);
                let moved = |(_, share): &(usize, &[f32])| share.iter().any(|&x| x != 0.0);
                shares.enumerate().filter(moved).for_each(|(row, share)| level.sums.add(row, share));
            }
            return level.adam.step(table, &mut level.sums, self.rate, 0.0);
        }
        let half = levels.len() / 2;
        let (coarse, fine) = levels.split_at_mut(half);
        let coarse_rows: usize = coarse.iter().map(|level| level.sums.table_rows()).sum();
        let (coarse_table, fine_table) = table.split_at_mut(coarse_rows * self.grid.features());
        let (a, b) = rayon::join(|| self.run(first, coarse, coarse_table), || self.run(first + half, fine, fine_table));
        a + b
    }
}
