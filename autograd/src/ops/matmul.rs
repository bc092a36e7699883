//! Matrix products: of two matrices, of batches of them, and of vectors.

use crate::error::ensure;
use crate::{Grads, Op, Operand, Reads, ShapeError, Var, Vjp};
use raygrad_tensor::matmul::matmul;
use raygrad_tensor::{Pool, Scalar, Shape, Tensor, broadcast_shape};
use std::borrow::Cow;

/// y = a b over the last two axes. Leading axes count matrices and broadcast. dA = g B', dB = A' g, summed over
/// broadcast axes.
#[derive(Clone, Copy)]
pub struct Matmul;

impl<T: Scalar> Op<T> for Matmul {
    fn name(&self) -> &'static str {
        "matmul"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        let (&[ref a @ .., rows, inner], &[ref b @ .., inner_b, columns]) = (x[0], x[1]) else {
            return Err("both factors must have two axes at least".into());
        };
        if inner != inner_b {
            return Err(format!("the inner extents {inner} and {inner_b} differ"));
        }
        let Some(mut shape) = broadcast_shape(&[a, b]) else {
            return Err("the leading axes do not broadcast".into());
        };
        shape.extend([rows, columns]);
        Ok(shape)
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        matmul(x[0], x[1], pool)
    }

    fn reads_for(&self, has_gradient: &dyn Fn(usize) -> bool) -> Reads {
        Reads::NOTHING.and_if(has_gradient(0), Reads::only(&[1])).and_if(has_gradient(1), Reads::only(&[0]))
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        let product = |a: &Var<'t, T>, b: &Var<'t, T>| cx.tape().apply(Matmul, &[a, b]);
        let a = cx.needs(0).then(|| product(cx.g(), &cx.x(1).t()).sum_to(cx.shape(0)));
        let b = cx.needs(1).then(|| product(&cx.x(0).t(), cx.g()).sum_to(cx.shape(1)));
        Grads::new([a, b])
    }
}

impl<'t, T: Scalar> Var<'t, T> {
    /// The matrix product, with NumPy's conventions:
    /// * two matrices: `[m, k]` times `[k, n]`;
    /// * more axes count matrices and broadcast: `[b, 1, m, k]` times `[c, k, n]` gives `[b, c, m, n]`;
    /// * a vector `[k]` on the left is a row, on the right a column. That axis is missing from the result, which is a
    ///   scalar for two vectors.
    ///
    /// A transpose ([`t`](Self::t)) or any other view is read without a copy.
    ///
    /// ```
    /// use raygrad_autograd::{Tape, Tensor};
    /// let tape = Tape::<f64>::new();
    /// let a = tape.leaf(Tensor::from([[1.0, 2.0], [3.0, 4.0]]));
    /// let x = tape.leaf(Tensor::from([1.0, 10.0]));
    /// let y = a.matmul(&x);
    /// assert_eq!(y.value(), [21.0, 43.0]);
    /// assert_eq!(x.matmul(&y).grad(&[&a])[0], [[1.0, 10.0], [10.0, 100.0]]);
    /// ```
    ///
    /// # Panics
    /// If a factor is a scalar, the inner extents differ or the leading axes do not broadcast.
    #[track_caller]
    pub fn matmul(&self, other: impl Operand<'t, T>) -> Self {
        let other = &other.on(self.tape());
        let (a, b) = (self.shape(), other.shape());
        let matrices = ensure(!a.is_empty() && !b.is_empty(), || "a scalar is no matrix".into());
        self.tape().fits("matmul", &[self, other], matrices);
        let (mut left, mut right) = (Cow::Borrowed(self), Cow::Borrowed(other));
        if a.len() == 1 {
            left = Cow::Owned(self.unsqueeze(0));
        }
        if b.len() == 1 {
            right = Cow::Owned(other.unsqueeze(1));
        }
        let rows: usize = left.shape()[..left.shape().len() - 1].iter().product();
        let flat = [rows, left.shape()[left.shape().len() - 1]];
        let mut y =
            if right.shape().len() == 2 && left.shape().len() > 2 && left.value().layout().reshaped(&flat).is_some() {
                // One right factor for all: the rows of all left factors together are one matrix.
                let mut shape = Shape::from_slice(left.shape());
                shape[left.shape().len() - 1] = right.shape()[1];
                self.tape().apply(Matmul, &[&left.reshape(&flat), &right]).reshape(&shape)
            } else {
                self.tape().apply(Matmul, &[&left, &right])
            };
        if b.len() == 1 {
            y = y.squeeze(-1);
        }
        if a.len() == 1 {
            // The row's axis stands before the columns, if these are still there.
            y = y.squeeze(if b.len() == 1 { -1 } else { -2 });
        }
        y
    }

    /// The inner product of two vectors, as a scalar. The sum is pairwise.
    ///
    /// # Panics
    /// If the operands are not vectors of equal length.
    #[track_caller]
    pub fn dot(&self, other: impl Operand<'t, T>) -> Self {
        let other = &other.on(self.tape());
        let vectors = self.shape().len() == 1 && self.shape() == other.shape();
        self.tape().fits("dot", &[self, other], ensure(vectors, || "not two vectors of one length".into()));
        (self * other).sum()
    }

    /// The outer product of two vectors: `[m]` and `[n]` to `[m, n]`.
    ///
    /// # Panics
    /// If an operand is not a vector.
    #[track_caller]
    pub fn outer(&self, other: impl Operand<'t, T>) -> Self {
        let other = &other.on(self.tape());
        let vectors = self.shape().len() == 1 && other.shape().len() == 1;
        self.tape().fits("outer", &[self, other], ensure(vectors, || "not two vectors".into()));
        self.unsqueeze(1) * other
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Tape;
    use crate::check::spread;
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
            let got = tape.constant(x.clone()).matmul(tape.constant(y.clone()));
            prop_assert_eq!(got.shape(), &expected_shape[..]);
            let full = |x: &Tensor<f64>, axes: [usize; 2]| {
                let mut wide = wide.to_vec();
                wide.extend(axes);
                let lead = x.shape().len().saturating_sub(2);
                let mut narrow = x.shape()[..lead].to_vec();
                narrow.extend(axes);
                x.reshape(&narrow).broadcast_to(&wide)
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
        let error = |a: &[usize], b: &[usize]| tape.try_apply(Matmul, &[&zeros(a), &zeros(b)]).unwrap_err().to_string();
        assert!(error(&[2, 3], &[2, 3]).contains("the inner extents 3 and 2 differ"));
        assert!(error(&[2, 2, 3], &[3, 3, 2]).contains("the leading axes do not broadcast"));
        assert!(error(&[3], &[3, 2]).contains("two axes at least"));
    }
}
