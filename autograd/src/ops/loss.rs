//! Losses between predictions and targets.

use super::arithmetic::Alias;
use super::gradient_op::{FusedGradient, GradientOp};
use super::softmax::{column, softmax_times};
use crate::cases::INF;
use crate::error::ensure;
use crate::formula::Elementwise;
use crate::slopes::{checked, product_over, scaled_difference, softplus_slope, within};
use crate::{Axes, Cases, Formula, Grads, Op, Operand, Reads, ShapeError, Var, Vjp};
use raygrad_tensor::rows::{cross_entropy_rows, cross_entropy_rows_grad};
use raygrad_tensor::scale::power_of_two;
use raygrad_tensor::{Indices, Mask, Pool, Real, Scalar, Shape, Tensor, map, mean_to};
use std::sync::Arc;

/// y = (a - b)^2; da = 2 g (a - b), db = -da.
#[derive(Clone, Copy)]
pub struct SquaredError;
impl Formula<2> for SquaredError {
    const NAME: &'static str = "squared_error";
    #[inline(always)]
    fn f<E: Real>(&self, [a, b]: [E; 2]) -> E {
        let r = a - b;
        r * r
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-3.0..3.0).domain(-3.0..3.0).at([1.0, 1.0], 0.0, [0.0, 0.0]).at([3.0, 1.0], 4.0, [4.0, -4.0]);
    }
}

/// y = |a - b|; da = g sign(a - b), so 0 at the kink, db = -da.
#[derive(Clone, Copy)]
pub struct AbsoluteError;
impl Formula<2> for AbsoluteError {
    const NAME: &'static str = "absolute_error";
    #[inline(always)]
    fn f<E: Real>(&self, [a, b]: [E; 2]) -> E {
        (a - b).abs()
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(0.1..3.0).domain(-3.0..-0.1).domain_also(3.1..4.0);
        c.at([1.0, 1.0], 0.0, [0.0, 0.0]).at([-INF, 1.0], INF, [-1.0, 1.0]);
    }
}

/// With r = a - b: y = r^2 / 2 for |r| <= delta, else delta (|r| - delta / 2); da = g r limited to +-delta, db = -da.
#[derive(Clone, Copy)]
pub struct Huber {
    /// The residual where the parabola meets its tangents.
    pub delta: f64,
}
impl Formula<2> for Huber {
    const NAME: &'static str = "huber";
    const WIDE_VALUE: bool = true;
    #[inline(always)]
    fn f<E: Real>(&self, [a, b]: [E; 2]) -> E {
        let (half, delta) = (a.like(0.5), a.like(self.delta));
        let r = a - b;
        // With m, the smaller of |r| and delta, both are m (|r| - m / 2).
        let bounded = (r.abs() - delta).if_positive(delta, r.abs());
        checked!(bounded * (r.abs() - half * bounded), r, [], [r], {
            let [scaled, scale] = scaled_difference(a, b);
            bounded * (scaled.abs() - half * bounded * scale) / scale
        })
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, [a, b]: [E; 2], _y: E) -> [E; 2] {
        // Limited and not chosen: an infinite residual times 0 would be NaN in the next derivative.
        let da = g * within(a - b, self.delta);
        [da, -da]
    }
    fn cases(&self, c: &mut Cases) {
        let d = self.delta;
        c.domain(0.1 * d..0.9 * d).domain_also(2.5 * d..4.0 * d).domain(-0.05 * d..0.05 * d);
        c.at([1.0, 1.0], 0.0, [0.0, 0.0]).at([d, 0.0], 0.5 * d * d, [d, -d]).at([INF, 0.0], INF, [d, -d]);
        c.at([-1e30, 0.0], 1e30 * d, [-d, d]);
    }
}

/// With r = a - b: y = r^2 / (2 beta) for |r| < beta, else |r| - beta / 2; da = g r / beta limited to +-1, db = -da.
/// For beta = 0 this is |r|.
#[derive(Clone, Copy)]
pub struct SmoothL1 {
    /// The residual where the parabola meets its tangents; may be 0.
    pub beta: f64,
}
impl Formula<2> for SmoothL1 {
    const NAME: &'static str = "smooth_l1";
    const WIDE_VALUE: bool = true;
    const WIDE_GRADIENT: bool = true;
    #[inline(always)]
    fn f<E: Real>(&self, [a, b]: [E; 2]) -> E {
        let (half, beta) = (a.like(0.5), a.like(self.beta));
        let (r, width) = (a - b, SmoothL1::width(beta));
        let near = half * product_over(r, r, width);
        let far = checked!(r.abs() - half * beta, r, [], [r], {
            let [scaled, scale] = scaled_difference(a, b);
            (scaled.abs() - half * beta * scale) / scale
        });
        (beta - r.abs()).if_positive(near, far)
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, [a, b]: [E; 2], _y: E) -> [E; 2] {
        let (r, beta) = (a - b, a.like(self.beta));
        // Finite where it is not chosen, or the next derivative would be NaN.
        let limited = within(r, self.beta);
        let near = product_over(g, limited, SmoothL1::width(beta));
        // Constant also at 0, which is far if beta is 0; NaN stays.
        let far = r.if_positive(g, (-r).if_positive(-g, g * limited * a.like(0.0)));
        let da = (beta - r.abs()).if_positive(near, far);
        [da, -da]
    }
    fn cases(&self, c: &mut Cases) {
        let w = self.beta.max(0.1);
        c.domain(0.1 * w..0.9 * w).domain_also(2.5 * w..4.0 * w).domain(-0.05 * w..0.05 * w);
        c.at([1.0, 1.0], 0.0, [0.0, 0.0]).at([w, 0.0], w - 0.5 * self.beta, [1.0, -1.0]).at(
            [INF, 0.0],
            INF,
            [1.0, -1.0],
        );
    }
}

impl SmoothL1 {
    /// The divisor of the parabola; 1 if beta is 0, or rounds to 0.
    #[inline(always)]
    fn width<E: Real>(beta: E) -> E {
        beta.if_positive(beta, beta.like(1.0))
    }
}

/// y = b softplus(-a) + (1 - b) softplus(a), for a logit a and a target b in 0..=1: minus the log-probability of b.
/// da = g (s(a) - b), from s(-|a|); db = -g a. The terms of y do not cancel, so small losses keep their
/// digits; so do small gradients at the targets 0 and 1.
#[derive(Clone, Copy)]
pub struct BinaryCrossEntropy;
impl Formula<2> for BinaryCrossEntropy {
    const NAME: &'static str = "binary_cross_entropy_with_logits";
    const WIDE_GRADIENT: bool = true;
    #[inline(always)]
    fn f<E: Real>(&self, [a, b]: [E; 2]) -> E {
        let (zero, one) = (a.like(0.0), a.like(1.0));
        // softplus(+-a) = softplus(-|a|) + max(+-a, 0).
        let tail = (-a.abs()).softplus();
        // A perfect prediction has no loss, even an infinite one.
        let times = |share: E, distance: E| share.abs().if_positive(share * distance, share);
        let against = times(one - b, a.if_positive(a, zero));
        let towards = times(b, (-a).if_positive(-a, zero));
        tail + against + towards
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, [a, b]: [E; 2], _y: E) -> [E; 2] {
        // s(a) - b is (1 - b) - s(-a). At a = 0 it is the first, for the sake of the second derivative.
        let share = softplus_slope(g, a.if_positive(-a, a));
        [a.if_positive(g * (b.like(1.0) - b) - share, share - g * b), -(g * a)]
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-3.0..3.0).domain(0.1..0.9).at([0.0, 1.0], std::f64::consts::LN_2, [-0.5, 0.0]);
        c.at([40.0, 1.0], 4.248_354_255_291_589e-18, [-4.248_354_255_291_589e-18, -40.0]).at(
            [-200.0, 1.0],
            200.0,
            [-1.0, 200.0],
        );
        c.at([-40.0, 0.0], 4.248_354_255_291_589e-18, [4.248_354_255_291_589e-18, 40.0]).at(
            [1e30, 0.0],
            1e30,
            [1.0, -1e30],
        );
    }
}

/// y = ln sum e^x - x[class] of each row of logits: `[.., n]` to `[..]`; dx = g (softmax - 1 at the class).
#[derive(Clone)]
pub struct CrossEntropy {
    /// The class of each row.
    pub classes: Arc<[u32]>,
}

impl<T: Scalar> Op<T> for CrossEntropy {
    fn name(&self) -> &'static str {
        "cross_entropy"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        let Some((&n, rest)) = x[0].split_last() else { return Err("a scalar has no classes".into()) };
        let rows: usize = rest.iter().product();
        if rows != self.classes.len() {
            return Err(format!("{} classes for {rows} rows", self.classes.len()));
        }
        match self.classes.iter().enumerate().find(|&(_, &class)| class as usize >= n) {
            Some((i, class)) => Err(format!("row {i} has class {class}, but there are {n} classes")),
            None => Ok(Shape::from_slice(rest)),
        }
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let axes = x[0].ndim() - 1;
        let mut out = pool.tensor(&x[0].shape()[..axes]);
        cross_entropy_rows(x[0].as_slice(), x[0].shape()[axes], &self.classes, out.as_mut_slice(), pool);
        out
    }

    fn reads(&self) -> Reads {
        Reads::INPUTS
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        Grads::one(cx.tape().apply(GradientOp { op: self.clone(), input: 0 }, &[&cx.x(0), cx.g()]))
    }

    fn reference<'t>(&self, x: &[Var<'t, T>]) -> Option<Var<'t, T>> {
        let axes = x[0].shape().len() - 1;
        let mut column = Shape::from_slice(x[0].shape());
        column[axes] = 1;
        let logs = x[0].log_softmax(-1).gather(-1, Indices::new(&column, self.classes.clone()));
        Some(-logs.reshape(&x[0].shape()[..axes]))
    }
}

impl<T: Scalar> FusedGradient<T> for CrossEntropy {
    const GRADIENT: &'static str = "cross_entropy_grad";

    fn gradient(&self, _input: usize, x: &[&Tensor<T>], g: &Tensor<T>, pool: &Pool<T>) -> Tensor<T> {
        let (n, mut out) = (x[0].shape()[x[0].ndim() - 1], pool.tensor(x[0].shape()));
        cross_entropy_rows_grad(x[0].as_slice(), n, &self.classes, g.as_slice(), out.as_mut_slice(), pool);
        out
    }

    fn recorded<'t>(&self, _input: usize, x: &[Var<'t, T>], g: &Var<'t, T>) -> Option<Var<'t, T>> {
        let x = &x[0];
        let n = x.shape()[x.shape().len() - 1];
        // The gradient at the class is minus the sum of the others: the probability minus 1 would cancel.
        let is_class = (0..x.value().len()).map(|i| self.classes[i / n] as usize == i % n);
        let is_class = Mask::new(x.shape(), is_class.collect::<Vec<_>>());
        let others = x.constant(0.0).where_(&is_class, softmax_times(x, &column(g)));
        Some((-others.sum_over(Axes::from(-1).keepdims())).where_(&is_class, others))
    }
}

/// A loss of each element with a [`MeanLoss`].
pub trait ElementLoss: Formula<2> {
    /// The loss of both operands times `down`, a power of two, and the degree `d` for which that is this loss times
    /// `down^d`. `None` if no loss of finite operands overflows.
    fn shrunk(self, down: f64) -> Option<(Self, usize)>;
}

impl ElementLoss for SquaredError {
    fn shrunk(self, _down: f64) -> Option<(Self, usize)> {
        Some((self, 2))
    }
}

impl ElementLoss for AbsoluteError {
    fn shrunk(self, _down: f64) -> Option<(Self, usize)> {
        Some((self, 1))
    }
}

impl ElementLoss for Huber {
    fn shrunk(self, down: f64) -> Option<(Self, usize)> {
        Some((Huber { delta: self.delta * down }, 2))
    }
}

impl ElementLoss for SmoothL1 {
    fn shrunk(self, down: f64) -> Option<(Self, usize)> {
        Some((SmoothL1 { beta: self.beta * down }, 1))
    }
}

impl ElementLoss for BinaryCrossEntropy {
    fn shrunk(self, _down: f64) -> Option<(Self, usize)> {
        None
    }
}

/// y = the mean of the elements of a loss, given these and its operands; the gradient of an element is g / n. Where the
/// loss of an element overflows and the mean does not, the mean follows from the operands. Where g / n is a subnormal
/// number, which has lost digits, the gradients of the operands follow from a multiple of it.
#[derive(Clone, Copy)]
pub struct MeanLoss<F>(pub F);

impl<T: Scalar, F: ElementLoss> Op<T> for MeanLoss<F> {
    fn name(&self) -> &'static str {
        "mean_loss"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        if x[1..].iter().all(|operand| operand == &x[0]) { Ok(Shape::new()) } else { Err("the shapes differ".into()) }
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let mean = mean_to(x[0], &[], pool);
        if mean.is_finite() || !x[1..].iter().all(|operand| operand.is_finite()) {
            return mean;
        }
        // The square of a residual times the first is in range, and a residual times the second.
        let of_squares = if size_of::<T>() == 4 { -70 } else { -520 };
        let of_degree = |degree: usize| power_of_two(if degree == 2 { of_squares } else { -2 });
        let Some((_, degree)) = self.0.shrunk(1.0) else { return mean };
        let down = of_degree(degree);
        let Some((loss, _)) = self.0.shrunk(down) else { return mean };
        let [down, up] = [down, down.recip()].map(T::from_f64);
        let times = |x: &Tensor<T>, by: T| map([x], pool, |[x]| x * by);
        let [a, b] = [1, 2].map(|i| times(x[i], down));
        let small = mean_to(&Elementwise(loss).forward(&[&a, &b], pool), &[], pool);
        (0..degree).fold(small, |mean, _| times(&mean, up))
    }

    fn reads(&self) -> Reads {
        Reads::only(&[1, 2])
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        let (g, shape) = (cx.g(), cx.shape(0));
        let n = shape.iter().product::<usize>() as f64;
        let [least, up] = if size_of::<T>() == 4 { [-126, 100] } else { [-1022, 900] }.map(power_of_two);
        let share = g / n;
        if g.item() == T::ZERO || !(share.item().abs() < T::from_f64(least)) {
            return Grads::new([Some(g.spread_to(shape)), None, None]);
        }
        // Of variables on the same tape, or on one of its own. On the same, as new nodes: one may depend on the other.
        let [a, b] = [1, 2].map(|i| cx.x(i));
        let [da, db] = if cx.recording() {
            let [a, b] = [a, b].map(|x| Alias.on([&x.tracked()]));
            gradients(self.0, [&a, &b], g.clone(), up)
        } else {
            let tape = cx.tape().nested();
            let [a, b] = [a, b].map(|x| tape.leaf(x.value().clone()));
            let grads = gradients(self.0, [&a, &b], tape.constant(g.value().clone()), up);
            grads.map(|grad| cx.constant(grad.into_value()))
        };
        Grads::new([None, Some(da), Some(db)])
    }

    fn reference<'t>(&self, x: &[Var<'t, T>]) -> Option<Var<'t, T>> {
        Some(x[0].mean())
    }
}

/// The gradients of the operands of a mean of losses, from `up` times the gradient of each.
fn gradients<'t, T: Scalar, F: Formula<2>>(loss: F, x: [&Var<'t, T>; 2], g: Var<'t, T>, up: f64) -> [Var<'t, T>; 2] {
    let y = loss.on(x);
    let g = (g * up).spread_to(y.shape());
    let mut grads = y.vjp(&g, &x).into_iter().map(|grad| grad / up);
    [(); 2].map(|()| match grads.next() {
        Some(grad) => grad,
        None => unreachable!("a gradient of each operand"),
    })
}

/// y = the mean of the [cross-entropies](CrossEntropy) of rows, given these and the logits; the gradient of a row is
/// g / n. Where the loss of a row overflows and the mean does not, the mean follows from the logits.
#[derive(Clone)]
pub struct MeanCrossEntropy {
    /// The class of each row.
    pub classes: Arc<[u32]>,
}

impl<T: Scalar> Op<T> for MeanCrossEntropy {
    fn name(&self) -> &'static str {
        "mean_cross_entropy"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        let losses = Op::<T>::shape(&CrossEntropy { classes: self.classes.clone() }, &x[1..])?;
        if x[0] == losses.as_slice() { Ok(Shape::new()) } else { Err("not one loss for each row".into()) }
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let (mean, [losses, logits]) = (mean_to(x[0], &[], pool), [x[0], x[1]]);
        if mean.is_finite() || losses.is_empty() || !logits.is_finite() {
            return mean;
        }
        let [down, up] = [0.25, 4.0].map(T::from_f64);
        let mut small = losses.clone();
        let rows = logits.as_slice().chunks_exact(logits.len() / losses.len());
        for ((loss, row), &class) in small.as_mut_slice().iter_mut().zip(rows).zip(self.classes.iter()) {
            // Beside a difference that overflows, the logarithm of the sum is that of its largest term.
            let most = || row.iter().copied().reduce(Real::maximum).unwrap_or(T::ZERO);
            *loss = if loss.is_finite() { *loss * down } else { most() * down - row[class as usize] * down };
        }
        map([&mean_to(&small, &[], pool)], pool, |[mean]| mean * up)
    }

    fn reads(&self) -> Reads {
        Reads::NOTHING
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        let shape = cx.shape(0);
        Grads::new([Some(cx.g().spread_to(shape)), None])
    }

    fn reference<'t>(&self, x: &[Var<'t, T>]) -> Option<Var<'t, T>> {
        Some(x[0].mean())
    }
}

impl<'t, T: Scalar> Var<'t, T> {
    /// A loss of each element. Shapes must be equal: broadcasting in a loss is most often a mistake.
    #[track_caller]
    fn loss<F: Formula<2>>(&self, loss: F, target: impl Operand<'t, T>) -> Self {
        let target = target.on(self.tape());
        let same = ensure(self.shape() == target.shape(), || "prediction and target have different shapes".into());
        self.tape().fits(F::NAME, &[self, &target], same);
        loss.on([self, &target])
    }

    /// The mean of a loss of each element.
    #[track_caller]
    fn mean_loss(&self, loss: impl ElementLoss, target: impl Operand<'t, T>) -> Self {
        let target = target.on(self.tape());
        let losses = self.loss(loss, &target);
        self.tape().apply(MeanLoss(loss), &[&losses, self, &target])
    }

    /// The squared error of each element, `(self - target)^2`.
    ///
    /// # Panics
    /// If the shapes differ.
    #[track_caller]
    pub fn squared_error(&self, target: impl Operand<'t, T>) -> Self {
        self.loss(SquaredError, target)
    }

    /// The mean squared error: the mean of [`squared_error`](Self::squared_error), as a scalar.
    ///
    /// # Panics
    /// If the shapes differ.
    #[track_caller]
    pub fn mse_loss(&self, target: impl Operand<'t, T>) -> Self {
        self.mean_loss(SquaredError, target)
    }

    /// The absolute error of each element, `|self - target|`. The gradient at equality is 0.
    ///
    /// # Panics
    /// If the shapes differ.
    #[track_caller]
    pub fn absolute_error(&self, target: impl Operand<'t, T>) -> Self {
        self.loss(AbsoluteError, target)
    }

    /// The mean absolute error: the mean of [`absolute_error`](Self::absolute_error), as a scalar.
    ///
    /// # Panics
    /// If the shapes differ.
    #[track_caller]
    pub fn l1_loss(&self, target: impl Operand<'t, T>) -> Self {
        self.mean_loss(AbsoluteError, target)
    }

    /// The Huber loss of each element. With `r = self - target` it is `r^2 / 2` for `|r| <= delta`, and
    /// `delta (|r| - delta / 2)` beyond.
    ///
    /// # Panics
    /// If the shapes differ or `delta` is not positive.
    #[track_caller]
    pub fn huber(&self, target: impl Operand<'t, T>, delta: f64) -> Self {
        self.loss(self.huber_of(delta), target)
    }

    #[track_caller]
    fn huber_of(&self, delta: f64) -> Huber {
        self.fits("huber", ensure(delta > 0.0, || format!("delta is {delta}; it must be above 0")));
        Huber { delta }
    }

    /// The mean of [`huber`](Self::huber), as a scalar.
    ///
    /// # Panics
    /// Where [`huber`](Self::huber) panics.
    #[track_caller]
    pub fn huber_loss(&self, target: impl Operand<'t, T>, delta: f64) -> Self {
        self.mean_loss(self.huber_of(delta), target)
    }

    /// The Huber loss divided by `beta`, of each element: the slope is 1 beyond `beta`. For `beta` 0 it is the absolute
    /// error.
    ///
    /// # Panics
    /// If the shapes differ or `beta` is negative.
    #[track_caller]
    pub fn smooth_l1(&self, target: impl Operand<'t, T>, beta: f64) -> Self {
        self.loss(self.smooth_l1_of(beta), target)
    }

    #[track_caller]
    fn smooth_l1_of(&self, beta: f64) -> SmoothL1 {
        self.fits("smooth_l1", ensure(beta >= 0.0, || format!("beta is {beta}; it must be at least 0")));
        SmoothL1 { beta }
    }

    /// The mean of [`smooth_l1`](Self::smooth_l1), as a scalar.
    ///
    /// # Panics
    /// Where [`smooth_l1`](Self::smooth_l1) panics.
    #[track_caller]
    pub fn smooth_l1_loss(&self, target: impl Operand<'t, T>, beta: f64) -> Self {
        self.mean_loss(self.smooth_l1_of(beta), target)
    }

    /// The binary cross-entropy of each element, from logits: `-t ln s - (1 - t) ln(1 - s)`. Here `s` is the
    /// [`sigmoid`](Self::sigmoid) of this logit and `t` is the target in 0..=1. Finite and accurate for any finite
    /// logit.
    ///
    /// # Panics
    /// If the shapes differ.
    #[track_caller]
    pub fn binary_cross_entropy_with_logits(&self, target: impl Operand<'t, T>) -> Self {
        self.loss(BinaryCrossEntropy, target)
    }

    /// The mean of [`binary_cross_entropy_with_logits`](Self::binary_cross_entropy_with_logits), as a scalar.
    ///
    /// # Panics
    /// If the shapes differ.
    #[track_caller]
    pub fn binary_cross_entropy_with_logits_loss(&self, target: impl Operand<'t, T>) -> Self {
        self.mean_loss(BinaryCrossEntropy, target)
    }

    /// The cross-entropy of each row of logits, `-ln softmax(row)[class]`: `[.., n]` to `[..]`. `classes` has one class
    /// below `n` for each row, as a list or an array `[..]`.
    ///
    /// ```
    /// use raygrad_autograd::{Tape, Tensor};
    /// let tape = Tape::<f64>::new();
    /// let logits = tape.leaf(Tensor::from([[0.0, 0.0], [3.0_f64.ln(), 0.0]]));
    /// let loss = logits.cross_entropy(&[1, 0]);
    /// assert!((loss.value().as_slice()[0] - 2.0_f64.ln()).abs() < 1e-15); // 1/2 for the right class
    /// assert!((loss.value().as_slice()[1] - (4.0_f64 / 3.0).ln()).abs() < 1e-15); // 3/4
    /// ```
    ///
    /// # Panics
    /// If there is not one class for each row, or one is not below `n`.
    #[track_caller]
    pub fn cross_entropy(&self, classes: impl Into<Indices>) -> Self {
        let classes = classes.into();
        // One list, or an array of the rows' shape.
        let rows = self.shape().split_last().map_or(&[][..], |(_, rows)| rows);
        let fits = classes.shape().len() == 1 || classes.shape() == rows;
        let what = || format!("classes of shape {:?} for rows of shape {rows:?}", classes.shape());
        self.fits("cross_entropy", ensure(fits, what));
        self.tape().apply(CrossEntropy { classes: classes.values().clone() }, &[self])
    }

    /// The mean of [`cross_entropy`](Self::cross_entropy) over the rows, as a scalar; NaN for no rows.
    ///
    /// # Panics
    /// Where [`cross_entropy`](Self::cross_entropy) panics.
    #[track_caller]
    pub fn cross_entropy_loss(&self, classes: impl Into<Indices>) -> Self {
        let classes = classes.into();
        let losses = self.cross_entropy(classes.clone());
        self.tape().apply(MeanCrossEntropy { classes: classes.values().clone() }, &[&losses, self])
    }
}

#[cfg(test)]
mod tests {
    use crate::{Tape, Tensor};

    #[test]
    #[should_panic(expected = "different shapes")]
    fn a_loss_does_not_broadcast() {
        let tape = Tape::<f32>::new();
        let _ = tape.constant(Tensor::zeros(&[4, 1])).mse_loss(tape.constant(Tensor::zeros(&[4])));
    }

    #[test]
    #[should_panic(expected = "row 1 has class 3, but there are 3 classes")]
    fn a_class_that_does_not_exist_is_reported() {
        let tape = Tape::<f32>::new();
        let _ = tape.constant(Tensor::zeros(&[2, 3])).cross_entropy_loss([0, 3]);
    }

    #[test]
    fn losses_are_means() {
        let tape = Tape::<f64>::new();
        let x = tape.leaf(Tensor::from_vec(&[2], vec![3.0, 0.5]));
        let t = tape.constant(Tensor::from_vec(&[2], vec![0.0, 0.0]));
        assert_eq!(x.mse_loss(&t).item(), 9.25 / 2.0);
        assert_eq!(x.l1_loss(&t).item(), 3.5 / 2.0);
        assert_eq!(x.huber_loss(&t, 2.0).item(), (4.0 + 0.125) / 2.0);
        assert_eq!(x.smooth_l1_loss(&t, 2.0).item(), (2.0 + 0.0625) / 2.0);
        assert_eq!(x.smooth_l1_loss(&t, 0.0).item(), x.l1_loss(&t).item());
    }
}

elementwise! {
    also examined: SquaredError, AbsoluteError, Huber { delta: 0.5 }, SmoothL1 { beta: 0.5 }, SmoothL1 { beta: 0.0 }, BinaryCrossEntropy;
}
