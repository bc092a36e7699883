//! Softmax, its logarithm, and the logarithm of a sum of exponentials.

use super::gradient_op::{FusedGradient, GradientOp};
use crate::{Axes, Grads, Op, Reads, ShapeError, Var, Vjp};
use raygrad_tensor::rows;
use raygrad_tensor::scale::power_of_two;
use raygrad_tensor::{Pool, Scalar, Shape, Tensor, map};

/// The shape, if it has a last axis, and the extent of that.
fn last_axis(x: &[usize]) -> Result<(Shape, usize), ShapeError> {
    match x.last() {
        Some(&n) => Ok((Shape::from_slice(x), n)),
        None => Err("a scalar has no last axis".into()),
    }
}

/// The last axis of a variable that an operation has accepted, as axes of a sum.
fn kept_last() -> Axes {
    Axes::from(-1).keepdims()
}

/// A tensor with a number for each row as a column.
pub(super) fn column<'t, T: Scalar>(x: &Var<'t, T>) -> Var<'t, T> {
    let mut shape = Shape::from_slice(x.shape());
    shape.push(1);
    x.reshape(&shape)
}

/// `g` times the softmax of `x` along the last axis, recorded. Each power is the square of its root, around `g`, which may
/// bring it back into range.
pub(super) fn softmax_times<'t, T: Scalar>(x: &Var<'t, T>, g: &Var<'t, T>) -> Var<'t, T> {
    if x.value().is_empty() {
        return x * g;
    }
    let tape = x.tape();
    // The shift cancels, so it is a constant.
    let greatest = x.value().max_over(kept_last());
    let half = T::from_f64(0.5);
    // Of each of two roots, by half of the rounding error.
    let correct = |[x, greatest]: [T; 2]| half + half * rows::corrected(T::ONE, x, greatest);
    let correction = tape.constant(map([x.value(), &greatest.broadcast_to(x.shape())], tape.pool(), correct));
    let root = ((x - tape.constant(greatest)) * 0.5).exp() * correction;
    &root * (g / root.square().sum_over(kept_last())) * &root
}

/// `dx(g)`, recorded, for a `dx` that is linear. It is computed in smaller units if a sum of rows of `g` may be out of
/// range.
fn in_range<'t, T: Scalar>(g: &Var<'t, T>, dx: impl Fn(&Var<'t, T>) -> Var<'t, T>) -> Var<'t, T> {
    let n = g.shape()[g.shape().len() - 1].max(1);
    let up = power_of_two(2 + i64::from(n.ilog2()));
    let most = if size_of::<T>() == 4 { f32::MAX.into() } else { f64::MAX };
    if g.value().iter().all(|g| g.to_f64().abs() <= most / up) { dx(g) } else { dx(&(g / up)) * up }
}

/// A tensor of the shape of `x`, whose rows `kernel(x, row length, out)` writes.
fn by_rows<T: Scalar>(x: &Tensor<T>, pool: &Pool<T>, kernel: impl FnOnce(&[T], usize, &mut [T])) -> Tensor<T> {
    let mut out = pool.tensor(x.shape());
    kernel(x.as_slice(), x.shape()[x.ndim() - 1], out.as_mut_slice());
    out
}

/// y = e^(x - max) / sum e^(x - max) along the last axis; dx = y (g - sum g y).
#[derive(Clone, Copy)]
pub struct Softmax;

impl<T: Scalar> Op<T> for Softmax {
    fn name(&self) -> &'static str {
        "softmax"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        Ok(last_axis(x[0])?.0)
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        by_rows(x[0], pool, |x, n, out| rows::softmax_rows(x, n, out, pool))
    }

    fn reads(&self) -> Reads {
        Reads::ALL
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        Grads::one(cx.tape().apply(SOFTMAX_GRAD, &[&cx.x(0), &cx.y(), cx.g()]))
    }

    fn reference<'t>(&self, x: &[Var<'t, T>]) -> Option<Var<'t, T>> {
        let powers = x[0].exp();
        Some(&powers / powers.sum_over(kept_last()))
    }
}

/// The gradient of the softmax as an operation of its input, its *output* and the gradient of that.
pub(crate) const SOFTMAX_GRAD: GradientOp<Softmax> = GradientOp { op: Softmax, input: 0 };

impl<T: Scalar> FusedGradient<T> for Softmax {
    const GRADIENT: &'static str = "softmax_grad";

    fn gradient(&self, _input: usize, x: &[&Tensor<T>], g: &Tensor<T>, pool: &Pool<T>) -> Tensor<T> {
        by_rows(x[0], pool, |x0, n, out| rows::softmax_rows_grad(x0, x[1].as_slice(), g.as_slice(), n, out))
    }

    fn recorded<'t>(&self, _input: usize, x: &[Var<'t, T>], g: &Var<'t, T>) -> Option<Var<'t, T>> {
        let y = &x[1];
        Some(in_range(g, |g| y * (g - (g * y).sum_over(kept_last()))))
    }
}

/// y = x - max - ln sum e^(x - max) along the last axis; dx = g - softmax(x) sum g.
#[derive(Clone, Copy)]
pub struct LogSoftmax;

impl<T: Scalar> Op<T> for LogSoftmax {
    fn name(&self) -> &'static str {
        "log_softmax"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        Ok(last_axis(x[0])?.0)
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        by_rows(x[0], pool, |x, n, out| rows::log_softmax_rows(x, n, out, pool))
    }

    fn reads(&self) -> Reads {
        // The output is rounded, and a power of it would be off by as many units as it is large.
        Reads::INPUTS
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        Grads::one(cx.tape().apply(GradientOp { op: *self, input: 0 }, &[&cx.x(0), cx.g()]))
    }

    fn reference<'t>(&self, x: &[Var<'t, T>]) -> Option<Var<'t, T>> {
        Some(&x[0] - x[0].exp().sum_over(kept_last()).ln())
    }
}

impl<T: Scalar> FusedGradient<T> for LogSoftmax {
    const GRADIENT: &'static str = "log_softmax_grad";

    fn gradient(&self, _input: usize, x: &[&Tensor<T>], g: &Tensor<T>, pool: &Pool<T>) -> Tensor<T> {
        by_rows(x[0], pool, |x, n, out| rows::log_softmax_rows_grad(x, g.as_slice(), n, out, pool))
    }

    fn recorded<'t>(&self, _input: usize, x: &[Var<'t, T>], g: &Var<'t, T>) -> Option<Var<'t, T>> {
        Some(in_range(g, |g| g - softmax_times(&x[0], &g.sum_over(kept_last()))))
    }
}

/// y = ln sum e^x along the last axis, which is removed; dx = g e^(x - y), and 0 where y is -inf.
#[derive(Clone, Copy)]
pub struct LogSumExp;

impl<T: Scalar> Op<T> for LogSumExp {
    fn name(&self) -> &'static str {
        "logsumexp"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        let (mut shape, _) = last_axis(x[0])?;
        shape.pop();
        Ok(shape)
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let last = x[0].ndim() - 1;
        let mut out = pool.tensor(&x[0].shape()[..last]);
        rows::logsumexp_rows(x[0].as_slice(), x[0].shape()[last], out.as_mut_slice(), pool);
        out
    }

    fn reads(&self) -> Reads {
        Reads::INPUTS
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        Grads::one(cx.tape().apply(GradientOp { op: *self, input: 0 }, &[&cx.x(0), cx.g()]))
    }

    fn reference<'t>(&self, x: &[Var<'t, T>]) -> Option<Var<'t, T>> {
        Some(x[0].exp().sum_over(-1).ln())
    }
}

impl<T: Scalar> FusedGradient<T> for LogSumExp {
    const GRADIENT: &'static str = "logsumexp_grad";

    fn gradient(&self, _input: usize, x: &[&Tensor<T>], g: &Tensor<T>, pool: &Pool<T>) -> Tensor<T> {
        by_rows(x[0], pool, |x, n, out| rows::logsumexp_rows_grad(x, n, g.as_slice(), out, pool))
    }

    fn recorded<'t>(&self, _input: usize, x: &[Var<'t, T>], g: &Var<'t, T>) -> Option<Var<'t, T>> {
        let x = &x[0];
        if x.value().is_empty() {
            return Some(x * column(g));
        }
        let lowest = T::from_f64(f64::NEG_INFINITY);
        let is_lost = x.value().max_over(kept_last()).broadcast_to(x.shape()).elementwise_eq(lowest);
        // The powers of a row of -inf are NaN, and so would their gradients be that are not chosen.
        let kept = x.constant(0.0).where_(&is_lost, x);
        Some(x.constant(0.0).where_(&is_lost, softmax_times(&kept, &column(g))))
    }
}

impl<'t, T: Scalar> Var<'t, T> {
    /// Applies an operation of the last axis along another one; a scalar counts as one entry.
    #[track_caller]
    fn along(&self, axis: isize, op: impl Op<T>) -> Self {
        let ndim = self.shape().len();
        if ndim == 0 {
            return self.reshape(&[1]).along(axis, op).reshape(&[]);
        }
        let axis = self.axis(op.name(), axis);
        if axis == ndim - 1 {
            return self.tape().apply(op, &[self]);
        }
        let mut order: Shape = (0..ndim).collect();
        order.swap(axis, ndim - 1);
        self.tape().apply(op, &[&self.reordered(&order)]).reordered(&order)
    }

    /// Softmax along `axis`: `e^self` divided by its sum, without overflow. Entries of -inf get probability 0; a row of
    /// -inf alone gives NaN. Fastest along the last axis.
    ///
    /// ```
    /// use raygrad_autograd::{Tape, Tensor};
    /// let tape = Tape::<f64>::new();
    /// let x = tape.leaf(Tensor::from([[0.0, 3.0_f64.ln()], [1000.0, 1000.0]]));
    /// let y = x.softmax(-1);
    /// assert!((y.value().as_slice()[1] - 0.75).abs() < 1e-15);
    /// assert_eq!(y.value().as_slice()[2..], [0.5, 0.5]);
    /// ```
    ///
    /// # Panics
    /// If the axis does not exist.
    #[track_caller]
    pub fn softmax(&self, axis: isize) -> Self {
        self.along(axis, Softmax)
    }

    /// The logarithm of [`softmax`](Self::softmax) along `axis`. Accurate even where the softmax underflows.
    ///
    /// # Panics
    /// If the axis does not exist.
    #[track_caller]
    pub fn log_softmax(&self, axis: isize) -> Self {
        self.along(axis, LogSoftmax)
    }

    /// `ln(sum(e^self))` of all elements, as a scalar; see [`logsumexp_over`](Self::logsumexp_over).
    #[track_caller]
    pub fn logsumexp(&self) -> Self {
        self.logsumexp_over(..)
    }

    /// `ln(sum(e^self))` over any axes, without overflow. If there are no elements, or all are -inf, it is -inf with
    /// gradient 0.
    ///
    /// # Panics
    /// If an axis does not exist or is named twice.
    #[track_caller]
    pub fn logsumexp_over(&self, axes: impl Into<Axes>) -> Self {
        let axes = self.axes("logsumexp_over", axes);
        self.tape().apply(LogSumExp, &[&self.rows_over(&axes)]).reshape(&axes.result())
    }
}
