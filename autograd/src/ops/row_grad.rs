//! The sparse gradient of a table with few used rows.

use super::pick::check_index;
use crate::{RowShare, RowSums, SparseGrad, SparseParts};
use raygrad_tensor::{Scalar, Shape, Tensor};
use std::sync::Arc;

/// Adds row `i` of `rows`, of `width` numbers, to row `index[i]` of `dense`, with sums in f64. A sum of any number of
/// rows then has its own rounding error alone; 10^5 rows added in f32 lose three digits. If the table is larger than
/// the added rows, it gets no second table for the sums.
pub(super) fn add_rows<T: Scalar>(dense: &mut [T], rows: &[T], index: &[u32], width: usize, sums: &mut Vec<f64>) {
    let add = |sums: &mut [f64], row: usize| {
        for (sum, x) in sums.iter_mut().zip(&rows[row * width..][..width]) {
            *sum += x.to_f64();
        }
    };
    let add_up = |dense: &mut [T], sums: &[f64]| {
        dense.iter_mut().zip(sums).for_each(|(dense, &sum)| *dense += T::from_f64(sum));
    };
    sums.clear();
    if dense.len() <= rows.len() {
        sums.resize(dense.len(), 0.0);
        index.iter().enumerate().for_each(|(row, &place)| add(&mut sums[place as usize * width..][..width], row));
        return add_up(dense, sums);
    }
    // The shares of a place beside each other, in their order.
    let mut order: Vec<usize> = (0..index.len()).collect();
    order.sort_by_key(|&row| index[row]);
    sums.resize(width, 0.0);
    for shares in order.chunk_by(|&a, &b| index[a] == index[b]) {
        sums.fill(0.0);
        shares.iter().for_each(|&row| add(sums, row));
        add_up(&mut dense[index[shares[0]] as usize * width..][..width], sums);
    }
}

/// The sparse gradient of a table, as from [`Var::gather_rows`](crate::Var::gather_rows): rows and their indices.
#[derive(Debug, Clone)]
pub struct RowGrad<T: Scalar> {
    shape: Shape,
    index: Arc<[u32]>,
    rows: Tensor<T>,
}

impl<T: Scalar> RowGrad<T> {
    /// The gradient of a table of this shape: `rows` `[index.len(), ..]`, to be added at `index`.
    ///
    /// # Panics
    /// If the table is a scalar, an index is not below its number of rows, or the rows have another shape.
    #[track_caller]
    pub fn new(shape: &[usize], index: Arc<[u32]>, rows: Tensor<T>) -> Self {
        assert!(!shape.is_empty(), "the gradient of a table without rows");
        if let Err(error) = check_index(&index, shape[0], 0) {
            panic!("the gradient of a table of shape {shape:?}: {error}");
        }
        let fits = rows.shape().split_first() == Some((&index.len(), &shape[1..]));
        assert!(fits, "rows of shape {:?} at {} places of a table of shape {shape:?}", rows.shape(), index.len());
        RowGrad { shape: shape.into(), index, rows }
    }

    /// The table row of each of [`rows`](Self::rows). An index may occur several times.
    pub fn index(&self) -> &Arc<[u32]> {
        &self.index
    }

    /// The rows, in the order of [`index`](Self::index).
    pub fn rows(&self) -> &Tensor<T> {
        &self.rows
    }

    /// The name of its [parts](SparseGrad::to_parts).
    pub const KIND: &'static str = "rows";

    /// Reads a contribution from its [parts](SparseGrad::to_parts).
    pub fn read(shape: &[usize], parts: SparseParts<T>) -> Option<Arc<dyn SparseGrad<T>>> {
        let (index, [rows]) = (parts.integers, <[_; 1]>::try_from(parts.tensors).ok()?);
        let fits = rows.shape().split_first() == Some((&index.len(), shape.get(1..)?));
        let is_within = index.iter().all(|&row| (row as usize) < shape[0]);
        (fits && is_within).then(|| Arc::new(RowGrad { shape: shape.into(), index, rows }) as Arc<dyn SparseGrad<T>>)
    }
}

impl<T: Scalar> SparseGrad<T> for RowGrad<T> {
    fn shape(&self) -> &[usize] {
        &self.shape
    }

    fn add_to(&self, dense: &mut Tensor<T>) {
        assert_eq!(dense.len(), self.shape.iter().product::<usize>(), "a dense gradient of the table");
        let width: usize = self.shape[1..].iter().product();
        add_rows(dense.as_mut_slice(), self.rows.as_slice(), &self.index, width, &mut vec![]);
    }

    fn as_rows(&self) -> Option<&dyn RowShare<T>> {
        Some(self)
    }

    fn to_parts(&self) -> Option<SparseParts<T>> {
        let (index, rows) = (self.index.clone(), self.rows.clone());
        Some(SparseParts { kind: RowGrad::<T>::KIND.into(), integers: index, tensors: vec![rows] })
    }
}

impl<T: Scalar> RowShare<T> for RowGrad<T> {
    fn scatter(&self, sums: &mut RowSums<T>) {
        let width: usize = self.shape[1..].iter().product();
        assert_eq!([sums.table_rows(), sums.features()], [self.shape[0], width], "sums of the table's rows");
        // All rows of an index are summed in f64, which a long sum in f32 needs.
        let row_of = |place: usize| self.index[place];
        let mut order: Vec<usize> = (0..self.index.len()).collect();
        order.sort_by_key(|&place| row_of(place));
        let mut groups: Vec<&[usize]> = order.chunk_by(|&a, &b| row_of(a) == row_of(b)).collect();
        groups.sort_unstable_by_key(|group| group[0]);
        let share = |place: usize| &self.rows.as_slice()[place * width..][..width];
        for group in groups {
            let row = row_of(group[0]) as usize;
            if let [place] = *group {
                sums.add(row, share(place));
                continue;
            }
            let sum = |i: usize| T::from_f64(group.iter().map(|&place| share(place)[i].to_f64()).sum());
            sums.add(row, &(0..width).map(sum).collect::<Vec<T>>());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Tape;

    #[test]
    fn sparse_gradient_equals_dense_up_to_rounding() {
        let index: Arc<[u32]> = [3, 0, 3, 3, 1].into();
        let run = |sparse: bool| {
            let tape = Tape::<f32>::new();
            let table = tape.leaf(Tensor::from_fn(&[5, 3], |i| (i as f32).sin()));
            let y = table.gather_rows(&index);
            let loss = (y.exp() * &y).sum();
            if !sparse {
                // The recorded gradient is dense.
                return loss.grad_graph(&[&table])[0].value().as_slice().to_vec();
            }
            let parts = loss.backward(&[&table]).remove(0).take::<RowGrad<f32>>();
            let (mut dense, mut sums) = (vec![0.0; 15], RowSums::new(5, 3));
            parts.iter().for_each(|part| part.scatter(&mut sums));
            assert!(parts.len() == 1 && parts[0].rows().shape() == [5, 3] && sums.rows() == [3, 0, 1]);
            sums.add_to(&mut dense);
            dense
        };
        // Several gradients are added in f32.
        let close = |(a, b): (&f32, &f32)| (a - b).abs() <= 2e-7 * b.abs();
        assert!(run(true).iter().zip(&run(false)).all(close), "{:?} {:?}", run(true), run(false));
    }

    #[test]
    fn long_sums_of_a_row_keep_their_digits() {
        let tape = Tape::<f32>::new();
        let table = tape.leaf(Tensor::ones(&[3, 2]));
        let index: Arc<[u32]> = (0..200_001).map(|i| if i == 77 { 2 } else { 1 }).collect();
        let weights = tape.constant(Tensor::from([0.1, -0.3]));
        let parts = (table.gather_rows(&index) * weights).sum().backward(&[&table]).remove(0).take::<RowGrad<f32>>();
        let mut sums = RowSums::new(3, 2);
        parts[0].scatter(&mut sums);
        let exact = |x: f32| (200_000.0 * f64::from(x)) as f32;
        assert_eq!((sums.rows(), sums.sums()), (&[1, 2][..], &[exact(0.1), exact(-0.3), 0.1, -0.3][..]));
    }

    #[test]
    #[should_panic(expected = "index 1 is 4, but axis 0 has 4 entries")]
    fn a_row_gradient_beyond_its_table_is_refused() {
        RowGrad::new(&[4, 2], [0, 4].into(), Tensor::<f32>::zeros(&[2, 2]));
    }
    #[test]
    fn a_large_table_gets_the_same_sums_as_a_small_one() {
        let index: Vec<u32> = (0..300).map(|i| (i * i + 3 * i) % 7).collect();
        let rows: Vec<f32> = (0..600).map(|i| (i as f32 * 0.7).sin() * 10.0_f32.powi(i % 5)).collect();
        let (mut small, mut large) = (vec![0.25; 14], vec![0.25; 2000]);
        let mut sums = vec![];
        add_rows(&mut small, &rows, &index, 2, &mut sums);
        add_rows(&mut large, &rows, &index, 2, &mut sums);
        assert!(small == large[..14] && large[14..].iter().all(|&x| x == 0.25));
        assert!(small.iter().filter(|&&x| x == 0.25).count() < 14);
        add_rows(&mut [] as &mut [f32], &[], &[3, 3], 0, &mut sums);
        add_rows(&mut large, &[], &[], 2, &mut sums);
    }
}
