//! Matrix products: of two matrices, of batches of them, and of vectors.

use crate::{Grads, Op, Reads, ShapeError, Var, Vjp};
use raygrad_tensor::matmul::{Matrix, gemm};
use raygrad_tensor::{Pool, Scalar, Shape, Tensor, broadcast_shape};
use std::borrow::Cow;

/// y = a b over the last two axes, with either matrix transposed by stride; leading axes count matrices and broadcast.
/// dA = g B', dB = A' g, summed over what was broadcast.
#[derive(Clone, Copy)]
pub struct Matmul {
    /// Read `a` as its transpose.
    pub transpose_a: bool,
    /// Read `b` as its transpose.
    pub transpose_b: bool,
}

/// Rows and columns of the matrices in a tensor, transposed on demand.
fn extents(shape: &[usize], transpose: bool) -> [usize; 2] {
    let (rows, columns) = (shape[shape.len() - 2], shape[shape.len() - 1]);
    if transpose { [columns, rows] } else { [rows, columns] }
}

/// The axes that count matrices.
fn batch(shape: &[usize]) -> &[usize] {
    &shape[..shape.len() - 2]
}

/// Matrix `i` of a tensor, transposed on demand.
fn matrix<T: Scalar>(x: &Tensor<T>, i: usize, transpose: bool) -> Matrix<'_, T> {
    let [rows, columns] = extents(x.shape(), false);
    let len = rows * columns;
    let matrix = Matrix::new(&x.as_slice()[i * len..(i + 1) * len], rows, columns);
    if transpose { matrix.t() } else { matrix }
}

/// For each matrix of the output its number in an operand whose batch broadcasts to `wide`.
fn numbers(narrow: &[usize], wide: &[usize]) -> Vec<usize> {
    let mut numbers = vec![0];
    for (axis, &extent) in wide.iter().enumerate() {
        // An absent axis or one of extent 1 repeats what there is.
        let own = (axis + narrow.len()).checked_sub(wide.len()).map_or(1, |axis| narrow[axis]);
        let next = |&i: &usize| (0..extent).map(move |k| i * own + if own == 1 { 0 } else { k });
        numbers = numbers.iter().flat_map(next).collect();
    }
    numbers
}

impl<T: Scalar> Op<T> for Matmul {
    fn name(&self) -> &'static str {
        "matmul"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        if x[0].len() < 2 || x[1].len() < 2 {
            return Err("both factors must have two axes at least".into());
        }
        let ([rows, inner], [inner_b, columns]) = (extents(x[0], self.transpose_a), extents(x[1], self.transpose_b));
        if inner != inner_b {
            return Err(format!("the inner extents {inner} and {inner_b} differ"));
        }
        let Some(mut shape) = broadcast_shape(&[batch(x[0]), batch(x[1])]) else {
            return Err("the leading axes do not broadcast".into());
        };
        shape.extend([rows, columns]);
        Ok(shape)
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let Ok(shape) = Op::<T>::shape(self, &[x[0].shape(), x[1].shape()]) else {
            unreachable!("`shape` has accepted these extents")
        };
        let mut out = pool.tensor(&shape);
        let [rows, columns] = extents(&shape, false);
        if shape.len() == 2 {
            gemm(matrix(x[0], 0, self.transpose_a), matrix(x[1], 0, self.transpose_b), out.as_mut_slice(), false);
        } else if rows * columns > 0 {
            let [a, b] = [0, 1].map(|i| numbers(batch(x[i].shape()), batch(&shape)));
            for (i, out) in out.as_mut_slice().chunks_exact_mut(rows * columns).enumerate() {
                let left = matrix(x[0], a[i], self.transpose_a);
                gemm(left, matrix(x[1], b[i], self.transpose_b), out, false);
            }
        }
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
        Grads::new([a.map(|a| a.sum_to(cx.shape(0))), b.map(|b| b.sum_to(cx.shape(1)))])
    }
}

impl<'t, T: Scalar> Var<'t, T> {
    /// The matrix product, with NumPy's conventions:
    /// - two matrices, `[m, k]` times `[k, n]`;
    /// - more axes count matrices, and broadcast: `[b, 1, m, k]` times `[c, k, n]` gives `[b, c, m, n]`;
    /// - a vector `[k]` on the left is a row, on the right a column, and that axis is missing from the result, which is
    ///   a scalar for two vectors.
    ///
    /// ```
    /// use raygrad_autograd::{Tape, Tensor};
    /// let tape = Tape::<f64>::new();
    /// let a = tape.leaf(Tensor::from_vec(&[2, 2], vec![1.0, 2.0, 3.0, 4.0]));
    /// let x = tape.leaf(Tensor::from_vec(&[2], vec![1.0, 10.0]));
    /// let y = a.matmul(&x);
    /// assert_eq!(y.value().as_slice(), [21.0, 43.0]);
    /// assert_eq!(x.matmul(&y).grad(&[&a])[0].as_slice(), [1.0, 10.0, 10.0, 100.0]);
    /// ```
    ///
    /// # Panics
    /// If a factor is a scalar, the inner extents differ or the leading axes do not broadcast.
    #[track_caller]
    pub fn matmul(&self, other: &Self) -> Self {
        let (a, b) = (self.shape(), other.shape());
        assert!(!a.is_empty() && !b.is_empty(), "matmul of shapes {a:?} and {b:?}: a scalar is no matrix");
        let (mut left, mut right) = (Cow::Borrowed(self), Cow::Borrowed(other));
        if a.len() == 1 {
            left = Cow::Owned(self.unsqueeze(0));
        }
        if b.len() == 1 {
            right = Cow::Owned(other.unsqueeze(1));
        }
        let mut y = if right.shape().len() == 2 && left.shape().len() > 2 {
            // One right factor for all: the rows of all left factors together are one matrix.
            let rows: usize = left.shape()[..left.shape().len() - 1].iter().product();
            let inner = left.shape()[left.shape().len() - 1];
            let mut shape = Shape::from_slice(left.shape());
            shape[left.shape().len() - 1] = right.shape()[1];
            left.reshape(&[rows, inner]).matmul_t(false, &right, false).reshape(&shape)
        } else {
            left.matmul_t(false, &right, false)
        };
        if b.len() == 1 {
            y = y.squeeze(y.shape().len() - 1);
        }
        if a.len() == 1 {
            // The row's axis stands before the columns, if these are still there.
            y = y.squeeze(y.shape().len() - if b.len() == 1 { 1 } else { 2 });
        }
        y
    }

    /// The product of two matrices, each read as its transpose if its flag is set; nothing is copied. Axes before the
    /// last two count matrices, and broadcast.
    ///
    /// # Panics
    /// If a factor has less than two axes, the inner extents differ or the leading axes do not broadcast.
    #[track_caller]
    pub fn matmul_t(&self, transpose_self: bool, other: &Self, transpose_other: bool) -> Self {
        let op = Matmul { transpose_a: transpose_self, transpose_b: transpose_other };
        self.tape().apply(op, &[self, other])
    }

    /// The inner product of two vectors, as a scalar; summed pairwise.
    ///
    /// # Panics
    /// If the operands are not vectors of one length.
    #[track_caller]
    pub fn dot(&self, other: &Self) -> Self {
        let shapes = (self.shape(), other.shape());
        assert!(shapes.0.len() == 1 && shapes.0 == shapes.1, "dot of shapes {shapes:?}");
        (self * other).sum()
    }

    /// The outer product of two vectors: `[m]` and `[n]` to `[m, n]`.
    ///
    /// # Panics
    /// If an operand is not a vector.
    #[track_caller]
    pub fn outer(&self, other: &Self) -> Self {
        let (&[_], &[_]) = (self.shape(), other.shape()) else {
            panic!("outer of shapes {:?} and {:?}", self.shape(), other.shape())
        };
        self.unsqueeze(1) * other
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Tape;
    use crate::catalogue::spread;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn batches_broadcast_and_vectors_lose_their_axis(
            lead in prop::collection::vec((0usize..3, 0usize..3), 0..3), cut in 0usize..3, [m, k, n] in [0usize..4, 0..4, 0..4],
            vectors in 0usize..4
        ) {
            // Each leading extent is d for one operand and d or 1 for the other; one of them may lack some.
            let extent = |(d, kind): &(usize, usize), side: usize| if *kind == side { 1 } else { *d };
            let mut a: Vec<usize> = lead.iter().map(|d| extent(d, 1)).collect();
            let mut b: Vec<usize> = lead.iter().map(|d| extent(d, 2)).collect();
            b.drain(..cut.min(b.len()));
            let (row, column) = (vectors & 1 == 1, vectors & 2 == 2);
            if row { a.clear() }
            if column { b.clear() }
            let wide = broadcast_shape(&[&a[..], &b[..]]).unwrap();
            let mut expected_shape = wide.to_vec();
            if row { a.push(k) } else { a.extend([m, k]); expected_shape.push(m) }
            if column { b.push(k) } else { b.extend([k, n]); expected_shape.push(n) }
            let (m, n) = (if row { 1 } else { m }, if column { 1 } else { n });
            let tape = Tape::<f64>::new();
            let (x, y) = (spread(&a, &[-1.0..1.0], 1), spread(&b, &[-1.0..1.0], 2));
            let got = tape.constant(x.clone()).matmul(&tape.constant(y.clone()));
            prop_assert_eq!(got.shape(), &expected_shape[..]);
            let full = |x: &Tensor<f64>, axes: [usize; 2]| {
                let mut wide = wide.to_vec();
                wide.extend(axes);
                let lead = x.shape().len().saturating_sub(2);
                let mut narrow = x.shape()[..lead].to_vec();
                narrow.extend(axes);
                raygrad_tensor::broadcast_to(&x.reshape(&narrow), &wide, &Pool::none())
            };
            let (x, y) = (full(&x, [m, k]), full(&y, [k, n]));
            for (i, &got) in got.value().as_slice().iter().enumerate() {
                let (batch, i, j) = (i / (m * n), i / n % m, i % n);
                let at = |l| x.as_slice()[(batch * m + i) * k + l] * y.as_slice()[(batch * k + l) * n + j];
                prop_assert!((got - (0..k).map(at).sum::<f64>()).abs() < 1e-12);
            }
        }
    }

    #[test]
    fn factors_that_do_not_fit_are_shape_errors() {
        let tape = Tape::<f32>::new();
        let zeros = |shape: &[usize]| tape.constant(Tensor::zeros(shape));
        let op = Matmul { transpose_a: false, transpose_b: false };
        let error = |a: &[usize], b: &[usize]| tape.try_apply(op, &[&zeros(a), &zeros(b)]).unwrap_err().to_string();
        assert!(error(&[2, 3], &[2, 3]).contains("the inner extents 3 and 2 differ"));
        assert!(error(&[2, 2, 3], &[3, 3, 2]).contains("the leading axes do not broadcast"));
        assert!(error(&[3], &[3, 2]).contains("two axes at least"));
    }
}
