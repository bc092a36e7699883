//! The product of the elements of each row, without overflow or underflow of partial products.

use super::double::Double;
use super::gradient_op::{FusedGradient, GradientOp};
use super::running::Running;
use super::scan::Cumprod;
use super::unbounded::{halves, is_special, scaled, split};
use super::walk::Walk;
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
