//! Sums, means and broadcasting, the adjoint of the sum.

use crate::{Axes, Grads, Op, Reads, ShapeError, Var, Vjp};
use raygrad_tensor::Reduction;
use raygrad_tensor::{Pool, Scalar, Shape, Tensor, broadcast_shape, map, mean_to, sum_to};

/// y = x summed over the axes along which `shape` broadcasts to the shape of x; dx = g broadcast. The mean is the sum
/// divided by the number of summands, and so is its gradient. The mean overflows only if the mean itself does.
#[derive(Clone)]
pub struct SumTo {
    /// The shape of the output, which broadcasts to the shape of the input.
    pub shape: Shape,
    /// Divides by the number of summands.
    pub mean: bool,
}

impl<T: Scalar> Op<T> for SumTo {
    fn name(&self) -> &'static str {
        if self.mean { "mean" } else { "sum" }
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        match broadcast_shape(&[x[0], &self.shape]) {
            Some(wide) if wide.as_slice() == x[0] => Ok(self.shape.clone()),
            _ => Err(format!("cannot be summed to {:?}", self.shape)),
        }
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        if self.mean { mean_to(x[0], &self.shape, pool) } else { sum_to(x[0], &self.shape, pool) }
    }

    fn reads(&self) -> Reads {
        Reads::NOTHING
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        if !self.mean {
            return Grads::one(cx.g().broadcast_to(cx.shape(0)));
        }
        Grads::one(cx.g().spread_to(cx.shape(0)))
    }
}

/// y = x broadcast to `shape`; dx = g summed over the broadcast axes. The adjoint of the mean divides x by the number of
/// copies, and its own gradient is a mean.
#[derive(Clone)]
pub struct BroadcastTo {
    /// The shape of the output.
    pub shape: Shape,
    /// Divides by the number of copies.
    pub divided: bool,
}

impl<T: Scalar> Op<T> for BroadcastTo {
    fn name(&self) -> &'static str {
        if self.divided { "spread_to" } else { "broadcast_to" }
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        match broadcast_shape(&[x[0], &self.shape]) {
            Some(wide) if wide == self.shape => Ok(wide),
            _ => Err(format!("does not broadcast to {:?}", self.shape)),
        }
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        if !self.divided {
            return x[0].broadcast_to(&self.shape);
        }
        let [from, to] = [&self.shape, x[0].shape()].map(|shape| shape.iter().product::<usize>() as f64);
        let copies = T::from_f64(from / to);
        map([x[0]], pool, |[x]| x / copies).broadcast_to(&self.shape)
    }

    fn reads(&self) -> Reads {
        Reads::NOTHING
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        let g = cx.g();
        Grads::one(if self.divided { g.mean_to(cx.shape(0)) } else { g.sum_to(cx.shape(0)) })
    }
}

impl<'t, T: Scalar> Var<'t, T> {
    /// The sum of all elements, as a scalar. The sum is pairwise.
    #[track_caller]
    pub fn sum(&self) -> Self {
        self.sum_to(&[])
    }

    /// The mean of all elements, as a scalar; NaN for an empty tensor. It overflows only if the mean itself is too
    /// large.
    #[track_caller]
    pub fn mean(&self) -> Self {
        self.mean_to(&[])
    }

    /// The sum over any axes; 0 if there are no elements.
    ///
    /// ```
    /// use raygrad_autograd::{Axes, Tape, Tensor};
    /// let tape = Tape::<f32>::new();
    /// let x = tape.leaf(Tensor::from([[1.0, 2.0], [3.0, 4.0]]));
    /// assert_eq!(x.sum_over(-1).value(), [3.0, 7.0]);
    /// assert_eq!(x.sum_over(Axes::from(0).keepdims()).shape(), [1, 2]);
    /// ```
    ///
    /// # Panics
    /// If an axis does not exist or is named twice.
    #[track_caller]
    pub fn sum_over(&self, axes: impl Into<Axes>) -> Self {
        let axes = self.axes("sum_over", axes);
        self.sum_to(&axes.kept()).reshape(&axes.result())
    }

    /// The mean over any axes; NaN if there are no elements.
    ///
    /// # Panics
    /// If an axis does not exist or is named twice.
    #[track_caller]
    pub fn mean_over(&self, axes: impl Into<Axes>) -> Self {
        let axes = self.axes("mean_over", axes);
        self.mean_to(&axes.kept()).reshape(&axes.result())
    }

    /// The mean over the axes along which `shape` broadcasts to the shape of this tensor.
    #[track_caller]
    pub(crate) fn mean_to(&self, shape: &[usize]) -> Self {
        self.tape().apply(SumTo { shape: shape.into(), mean: true }, &[self])
    }

    /// `[kept elements, reduced elements]`, with the reduced axes moved to the end.
    #[track_caller]
    pub(crate) fn rows_over(&self, axes: &Reduction) -> Self {
        let order = axes.reduced_last();
        let sorted = order.is_sorted();
        let rows = axes.kept().iter().product();
        if sorted { self.clone() } else { self.reordered(&order) }.reshape(&[rows, axes.count()])
    }

    /// Sums over the axes along which `shape` broadcasts to the shape of this tensor: the adjoint of
    /// [`broadcast_to`](Self::broadcast_to).
    ///
    /// # Panics
    /// If `shape` does not broadcast to the shape of this tensor.
    #[track_caller]
    pub fn sum_to(&self, shape: &[usize]) -> Self {
        if self.shape() == shape {
            return self.clone();
        }
        self.tape().apply(SumTo { shape: shape.into(), mean: false }, &[self])
    }

    /// Broadcasts this tensor to `shape`, with NumPy's rules.
    ///
    /// # Panics
    /// If this tensor does not broadcast to `shape`.
    #[track_caller]
    pub fn broadcast_to(&self, shape: &[usize]) -> Self {
        if self.shape() == shape {
            return self.clone();
        }
        self.tape().apply(BroadcastTo { shape: shape.into(), divided: false }, &[self])
    }

    /// Broadcasts shares: this tensor divided by the number of its copies. The adjoint of the mean.
    pub(crate) fn spread_to(&self, shape: &[usize]) -> Self {
        self.tape().apply(BroadcastTo { shape: shape.into(), divided: true }, &[self])
    }
}
