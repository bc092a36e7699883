//! The matrix product.

use crate::{Grads, Op, Reads, ShapeError, Var, Vjp};
use raygrad_tensor::matmul::{Matrix, gemm};
use raygrad_tensor::{Pool, Scalar, Shape, Tensor};
use smallvec::smallvec;

/// y = a b, with either matrix transposed by stride. dA = g B', dB = A' g.
#[derive(Clone, Copy)]
pub struct Matmul {
    /// Read `a` as its transpose.
    pub transpose_a: bool,
    /// Read `b` as its transpose.
    pub transpose_b: bool,
}

/// A 2-D tensor as a matrix, transposed on demand.
fn matrix<T: Scalar>(x: &Tensor<T>, transpose: bool) -> Matrix<'_, T> {
    if transpose { Matrix::rows_of(x).t() } else { Matrix::rows_of(x) }
}

impl<T: Scalar> Op<T> for Matmul {
    fn name(&self) -> &'static str {
        "matmul"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        let (&[a0, a1], &[b0, b1]) = (x[0], x[1]) else { return Err("both factors must have two axes".into()) };
        let (rows, inner) = if self.transpose_a { (a1, a0) } else { (a0, a1) };
        let (inner_b, columns) = if self.transpose_b { (b1, b0) } else { (b0, b1) };
        if inner != inner_b {
            return Err(format!("the inner extents {inner} and {inner_b} differ"));
        }
        Ok(smallvec![rows, columns])
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let (a, b) = (matrix(x[0], self.transpose_a), matrix(x[1], self.transpose_b));
        let mut out = pool.tensor(&[a.rows(), b.columns()]);
        gemm(a, b, out.as_mut_slice(), false);
        out
    }

    fn reads(&self) -> Reads {
        Reads::INPUTS
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        let g = cx.g();
        let a = cx.needs(0).then(|| match *self {
            // dA = g op(B)', dA' = op(B) g'.
            Matmul { transpose_a: false, transpose_b } => g.matmul_t(false, &cx.x(1), !transpose_b),
            Matmul { transpose_a: true, transpose_b } => cx.x(1).matmul_t(transpose_b, g, true),
        });
        let b = cx.needs(1).then(|| match *self {
            Matmul { transpose_a, transpose_b: false } => cx.x(0).matmul_t(!transpose_a, g, false),
            Matmul { transpose_a, transpose_b: true } => g.matmul_t(true, &cx.x(0), transpose_a),
        });
        Grads::new([a, b])
    }
}

impl<'t, T: Scalar> Var<'t, T> {
    /// The product of two matrices, `[m, k]` times `[k, n]`.
    ///
    /// # Panics
    /// If a factor has not two axes or the inner extents differ.
    #[track_caller]
    pub fn matmul(&self, other: &Self) -> Self {
        self.matmul_t(false, other, false)
    }

    /// The product of two matrices, each read as its transpose if its flag is set; nothing is copied.
    ///
    /// # Panics
    /// If a factor has not two axes or the inner extents differ.
    #[track_caller]
    pub fn matmul_t(&self, transpose_self: bool, other: &Self, transpose_other: bool) -> Self {
        let op = Matmul { transpose_a: transpose_self, transpose_b: transpose_other };
        self.tape().apply(op, &[self, other])
    }
}
