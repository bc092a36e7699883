//! Matrix products: one function, with transposed operands by stride.

use crate::parallel::{chunks, is_worthwhile};
use crate::{Scalar, Tensor};

/// A matrix in a slice: element `(i, j)` is `data[i * strides[0] + j * strides[1]]`.
#[derive(Clone, Copy)]
pub struct Matrix<'a, T> {
    data: &'a [T],
    rows: usize,
    columns: usize,
    strides: [usize; 2],
}

impl<'a, T: Scalar> Matrix<'a, T> {
    /// The row-major matrix of `rows x columns` in `data`.
    ///
    /// # Panics
    /// If `data` has another length.
    #[track_caller]
    pub fn new(data: &'a [T], rows: usize, columns: usize) -> Self {
        assert_eq!(data.len(), rows * columns, "{} values for a {rows}x{columns} matrix", data.len());
        Matrix { data, rows, columns, strides: [columns, 1] }
    }

    /// The matrix whose rows are the last axis of `tensor`; all other axes count the rows.
    ///
    /// # Panics
    /// If the tensor has no axis.
    #[track_caller]
    pub fn rows_of(tensor: &'a Tensor<T>) -> Self {
        let Some(&columns) = tensor.shape().last() else { panic!("a scalar has no rows") };
        let rows = tensor.shape()[..tensor.ndim() - 1].iter().product();
        Matrix::new(tensor.as_slice(), rows, columns)
    }

    /// Number of rows.
    pub fn rows(&self) -> usize {
        self.rows
    }

    /// Number of columns.
    pub fn columns(&self) -> usize {
        self.columns
    }

    /// `count` rows from `first` on.
    fn some_rows(self, first: usize, count: usize) -> Self {
        Matrix { data: &self.data[first * self.strides[0]..], rows: count, ..self }
    }

    /// The same matrix with rows and columns exchanged; nothing is copied.
    pub fn t(self) -> Self {
        let [row, column] = self.strides;
        Matrix { rows: self.columns, columns: self.rows, strides: [column, row], ..self }
    }
}

/// Rows of a piece of a product, about, at least, and pieces, at most: with less in a piece each thread would mostly
/// rearrange the right factor for itself. Small products, of up to 64 x 64 or 256 elements, are added up in another order;
/// no piece is as small.
const ROWS: usize = 128;
const PIECES: usize = 32;
/// Multiplications and additions that take as long as one operation of a loop (see [`chunks`]).
const PER_OPERATION: usize = 8;

/// `c = a b`, or `c += a b` if `accumulate`; `c` is row-major. The rows of a large product are computed on all threads, unless
/// the caller is one of rayon's.
///
/// Sums run in the order of the underlying kernel, which depends on the sizes and on the processor's instruction set
/// but never on the number of threads.
///
/// # Panics
/// If the sizes do not fit together.
#[track_caller]
pub fn gemm<T: Scalar>(a: Matrix<'_, T>, b: Matrix<'_, T>, c: &mut [T], accumulate: bool) {
    let (m, k, n) = (a.rows, a.columns, b.columns);
    assert_eq!(b.rows, k, "inner dimensions of {m}x{k} times {}x{n}", b.rows);
    assert_eq!(c.len(), m * n, "{} values for a {m}x{n} product", c.len());
    if m * n == 0 {
        return;
    }
    if k == 0 {
        if !accumulate {
            c.fill(T::ZERO);
        }
        return;
    }
    let work = m * n * k / PER_OPERATION;
    if m >= 2 * ROWS && n > 2 && is_worthwhile(work) {
        let rows = m.div_ceil((m / ROWS).min(PIECES));
        return chunks(c, rows * n, work, || (), &|_, i, c| {
            gemm(a.some_rows(i * rows, c.len() / n), b, c, accumulate);
        });
    }
    let strides = |s: [usize; 2]| [s[0] as isize, s[1] as isize];
    let (left, right) = ((a.data.as_ptr(), strides(a.strides)), (b.data.as_ptr(), strides(b.strides)));
    // SAFETY: a `Matrix` is all of a row-major slice or some rows or columns of one, so every index is in the slice; `c` has
    // m * n elements and, as a mutable borrow, overlaps neither.
    unsafe { T::gemm_raw([m, k, n], left, right, c.as_mut_ptr(), accumulate) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn naive(a: &[f64], b: &[f64], [m, k, n]: [usize; 3]) -> Vec<f64> {
        let at = |i: usize, j: usize| (0..k).map(|l| a[i * k + l] * b[l * n + j]).sum();
        (0..m * n).map(|index| at(index / n, index % n)).collect()
    }

    fn transposed(a: &[f64], rows: usize, columns: usize) -> Vec<f64> {
        (0..rows * columns).map(|i| a[(i % rows) * columns + i / rows]).collect()
    }

    proptest! {
        #[test]
        fn agrees_with_three_loops(m in 0usize..40, k in 0usize..70, n in 0usize..40, seed in 0u64..1000) {
            let value = |i: usize| ((i as u64 * 7919 + seed * 104_729) % 1009) as f64 / 500.0 - 1.0;
            let a: Vec<f64> = (0..m * k).map(value).collect();
            let b: Vec<f64> = (0..k * n).map(|i| value(i + 13)).collect();
            let expected = naive(&a, &b, [m, k, n]);
            let (at, bt) = (transposed(&a, m, k), transposed(&b, k, n));
            for (left, right) in [
                (Matrix::new(&a, m, k), Matrix::new(&b, k, n)),
                (Matrix::new(&at, k, m).t(), Matrix::new(&b, k, n)),
                (Matrix::new(&a, m, k), Matrix::new(&bt, n, k).t()),
            ] {
                let mut c = vec![f64::NAN; m * n];
                gemm(left, right, &mut c, false);
                gemm(left, right, &mut c, true);
                for (c, e) in c.iter().zip(&expected) {
                    prop_assert!((c - 2.0 * e).abs() < 1e-12, "{c} {e}");
                }
            }
        }
    }

    #[test]
    fn f32_products_keep_their_accuracy() {
        let (m, k, n) = (37, 256, 65);
        let a = Tensor::<f64>::from_fn(&[m, k], |i| ((i * 31) % 97) as f64 / 97.0 - 0.5);
        let b = Tensor::<f64>::from_fn(&[k, n], |i| ((i * 17) % 89) as f64 / 89.0 - 0.5);
        let expected = naive(a.as_slice(), b.as_slice(), [m, k, n]);
        let mut c = vec![0.0_f32; m * n];
        gemm(Matrix::rows_of(&a.cast()), Matrix::rows_of(&b.cast()), &mut c, false);
        for (c, e) in c.iter().zip(&expected) {
            assert!((f64::from(*c) - e).abs() < 1e-5, "{c} {e}");
        }
    }
}
