//! Lazy Adam for an embedding's table.

use crate::{AdamConfig, RowAdam, RowGrad, RowShare, RowStats, RowSums};
use raygrad_tensor::{Scalar, Tensor};

/// [`RowAdam`] for a table whose gradient comes as [`RowGrad`]s: reads and moves only the rows that were gathered.
#[derive(Debug, Clone)]
pub struct TableAdam<T: Scalar> {
    adam: RowAdam<T>,
    /// The sum of the gradients, nothing between steps.
    sums: RowSums<T>,
}

impl<T: Scalar> TableAdam<T> {
    /// An optimiser of a table of `rows` rows of `width` numbers that has seen nothing.
    ///
    /// # Panics
    /// If `width` is 0.
    #[track_caller]
    pub fn new(config: AdamConfig, [rows, width]: [usize; 2]) -> Self {
        TableAdam { adam: RowAdam::new(config, rows, width), sums: RowSums::new(rows, width) }
    }

    /// Adds up the parts in their order and moves the rows whose gradient is not zero; see [`RowAdam`] for how that
    /// differs from dense Adam.
    ///
    /// # Panics
    /// If the table or a part has another size.
    #[track_caller]
    pub fn step(&mut self, table: &mut Tensor<T>, parts: &[impl AsRef<RowGrad<T>>], rate: f64) -> RowStats {
        for part in parts {
            part.as_ref().scatter(&mut self.sums);
        }
        self.adam.step(table.as_mut_slice(), &mut self.sums, rate)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Adam, Tape};
    use std::sync::Arc;

    #[test]
    fn moves_the_rows_that_dense_adam_moves_and_no_others() {
        let (rows, width) = (50, 3);
        let mut table = Tensor::from_fn(&[rows, width], |i| (i as f64).sin());
        let mut dense = [table.clone()];
        let (mut lazy, mut adam) =
            (TableAdam::new(AdamConfig::default(), [rows, width]), Adam::new(AdamConfig::default()));
        let index: Arc<[u32]> = [7, 30, 7, 2].into();
        for _ in 0..20 {
            let tape = Tape::new();
            let x = tape.leaf(table.clone());
            // Two uses of the table: two parts, whose sum counts.
            let loss = (x.gather_rows(&index).square().sum() + x.gather_rows(&[2].into()).sum()) * 0.5;
            let mut gradient = loss.backward(&[&x]).remove(0);
            assert!(gradient.is_rows() && gradient.sparse().len() == 2);
            let stats = lazy.step(&mut table, &gradient.take::<RowGrad<f64>>(), 0.05);
            assert_eq!((stats.touched, stats.skipped), (3, 0));
            let x = tape.leaf(dense[0].clone());
            let loss = (x.gather_rows(&index).square().sum() + x.gather_rows(&[2].into()).sum()) * 0.5;
            adam.step(&mut dense, &loss.grad(&[&x]), 0.05);
        }
        for (got, expected) in table.as_slice().iter().zip(dense[0].as_slice()) {
            assert!((got - expected).abs() < 1e-12, "{got} instead of {expected}");
        }
        assert_eq!(lazy.step(&mut table, &[] as &[Arc<RowGrad<f64>>], 0.05), RowStats::default());
    }
}
