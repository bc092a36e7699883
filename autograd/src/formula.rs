//! Elementwise operations from one formula: one pass for the value, one more for all gradients.

use crate::ops::gradient_op::{FusedGradient, GradientOp, has_far};
use crate::reading::Reading;
use crate::recorded::{Recorded, Sheet};
use crate::{Cases, Dual, Grads, Op, Reads, ShapeError, Var, Vjp};
use raygrad_tensor::{
    EXACT, PLAIN, Pool, QUICK, Real, Scalar, Shape, Tensor, broadcast_shape, lanes_fused, map_fused, sum_to,
};
use smallvec::SmallVec;
use std::array::from_fn;
use std::slice;

/// A custom elementwise operation: a function of `N` numbers, applied to `N` tensors with NumPy's broadcasting.
///
/// An implementation needs a name and the formula; [`formula!`](crate::formula) writes one in a line. The formula is
/// evaluated on three types of number:
///
/// * on floats, as one vectorised loop without temporary arrays;
/// * on [`Dual`] numbers, as one such loop that gives the gradients of all operands;
/// * on variables, which records it where a gradient is itself differentiated.
///
/// ```
/// use raygrad_autograd::{Formula, Real, Tape, Tensor};
///
/// /// y = 1 / (1 + x^2).
/// #[derive(Clone, Copy)]
/// struct Lorentz;
///
/// impl Formula<1> for Lorentz {
///     const NAME: &'static str = "lorentz";
///     #[inline(always)]
///     fn f<E: Real>(&self, [x]: [E; 1]) -> E {
///         let one = x.like(1.0);
///         one / (one + x * x)
///     }
/// }
///
/// let tape = Tape::<f64>::new();
/// let x = tape.leaf(Tensor::scalar(1.0));
/// let y = Lorentz.on([&x]);
/// assert_eq!((y.item(), y.grad(&[&x])[0].item()), (0.5, -0.5));
/// ```
///
/// Mark [`f`](Self::f) and [`vjp`](Self::vjp) `#[inline(always)]`: only inlined code is vectorised.
pub trait Formula<const N: usize>: Copy + Send + Sync + 'static {
    /// The operation's name.
    const NAME: &'static str;
    /// Whether to evaluate the formula first with a short argument reduction for sines and cosines. They then take a
    /// third of the time, with the same bits (see [`raygrad_tensor::Lane`]). All kernels are compiled twice.
    const ANGLES: bool = false;
    /// Whether the function uses [`Real::checked`], with quick products first and those of any range where they are
    /// necessary. The kernel of the value is then compiled twice.
    const WIDE_VALUE: bool = false;
    /// The same for the gradients.
    const WIDE_GRADIENT: bool = false;

    /// The function.
    fn f<E: Real>(&self, x: [E; N]) -> E;

    /// Its vector-Jacobian product: the gradient of each operand for the gradient `g` of `y = f(x)`. The tape saves
    /// those of `x` and `y` that it reads.
    ///
    /// The default evaluates [`f`](Self::f) on dual numbers. Override it if another form is more accurate, or can reuse
    /// a `y` that is expensive to compute.
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, x: [E; N], _y: E) -> [E; N] {
        derived(self, g, x)
    }

    /// Adds sampling ranges, and exact values at extremes, for
    /// [`check::Entry::examined`](crate::check::Entry::examined).
    fn cases(&self, _cases: &mut Cases) {}

    /// Applies the formula to variables, elementwise with broadcasting.
    ///
    /// # Panics
    /// If the shapes do not broadcast.
    #[track_caller]
    fn on<'t, T: Scalar>(self, x: [&Var<'t, T>; N]) -> Var<'t, T> {
        x[0].tape().apply(Elementwise(self), &x)
    }
}

/// The gradients of a formula by dual numbers. Their slopes start as `g`, since each element of the Jacobian is on its
/// diagonal.
#[inline(always)]
pub(crate) fn derived<F: Formula<N>, E: Real, const N: usize>(formula: &F, g: E, x: [E; N]) -> [E; N] {
    let mut duals = [Dual { value: g, slopes: [None; N] }; N];
    let mut k = 0;
    while k < N {
        duals[k].value = x[k];
        duals[k].slopes[k] = Some(g);
        k += 1;
    }
    let y = formula.f(duals);
    let (mut grads, mut k) = ([g; N], 0);
    while k < N {
        grads[k] = match y.slopes[k] {
            Some(slope) => slope,
            None => g.like(0.0),
        };
        k += 1;
    }
    grads
}

/// A [`Formula`] as an operation.
#[derive(Clone, Copy)]
pub struct Elementwise<F, const N: usize>(pub F);

impl<F: Formula<N>, const N: usize> Elementwise<F, N> {
    /// The values that each gradient depends on.
    #[inline(always)]
    fn readings(&self) -> [Reading; N] {
        const { assert!(N > 0 && N < 32, "a formula of 1 to 31 operands") };
        let (mut x, mut k) = ([Reading::of(0); N], 0);
        while k < N {
            x[k] = Reading::of(1 << k);
            k += 1;
        }
        self.0.vjp(Reading::gradient(), x, Reading::of(Reading::OUTPUT))
    }

    /// All gradients of a block: `x` are g, y and the operands.
    fn gradients<T: Scalar>(&self, x: &[&[T]], out: &mut [&mut [T]]) {
        if !F::ANGLES && !F::WIDE_GRADIENT {
            self.gradients_in::<T, PLAIN>(x, out);
        } else if self.gradients_in::<T, QUICK>(x, out) {
            self.gradients_in::<T, EXACT>(x, out);
        }
    }

    #[inline(always)]
    fn gradients_in<T: Scalar, const MODE: u8>(&self, x: &[&[T]], out: &mut [&mut [T]]) -> bool {
        // A copy, whose constants no store of a result can change.
        let formula = self.0;
        lanes_fused::<T, MODE, 2, N, N>(
            x,
            out,
            #[inline(always)]
            move |[g, y], x| formula.vjp(g, x, y),
        )
    }

    /// The values of a block.
    fn values<T: Scalar>(&self, x: &[&[T]], out: &mut [&mut [T]]) {
        if !F::ANGLES && !F::WIDE_VALUE {
            self.values_in::<T, PLAIN>(x, out);
        } else if self.values_in::<T, QUICK>(x, out) {
            self.values_in::<T, EXACT>(x, out);
        }
    }

    #[inline(always)]
    fn values_in<T: Scalar, const MODE: u8>(&self, x: &[&[T]], out: &mut [&mut [T]]) -> bool {
        let formula = self.0;
        lanes_fused::<T, MODE, 0, N, 1>(
            x,
            out,
            #[inline(always)]
            move |[], x| [formula.f(x)],
        )
    }
}

impl<T: Scalar, F: Formula<N>, const N: usize> Op<T> for Elementwise<F, N> {
    fn name(&self) -> &'static str {
        F::NAME
    }

    fn arity(&self) -> Option<usize> {
        Some(N)
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        broadcast_shape(x).ok_or_else(|| "the shapes do not broadcast".into())
    }

    #[inline(never)]
    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let [y] = map_fused(x, [true], pool, &|x, out| self.values(x, out));
        y.unwrap_or_else(|| pool.tensor(&[]))
    }

    fn reads(&self) -> Reads {
        Op::<T>::reads_for(self, &|_| true)
    }

    fn reads_for(&self, has_gradient: &dyn Fn(usize) -> bool) -> Reads {
        let readings = self.readings().into_iter().enumerate();
        Reads::of_bits(readings.fold(0, |bits, (i, reading)| bits | if has_gradient(i) { reading.of } else { 0 }))
    }

    #[inline(never)]
    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        let readings = self.readings();
        if cx.recording() {
            let reads = Op::<T>::reads_for(self, &|i| cx.needs(i));
            // f64 has no wider type for the derivatives.
            if const { size_of::<T>() == size_of::<f32>() } {
                let has_operands = !reads.output() || (0..N).all(|i| reads.input(i));
                let is_fusible = has_operands && N < 3 && readings.iter().all(|reading| reading.of != 0);
                let has_far_operand = || (0..N).any(|i| reads.input(i) && has_far(cx.x(i).value()));
                if is_fusible && (has_far(cx.g().value()) || has_far_operand()) {
                    return fused_gradients(cx, *self, reads);
                }
            }
            let sheet = Sheet::new();
            let (g, x, y) = given(cx, &sheet, reads);
            return recorded(cx, &sheet, &self.0.vjp(g, x, y));
        }
        let mut wanted = [false; N];
        let mut reads = 0;
        for (i, reading) in readings.iter().enumerate() {
            wanted[i] = cx.needs(i) && !reading.is_gradient;
            reads |= if wanted[i] { reading.of } else { 0 };
        }
        Grads::new(gradients(cx, &readings, wanted, reads, &|x, out| self.gradients(x, out)))
    }
}

impl<T: Scalar, F: Formula<N>, const N: usize> FusedGradient<T> for Elementwise<F, N> {
    const GRADIENT: &'static str = F::NAME;
    // Recorded only where a number is far from 1.
    const WIDENS: bool = true;

    fn gradient(&self, input: usize, x: &[&Tensor<T>], g: &Tensor<T>, pool: &Pool<T>) -> Tensor<T> {
        let y = (self.readings()[input].of & Reading::OUTPUT != 0).then(|| self.forward(x, pool));
        let all: SmallVec<[&Tensor<T>; 6]> =
            [g, y.as_ref().unwrap_or(g)].into_iter().chain(x.iter().copied()).collect();
        let grads = map_fused(&all, from_fn::<_, N, _>(|i| i == input), pool, &|x, out| self.gradients(x, out));
        match grads.into_iter().flatten().next() {
            Some(grad) => sum_to(&grad, x[input].shape(), pool),
            None => unreachable!("an operand of the formula"),
        }
    }

    fn recorded<'t>(&self, input: usize, x: &[Var<'t, T>], g: &Var<'t, T>) -> Option<Var<'t, T>> {
        let (sheet, has_y) = (Sheet::new(), self.readings()[input].of & Reading::OUTPUT != 0);
        let y = if has_y { self.0.on(from_fn(|i| &x[i])) } else { g.clone() };
        let grads = self.0.vjp(sheet.given(g.clone()), from_fn(|i| sheet.given(x[i].clone())), sheet.given(y));
        let grad = sheet.vars(g, &[grads[input]]).remove(0);
        Some(grad.broadcast_to(g.shape()).sum_to(x[input].shape()))
    }
}

/// The required gradients of a recorded pass in which a number is far from 1, each as one operation. It reads the
/// operands, and computes the result again if it needs it. Numbers stand for operands that no required gradient reads.
fn fused_gradients<'t, T: Scalar, F: Formula<N>, const N: usize>(
    cx: &Vjp<'t, '_, T>,
    op: Elementwise<F, N>,
    reads: Reads,
) -> Grads<'t, T> {
    let unread = |i: usize| cx.constant(Tensor::scalar(T::ONE).broadcast_to(cx.shape(i)));
    let x: [_; N] = from_fn(|i| if reads.input(i) { cx.x(i) } else { unread(i) });
    let all: SmallVec<[&Var<'t, T>; 4]> = x.iter().chain([cx.g()]).collect();
    let by = |input: usize| cx.needs(input).then(|| cx.tape().apply(GradientOp { op, input }, &all));
    Grads::new((0..N).map(by))
}

/// Gradient, operands and result of a recorded pass. Those that the derivative does not read have no value.
#[allow(clippy::type_complexity)] // three numbers and their places
fn given<'s, 't, T: Scalar, const N: usize>(
    cx: &Vjp<'t, '_, T>,
    sheet: &'s Sheet<'t, T>,
    reads: Reads,
) -> (Recorded<'s, 't, T>, [Recorded<'s, 't, T>; N], Recorded<'s, 't, T>) {
    let unread = sheet.constant(f64::NAN);
    let x = from_fn(|i| if reads.input(i) { sheet.given(cx.x(i)) } else { unread });
    (sheet.given(cx.g().clone()), x, if reads.output() { sheet.given(cx.y()) } else { unread })
}

/// The required gradients, on the tape.
fn recorded<'t, T: Scalar>(cx: &Vjp<'t, '_, T>, sheet: &Sheet<'t, T>, grads: &[Recorded<'_, 't, T>]) -> Grads<'t, T> {
    let needed: SmallVec<[_; 4]> = (0..grads.len()).filter(|&i| cx.needs(i)).map(|i| grads[i]).collect();
    let mut vars = sheet.vars(cx.g(), &needed).into_iter();
    // A gradient that is 0 everywhere is a constant. A constant has no axes.
    let is_zero = |grad: &Var<'t, T>| !grad.is_on_graph() && grad.value().iter().all(|x| x == T::ZERO);
    let stretched = |grad: Var<'t, T>, i| grad.broadcast_to(cx.g().shape()).sum_to(cx.shape(i));
    let mut next = |i| vars.next().filter(|grad| !is_zero(grad)).map(|grad| stretched(grad, i));
    Grads::new((0..grads.len()).map(|i| if cx.needs(i) { next(i) } else { None }))
}

/// The required gradients, summed to the shapes of their operands. Separate from the loop, so that it is compiled once
/// and not for each formula.
fn gradients<'t, T: Scalar, const N: usize>(
    cx: &Vjp<'t, '_, T>,
    readings: &[Reading; N],
    wanted: [bool; N],
    reads: u32,
    block: &raygrad_tensor::Block<'_, T>,
) -> [Option<Var<'t, T>>; N] {
    let g = cx.g().value();
    if g.len() == 1 {
        return of_numbers(cx, readings, wanted, reads, block);
    }
    let mut grads = [const { None }; N];
    if wanted.contains(&true) {
        // An operand that no wanted gradient reads takes a register, not a pass over memory: `g` replaces it.
        let mut x: SmallVec<[&Tensor<T>; 6]> = SmallVec::new();
        x.push(g);
        x.push(if reads & Reading::OUTPUT == 0 { g } else { cx.output() });
        x.extend((0..N).map(|i| if reads >> i & 1 == 0 { g } else { cx.input(i) }));
        grads = map_fused(&x, wanted, cx.pool(), block);
    }
    let mut i = 0;
    grads.map(|grad| {
        let grad = grad.or_else(|| (cx.needs(i) && readings[i].is_gradient).then(|| g.clone()));
        let shape = cx.shape(i);
        i += 1;
        grad.map(|grad| cx.constant(if grad.shape() == shape { grad } else { sum_to(&grad, shape, cx.pool()) }))
    })
}

/// [`gradients`] of single numbers, without temporary tensors.
fn of_numbers<'t, T: Scalar, const N: usize>(
    cx: &Vjp<'t, '_, T>,
    readings: &[Reading; N],
    wanted: [bool; N],
    reads: u32,
    block: &raygrad_tensor::Block<'_, T>,
) -> [Option<Var<'t, T>>; N] {
    let g = cx.g().value().item();
    let mut values = [g; N];
    if wanted.contains(&true) {
        let y = if reads & Reading::OUTPUT == 0 { g } else { cx.output().item() };
        let x: [T; N] = from_fn(|i| if reads >> i & 1 == 0 { g } else { cx.input(i).item() });
        let x: SmallVec<[&[T]; 6]> = [&g, &y].into_iter().chain(&x).map(slice::from_ref).collect();
        block(&x, &mut values.each_mut().map(slice::from_mut));
    }
    from_fn(|i| {
        let given = if wanted[i] { values[i] } else { g };
        let is_given = wanted[i] || cx.needs(i) && readings[i].is_gradient;
        is_given.then(|| cx.constant(Tensor::full(cx.shape(i), given)))
    })
}

/// A [`Formula`] from a line like a closure: `formula!(|x, a, b| (x * a + b).tanh() * x)`.
///
/// The operands are [`Number`](crate::Number)s: they mix with `f64` constants, and functions are methods. List captured
/// numbers first, in brackets; each is `Into<f64>`.
///
/// Products in the value and in the gradients are ordinary ones: a derivative that underflows is 0, also where a large
/// incoming gradient would bring it back into range. An implementation of [`Formula`](crate::Formula) can do better.
///
/// ```
/// use raygrad_autograd::{Tape, Tensor, formula};
/// let tape = Tape::<f32>::new();
/// let x = tape.leaf(Tensor::from([[1.0, 2.0], [3.0, 4.0]]));
/// let (scale, shift) = (tape.leaf(Tensor::from([1.0, -1.0])), tape.leaf(Tensor::scalar(0.5)));
/// let limit = 3.0;
/// let y = formula!([limit] |x, a, b| (x * a + b).maximum(-limit) / 2.0).on([&x, &scale, &shift]);
/// assert_eq!(y.value(), [[0.75, -0.75], [1.75, -1.5]]);
/// let grads = y.sum().grad(&[&x, &scale, &shift]);
/// assert_eq!(grads[0], [[0.5, -0.5], [0.5, 0.0]]);
/// assert_eq!(grads[1], [2.0, 1.0]);
/// assert_eq!(grads[2].item(), 1.5);
/// ```
#[macro_export]
macro_rules! formula {
    (|$($x:ident),+ $(,)?| $y:expr) => {
        $crate::formula!([] |$($x),+| $y)
    };
    ([$($constant:ident),* $(,)?] |$($x:ident),+ $(,)?| $y:expr) => {{
        #[derive(Clone, Copy)]
        struct Written {
            $($constant: f64,)*
        }
        impl $crate::Formula<{ [$(stringify!($x)),+].len() }> for Written {
            const NAME: &'static str = stringify!($y);
            const ANGLES: bool = $crate::has_angle(stringify!($y));
            #[inline(always)]
            fn f<E: $crate::Real>(&self, x: [E; [$(stringify!($x)),+].len()]) -> E {
                let Written { $($constant,)* } = *self;
                let [$($x),+] = x;
                $(let $x = $crate::Number($x);)+
                let y: $crate::Number<E> = $y;
                y.0
            }
        }
        impl Written {
            /// [`Formula::on`]($crate::Formula::on), without an import of the trait.
            #[allow(dead_code)]
            #[track_caller]
            fn on<'t, T: $crate::Scalar>(
                self,
                x: [&$crate::Var<'t, T>; [$(stringify!($x)),+].len()],
            ) -> $crate::Var<'t, T> {
                $crate::Formula::on(self, x)
            }
        }
        Written { $($constant: f64::from($constant),)* }
    }};
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ops::{arithmetic, exponential, piecewise, trigonometric};

    #[test]
    fn an_operation_keeps_what_its_gradients_read() {
        fn reads<const N: usize>(formula: impl Formula<N>) -> Reads {
            Op::<f32>::reads(&Elementwise(formula))
        }
        assert_eq!(reads(arithmetic::Add), Reads::NOTHING);
        assert_eq!(reads(arithmetic::Affine { scale: 2.0, shift: 1.0 }), Reads::NOTHING);
        assert_eq!(reads(piecewise::Floor), Reads::NOTHING);
        assert_eq!(reads(arithmetic::Mul), Reads::only(&[0, 1]));
        assert_eq!(reads(trigonometric::Sin), Reads::only(&[0]));
        assert_eq!(reads(exponential::Sqrt), Reads::OUTPUT);
        assert_eq!(reads(trigonometric::Hypot), Reads::only(&[0, 1]).and_output());
        // Of the constant b^0 the gradient of c reads the value, and none reads c.
        assert_eq!(reads(crate::formula!(|x, a, b, c| a * x + b.powi(0) * c)), Reads::only(&[0, 1, 2]));
    }

    #[test]
    fn a_gradient_that_passes_is_not_copied() {
        let add = Elementwise(arithmetic::Add).readings();
        assert!(add.iter().all(|reading| reading.is_gradient));
        let sub = Elementwise(arithmetic::Sub).readings();
        assert_eq!(sub.map(|reading| reading.is_gradient), [true, false]);
    }
}
