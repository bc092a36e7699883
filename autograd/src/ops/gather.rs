//! Rows of a tensor by number: embeddings and tables.

use crate::{Grads, Op, Reads, ShapeError, Var, Vjp};
use raygrad_tensor::{Pool, Scalar, Shape, Tensor};
use std::sync::Arc;

/// y[i] = x[index[i]] along the first axis; dx = [`ScatterRows`] of g.
#[derive(Clone)]
pub struct GatherRows {
    /// For each row of the output its row of the input. A clone is a reference count.
    pub index: Arc<[u32]>,
}

/// y[index[i]] += x[i] along the first axis, onto zeros, in the order of i; dx = [`GatherRows`] of g.
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
        let mut out = pool.tensor(&shape);
        for (out, &row) in out.as_mut_slice().chunks_exact_mut(width.max(1)).zip(self.index.iter()) {
            out.copy_from_slice(&x[0].as_slice()[row as usize * width..][..width]);
        }
        out
    }

    fn reads(&self) -> Reads {
        Reads::NOTHING
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        Grads::one(cx.g().scatter_rows(&self.index, cx.shape(0)[0]))
    }
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
        for (x, &row) in x[0].as_slice().chunks_exact(width.max(1)).zip(self.index.iter()) {
            for (out, &x) in out.as_mut_slice()[row as usize * width..][..width].iter_mut().zip(x) {
                *out += x;
            }
        }
        out
    }

    fn reads(&self) -> Reads {
        Reads::NOTHING
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        Grads::one(cx.g().gather_rows(&self.index))
    }
}

impl<'t, T: Scalar> Var<'t, T> {
    /// Rows by number: `[rows, ..]` to `[index.len(), ..]`, row `i` of the result being row `index[i]` of this tensor.
    ///
    /// ```
    /// use raygrad_autograd::{Tape, Tensor};
    /// let tape = Tape::<f64>::new();
    /// let x = tape.leaf(Tensor::from_vec(&[2, 2], vec![1.0, 2.0, 3.0, 4.0]));
    /// let y = x.gather_rows(&[1, 0, 1].into());
    /// assert_eq!(y.value().as_slice(), [3.0, 4.0, 1.0, 2.0, 3.0, 4.0]);
    /// assert_eq!(y.sum().grad(&[&x])[0].as_slice(), [1.0, 1.0, 2.0, 2.0]);
    /// ```
    ///
    /// # Panics
    /// If this is a scalar or an index is not below the number of rows.
    #[track_caller]
    pub fn gather_rows(&self, index: &Arc<[u32]>) -> Self {
        self.tape().apply(GatherRows { index: index.clone() }, &[self])
    }

    /// The adjoint of [`gather_rows`](Self::gather_rows): `[index.len(), ..]` to `[rows, ..]`, zeros to which row `i` of
    /// this tensor is added at row `index[i]`, in the order of `i`.
    ///
    /// # Panics
    /// If there is not one index for each row, or one is not below `rows`.
    #[track_caller]
    pub fn scatter_rows(&self, index: &Arc<[u32]>, rows: usize) -> Self {
        self.tape().apply(ScatterRows { index: index.clone(), rows }, &[self])
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
    fn sums_into_one_row_are_taken_in_order() {
        let tape = Tape::<f32>::new();
        let x = tape.constant(Tensor::from_vec(&[3], vec![1e8, 1.0, -1e8]));
        assert_eq!(x.scatter_rows(&[1, 1, 1].into(), 2).value().as_slice(), [0.0, 0.0]);
        assert_eq!(x.scatter_rows(&[1, 0, 1].into(), 2).value().as_slice(), [1.0, 0.0]);
    }
}
