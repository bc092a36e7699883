//! The largest and smallest elements along axes, and their indices.

use crate::error::ensure;
use crate::{Axes, Grads, Indices, Op, Reads, ShapeError, Var, Vjp};
use raygrad_tensor::extremum::{Middle, extremum, extremum_grad};
use raygrad_tensor::{Pool, Scalar, Shape, Tensor};

/// y = the largest (or smallest) element over axes `from..behind`, which stay with extent 1. dx = g, shared evenly
/// among the elements that equal y, as PyTorch's `amax` does it.
#[derive(Debug, Clone, Copy)]
pub struct Extremum {
    /// The first axis.
    pub from: usize,
    /// One past the last axis.
    pub behind: usize,
    /// Whether to take the largest element, not the smallest.
    pub greatest: bool,
}

impl Extremum {
    fn middle(&self, x: &[usize]) -> Middle {
        [x[..self.from].iter().product(), x[self.from..self.behind].iter().product(), x[self.behind..].iter().product()]
    }
}

impl<T: Scalar> Op<T> for Extremum {
    fn name(&self) -> &'static str {
        "extremum"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        if self.behind > x[0].len() {
            return Err(format!("there is no axis {}", self.behind - 1));
        }
        let [outer, count, inner] = self.middle(x[0]);
        if count == 0 && outer * inner > 0 {
            return Err("no elements have no greatest or smallest one".into());
        }
        let mut shape = Shape::from_slice(x[0]);
        shape[self.from..self.behind].fill(1);
        Ok(shape)
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let mut shape = Shape::from_slice(x[0].shape());
        shape[self.from..self.behind].fill(1);
        let mut out = pool.tensor(&shape);
        extremum(x[0].as_slice(), self.middle(x[0].shape()), self.greatest, out.as_mut_slice());
        out
    }

    fn reads(&self) -> Reads {
        Reads::ALL
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        let (x, y, g) = (cx.x(0), cx.y(), cx.g());
        if cx.recording() {
            let equal = x.elementwise_eq(&y);
            // No element equals NaN.
            let count = cx.constant(equal.cast()).sum_to(y.shape()).maximum(1.0);
            let share = g / count;
            return Grads::one(share.where_(&equal, 0.0));
        }
        let mut out = cx.pool().tensor(x.shape());
        let [x_, y, g] = [x.value(), y.value(), g.value()].map(Tensor::as_slice);
        extremum_grad(x_, y, g, self.middle(x.shape()), out.as_mut_slice());
        Grads::one(cx.constant(out))
    }
}

impl<'t, T: Scalar> Var<'t, T> {
    #[track_caller]
    fn extremum(&self, axes: Axes, greatest: bool) -> Self {
        let axes = self.axes(if greatest { "max_over" } else { "min_over" }, axes);
        let y = match axes.run() {
            Some((from, behind)) => self.tape().apply(Extremum { from, behind, greatest }, &[self]),
            None => self.tape().apply(Extremum { from: 1, behind: 2, greatest }, &[&self.rows_over(&axes)]),
        };
        y.reshape(&axes.result())
    }

    /// The largest element, as a scalar; see [`max_over`](Self::max_over).
    ///
    /// # Panics
    /// If the tensor is empty.
    #[track_caller]
    pub fn max(&self) -> Self {
        self.max_over(..)
    }

    /// The largest elements over any axes; NaN if one is NaN (`torch.amax`). Equal elements share the gradient evenly.
    /// A NaN result has gradient 0.
    ///
    /// ```
    /// use raygrad_autograd::{Tape, Tensor};
    /// let tape = Tape::<f32>::new();
    /// let x = tape.leaf(Tensor::from([[1.0, 5.0], [3.0, 3.0]]));
    /// let y = x.max_over(-1);
    /// assert_eq!(y.value(), [5.0, 3.0]);
    /// assert_eq!(y.sum().grad(&[&x])[0], [[0.0, 1.0], [0.5, 0.5]]);
    /// ```
    ///
    /// # Panics
    /// If an axis does not exist or is named twice, or there are no elements to choose from.
    #[track_caller]
    #[doc(alias = "amax")]
    pub fn max_over(&self, axes: impl Into<Axes>) -> Self {
        self.extremum(axes.into(), true)
    }

    /// The smallest element, as a scalar; see [`max_over`](Self::max_over).
    ///
    /// # Panics
    /// If the tensor is empty.
    #[track_caller]
    pub fn min(&self) -> Self {
        self.min_over(..)
    }

    /// The smallest elements over any axes; see [`max_over`](Self::max_over).
    ///
    /// # Panics
    /// Where [`max_over`](Self::max_over) panics.
    #[track_caller]
    pub fn min_over(&self, axes: impl Into<Axes>) -> Self {
        self.extremum(axes.into(), false)
    }

    #[track_caller]
    fn chosen(&self, op: &'static str, axis: isize) -> Tensor<T> {
        if self.shape().is_empty() {
            return self.reshape(&[1]).chosen(op, axis);
        }
        let axis = self.axis(op, axis);
        let others = self.shape().iter().enumerate().all(|(i, &extent)| i == axis || extent > 0);
        self.fits(
            op,
            ensure(self.shape()[axis] > 0 || !others, || format!("nothing to choose from along axis {axis}")),
        );
        self.value().clone()
    }

    /// The indices of the largest elements along `axis`. The result has the shape of this tensor without that axis. It
    /// holds the first of equal elements, and the first NaN if there is one. There is no gradient.
    ///
    /// ```
    /// use raygrad_autograd::{Tape, Tensor};
    /// let tape = Tape::<f32>::new();
    /// let x = tape.leaf(Tensor::from_vec(&[2, 3], vec![1.0, 5.0, 2.0, 3.0, 0.0, 3.0]));
    /// assert_eq!(x.argmax(-1), [1, 0]);
    /// assert_eq!(x.argmax(0), [1, 0, 1]);
    /// ```
    ///
    /// # Panics
    /// If the axis does not exist, or there are no elements to choose from.
    #[track_caller]
    pub fn argmax(&self, axis: isize) -> Indices {
        self.chosen("argmax", axis).argmax(axis)
    }

    /// The indices of the smallest elements along `axis`; see [`argmax`](Self::argmax).
    ///
    /// # Panics
    /// Where [`argmax`](Self::argmax) panics.
    #[track_caller]
    pub fn argmin(&self, axis: isize) -> Indices {
        self.chosen("argmin", axis).argmin(axis)
    }
}

#[cfg(test)]
mod tests {
    use crate::{Indices, Tape, Tensor};

    #[test]
    fn axes_that_are_no_neighbours_are_reduced_together() {
        let tape = Tape::<f64>::new();
        let x = tape.leaf(Tensor::from_fn(&[2, 3, 2], |i| ((i * 5) % 7) as f64));
        let y = x.max_over([0, 2]);
        assert_eq!((y.shape(), y.value().as_slice()), (&[3][..], &[5.0, 5.0, 6.0][..]));
        // The six is there twice, in different planes.
        let expected = [0.0, 1.0, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.5];
        assert_eq!(y.sum().grad(&[&x])[0].as_slice(), expected);
    }

    #[test]
    #[should_panic(expected = "no elements have no greatest")]
    fn no_elements_have_no_maximum() {
        let tape = Tape::<f32>::new();
        let _ = tape.constant(Tensor::zeros(&[2, 0])).max_over(1);
    }

    #[test]
    fn empty_results_and_scalars_are_fine() {
        let tape = Tape::<f32>::new();
        assert_eq!(tape.constant(Tensor::zeros(&[0, 3])).max_over(1).shape(), [0]);
        let x = tape.leaf(Tensor::scalar(2.0));
        assert_eq!((x.min().item(), x.argmin(-1)), (2.0, Indices::new(&[], [0])));
        assert_eq!(tape.constant(Tensor::zeros(&[2, 3, 0])).argmax(1).shape(), [2, 0]);
        assert_eq!(x.max().grad(&[&x])[0].item(), 1.0);
    }
}
