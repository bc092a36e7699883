//! Variance, standard deviation and norms.

use crate::cases::INF;
use crate::slopes::{checked, product_over};
use crate::{Axes, Cases, Formula, Grads, Op, Reads, ShapeError, Var, Vjp};
use raygrad_tensor::scale::{power_of_two, scales};
use raygrad_tensor::{Pool, Real, Scalar, Shape, Tensor, Wide, broadcast_shape, norm_to, variance_to};

/// y = g a / b, where a part of it may be out of range.
#[derive(Clone, Copy)]
pub struct Ratio;
impl Formula<3> for Ratio {
    const NAME: &'static str = "ratio";
    const WIDE_VALUE: bool = true;
    const WIDE_GRADIENT: bool = true;
    #[inline(always)]
    fn f<E: Real>(&self, [g, a, b]: [E; 3]) -> E {
        product_over(g, a, b)
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, s: E, [g, a, b]: [E; 3], _y: E) -> [E; 3] {
        let db = -checked!(
            s * g / b * (a / b),
            s,
            [s, g, s * g, a, b],
            [],
            (s.wide() * g.wide() / b.wide() * (a.wide() / b.wide())).narrow()
        );
        [product_over(s, a, b), product_over(s, g, b), db]
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-3.0..3.0).domain(-3.0..3.0).domain(0.5..3.0);
        c.at([1e30, 1e20, 1e30], 1e20, [1e-10, 1.0, -1e-10]).at([1.0, 2.0, INF], 0.0, [0.0, 0.0, 0.0]);
    }
}

fn check_kept(x: &[usize], to: &[usize]) -> Result<Shape, ShapeError> {
    match broadcast_shape(&[x, to]) {
        Some(wide) if wide.as_slice() == x && x.len() == to.len() => Ok(Shape::from_slice(to)),
        _ => Err(format!("cannot be reduced to {to:?}")),
    }
}

/// y = the variance over the axes along which `shape` has extent 1: the sum of squared deviations from the mean,
/// divided by `n - correction`. dx = 2 g (x - mean) / (n - correction). Its square root is also right where the
/// variance is out of range. The root has dx = g (x - mean) / (y (n - correction)), 0 where y is 0.
#[derive(Clone)]
pub struct Variance {
    /// The shape of the output, with as many axes as the input.
    pub shape: Shape,
    /// Subtracted from the number of elements.
    pub correction: f64,
    /// Whether to take the square root.
    pub root: bool,
}

impl Variance {
    /// `n - correction` for an input of shape `x`.
    fn divisor(&self, x: &[usize]) -> f64 {
        let [from, to] = [x, &self.shape].map(|shape| shape.iter().product::<usize>() as f64);
        (from / to - self.correction).max(0.0)
    }

    /// The gradient of the square root.
    fn root_vjp<'t, T: Scalar>(&self, cx: &Vjp<'t, '_, T>) -> Var<'t, T> {
        let (shape, x, y) = (&self.shape, cx.x(0), cx.y());
        let divisor = self.divisor(cx.shape(0));
        let quotient =
            |x: Var<'t, T>, y: Var<'t, T>| Ratio.on([cx.g(), &x.centred(shape), &(unless_zero(&y) * divisor)]);
        let is_safe = |y: T| (1e-25..1e25).contains(&y.to_f64());
        let factor = if y.value().iter().all(is_safe) { None } else { middle(&x, shape, cx.pool()) };
        match factor {
            None => quotient(x, y),
            Some(factor) => {
                let x = x * factor;
                let y = x.tape().apply(self.clone(), &[&x]);
                quotient(x, y)
            }
        }
    }
}

impl<T: Scalar> Op<T> for Variance {
    fn name(&self) -> &'static str {
        if self.root { "std" } else { "var" }
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        check_kept(x[0], &self.shape)
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        variance_to(x[0], &self.shape, self.correction, self.root, pool)
    }

    fn reads(&self) -> Reads {
        if self.root { Reads::ALL } else { Reads::INPUTS }
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        if self.root {
            return Grads::one(self.root_vjp(cx));
        }
        let half = cx.g().constant(0.5 * self.divisor(cx.shape(0)));
        let x = cx.x(0);
        Grads::one(match middle(&x, &self.shape, cx.pool()) {
            None => Ratio.on([cx.g(), &x.centred(&self.shape), &half]),
            Some(factor) => Ratio.on([cx.g(), &(x * &factor).centred(&self.shape), &(half * factor)]),
        })
    }
}

/// For each line of `x`, a power of two that takes elements close to the ends of the range away from them; none if there
/// are no such lines. It is a constant, since it cancels.
fn middle<'t, T: Scalar>(x: &Var<'t, T>, kept: &[usize], pool: &Pool<T>) -> Option<Var<'t, T>> {
    let [down, _] = scales(x.value(), kept, pool);
    // `scales` ends at 2^-100 and 2^100, or 2^-1000 and 2^1000.
    let end = power_of_two(if size_of::<T>() == 4 { 90 } else { 990 });
    // Sums of deviations, and their products with the number of elements, stay in range.
    let of_large = power_of_two(-9 - i64::from(x.value().len().max(1).ilog2()));
    let factor = |down: T| match down.to_f64() {
        up if up > end => down,
        down if down < 1.0 / end => T::from_f64(of_large),
        _ => T::ONE,
    };
    let factor = down.map(factor);
    let is_any = factor.iter().any(|factor| factor != T::ONE);
    is_any.then(|| x.tape().constant(factor))
}

/// `y`, and infinity where it is 0: a quotient by it is 0 there, and so are its derivatives.
fn unless_zero<'t, T: Scalar>(y: &Var<'t, T>) -> Var<'t, T> {
    y.constant(f64::INFINITY).where_(&y.elementwise_eq(0.0), y)
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
        norm_to(x[0], &self.shape, pool)
    }

    fn reads(&self) -> Reads {
        Reads::ALL
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        let (x, y) = (cx.x(0), cx.y());
        let quotient = |x: &Var<'t, T>, y: &Var<'t, T>| Grads::one(Ratio.on([cx.g(), x, &unless_zero(y)]));
        // A length that is a subnormal number has lost digits, and one that overflows has lost all.
        let least = if size_of::<T>() == 4 { f32::MIN_POSITIVE.into() } else { f64::MIN_POSITIVE };
        if y.value().iter().all(|y| (least..f64::INFINITY).contains(&y.to_f64())) {
            return quotient(&x, &y);
        }
        match middle(&x, &self.shape, cx.pool()) {
            None => quotient(&x, &y),
            Some(factor) => {
                let x = x * factor;
                quotient(&x, &x.tape().apply(self.clone(), &[&x]))
            }
        }
    }
}

impl<'t, T: Scalar> Var<'t, T> {
    /// This tensor minus its mean over the axes along which `shape` has extent 1. It subtracts twice: the second time
    /// removes the rounding error of a large mean.
    pub(crate) fn centred(&self, shape: &[usize]) -> Self {
        let once = self - self.mean_to(shape);
        &once - once.mean_to(shape)
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
        let op = Variance { shape: axes.kept(), correction: correction as f64, root: false };
        self.tape().apply(op, &[self]).reshape(&axes.result())
    }

    /// The standard deviation of all elements, as a scalar; see [`std_over`](Self::std_over).
    #[track_caller]
    pub fn std(&self, correction: usize) -> Self {
        self.std_over(.., correction)
    }

    /// The standard deviation over any axes: the square root of [`var_over`](Self::var_over), also where that overflows
    /// or underflows. Where it is 0, the gradient is 0.
    ///
    /// # Panics
    /// If an axis does not exist or is named twice.
    #[track_caller]
    pub fn std_over(&self, axes: impl Into<Axes>, correction: usize) -> Self {
        let axes = self.axes("std_over", axes);
        let op = Variance { shape: axes.kept(), correction: correction as f64, root: true };
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
