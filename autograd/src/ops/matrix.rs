//! Parts of matrices: triangles and diagonals of the last two axes.

use crate::error::ensure;
use crate::{Grads, Op, Reads, ShapeError, Var, Vjp};
use raygrad_tensor::{Layout, Pool, Scalar, Shape, Tensor, checked_len};

/// y = x where column - row is at least (upper) or at most (lower) `diagonal`, else 0; dx is the same of g.
#[derive(Clone, Copy)]
pub struct Triangle {
    /// Whether to keep the upper triangle, not the lower.
    pub upper: bool,
    /// Column minus row of the diagonal that bounds the triangle; it belongs to the triangle.
    pub diagonal: isize,
}

impl<T: Scalar> Op<T> for Triangle {
    fn name(&self) -> &'static str {
        "triangle"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        if x[0].len() < 2 { Err("a matrix has two axes at least".into()) } else { Ok(x[0].into()) }
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let mut out = pool.copy_of(x[0].shape(), x[0].as_slice());
        let [.., rows, columns] = *x[0].shape() else { unreachable!("`shape` wants two axes") };
        for (row, out) in out.as_mut_slice().chunks_exact_mut(columns.max(1)).enumerate() {
            let diagonal = ((row % rows) as isize).saturating_add(self.diagonal);
            if self.upper {
                out[..diagonal.clamp(0, columns as isize) as usize].fill(T::ZERO);
            } else {
                out[diagonal.saturating_add(1).clamp(0, columns as isize) as usize..].fill(T::ZERO);
            }
        }
        out
    }

    fn reads(&self) -> Reads {
        Reads::NOTHING
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        Grads::one(cx.tape().apply(*self, &[cx.g()]))
    }
}

impl<'t, T: Scalar> Var<'t, T> {
    /// The lower triangle of each matrix: elements on or below a diagonal, and zeros elsewhere. Diagonal 0 is the main
    /// one; `diagonal` counts towards the upper right.
    ///
    /// # Panics
    /// If there are fewer than two axes.
    #[track_caller]
    pub fn tril(&self, diagonal: isize) -> Self {
        self.tape().apply(Triangle { upper: false, diagonal }, &[self])
    }

    /// The upper triangle of each matrix: elements on or above a diagonal, and zeros elsewhere. Diagonal 0 is the main
    /// one; `diagonal` counts towards the upper right.
    ///
    /// # Panics
    /// If there are fewer than two axes.
    #[track_caller]
    pub fn triu(&self, diagonal: isize) -> Self {
        self.tape().apply(Triangle { upper: true, diagonal }, &[self])
    }

    /// A diagonal of each matrix, `[.., m, n]` to `[.., k]`. Diagonal 0 is the main one; `diagonal` counts towards the
    /// upper right. Beyond the corners it is empty.
    ///
    /// # Panics
    /// If there are fewer than two axes.
    #[track_caller]
    pub fn diagonal(&self, diagonal: isize) -> Self {
        self.view("diagonal", |layout| layout.last_diagonal(diagonal))
    }

    /// Matrices with the rows of this tensor on a diagonal and zeros elsewhere: `[.., k]` to `[.., n, n]`, where
    /// `n = k + abs(diagonal)`. The adjoint of [`diagonal`](Self::diagonal).
    ///
    /// # Panics
    /// If this is a scalar.
    #[track_caller]
    pub fn diag_embed(&self, diagonal: isize) -> Self {
        let (&len, lead) =
            self.fits("diag_embed", self.shape().split_last().ok_or_else(|| "a scalar has no rows".into()));
        let n = len.saturating_add(diagonal.unsigned_abs());
        let shape: Shape = lead.iter().copied().chain([n, n]).collect();
        self.fits("diag_embed", ensure(checked_len(&shape).is_some(), || format!("{shape:?} is too large")));
        let layout = Layout::contiguous(&shape).diagonal(shape.len() - 2, shape.len() - 1, diagonal);
        self.scatter_view(&shape, layout)
    }

    /// The diagonal of a matrix, or the matrix with a vector on its diagonal, as in NumPy.
    ///
    /// # Panics
    /// If there are not one or two axes.
    #[track_caller]
    pub fn diag(&self, diagonal: isize) -> Self {
        match self.shape().len() {
            1 => self.diag_embed(diagonal),
            2 => self.diagonal(diagonal),
            _ => self.fits("diag", Err("use `diagonal` or `diag_embed`".into())),
        }
    }
}
