//! The product of the elements of each row, without overflow or underflow of partial products.

use super::double::Double;
use super::gradient_op::{FusedGradient, GradientOp};
use super::scan::{Cumprod, Running, Walk};
use crate::{Axes, Grads, Op, ShapeError, Var, Vjp};
use raygrad_tensor::scale::power_of_two;
use raygrad_tensor::{Pool, Scalar, Shape, Tensor, simd};

/// y = the product of each row (along the last axis); dx = g times the product of all others.
///
/// Products use [`balanced`] factors, in [`Double`] numbers. So a value or gradient in the range of the type is right,
/// even if partial products are out of range or the row is long.
#[derive(Clone, Copy)]
pub struct Product;

impl<T: Scalar> Op<T> for Product {
    fn name(&self) -> &'static str {
        "prod"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        let Some((_, rest)) = x[0].split_last() else { return Err("a scalar has no rows".into()) };
        Ok(Shape::from_slice(rest))
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let axes = x[0].ndim() - 1;
        let mut out = pool.full(&x[0].shape()[..axes], T::ONE);
        let n = x[0].shape()[axes];
        let rows = x[0].as_slice().chunks_exact(n.max(1)).zip(out.as_mut_slice());
        simd::dispatch(
            #[inline(always)]
            || {
                for (x, out) in rows {
                    let (mut product, mut total) = (Double::from(1.0), 0);
                    balanced(
                        x,
                        #[inline(always)]
                        |_, factor, exponent| (product, total) = (product.times(factor), total + exponent),
                    );
                    *out = T::from_f64(scaled(product.value(), 1.0, total));
                }
            },
        );
        out
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        Grads::one(cx.tape().apply(GradientOp { op: *self, input: 0 }, &[&cx.x(0), cx.g()]))
    }
}

impl<T: Scalar> FusedGradient<T> for Product {
    const GRADIENT: &'static str = "prod_grad";

    fn gradient(&self, _input: usize, x: &[&Tensor<T>], g: &Tensor<T>, pool: &Pool<T>) -> Tensor<T> {
        let (x, mut out) = (x[0], pool.tensor(x[0].shape()));
        let n = x.shape()[x.ndim() - 1].max(1);
        let mut others = Others::default();
        let rows = x.as_slice().chunks_exact(n).zip(out.as_mut_slice().chunks_exact_mut(n));
        for ((x, out), &g) in rows.zip(g.as_slice()) {
            others.of(x);
            for (i, out) in out.iter_mut().enumerate() {
                let product = others.products[i].value();
                *out = T::from_f64(scaled(product, g.to_f64(), others.total - others.exponents[i]));
            }
        }
        out
    }

    fn recorded<'t>(&self, _input: usize, x: &[Var<'t, T>], g: &Var<'t, T>) -> Option<Var<'t, T>> {
        Some(recorded(&x[0], g))
    }
}

/// The gradient as a formula of `x` and `g`: the products before and after each entry. The powers of two that balance
/// them are constants.
fn recorded<'t, T: Scalar>(x: &Var<'t, T>, g: &Var<'t, T>) -> Var<'t, T> {
    let (axis, shape) = (x.shape().len() - 1, x.shape());
    let mut others = Others::default();
    let mut powers: [Vec<T>; 4] = Default::default();
    for row in x.value().as_slice().chunks_exact(shape[axis].max(1)) {
        others.of(row);
        for (product, &exponent) in others.products.iter().zip(&others.exponents) {
            let product = product.value();
            let is_ordinary = product != 0.0 && product.is_finite();
            let [to_balanced, back] = [halves(-exponent), halves(others.total - exponent)];
            // A limit where 0 times infinity, or infinity times 0, would come of it.
            let most = if size_of::<T>() == 4 { 126 } else { 1022 };
            let back = if is_ordinary { back } else { back.map(|half| half.clamp(-most, most)) };
            for (powers, exponent) in powers.iter_mut().zip([to_balanced, back].into_iter().flatten()) {
                powers.push(T::from_f64(power_of_two(exponent)));
            }
        }
    }
    let [down, down_too, up, up_too] = powers.map(|powers| x.tape().constant(Tensor::from_vec(shape, powers)));
    let x = x * down * down_too;
    let around = |reverse: bool| {
        let walk = Walk { axis, reverse };
        walk.neighbour(&x.tape().apply(Cumprod(walk), &[&x]), false, 1.0)
    };
    let mut column = Shape::from_slice(g.shape());
    column.push(1);
    around(false) * around(true) * up * g.reshape(&column) * up_too
}

/// For each element of a row, the product of all others: `products[i] * 2^(total - exponents[i])`.
#[derive(Default)]
struct Others {
    factors: Vec<f64>,
    products: Vec<Double>,
    exponents: Vec<i64>,
    total: i64,
}

impl Others {
    fn of<T: Scalar>(&mut self, row: &[T]) {
        self.factors.resize(row.len(), 0.0);
        self.products.resize(row.len(), Double::from(0.0));
        self.exponents.resize(row.len(), 0);
        balanced(row, |i, factor, exponent| (self.factors[i], self.exponents[i]) = (factor, exponent));
        self.total = self.exponents.iter().sum();
        simd::dispatch(
            #[inline(always)]
            || {
                let mut behind = Double::from(1.0);
                for (product, &factor) in self.products.iter_mut().zip(&self.factors).rev() {
                    *product = behind;
                    behind = behind.times(factor);
                }
                let mut before = Double::from(1.0);
                for (product, &factor) in self.products.iter_mut().zip(&self.factors) {
                    *product = before.product(*product);
                    before = before.times(factor);
                }
            },
        );
    }
}

/// Calls `f(i, factor, exponent)` with each element as `factor * 2^exponent`. The product of any run of neighbouring
/// factors is between 1/2 and 2. Zeros, infinities and NaN stay unchanged and do not count.
#[inline(always)]
fn balanced<T: Scalar>(row: &[T], mut f: impl FnMut(usize, f64, i64)) {
    // The product of all factors so far, in 1..2.
    let mut product = 1.0;
    for (i, x) in row.iter().enumerate() {
        let x = x.to_f64();
        if is_special(x) {
            f(i, x, 0);
            continue;
        }
        let (mut factor, mut exponent) = split(x);
        product *= factor.abs();
        if product >= 2.0 {
            (product, factor, exponent) = (0.5 * product, 0.5 * factor, exponent + 1);
        }
        f(i, factor, exponent);
    }
}

/// Whether a number has no exponent.
fn is_special(x: f64) -> bool {
    x == 0.0 || !x.is_finite()
}

/// A finite number other than 0 as a factor in 1..2, with its sign, and an exponent of two.
fn split(x: f64) -> (f64, i64) {
    const MASK: u64 = 0x7ff << 52;
    let lift = if x.is_normal() { 0 } else { 54 };
    let bits = (x * power_of_two(lift)).to_bits();
    (f64::from_bits(bits & !MASK | 1023 << 52), (bits >> 52 & 0x7ff) as i64 - 1023 - lift)
}

/// A number `factor * 2^exponent` of any size. The exponent stays 0 as long as numbers are in the middle of f64's range.
#[derive(Debug, Clone, Copy)]
pub(super) struct Unbounded {
    /// Between 2^-400 and 2^400, unless it is 0 or not finite. After terms cancel it may be smaller.
    factor: Double,
    exponent: i64,
}

impl From<f64> for Unbounded {
    #[inline(always)]
    fn from(x: f64) -> Self {
        Unbounded { factor: Double::from(1.0), exponent: 0 }.times(x)
    }
}

impl Unbounded {
    #[inline(always)]
    fn is_in_the_middle(x: f64) -> bool {
        const END: f64 = f64::from_bits((1023 + 400) << 52);
        x.abs() > 1.0 / END && x.abs() < END
    }

    #[inline(never)]
    fn times_any(self, x: f64) -> Self {
        if is_special(self.factor.value()) || is_special(x) {
            return Unbounded { factor: Double::from(self.factor.value() * x), exponent: 0 };
        }
        let ((a, up), (b, up_too)) = (self.split(), split(x));
        Unbounded { factor: a.times(b), exponent: up + up_too }
    }

    /// The factor in 1..2, up to its sign, and the exponent that belongs to it.
    fn split(self) -> (Double, i64) {
        let (_, up) = split(self.factor.value());
        // In two steps: after terms have cancelled, the factor may be as small as a subnormal number.
        let factor = halves(-up).into_iter().fold(self.factor, |factor, half| factor.scaled(power_of_two(half)));
        (factor, self.exponent + up)
    }

    /// The product of two numbers.
    pub fn product_of(a: f64, b: f64) -> Self {
        Unbounded::from(a).times(b)
    }

    /// The difference.
    pub fn minus(self, other: Self) -> Self {
        self.plus(Unbounded { factor: other.factor.scaled(-1.0), ..other })
    }

    #[inline(never)]
    fn plus_any(self, other: Self) -> Self {
        let [a, b] = [self, other].map(|x| x.factor.value());
        match (is_special(a), is_special(b)) {
            (true, true) => return Unbounded { factor: Double::from(a + b), exponent: 0 },
            (true, false) => return if a == 0.0 { other } else { self },
            (false, true) => return if b == 0.0 { self } else { other },
            (false, false) => {}
        }
        let [(a, up), (b, up_too)] = [self, other].map(Unbounded::split);
        let most = up.max(up_too);
        let sum = a.scaled(power_of_two(up - most)).plus(b.scaled(power_of_two(up_too - most)));
        Unbounded { factor: sum, exponent: most }
    }
}

impl Running for Unbounded {
    #[inline(always)]
    fn times(self, x: f64) -> Self {
        let factor = self.factor.times(x);
        if Unbounded::is_in_the_middle(factor.value()) { Unbounded { factor, ..self } } else { self.times_any(x) }
    }
    #[inline(always)]
    fn product(self, other: Self) -> Self {
        let factor = self.factor.product(other.factor);
        if Unbounded::is_in_the_middle(factor.value()) {
            return Unbounded { factor, exponent: self.exponent + other.exponent };
        }
        let [a, b] = [self, other].map(|x| x.factor.value());
        if is_special(a) || is_special(b) {
            return Unbounded { factor: Double::from(a * b), exponent: 0 };
        }
        let [(a, up), (b, up_too)] = [self, other].map(Unbounded::split);
        Unbounded { factor: a.product(b), exponent: up + up_too }
    }
    #[inline(always)]
    fn plus(self, other: Self) -> Self {
        let factor = self.factor.plus(other.factor);
        if self.exponent == other.exponent && Unbounded::is_in_the_middle(factor.value()) {
            Unbounded { factor, ..self }
        } else {
            self.plus_any(other)
        }
    }
    #[inline(always)]
    fn value(self) -> f64 {
        if self.exponent == 0 { self.factor.value() } else { scaled(self.factor.value(), 1.0, self.exponent) }
    }
    #[inline(always)]
    fn is_in_range(self) -> bool {
        true
    }
}

/// Two numbers that differ by 1 at most and add up to `exponent`.
fn halves(exponent: i64) -> [i64; 2] {
    [exponent / 2, exponent - exponent / 2]
}

/// `product * g * 2^exponent`, for a product that is near 1, 0 or not finite, rounded once more at most.
fn scaled(product: f64, g: f64, exponent: i64) -> f64 {
    if is_special(product) || is_special(g) {
        return product * g;
    }
    let (g, of_g) = split(g);
    let [up, up_too] = halves(exponent + of_g).map(power_of_two);
    product * g * up * up_too
}

impl<'t, T: Scalar> Var<'t, T> {
    /// The product of all elements, as a scalar; see [`prod_over`](Self::prod_over).
    #[track_caller]
    pub fn prod(&self) -> Self {
        self.prod_over(..)
    }

    /// The product over any axes; 1 if there are no elements. The gradient is right even if elements are 0. Product and
    /// gradient are right even if partial products are out of the type's range.
    ///
    /// ```
    /// use raygrad_autograd::{Tape, Tensor};
    /// let tape = Tape::<f32>::new();
    /// let x = tape.leaf(Tensor::from_vec(&[3, 3], vec![2.0, 3.0, 4.0, 2.0, 0.0, 4.0, 0.0, 3.0, 0.0]));
    /// let y = x.prod_over(-1);
    /// assert_eq!(y.value(), [24.0, 0.0, 0.0]);
    /// assert_eq!(y.sum().grad(&[&x])[0], [[12.0, 8.0, 6.0], [0.0, 8.0, 0.0], [0.0, 0.0, 0.0]]);
    /// ```
    ///
    /// # Panics
    /// If an axis does not exist or is named twice.
    #[track_caller]
    pub fn prod_over(&self, axes: impl Into<Axes>) -> Self {
        let axes = self.axes("prod_over", axes);
        self.tape().apply(Product, &[&self.rows_over(&axes)]).reshape(&axes.result())
    }
}
