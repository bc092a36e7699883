//! Elementwise operations: a formula and its derivative, written once for every kind of number.

use crate::catalogue::Cases;
use crate::{Grads, Op, Reads, ShapeError, Var, Vjp};
use raygrad_tensor::{Pool, Real, Scalar, Shape, Tensor, broadcast_shape, map_real, sum_to};

/// A function of one number.
///
/// Mark [`f`](Self::f) and [`vjp`](Self::vjp) `#[inline(always)]`: only inlined code is vectorised.
pub trait Unary: Copy + Send + Sync + 'static {
    /// The operation's name.
    const NAME: &'static str;
    /// Which of `x` and `y` the derivative reads; what it does not read is passed as NaN.
    const READS: Reads;
    /// The function.
    fn f<E: Real>(&self, x: E) -> E;
    /// Its vector-Jacobian product: the gradient of `x` for the gradient `g` of `y = f(x)`.
    fn vjp<E: Real>(&self, g: E, x: E, y: E) -> E;
    /// Where it is sampled in checks, and exact values at extremes.
    fn cases(&self, cases: &mut Cases);
}

/// A function of two numbers, with NumPy's broadcasting.
///
/// Mark the methods `#[inline(always)]`, as those of [`Unary`].
pub trait Binary: Copy + Send + Sync + 'static {
    /// The operation's name.
    const NAME: &'static str;
    /// Which of `a`, `b` (inputs 0 and 1) and `y` the derivatives read; what they do not read is passed as NaN.
    const READS: Reads;
    /// Whether the gradient of `a`, and that of `b`, is the gradient of `y` as it is: the tape then hands it on, without a
    /// pass over its elements.
    const PASSES: [bool; 2] = [false; 2];
    /// The function.
    fn f<E: Real>(&self, a: E, b: E) -> E;
    /// The gradient of `a` for the gradient `g` of `y = f(a, b)`.
    fn vjp_a<E: Real>(&self, g: E, a: E, b: E, y: E) -> E;
    /// The gradient of `b`.
    fn vjp_b<E: Real>(&self, g: E, a: E, b: E, y: E) -> E;
    /// Where it is sampled in checks, and exact values at extremes.
    fn cases(&self, cases: &mut Cases);
}

/// A [`Unary`] formula as an operation.
#[derive(Clone, Copy)]
pub struct Map<U>(pub U);

/// A [`Binary`] formula as an operation.
#[derive(Clone, Copy)]
pub struct Zip<B>(pub B);

/// What a derivative gets for a value that it said it does not read.
#[inline(always)]
fn unread<E: Real>(g: &E) -> E {
    g.like(f64::NAN)
}

#[inline(always)]
fn kept<E: Real>(reads: bool, value: E) -> E {
    if reads { value } else { unread(&value) }
}

impl<T: Scalar, U: Unary> Op<T> for Map<U> {
    fn name(&self) -> &'static str {
        U::NAME
    }

    fn arity(&self) -> Option<usize> {
        Some(1)
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        Ok(Shape::from_slice(x[0]))
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        map_real!([x[0]], pool, |[x]| self.0.f(x))
    }

    fn reads(&self) -> Reads {
        U::READS
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        let (reads_x, reads_y) = (U::READS.input(0), U::READS.output());
        if cx.recording() {
            let nan = || cx.g().constant(f64::NAN);
            let (x, y) = (if reads_x { cx.x(0) } else { nan() }, if reads_y { cx.y() } else { nan() });
            // A formula may give a constant, which has no axes.
            return Grads::one(self.0.vjp(cx.g().clone(), x, y).broadcast_to(cx.shape(0)));
        }
        let g = cx.g().value();
        let grad = match (reads_x, reads_y) {
            (false, false) => map_real!([g], cx.pool(), |[g]| self.0.vjp(g, unread(&g), unread(&g))),
            (true, false) => {
                map_real!([g, cx.input(0)], cx.pool(), |[g, x]| self.0.vjp(g, x, unread(&g)))
            }
            (false, true) => {
                map_real!([g, cx.output()], cx.pool(), |[g, y]| self.0.vjp(g, unread(&g), y))
            }
            (true, true) => {
                map_real!([g, cx.input(0), cx.output()], cx.pool(), |[g, x, y]| self.0.vjp(g, x, y))
            }
        };
        Grads::one(cx.constant(grad))
    }
}

impl<B: Binary> Zip<B> {
    /// One input's gradient as a tensor of the output's shape: that of `a` or that of `b`.
    fn grad<T: Scalar, const OF_A: bool>(&self, cx: &Vjp<'_, '_, T>) -> Tensor<T> {
        let g = cx.g().value();
        if B::PASSES[usize::from(!OF_A)] {
            return g.clone();
        }
        // A value that is not read costs a register, not a pass: `g` stands in for it and is replaced by NaN.
        // (Asked for again inside the loop: there a variable from outside would not be a constant to the compiler.)
        let a = if B::READS.input(0) { cx.input(0) } else { g };
        let b = if B::READS.input(1) { cx.input(1) } else { g };
        let y = if B::READS.output() { cx.output() } else { g };
        map_real!([g, a, b, y], cx.pool(), |[g, a, b, y]| {
            let (a, b) = (kept(B::READS.input(0), a), kept(B::READS.input(1), b));
            let y = kept(B::READS.output(), y);
            if OF_A { self.0.vjp_a(g, a, b, y) } else { self.0.vjp_b(g, a, b, y) }
        })
    }
}

impl<T: Scalar, B: Binary> Op<T> for Zip<B> {
    fn name(&self) -> &'static str {
        B::NAME
    }

    fn arity(&self) -> Option<usize> {
        Some(2)
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        broadcast_shape(x).ok_or_else(|| "the shapes do not broadcast".into())
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        map_real!([x[0], x[1]], pool, |[a, b]| self.0.f(a, b))
    }

    fn reads(&self) -> Reads {
        B::READS
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        if cx.recording() {
            let nan = || cx.g().constant(f64::NAN);
            let a = if B::READS.input(0) { cx.x(0) } else { nan() };
            let b = if B::READS.input(1) { cx.x(1) } else { nan() };
            let y = if B::READS.output() { cx.y() } else { nan() };
            let g = cx.g().clone();
            let reduced = |grad: Var<'t, T>, i| grad.broadcast_to(cx.g().shape()).sum_to(cx.shape(i));
            let ga = cx.needs(0).then(|| reduced(self.0.vjp_a(g.clone(), a.clone(), b.clone(), y.clone()), 0));
            let gb = cx.needs(1).then(|| reduced(self.0.vjp_b(g, a, b, y), 1));
            return Grads::new([ga, gb]);
        }
        let reduced = |grad: Tensor<T>, i: usize| -> Var<'t, T> {
            if grad.shape() == cx.shape(i) {
                return cx.constant(grad);
            }
            cx.constant(sum_to(&grad, cx.shape(i), cx.pool()))
        };
        let ga = cx.needs(0).then(|| reduced(self.grad::<T, true>(cx), 0));
        let gb = cx.needs(1).then(|| reduced(self.grad::<T, false>(cx), 1));
        Grads::new([ga, gb])
    }
}
