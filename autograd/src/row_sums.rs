//! Sums of sparse gradients by table row.

use raygrad_tensor::{Scalar, checked_len, simd};

/// Sparse row sums of a table: the rows that got a contribution, and their sums side by side.
///
/// A training step touches few rows of a large table, at random places. Here each row of the table has only a 4-byte
/// entry. The sums are stored in the order in which their rows first came, so they fit the caches. An optimizer gets
/// the list of rows to visit.
#[derive(Debug, Clone)]
pub struct RowSums<T> {
    /// For each row of the table, the place of its sum counted from 1; 0 if it has none.
    places: Vec<u32>,
    /// The row of each sum. This and `sums` have room for all rows and one more.
    rows: Vec<u32>,
    /// Zero from `len` on.
    sums: Vec<T>,
    features: usize,
    len: usize,
}

impl<T: Scalar> RowSums<T> {
    /// Empty sums for a table of `rows` rows of `features` numbers.
    ///
    /// # Panics
    /// If `features` is 0, there are 2^32 - 1 rows or more, or the table is larger than memory.
    #[track_caller]
    pub fn new(rows: usize, features: usize) -> Self {
        assert!(features > 0, "rows without features");
        assert!(rows < u32::MAX as usize, "a table of {rows} rows");
        assert!(checked_len(&[rows + 1, features]).is_some(), "a table of {rows} rows of {features} numbers");
        RowSums {
            places: vec![0; rows],
            rows: vec![0; rows + 1],
            sums: vec![T::ZERO; (rows + 1) * features],
            features,
            len: 0,
        }
    }

    /// Number of rows of the table.
    pub fn table_rows(&self) -> usize {
        self.places.len()
    }

    /// Number of elements in a row.
    pub fn features(&self) -> usize {
        self.features
    }

    /// The rows that got a contribution, in the order of the first one.
    pub fn rows(&self) -> &[u32] {
        &self.rows[..self.len]
    }

    /// The sums of [`rows`](Self::rows), `[rows, features]`.
    pub fn sums(&self) -> &[T] {
        &self.sums[..self.len * self.features]
    }

    /// Adds `share` to the sum of a row.
    ///
    /// # Panics
    /// If there is no such row, or if `share` does not have the length of a row.
    #[track_caller]
    pub fn add(&mut self, row: usize, share: &[T]) {
        assert_eq!(share.len(), self.features, "a share of another width");
        let place = place(&mut self.places, &mut self.rows, &mut self.len, row);
        for (sum, &x) in self.sums[place * self.features..].iter_mut().zip(share) {
            *sum += x;
        }
    }

    /// The same sums with the row length as a compile-time constant, for loops that add very often.
    ///
    /// # Panics
    /// If the rows have another length.
    #[track_caller]
    pub fn of_width<const F: usize>(&mut self) -> RowAdder<'_, T, F> {
        assert_eq!(F, self.features, "sums of another width");
        RowAdder {
            places: &mut self.places,
            rows: &mut self.rows,
            sums: self.sums.as_chunks_mut().0,
            len: &mut self.len,
        }
    }

    /// Adds all sums to a dense gradient `[rows, features]`.
    ///
    /// # Panics
    /// If `dense` is shorter.
    #[track_caller]
    pub fn add_to(&self, dense: &mut [T]) {
        for (&row, sum) in self.rows().iter().zip(self.sums().chunks_exact(self.features)) {
            let dense = &mut dense[row as usize * self.features..][..self.features];
            for (dense, &sum) in dense.iter_mut().zip(sum) {
                *dense += sum;
            }
        }
    }

    /// Removes all sums.
    pub fn clear(&mut self) {
        for &row in &self.rows[..self.len] {
            self.places[row as usize] = 0;
        }
        self.sums[..self.len * self.features].fill(T::ZERO);
        self.len = 0;
    }
}

/// [`RowSums`] with `F` elements in a row; see [`RowSums::of_width`].
#[derive(Debug)]
pub struct RowAdder<'a, T, const F: usize> {
    places: &'a mut [u32],
    rows: &'a mut [u32],
    sums: &'a mut [[T; F]],
    len: &'a mut usize,
}

impl<T: Scalar, const F: usize> RowAdder<'_, T, F> {
    /// Adds `share` to the sum of a row.
    ///
    /// # Panics
    /// If there is no such row.
    #[inline(always)]
    pub fn add(&mut self, row: usize, share: &[T; F]) {
        let sum = &mut self.sums[place(self.places, self.rows, self.len, row)];
        for f in 0..F {
            sum[f] += share[f];
        }
    }

    /// Prefetches the entry that [`add`](Self::add) for this row reads first.
    #[inline(always)]
    pub fn prefetch(&self, row: usize) {
        simd::prefetch(self.places.as_ptr().wrapping_add(row));
    }
}

/// The place of a row's sum, a new one if it has none. A branch would be unpredictable, so there is none: the row is
/// written as the next one in any case.
#[inline(always)]
fn place(places: &mut [u32], rows: &mut [u32], len: &mut usize, row: usize) -> usize {
    let known = places[row];
    let new = known == 0;
    let place = if new { *len as u32 + 1 } else { known };
    places[row] = place;
    rows[*len] = row as u32;
    *len += usize::from(new);
    place as usize - 1
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn row_sums_equal_dense_gradient() {
        let mut sums = RowSums::<f64>::new(5, 2);
        for round in 0..3 {
            let mut dense = [0.0; 10];
            // As often as there are rows and more.
            for i in 0..20 {
                let row = [4, 1, 1, 4, 0, 2, 3][(i + round) % 7];
                let share = [i as f64, 0.5];
                if i % 2 == 0 {
                    sums.add(row, &share)
                } else {
                    sums.of_width::<2>().add(row, &share)
                }
                dense[2 * row] += share[0];
                dense[2 * row + 1] += share[1];
            }
            let mut got = [0.0; 10];
            sums.add_to(&mut got);
            assert_eq!(got, dense);
            let first = [[4, 1, 0, 2, 3], [1, 4, 0, 2, 3], [1, 4, 0, 2, 3]][round];
            assert_eq!(sums.rows(), first);
            sums.clear();
            assert!(sums.rows().is_empty() && sums.sums.iter().all(|&sum| sum == 0.0));
        }
    }

    #[test]
    #[should_panic(expected = "a table of 3 rows of 4611686018427387904 numbers")]
    fn row_sums_whose_size_wraps_are_refused() {
        RowSums::<f32>::new(3, 1 << 62);
    }

    #[test]
    #[should_panic]
    fn a_row_beyond_the_table_is_refused() {
        RowSums::<f32>::new(3, 1).add(3, &[1.0]);
    }
}
