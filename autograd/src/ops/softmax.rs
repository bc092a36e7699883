//! Softmax, its logarithm, and the logarithm of a sum of exponentials.

use crate::{Axes, Grads, Op, Reads, ShapeError, Var, Vjp};
use raygrad_tensor::rows;
use raygrad_tensor::{Pool, Scalar, Shape, Tensor};

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

/// `e^x g`, where the power may underflow if `g` brings it back into range: from the root of the power, for all elements
/// alike.
fn power_times<'t, T: Scalar>(x: &Var<'t, T>, g: &Var<'t, T>) -> Var<'t, T> {
    let root = (x * 0.5).exp();
    &root * g * &root
}

/// A tensor of the shape of `x`, whose rows `kernel(x, row length, out)` writes.
fn by_rows<T: Scalar>(x: &Tensor<T>, pool: &Pool<T>, kernel: impl FnOnce(&[T], usize, &mut [T])) -> Tensor<T> {
    let mut out = pool.tensor(x.shape());
    kernel(x.as_slice(), x.shape()[x.ndim() - 1], out.as_mut_slice());
    out
}

/// y = e^(x - max) / sum e^(x - max) along the last axis; dx = y (g - sum g y). The logarithm of it is
/// y = x - max - ln sum e^(x - max), with dx = g - e^y sum g.
#[derive(Clone, Copy)]
pub struct Softmax {
    /// Whether to take the logarithm.
    pub log: bool,
}

impl<T: Scalar> Op<T> for Softmax {
    fn name(&self) -> &'static str {
        if self.log { "log_softmax" } else { "softmax" }
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        Ok(last_axis(x[0])?.0)
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let kernel = if self.log { rows::log_softmax_rows::<T> } else { rows::softmax_rows::<T> };
        by_rows(x[0], pool, |x, n, out| kernel(x, n, out, pool))
    }

    fn reads(&self) -> Reads {
        Reads::OUTPUT
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        let (y, g) = (cx.y(), cx.g());
        if cx.recording() {
            return Grads::one(if self.log {
                g - power_times(&y, &g.sum_over(kept_last()))
            } else {
                &y * (g - (g * &y).sum_over(kept_last()))
            });
        }
        let kernel = if self.log { rows::log_softmax_rows_grad::<T> } else { rows::softmax_rows_grad::<T> };
        let g = g.value().as_slice();
        Grads::one(cx.constant(by_rows(y.value(), cx.pool(), |y, n, out| kernel(y, g, n, out))))
    }

    fn reference<'t>(&self, x: &[Var<'t, T>]) -> Option<Var<'t, T>> {
        let powers = x[0].exp();
        let sum = powers.sum_over(kept_last());
        Some(if self.log { &x[0] - sum.ln() } else { &powers / sum })
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
        Reads::ALL
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        let (x, g) = (cx.x(0), cx.g());
        if cx.recording() {
            let mut column = Shape::from_slice(g.shape());
            column.push(1);
            let is_lost = cx.y().value().map(|y| if y == T::from_f64(f64::NEG_INFINITY) { T::ONE } else { T::ZERO });
            let is_lost = is_lost.reshape(&column).broadcast_to(x.shape()).gt(T::ZERO);
            // The logarithms of a row of -inf are NaN, and so would their gradients be that are not chosen.
            let kept = x.constant(0.0).where_(&is_lost, &x);
            let logarithms = x.constant(f64::NEG_INFINITY).where_(&is_lost, kept.log_softmax(-1));
            return Grads::one(power_times(&logarithms, &g.reshape(&column)));
        }
        let kernel = |x: &[T], n, out: &mut [T]| rows::logsumexp_rows_grad(x, n, g.value().as_slice(), out, cx.pool());
        Grads::one(cx.constant(by_rows(x.value(), cx.pool(), kernel)))
    }

    fn reference<'t>(&self, x: &[Var<'t, T>]) -> Option<Var<'t, T>> {
        Some(x[0].exp().sum_over(-1).ln())
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
        self.along(axis, Softmax { log: false })
    }

    /// The logarithm of [`softmax`](Self::softmax) along `axis`. Accurate even where the softmax underflows.
    ///
    /// # Panics
    /// If the axis does not exist.
    #[track_caller]
    pub fn log_softmax(&self, axis: isize) -> Self {
        self.along(axis, Softmax { log: true })
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
