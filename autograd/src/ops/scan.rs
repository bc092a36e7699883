//! Cumulative sums and products, and the recurrence in their derivatives.

use super::double::Double;
use super::gradient_op::{FusedGradient, GradientOp, has_far};
use super::running::Running;
use super::unbounded::Unbounded;
use super::walk::Walk;
use crate::{Grads, Op, Reads, ShapeError, Var, Vjp};
use raygrad_tensor::{Pool, Scalar, Shape, Tensor, simd};

/// A sum carried in twice the digits of its numbers: `f64` for f32, and for f64 the sum and its rounding errors.
pub(super) trait CarriedSum: Copy + Default {
    fn plus(self, x: f64) -> Self;
    fn value(self) -> f64;
}

impl CarriedSum for f64 {
    #[inline(always)]
    fn plus(self, x: f64) -> Self {
        self + x
    }
    #[inline(always)]
    fn value(self) -> f64 {
        self
    }
}

impl CarriedSum for [f64; 2] {
    #[inline(always)]
    fn plus(self, x: f64) -> Self {
        let [sum, rest] = self;
        let next = sum + x;
        let of_x = next - sum;
        [next, rest + ((sum - (next - of_x)) + (x - of_x))]
    }
    #[inline(always)]
    fn value(self) -> f64 {
        let [sum, rest] = self;
        if sum.is_finite() { sum + rest } else { sum }
    }
}

/// y = the sum of x up to and including each entry, in twice the digits of f32 or f64; dx = the sum of g the other way.
#[derive(Clone, Copy)]
pub struct Cumsum(
    /// The order.
    pub Walk,
);

impl Cumsum {
    fn sums<S: CarriedSum, T: Scalar>(&self, shape: &[usize], x: &[T], y: &mut [T]) {
        self.0.run(shape, S::default(), |sum, i| {
            *sum = sum.plus(x[i].to_f64());
            y[i] = T::from_f64(sum.value());
        });
    }
}

impl<T: Scalar> Op<T> for Cumsum {
    fn name(&self) -> &'static str {
        "cumsum"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        self.0.check(x[0])
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let mut out = pool.tensor(x[0].shape());
        let (x, y, shape) = (x[0].as_slice(), out.as_mut_slice(), x[0].shape());
        if T::EPSILON > 1e-10 {
            self.sums::<f64, T>(shape, x, y)
        } else {
            self.sums::<[f64; 2], T>(shape, x, y)
        }
        out
    }

    fn reads(&self) -> Reads {
        Reads::NOTHING
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        Grads::one(cx.tape().apply(Cumsum(self.0.back()), &[cx.g()]))
    }
}

impl Walk {
    /// Whether no product of `x` is in the range of f32 after one has left that of f64; false for f64.
    fn stays_in_range<T: Scalar>(self, shape: &[usize], x: &[T]) -> bool {
        if const { size_of::<T>() == size_of::<f64>() } {
            return false;
        }
        // The order of positive numbers is that of their bits. Signed, which vectors compare.
        let sizes = simd::dispatch(
            #[inline(always)]
            || {
                const LANES: usize = 16;
                let size = |x: T| (x.to_f64().to_bits() << 1 >> 1) as i64;
                let (mut least, mut most) = ([i64::MAX; LANES], [0; LANES]);
                let mut rows = x.chunks_exact(LANES);
                for row in &mut rows {
                    for i in 0..LANES {
                        let size = size(row[i]);
                        most[i] = if size > most[i] { size } else { most[i] };
                        least[i] = if size < least[i] && size > 0 { size } else { least[i] };
                    }
                }
                for &x in rows.remainder() {
                    most[0] = most[0].max(size(x));
                    least[0] = if size(x) == 0 { least[0] } else { least[0].min(size(x)) };
                }
                let most = most.into_iter().fold(0, i64::max);
                [least.into_iter().fold(most, i64::min), most]
            },
        );
        let [least, most] = sizes.map(|bits| f64::from_bits(bits as u64));
        // A product that only falls below the range of f64 stays below that of f32.
        let is_near_one = |size: f64| shape[self.axis] as f64 * size.log2().abs() < 700.0;
        most <= 1.0 || is_near_one(most) && is_near_one(least)
    }
}

/// A scan of running numbers.
trait Pass {
    /// Runs the scan. Returns whether all numbers are right, if it is `CHECKED`.
    fn run<const CHECKED: bool, S: Running>(&mut self) -> bool;
}

/// Runs a scan of `T`, with more digits than `T` has, and in [`Unbounded`] numbers if others leave the range of f64.
/// If `stays_in_range`, none leaves it.
fn run_in_range<T: Scalar>(stays_in_range: bool, pass: &mut impl Pass) {
    let is_right = if stays_in_range {
        pass.run::<false, f64>()
    } else if const { size_of::<T>() == size_of::<f32>() } {
        pass.run::<true, f64>()
    } else {
        simd::dispatch(
            #[inline(always)]
            || pass.run::<true, Double>(),
        )
    };
    if !(is_right || stays_in_range) {
        pass.run::<false, Unbounded>();
    }
}

/// The product of `x` up to each entry, in `y`.
struct Products<'a, T> {
    walk: Walk,
    shape: &'a [usize],
    x: &'a [T],
    y: &'a mut [T],
}

impl<T: Scalar> Pass for Products<'_, T> {
    #[inline(always)]
    fn run<const CHECKED: bool, S: Running>(&mut self) -> bool {
        let (Products { walk, shape, x, y }, mut are_right) = (self, true);
        walk.run(
            shape,
            S::from(1.0),
            #[inline(always)]
            |product, i| {
                let x = x[i].to_f64();
                let is_zero = !CHECKED || x == 0.0 || product.value() == 0.0;
                *product = product.times(x);
                are_right &= is_zero || product.is_in_range();
                y[i] = T::from_f64(product.value());
            },
        );
        are_right
    }
}

/// The gradient by the factors of the [`Running`] numbers that begin with `start`, get the factors `x` and then the
/// summands `b`, if there are any; in `dx`.
struct FactorsGrad<'a, T> {
    walk: Walk,
    shape: &'a [usize],
    x: &'a [T],
    g: &'a [T],
    start: f64,
    b: Option<&'a [T]>,
    dx: &'a mut [T],
}

impl<T: Scalar> Pass for FactorsGrad<'_, T> {
    #[inline(always)]
    fn run<const CHECKED: bool, S: Running>(&mut self) -> bool {
        let FactorsGrad { walk, shape, x, g, start, b, dx } = self;
        let (mut later, mut are_right) = (vec![S::from(0.0); x.len()], true);
        // The gradient of the number at entry i, times the factor there.
        walk.back().run(
            shape,
            S::from(0.0),
            #[inline(always)]
            |sum, i| {
                let (x, g) = (x[i].to_f64(), g[i].to_f64());
                later[i] = sum.plus(S::from(g));
                are_right &= !CHECKED || (g == 0.0 && sum.value() == 0.0) || later[i].is_in_range();
                let is_zero = !CHECKED || x == 0.0 || later[i].value() == 0.0;
                *sum = later[i].times(x);
                are_right &= is_zero || sum.is_in_range();
            },
        );
        walk.run(
            shape,
            S::from(*start),
            #[inline(always)]
            |before, i| {
                let x = x[i].to_f64();
                dx[i] = T::from_f64(before.product(later[i]).value());
                let is_zero = !CHECKED || x == 0.0 || before.value() == 0.0;
                *before = before.times(x);
                are_right &= is_zero || before.is_in_range();
                if let Some(b) = b {
                    let b = b[i].to_f64();
                    let is_zero = !CHECKED || b == 0.0;
                    *before = before.plus(S::from(b));
                    are_right &= is_zero || before.is_in_range();
                }
            },
        );
        are_right
    }
}

/// The [`Recurrence`] of the factors `a` and the summands `b`, in `y`.
struct Recurred<'a, T> {
    walk: Walk,
    shape: &'a [usize],
    a: &'a [T],
    b: &'a [T],
    y: &'a mut [T],
}

impl<T: Scalar> Pass for Recurred<'_, T> {
    #[inline(always)]
    fn run<const CHECKED: bool, S: Running>(&mut self) -> bool {
        let (Recurred { walk, shape, a, b, y }, mut are_right) = (self, true);
        walk.run(
            shape,
            S::from(0.0),
            #[inline(always)]
            |state, i| {
                let (a, b) = (a[i].to_f64(), b[i].to_f64());
                let is_zero = !CHECKED || a == 0.0 || state.value() == 0.0;
                *state = state.times(a);
                are_right &= is_zero || state.is_in_range();
                let is_zero = !CHECKED || b == 0.0;
                *state = state.plus(S::from(b));
                are_right &= is_zero || state.is_in_range();
                y[i] = T::from_f64(state.value());
            },
        );
        are_right
    }
}

/// y = the product of x up to and including each entry; dx = [`CumprodGrad`] of x and g. Products have more digits than
/// the type, and are in [`Unbounded`] numbers if they leave the range of f64: those in the range of the type are right
/// even if others are not.
#[derive(Clone, Copy)]
pub struct Cumprod(
    /// The order.
    pub Walk,
);

impl<T: Scalar> Op<T> for Cumprod {
    fn name(&self) -> &'static str {
        "cumprod"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        self.0.check(x[0])
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let mut out = pool.tensor(x[0].shape());
        let (x, y, shape) = (x[0].as_slice(), out.as_mut_slice(), x[0].shape());
        run_in_range::<T>(self.0.stays_in_range(shape, x), &mut Products { walk: self.0, shape, x, y });
        out
    }

    fn reads(&self) -> Reads {
        Reads::INPUTS
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        Grads::one(cx.tape().apply(CumprodGrad(self.0), &[&cx.x(0), cx.g()]))
    }
}

/// The gradient of [`Cumprod`] from x and g: the gradients of all later products, carried back, times the product before
/// the entry. Nothing is divided, so zeros do no harm. Its gradients: the tangent t of the products along g, and that of
/// the recurrence t[i] = x[i] t[i - 1] + g[i] y[i - 1].
#[derive(Clone, Copy)]
pub struct CumprodGrad(
    /// The order of the products.
    pub Walk,
);

impl<T: Scalar> Op<T> for CumprodGrad {
    fn name(&self) -> &'static str {
        "cumprod_grad"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        if x[0] != x[1] {
            return Err("factors and gradients must have one shape".into());
        }
        self.0.check(x[0])
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let mut out = pool.tensor(x[0].shape());
        let (x, g, dx, shape) = (x[0].as_slice(), x[1].as_slice(), out.as_mut_slice(), x[0].shape());
        let stays_in_range = self.0.stays_in_range(shape, x);
        run_in_range::<T>(stays_in_range, &mut FactorsGrad { walk: self.0, shape, x, g, start: 1.0, b: None, dx });
        out
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        let (walk, tape, x, h) = (self.0, cx.tape(), cx.x(0), cx.g());
        let back = Recurrence(walk.back());
        let before = walk.neighbour(&tape.apply(Cumprod(walk), &[&x]), false, 1.0);
        let tangent = tape.apply(Recurrence(walk), &[&x, &(h * &before)]);
        let dx = cx.needs(0).then(|| {
            let next = walk.neighbour(&x, true, 0.0);
            let later = tape.apply(back, &[&next, &cx.x(1)]);
            let of_products = tape.apply(back, &[&next, &walk.neighbour(&(h * &later), true, 0.0)]);
            later * walk.neighbour(&tangent, false, 0.0) + of_products * before
        });
        Grads::new([dx, Some(tangent)])
    }
}

/// y[i] = a[i] y[i - 1] + b[i], with 0 before the first entry. db: the same recurrence of g in the other direction,
/// with the next factor; da = db y[i - 1]. Numbers have more digits than the type, and are in [`Unbounded`] numbers if
/// they leave the range of f64.
#[derive(Clone, Copy)]
pub struct Recurrence(
    /// The order.
    pub Walk,
);

impl<T: Scalar> Op<T> for Recurrence {
    fn name(&self) -> &'static str {
        "recurrence"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        if x[0] != x[1] {
            return Err("factors and summands must have one shape".into());
        }
        self.0.check(x[0])
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let mut out = pool.tensor(x[0].shape());
        let (a, b, y, shape) = (x[0].as_slice(), x[1].as_slice(), out.as_mut_slice(), x[0].shape());
        run_in_range::<T>(self.0.stays_in_range(shape, a), &mut Recurred { walk: self.0, shape, a, b, y });
        out
    }

    fn reads_for(&self, has_gradient: &dyn Fn(usize) -> bool) -> Reads {
        // The summands are for products that may be lost.
        Reads::only(&[0]).and_if(has_gradient(0), Reads::ALL)
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        let (tape, a, g) = (cx.tape(), cx.x(0), cx.g());
        let db = tape.apply(Recurrence(self.0.back()), &[&self.0.neighbour(&a, true, 0.0), g]);
        let da = cx.needs(0).then(|| {
            // A factor of the product may have been rounded out of the range, and be 0.
            if has_far(a.value()) || has_far(db.value()) || has_far(cx.y().value()) {
                tape.apply(GradientOp { op: *self, input: 0 }, &[&a, &cx.x(1), g])
            } else {
                &db * self.0.neighbour(&cx.y(), false, 0.0)
            }
        });
        Grads::new([da, Some(db)])
    }
}

impl<T: Scalar> FusedGradient<T> for Recurrence {
    const GRADIENT: &'static str = "recurrence_grad";

    /// The gradient by the factors, from numbers that are not rounded to the type: one may be out of its range where
    /// the product is not.
    fn gradient(&self, _input: usize, x: &[&Tensor<T>], g: &Tensor<T>, pool: &Pool<T>) -> Tensor<T> {
        let mut out = pool.tensor(x[0].shape());
        let (a, b, da, shape) = (x[0].as_slice(), x[1].as_slice(), out.as_mut_slice(), x[0].shape());
        let (walk, g, stays_in_range) = (self.0, g.as_slice(), self.0.stays_in_range(shape, a));
        run_in_range::<T>(stays_in_range, &mut FactorsGrad { walk, shape, x: a, g, start: 0.0, b: Some(b), dx: da });
        out
    }

    fn recorded<'t>(&self, _input: usize, x: &[Var<'t, T>], g: &Var<'t, T>) -> Option<Var<'t, T>> {
        let (walk, tape) = (self.0, g.tape());
        let later = tape.apply(Recurrence(walk.back()), &[&walk.neighbour(&x[0], true, 0.0), g]);
        Some(later * walk.neighbour(&tape.apply(*self, &[&x[0], &x[1]]), false, 0.0))
    }
}

impl<'t, T: Scalar> Var<'t, T> {
    /// A scan along an axis; a scalar counts as one entry.
    #[track_caller]
    fn walk(&self, op: &'static str, axis: isize, reverse: bool, scan: impl Fn(Walk, &Self) -> Self) -> Self {
        if self.shape().is_empty() {
            return self.reshape(&[1]).walk(op, axis, reverse, scan).reshape(&[]);
        }
        let walk = Walk { axis: self.axis(op, axis), reverse };
        self.tape().as_one(|| scan(walk, self))
    }

    /// The cumulative sum along `axis`, rounded once. Each sum includes its own entry.
    ///
    /// # Panics
    /// If the axis does not exist.
    #[track_caller]
    pub fn cumsum(&self, axis: isize) -> Self {
        self.walk("cumsum", axis, false, |walk, x| x.tape().apply(Cumsum(walk), &[x]))
    }

    /// The cumulative sum along `axis` from the last entry back, rounded once. Each sum includes its own entry.
    ///
    /// # Panics
    /// If the axis does not exist.
    #[track_caller]
    pub fn reverse_cumsum(&self, axis: isize) -> Self {
        self.walk("reverse_cumsum", axis, true, |walk, x| x.tape().apply(Cumsum(walk), &[x]))
    }

    /// The cumulative product along `axis`, rounded once. Each product includes its own entry. Products and gradients are
    /// right even if entries are 0, or other products are out of the type's range.
    ///
    /// # Panics
    /// If the axis does not exist.
    #[track_caller]
    pub fn cumprod(&self, axis: isize) -> Self {
        self.walk("cumprod", axis, false, |walk, x| x.tape().apply(Cumprod(walk), &[x]))
    }

    /// A first-order linear recurrence along `axis`: `y[i] = self[i] y[i - 1] + summand[i]`, with 0 before the first
    /// entry. It computes discounted sums and exponential moving averages.
    ///
    /// # Panics
    /// If the shapes differ or the axis does not exist.
    #[track_caller]
    pub fn recurrence(&self, summand: &Self, axis: isize) -> Self {
        let walk = Walk { axis: self.axis("recurrence", axis), reverse: false };
        self.tape().apply(Recurrence(walk), &[self, summand])
    }
}
