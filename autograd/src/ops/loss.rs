//! Losses between predictions and targets.

use super::arithmetic::Alias;
use crate::cases::INF;
use crate::error::ensure;
use crate::formula::Elementwise;
use crate::slopes::{checked, product_over, scaled_difference, softplus_slope, within};
use crate::{Cases, Formula, Grads, Op, Operand, Reads, ShapeError, Var, Vjp};
use raygrad_tensor::scale::power_of_two;
use raygrad_tensor::{Pool, Real, Scalar, Shape, Tensor, map, mean_to};

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
