//! Rows of a tensor by number: embeddings and tables.

use crate::{Grads, Op, Reads, RowShare, RowSums, ShapeError, SparseGrad, Var, Vjp};
use raygrad_tensor::{Indices, Pool, Scalar, Shape, Tensor};
use std::sync::Arc;

/// y[i] = x[index[i]] along the first axis; dx = [`ScatterRows`] of g, unrecorded as a sparse [`RowGrad`].
#[derive(Clone)]
pub struct GatherRows {
    /// For each row of the output its row of the input. A clone is a reference count.
    pub index: Arc<[u32]>,
}

/// y[index[i]] += x[i] along the first axis, onto zeros, with sums in f64; dx = [`GatherRows`] of g.
#[derive(Clone)]
pub struct ScatterRows {
    /// For each row of the input its row of the output.
    pub index: Arc<[u32]>,
    /// Rows of the output.
    pub rows: usize,
}

/// The shape with another first extent, or why there is none.
fn with_rows(x: &[usize], rows: usize) -> Result<Shape, ShapeError> {
    let Some((_, row)) = x.split_first() else { return Err("a scalar has no rows".into()) };
    Ok([rows].iter().chain(row).copied().collect())
}

/// Whether every index is below `rows`.
fn check_index(index: &[u32], rows: usize) -> Result<(), ShapeError> {
    match index.iter().enumerate().find(|&(_, &row)| row as usize >= rows) {
        None => Ok(()),
        Some((i, row)) => Err(format!("index {i} is {row}, but there are {rows} rows")),
    }
}

/// Adds to `dense` what `add` adds to zeros in f64: a sum of any number of shares is off by its own rounding alone, where
/// 10^5 shares added in f32 lose three digits.
pub(crate) fn add_up<T: Scalar>(dense: &mut [T], add: impl FnOnce(&mut [f64])) {
    let mut sums = vec![0.0; dense.len()];
    add(&mut sums);
    for (dense, sum) in dense.iter_mut().zip(sums) {
        *dense += T::from_f64(sum);
    }
}

/// Adds row `i` of `rows`, of `width` numbers, to row `index[i]` of `dense`, with sums in f64 as [`add_up`]. A table that is
/// larger than what is added to it gets no second one for the sums.
fn add_rows<T: Scalar>(dense: &mut [T], rows: &[T], index: &[u32], width: usize) {
    let add = |sums: &mut [f64], row: usize| {
        for (sum, x) in sums.iter_mut().zip(&rows[row * width..][..width]) {
            *sum += x.to_f64();
        }
    };
    if dense.len() <= rows.len() {
        add_up(dense, |sums| {
            index.iter().enumerate().for_each(|(row, &place)| add(&mut sums[place as usize * width..][..width], row));
        });
        return;
    }
    // The shares of a place beside each other, in their order.
    let mut order: Vec<usize> = (0..index.len()).collect();
    order.sort_by_key(|&row| index[row]);
    let mut sums = vec![0.0; width];
    for shares in order.chunk_by(|&a, &b| index[a] == index[b]) {
        let place = index[shares[0]] as usize * width;
        sums.fill(0.0);
        shares.iter().for_each(|&row| add(&mut sums, row));
        dense[place..place + width].iter_mut().zip(&sums).for_each(|(dense, &sum)| *dense += T::from_f64(sum));
    }
}

impl<T: Scalar> Op<T> for GatherRows {
    fn name(&self) -> &'static str {
        "gather_rows"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        let shape = with_rows(x[0], self.index.len())?;
        check_index(&self.index, x[0][0])?;
        Ok(shape)
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let mut shape = Shape::from_slice(x[0].shape());
        shape[0] = self.index.len();
        let width: usize = shape[1..].iter().product();
        let (mut out, x) = (pool.tensor(&shape), x[0].as_slice());
        for (out, &row) in out.as_mut_slice().chunks_exact_mut(width.max(1)).zip(self.index.iter()) {
            out.copy_from_slice(&x[row as usize * width..][..width]);
        }
        out
    }

    fn reads(&self) -> Reads {
        Reads::NOTHING
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        rows_gradient(cx, &self.index)
    }
}

/// The gradient of a table of which rows were picked: sparse, unless it is recorded.
pub(super) fn rows_gradient<'t, T: Scalar>(cx: &Vjp<'t, '_, T>, index: &Arc<[u32]>) -> Grads<'t, T> {
    if cx.recording() {
        return Grads::one(cx.g().scatter_rows(index, cx.shape(0)[0]));
    }
    let grad = RowGrad::new(cx.shape(0), index.clone(), cx.g().value().clone());
    Grads::new([None]).with_sparse(0, Arc::new(grad))
}

impl<T: Scalar> Op<T> for ScatterRows {
    fn name(&self) -> &'static str {
        "scatter_rows"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        let shape = with_rows(x[0], self.rows)?;
        if x[0][0] != self.index.len() {
            return Err(format!("there must be {} rows, one for each index", self.index.len()));
        }
        check_index(&self.index, self.rows)?;
        Ok(shape)
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let mut shape = Shape::from_slice(x[0].shape());
        shape[0] = self.rows;
        let width: usize = shape[1..].iter().product();
        let mut out = pool.full(&shape, T::ZERO);
        add_rows(out.as_mut_slice(), x[0].as_slice(), &self.index, width);
        out
    }

    fn reads(&self) -> Reads {
        Reads::NOTHING
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        Grads::one(cx.g().gather_rows(&self.index))
    }
}

/// The gradient of a table of which some rows were gathered: the rows of the output's gradient and where they belong.
#[derive(Debug, Clone)]
pub struct RowGrad<T: Scalar> {
    shape: Shape,
    index: Arc<[u32]>,
    rows: Tensor<T>,
}

impl<T: Scalar> RowGrad<T> {
    /// The gradient of a table of this shape to which `rows` `[index.len(), ..]` are to be added at `index`.
    ///
    /// # Panics
    /// If the table is a scalar, an index is not below its number of rows, or the rows have another shape.
    #[track_caller]
    pub fn new(shape: &[usize], index: Arc<[u32]>, rows: Tensor<T>) -> Self {
        assert!(!shape.is_empty(), "the gradient of a table without rows");
        if let Err(error) = check_index(&index, shape[0]) {
            panic!("the gradient of a table of shape {shape:?}: {error}");
        }
        let fits = rows.shape().split_first() == Some((&index.len(), &shape[1..]));
        assert!(fits, "rows of shape {:?} at {} places of a table of shape {shape:?}", rows.shape(), index.len());
        RowGrad { shape: shape.into(), index, rows }
    }

    /// For each row its place in the table. A row of the table can come several times.
    pub fn index(&self) -> &Arc<[u32]> {
        &self.index
    }

    /// The rows, in the order of [`index`](Self::index).
    pub fn rows(&self) -> &Tensor<T> {
        &self.rows
    }

    #[track_caller]
    fn add(&self, dense: &mut [T]) {
        assert_eq!(dense.len(), self.shape.iter().product::<usize>(), "a dense gradient of the table");
        let width: usize = self.shape[1..].iter().product();
        add_rows(dense, self.rows.as_slice(), &self.index, width);
    }
}

impl<T: Scalar> SparseGrad<T> for RowGrad<T> {
    fn shape(&self) -> &[usize] {
        &self.shape
    }

    fn add_to(&self, dense: &mut Tensor<T>) {
        self.add(dense.as_mut_slice());
    }

    fn as_rows(&self) -> Option<&dyn RowShare<T>> {
        Some(self)
    }
}

impl<T: Scalar> RowShare<T> for RowGrad<T> {
    fn scatter(&self, sums: &mut RowSums<T>) {
        let width: usize = self.shape[1..].iter().product();
        assert_eq!([sums.table_rows(), sums.features()], [self.shape[0], width], "sums of the table's rows");
        for (share, &row) in self.rows.as_slice().chunks_exact(width).zip(self.index.iter()) {
            sums.add(row as usize, share);
        }
    }
}

impl<'t, T: Scalar> Var<'t, T> {
    /// Rows by number: `[rows, ..]` to `[index.len(), ..]`, row `i` of the result being row `index[i]` of this tensor.
    ///
    /// ```
    /// use raygrad_autograd::{Tape, Tensor};
    /// let tape = Tape::<f64>::new();
    /// let x = tape.leaf(Tensor::from([[1.0, 2.0], [3.0, 4.0]]));
    /// let y = x.gather_rows([1, 0, 1]);
    /// assert_eq!(y.value(), [[3.0, 4.0], [1.0, 2.0], [3.0, 4.0]]);
    /// assert_eq!(y.sum().grad(&[&x])[0], [[1.0, 1.0], [2.0, 2.0]]);
    /// ```
    ///
    /// # Panics
    /// If this is a scalar or an index is not below the number of rows.
    #[track_caller]
    pub fn gather_rows(&self, index: impl Into<Indices>) -> Self {
        self.tape().apply(GatherRows { index: self.line("gather_rows", index) }, &[self])
    }

    /// The adjoint of [`gather_rows`](Self::gather_rows): `[index.len(), ..]` to `[rows, ..]`, zeros to which row `i` of
    /// this tensor is added at row `index[i]`. Sums are carried in f64.
    ///
    /// # Panics
    /// If there is not one index for each row, or one is not below `rows`.
    #[track_caller]
    pub fn scatter_rows(&self, index: impl Into<Indices>, rows: usize) -> Self {
        self.tape().apply(ScatterRows { index: self.line("scatter_rows", index), rows }, &[self])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Tape;

    #[test]
    fn an_index_beyond_the_rows_is_a_shape_error() {
        let tape = Tape::<f32>::new();
        let x = tape.constant(Tensor::zeros(&[2, 3]));
        let error = tape.try_apply(GatherRows { index: [0, 2].into() }, &[&x]).unwrap_err().to_string();
        assert!(error.contains("index 1 is 2, but there are 2 rows"), "{error}");
        let error = tape.try_apply(ScatterRows { index: [0, 5].into(), rows: 5 }, &[&x]).unwrap_err().to_string();
        assert!(error.contains("index 1 is 5, but there are 5 rows"), "{error}");
        let error = tape.try_apply(ScatterRows { index: [0].into(), rows: 5 }, &[&x]).unwrap_err().to_string();
        assert!(error.contains("one for each index"), "{error}");
        assert!(tape.try_apply(GatherRows { index: [0].into() }, &[&tape.constant(Tensor::scalar(1.0))]).is_err());
    }

    #[test]
    fn the_sparse_gradient_is_the_dense_one_up_to_rounding() {
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
        // The sums of the sparse one are f32.
        let close = |(a, b): (&f32, &f32)| (a - b).abs() <= 2e-7 * b.abs();
        assert!(run(true).iter().zip(&run(false)).all(close), "{:?} {:?}", run(true), run(false));
    }

    #[test]
    #[should_panic(expected = "index 1 is 4, but there are 4 rows")]
    fn a_row_gradient_beyond_its_table_is_refused() {
        RowGrad::new(&[4, 2], [0, 4].into(), Tensor::<f32>::zeros(&[2, 2]));
    }

    #[test]
    fn a_large_table_gets_the_same_sums_as_a_small_one() {
        let index: Vec<u32> = (0..300).map(|i| (i * i + 3 * i) % 7).collect();
        let rows: Vec<f32> = (0..600).map(|i| (i as f32 * 0.7).sin() * 10.0_f32.powi(i % 5)).collect();
        let (mut small, mut large) = (vec![0.25; 14], vec![0.25; 2000]);
        add_rows(&mut small, &rows, &index, 2);
        add_rows(&mut large, &rows, &index, 2);
        assert!(small == large[..14] && large[14..].iter().all(|&x| x == 0.25));
        assert!(small.iter().filter(|&&x| x == 0.25).count() < 14);
        add_rows(&mut [] as &mut [f32], &[], &[3, 3], 0);
        add_rows(&mut large, &[], &[], 2);
    }

    #[test]
    fn sums_into_one_row_keep_their_digits() {
        let tape = Tape::<f32>::new();
        let x = tape.constant(Tensor::from_vec(&[3], vec![1e8, 1.0, -1e8]));
        assert_eq!(x.scatter_rows([1, 1, 1], 2).value().as_slice(), [0.0, 1.0]);
        assert_eq!(x.scatter_rows([1, 0, 1], 2).value().as_slice(), [1.0, 0.0]);
    }
}
