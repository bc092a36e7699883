//! Variance, standard deviation and norms.

use crate::{Axes, Grads, Op, Reads, ShapeError, Var, Vjp};
use raygrad_tensor::extremum::extremum;
use raygrad_tensor::rows::{at_least_zero, variance_rows};
use raygrad_tensor::{Pool, Scalar, Shape, Tensor, broadcast_shape, map, sum_to};

/// The number of elements in each row, if a tensor of shape `x` is reduced to `to` over its last axes alone.
fn trailing(x: &[usize], to: &[usize]) -> Option<usize> {
    let first = (0..x.len()).find(|&axis| x[axis] != to[axis]).unwrap_or(x.len());
    to[first..].iter().all(|&extent| extent == 1).then(|| x[first..].iter().product())
}

fn check_kept(x: &[usize], to: &[usize]) -> Result<Shape, ShapeError> {
    match broadcast_shape(&[x, to]) {
        Some(wide) if wide.as_slice() == x && x.len() == to.len() => Ok(Shape::from_slice(to)),
        _ => Err(format!("cannot be reduced to {to:?}")),
    }
}

/// The sum of squared deviations from the mean, divided by `count - correction`.
fn variance<T: Scalar>(x: &Tensor<T>, shape: &[usize], correction: f64, pool: &Pool<T>) -> Tensor<T> {
    let mut out = pool.tensor(shape);
    let count = x.len() as f64 / out.len() as f64;
    let ratio = T::from_f64(count / (count - correction).max(0.0));
    if let Some(n) = trailing(x.shape(), shape) {
        variance_rows(x.as_slice(), n, out.as_mut_slice());
    } else {
        // As `variance_rows`: deviations from the rounded mean, corrected for its rounding.
        let count = T::from_f64(count);
        let mean_of = |x: &Tensor<T>| {
            map(
                [&sum_to(x, shape, pool)],
                pool,
                #[inline(always)]
                |[sum]| sum / count,
            )
        };
        let deviation = map(
            [x, &mean_of(x)],
            pool,
            #[inline(always)]
            |[x, mean]| x - mean,
        );
        out = map(
            [&mean_of(&deviation.square()), &mean_of(&deviation)],
            pool,
            #[inline(always)]
            |[square, rest]| at_least_zero(square - rest * rest),
        );
    }
    if correction == 0.0 { out } else { out * ratio }
}

/// y = the variance over the axes along which `shape` has extent 1: the sum of squared deviations from the mean,
/// divided by `n - correction`. dx = 2 g (x - mean) / (n - correction).
#[derive(Clone)]
pub struct Variance {
    /// The shape of the output, with as many axes as the input.
    pub shape: Shape,
    /// Subtracted from the number of elements.
    pub correction: f64,
}

/// y = the square root of [`Variance`]; dx = g (x - mean) / (y (n - correction)), 0 where y is 0.
#[derive(Clone)]
pub struct Deviation(
    /// The variance.
    pub Variance,
);

impl Variance {
    /// `share (x - mean) / (n - correction)`.
    fn centred<'t, T: Scalar>(&self, x: &Var<'t, T>, share: &Var<'t, T>) -> Var<'t, T> {
        let count = x.value().len() as f64 / self.shape.iter().product::<usize>() as f64;
        x.centred(&self.shape) * (share * (1.0 / (count - self.correction).max(0.0)))
    }
}

impl<T: Scalar> Op<T> for Variance {
    fn name(&self) -> &'static str {
        "var"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        check_kept(x[0], &self.shape)
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        variance(x[0], &self.shape, self.correction, pool)
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        Grads::one(self.centred(&cx.x(0), &(cx.g() * 2.0)))
    }
}

impl<T: Scalar> Op<T> for Deviation {
    fn name(&self) -> &'static str {
        "std"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        check_kept(x[0], &self.0.shape)
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        variance(x[0], &self.0.shape, self.0.correction, pool).sqrt()
    }

    fn reads(&self) -> Reads {
        Reads::ALL
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        Grads::one(self.0.centred(&cx.x(0), &over_unless_zero(cx.g(), &cx.y())))
    }
}

/// `g / y`, and 0 where `y` is 0.
fn over_unless_zero<'t, T: Scalar>(g: &Var<'t, T>, y: &Var<'t, T>) -> Var<'t, T> {
    let (zero, one) = (y.constant(0.0), y.constant(1.0));
    let is_zero = y.elementwise_eq(0.0);
    // Divided by 1 where it is not chosen, so that the next derivative is not NaN.
    zero.where_(&is_zero, &(g / one.where_(&is_zero, y)))
}

/// y = sqrt(sum of x^2) over the axes along which `shape` has extent 1, without overflow on the way. dx = g x / y, 0
/// where y is 0.
#[derive(Clone)]
pub struct Norm {
    /// The shape of the output, with as many axes as the input.
    pub shape: Shape,
}

impl<T: Scalar> Op<T> for Norm {
    fn name(&self) -> &'static str {
        "norm"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        check_kept(x[0], &self.shape)
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let squares = |x: &Tensor<T>| {
            let square = map(
                [x],
                pool,
                #[inline(always)]
                |[x]| x * x,
            );
            sum_to(&square, &self.shape, pool)
        };
        let sums = squares(x[0]);
        // Sums in this range have lost nothing to overflow or underflow.
        let (least, most) = (T::from_f64(1e-25), T::from_f64(1e37));
        if sums.as_slice().iter().all(|&sum| sum > least && sum < most) {
            return sums.sqrt();
        }
        // Else in units of the greatest element.
        let mut size = map(
            [x[0]],
            pool,
            #[inline(always)]
            |[x]| x.abs(),
        );
        if size.is_empty() {
            return sums;
        }
        for axis in (0..self.shape.len()).filter(|&axis| self.shape[axis] == 1) {
            let mut shape = Shape::from_slice(size.shape());
            let middle = [shape[..axis].iter().product(), shape[axis], shape[axis + 1..].iter().product()];
            shape[axis] = 1;
            let mut out = pool.tensor(&shape);
            extremum(size.as_slice(), middle, true, out.as_mut_slice());
            size = out;
        }
        let unit = map(
            [x[0], &size],
            pool,
            #[inline(always)]
            |[x, size]| {
                let quotient = x / size;
                let limit = if size > T::ZERO { T::ONE } else { size };
                if size > T::ZERO && size.is_finite() { quotient } else { limit }
            },
        );
        size * squares(&unit).sqrt()
    }

    fn reads(&self) -> Reads {
        Reads::ALL
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        // x / y first: g / y may overflow where the quotient is of order 1.
        Grads::one(over_unless_zero(&cx.x(0), &cx.y()) * cx.g())
    }
}

impl<'t, T: Scalar> Var<'t, T> {
    /// This tensor minus its mean over the axes along which `shape` has extent 1. It subtracts twice: the second time
    /// removes the rounding error of a large mean.
    pub(crate) fn centred(&self, shape: &[usize]) -> Self {
        let share = shape.iter().product::<usize>() as f64 / self.value().len() as f64;
        let once = self - self.sum_to(shape) * share;
        &once - once.sum_to(shape) * share
    }

    /// The variance of all elements, as a scalar; see [`var_over`](Self::var_over).
    #[track_caller]
    pub fn var(&self, correction: usize) -> Self {
        self.var_over(.., correction)
    }

    /// The variance over any axes: the sum of squared deviations from the mean, divided by the number of elements minus
    /// `correction`.
    ///
    /// `correction` is `ddof` in NumPy: 0 for the variance of these elements, 1 for an unbiased estimate from a sample.
    /// The result is NaN or infinite if the divisor is not positive. It takes two passes, so a large mean loses no
    /// digits.
    ///
    /// # Panics
    /// If an axis does not exist or is named twice.
    #[track_caller]
    pub fn var_over(&self, axes: impl Into<Axes>, correction: usize) -> Self {
        let axes = self.axes("var_over", axes);
        let op = Variance { shape: axes.kept(), correction: correction as f64 };
        self.tape().apply(op, &[self]).reshape(&axes.result())
    }

    /// The standard deviation of all elements, as a scalar; see [`std_over`](Self::std_over).
    #[track_caller]
    pub fn std(&self, correction: usize) -> Self {
        self.std_over(.., correction)
    }

    /// The standard deviation over any axes: the square root of [`var_over`](Self::var_over). Where it is 0, the
    /// gradient is 0.
    ///
    /// # Panics
    /// If an axis does not exist or is named twice.
    #[track_caller]
    pub fn std_over(&self, axes: impl Into<Axes>, correction: usize) -> Self {
        let axes = self.axes("std_over", axes);
        let op = Deviation(Variance { shape: axes.kept(), correction: correction as f64 });
        self.tape().apply(op, &[self]).reshape(&axes.result())
    }

    /// The Euclidean norm of all elements, as a scalar; see [`norm_over`](Self::norm_over).
    #[track_caller]
    pub fn norm(&self) -> Self {
        self.norm_over(..)
    }

    /// The Euclidean norm over any axes, `sqrt(sum of squares)`. Accurate even where the squares would overflow or
    /// underflow. Where the norm is 0, the gradient is 0.
    ///
    /// ```
    /// use raygrad_autograd::{Tape, Tensor};
    /// let tape = Tape::<f32>::new();
    /// let large = 2.0_f32.powi(100); // its square is infinite
    /// let x = tape.leaf(Tensor::from([[3.0 * large, 4.0 * large], [0.0, 0.0]]));
    /// let y = x.norm_over(-1);
    /// assert_eq!(y.value(), [5.0 * large, 0.0]);
    /// assert_eq!(y.sum().grad(&[&x])[0], [[0.6, 0.8], [0.0, 0.0]]);
    /// ```
    ///
    /// # Panics
    /// If an axis does not exist or is named twice.
    #[track_caller]
    pub fn norm_over(&self, axes: impl Into<Axes>) -> Self {
        let axes = self.axes("norm_over", axes);
        self.tape().apply(Norm { shape: axes.kept() }, &[self]).reshape(&axes.result())
    }

    /// The L1 norm: the sum of absolute values of all elements, as a scalar.
    #[track_caller]
    pub fn norm_l1(&self) -> Self {
        self.norm_l1_over(..)
    }

    /// The L1 norm over any axes: the sum of absolute values. An element that is 0 has gradient 0.
    ///
    /// # Panics
    /// If an axis does not exist or is named twice.
    #[track_caller]
    pub fn norm_l1_over(&self, axes: impl Into<Axes>) -> Self {
        self.abs().sum_over(axes)
    }
}
