//! Matrix products. Start with [`matmul`]; [`gemm`] works on slices with any strides.

use crate::parallel::{chunks, each, is_worthwhile};
use crate::{Layout, Pool, Scalar, Shape, Tensor, add_assign, broadcast_shape, sum_rows};
use std::ops::Range;

/// A strided matrix in a slice: element `(i, j)` is `data[offset + i * strides[0] + j * strides[1]]`.
#[derive(Clone, Copy)]
pub struct Matrix<'a, T> {
    data: &'a [T],
    offset: isize,
    rows: usize,
    columns: usize,
    strides: [isize; 2],
}

impl<'a, T: Scalar> Matrix<'a, T> {
    /// The row-major matrix `rows x columns` in `data`.
    ///
    /// # Panics
    /// If `data` has another length.
    #[track_caller]
    pub fn new(data: &'a [T], rows: usize, columns: usize) -> Self {
        let len = rows.checked_mul(columns);
        assert_eq!(Some(data.len()), len, "{} values for a {rows}x{columns} matrix", data.len());
        Matrix { data, offset: 0, rows, columns, strides: [columns as isize, 1] }
    }

    /// The matrix whose rows are the last axis of `tensor`; all other axes count the rows.
    ///
    /// # Panics
    /// If the tensor has no axis.
    #[track_caller]
    pub fn rows_of(tensor: &'a Tensor<T>) -> Self {
        let Some(&columns) = tensor.shape().last() else { panic!("a scalar has no rows") };
        let rows = tensor.shape()[..tensor.ndim() - 1].iter().product();
        match tensor.layout().reshaped(&[rows, columns]) {
            Some(layout) => Matrix::of(tensor.buffer(), &layout, layout.offset()),
            None => Matrix::new(tensor.as_slice(), rows, columns),
        }
    }

    /// The matrix in the last two axes of a layout, from `offset` on.
    ///
    /// # Panics
    /// If it leaves the buffer, or there are fewer than two axes.
    #[track_caller]
    pub fn of(data: &'a [T], layout: &Layout, offset: usize) -> Self {
        let (&[.., rows, columns], &[.., row, column]) = (layout.shape(), layout.strides()) else {
            panic!("a matrix of shape {:?}", layout.shape())
        };
        let inside = Layout::strided(&[rows, columns], &[row, column], offset as isize, data.len());
        assert!(inside.is_some(), "a {rows}x{columns} matrix beyond the end of its buffer");
        Matrix { data, offset: offset as isize, rows, columns, strides: [row, column] }
    }

    /// Number of rows.
    pub fn rows(&self) -> usize {
        self.rows
    }

    /// Number of columns.
    pub fn columns(&self) -> usize {
        self.columns
    }

    /// The rows of this range, which must not be empty.
    fn some_rows(self, range: Range<usize>) -> Self {
        debug_assert!(!range.is_empty() && range.end <= self.rows);
        Matrix { offset: self.offset + range.start as isize * self.strides[0], rows: range.len(), ..self }
    }

    /// The columns of this range, which must not be empty.
    fn some_columns(self, range: Range<usize>) -> Self {
        self.t().some_rows(range).t()
    }

    /// The transposed matrix, without a copy.
    pub fn t(self) -> Self {
        let [row, column] = self.strides;
        Matrix { rows: self.columns, columns: self.rows, strides: [column, row], ..self }
    }
}

/// Least number of rows or columns of a piece, about, and largest number of pieces. With smaller pieces each thread
/// would mostly rearrange the other factor again. Small products, of up to 64 x 64 or 256 elements, are summed in
/// another order; no piece is so small.
const ROWS: usize = 128;
const PIECES: usize = 32;
/// Least number of terms in a part of a sum that is split, if a product is too small otherwise.
const DEPTH: usize = 1 << 12;
/// Multiply-adds that take as long as one operation of a loop (see [`chunks`]).
const PER_OPERATION: usize = 8;

/// `c = a b`, or `c += a b` if `accumulate`; `c` is row-major. A large product is split by rows, by columns, or by
/// depth, and runs on all threads.
///
/// Sums run in the order of the underlying kernel. It depends on the sizes and on the processor's instruction set, but
/// never on the number of threads. Sums of 8192 terms or more in a small product are split, and their parts are added in
/// pairs.
///
/// # Panics
/// If the sizes do not fit together.
#[track_caller]
#[inline(never)]
pub fn gemm<T: Scalar>(a: Matrix<'_, T>, b: Matrix<'_, T>, c: &mut [T], accumulate: bool) {
    let (m, k, n) = (a.rows, a.columns, b.columns);
    assert_eq!(b.rows, k, "inner dimensions of {m}x{k} times {}x{n}", b.rows);
    assert_eq!(Some(c.len()), m.checked_mul(n), "{} values for a {m}x{n} product", c.len());
    if c.is_empty() {
        return;
    }
    if k == 0 {
        if !accumulate {
            c.fill(T::ZERO);
        }
        return;
    }
    let work = (m * n).saturating_mul(k) / PER_OPERATION;
    if m >= 2 * ROWS && n > 2 && is_worthwhile(work) {
        let rows = m.div_ceil((m / ROWS).min(PIECES));
        chunks(c, rows * n, work, || (), &|_, i, c| {
            let rows = i * rows..i * rows + c.len() / n;
            // SAFETY: `c` has as many rows of n elements.
            unsafe { product(a.some_rows(rows), b, c.as_mut_ptr(), n, accumulate) }
        });
    } else if m > 2 && n >= 2 * ROWS && is_worthwhile(work) {
        let columns = n.div_ceil((n / ROWS).min(PIECES));
        let target = Target(c.as_mut_ptr());
        each(n.div_ceil(columns), &|i| {
            let columns = i * columns..n.min((i + 1) * columns);
            // SAFETY: the columns of the pieces differ, and all lie in `c`, which is borrowed until all are done. Tests of
            // parallel.rs and `agrees_with_three_loops` run it.
            unsafe { product(a, b.some_columns(columns.clone()), target.at(columns.start), n, accumulate) }
        });
    } else if m < 2 * ROWS && n < 2 * ROWS && k >= 2 * DEPTH {
        let depth = k.div_ceil((k / DEPTH).min(PIECES));
        let parts = k.div_ceil(depth);
        let mut sums = vec![T::ZERO; parts * c.len()];
        chunks(&mut sums, c.len(), work, || (), &|_, i, sum| {
            let terms = i * depth..k.min((i + 1) * depth);
            // SAFETY: `sum` has as many elements as `c`, m x n.
            unsafe { product(a.some_columns(terms.clone()), b.some_rows(terms), sum.as_mut_ptr(), n, false) }
        });
        if accumulate {
            let mut total = vec![T::ZERO; c.len()];
            sum_rows(&sums, &mut total);
            add_assign(c, &total);
        } else {
            sum_rows(&sums, c);
        }
    } else {
        // SAFETY: `c` has m x n elements.
        unsafe { product(a, b, c.as_mut_ptr(), n, accumulate) }
    }
}

/// The matrix product over the last two axes of `a` `[.., m, k]` and `b` `[.., k, n]`. Leading axes count matrices and
/// broadcast. Views, such as transposes, are read without a copy. All threads work on one large product, or on many
/// small ones.
///
/// ```
/// use raygrad_tensor::{Pool, Tensor, matmul::matmul};
/// let a = Tensor::from([[1.0, 2.0], [3.0, 4.0_f32]]);
/// assert_eq!(matmul(&a, &a.t(), &Pool::none()), [[5.0, 11.0], [11.0, 25.0]]);
/// ```
///
/// # Panics
/// If a factor has fewer than two axes, the inner extents differ, or the leading axes do not broadcast.
#[track_caller]
pub fn matmul<T: Scalar>(a: &Tensor<T>, b: &Tensor<T>, pool: &Pool<T>) -> Tensor<T> {
    let (&[ref a_lead @ .., m, k], &[ref b_lead @ .., inner, n]) = (a.shape(), b.shape()) else {
        panic!("matmul of shapes {:?} and {:?}: a matrix has two axes", a.shape(), b.shape())
    };
    let lead = broadcast_shape(&[a_lead, b_lead]).filter(|_| k == inner);
    let Some(lead) = lead else { panic!("matmul of shapes {:?} and {:?}: they do not fit", a.shape(), b.shape()) };
    let with = |last: [usize; 2]| lead.iter().copied().chain(last).collect::<Shape>();
    let layouts = [a.layout().stretched(&with([m, k])), b.layout().stretched(&with([k, n]))];
    pool.filled(&with([m, n]), |c| {
        // The leading axes of an empty product may be larger than memory.
        if c.is_empty() {
            return;
        }
        let ([a_at, b_at], work) =
            (layouts.each_ref().map(|x| x.offsets(lead.len())), m.saturating_mul(k).saturating_mul(n));
        let one = |i: usize, c: &mut [T]| {
            let left = Matrix::of(a.buffer(), &layouts[0], a_at[i]);
            gemm(left, Matrix::of(b.buffer(), &layouts[1], b_at[i]), c, false);
        };
        if is_worthwhile(work / PER_OPERATION) {
            c.chunks_mut(m * n).enumerate().for_each(|(i, c)| one(i, c));
        } else {
            let all = work.saturating_mul(a_at.len()) / PER_OPERATION;
            chunks(c, m * n, all, || (), &|_, i, c| one(i, c));
        }
    })
}

/// The destination of several tasks, each of which writes its own columns.
#[derive(Clone, Copy)]
struct Target<T>(*mut T);

// SAFETY: a place to write to from several threads; callers of `at` ensure that no two write to one element.
unsafe impl<T: Send> Sync for Target<T> {}

impl<T> Target<T> {
    fn at(&self, column: usize) -> *mut T {
        self.0.wrapping_add(column)
    }
}

/// Computes the product on this thread.
///
/// # Safety
/// `c` is valid for `a.rows` rows of `b.columns` elements, `row` apart, and no other code reads or writes them.
// SAFETY: kept by `gemm`.
unsafe fn product<T: Scalar>(a: Matrix<'_, T>, b: Matrix<'_, T>, c: *mut T, row: usize, accumulate: bool) {
    let start = |x: &Matrix<'_, T>| (x.data.as_ptr().wrapping_offset(x.offset), x.strides);
    // SAFETY: a `Matrix` stays in its slice, which its constructors check, and so do some of its rows or columns; the caller
    // vouches for `c`.
    unsafe { T::gemm_raw([a.rows, a.columns, b.columns], start(&a), start(&b), c, row, accumulate) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn empty_products_of_any_leading_extent_are_immediate() {
        let a = Tensor::<f32>::zeros(&[1 << 40, 0, 3]);
        assert_eq!(matmul(&a, &Tensor::zeros(&[3, 4]), &Pool::none()).shape(), [1 << 40, 0, 4]);
    }

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
    fn matmul_large_views_equal_copies() {
        let pool = Pool::new();
        let value = |i: usize| ((i * 7919) % 1009) as f64 / 500.0 - 1.0;
        // Cut by rows, by columns, by depth, and not at all; one large product of a batch, many small ones.
        for [batch, m, k, n] in [
            [1, 517, 130, 131],
            [1, 3, 64, 20_003],
            [1, 7, 16_385, 11],
            [1, 40, 30, 20],
            [3, 256, 130, 140],
            [90, 20, 31, 33],
        ] {
            let a = Tensor::from_fn(&[batch, k, m], value).t().flip(-1);
            let b = Tensor::from_fn(&[n, k], value).t().flip(0);
            let (a_copy, b_copy) = (a.packed(), b.packed());
            let got = matmul(&a, &b, &pool);
            assert_eq!(got.shape(), [batch, m, n]);
            for (i, got) in got.as_slice().chunks(m * n).enumerate() {
                let expected = naive(&a_copy.as_slice()[i * m * k..][..m * k], b_copy.as_slice(), [m, k, n]);
                let close = got.iter().zip(&expected).all(|(got, expected)| (got - expected).abs() <= 1e-10);
                assert!(close, "{batch} of {m}x{k} by {k}x{n}");
            }
        }
        // One factor repeated, and rows that are all the same.
        let (a, b) = (Tensor::from_fn(&[1, 40], value).broadcast_to(&[300, 40]), Tensor::from_fn(&[2, 40, 5], value));
        assert!(matmul(&a, &b, &pool).allclose(&matmul(&a.packed(), &b, &pool), 1e-13, 1e-13));
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
