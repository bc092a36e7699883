//! Vectors along the last axis: cross product and normalisation.

use super::double::Double;
use super::gradient_op::{FusedGradient, GradientOp};
use super::running::Running;
use super::unbounded::Unbounded;
use crate::{Axes, Grads, Op, Operand, Reads, ShapeError, Var, Vjp};
use raygrad_tensor::scale::{exponent, largest, power_of_two, wide_power};
use raygrad_tensor::{Pool, Scalar, Shape, Tensor, Wide, broadcast_shape, simd};

/// y = a x b along the last axis of extent 3, with broadcasting; da = b x g, db = g x a.
#[derive(Clone, Copy)]
pub struct Cross;

impl<T: Scalar> Op<T> for Cross {
    fn name(&self) -> &'static str {
        "cross"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        if x[0].last() != Some(&3) || x[1].last() != Some(&3) {
            return Err("the last axis of both must have three entries".into());
        }
        broadcast_shape(x).ok_or_else(|| "the shapes do not broadcast".into())
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let Some(shape) = broadcast_shape(&[x[0].shape(), x[1].shape()]) else {
            unreachable!("`shape` has accepted these extents")
        };
        let (a, b) = (x[0].broadcast_to(&shape), x[1].broadcast_to(&shape));
        let mut out = pool.tensor(&shape);
        let pairs = a.as_slice().chunks_exact(3).zip(b.as_slice().chunks_exact(3));
        let rows = out.as_mut_slice().chunks_exact_mut(3).zip(pairs);
        simd::dispatch(
            #[inline(always)]
            || {
                for (y, (a, b)) in rows {
                    y[0] = difference([a[1], b[2]], [a[2], b[1]]);
                    y[1] = difference([a[2], b[0]], [a[0], b[2]]);
                    y[2] = difference([a[0], b[1]], [a[1], b[0]]);
                }
            },
        );
        out
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        let da = cx.needs(0).then(|| cx.x(1).cross(cx.g()).sum_to(cx.shape(0)));
        let db = cx.needs(1).then(|| cx.g().cross(cx.x(0)).sum_to(cx.shape(1)));
        Grads::new([da, db])
    }
}

/// The difference of two products, to the last digits: products that cancel, overflow or underflow do no harm.
#[inline(always)]
fn difference<T: Scalar>(a: [T; 2], b: [T; 2]) -> T {
    let [a, b] = [a, b].map(|factors| factors.map(T::to_f64));
    if const { size_of::<T>() == size_of::<f32>() } {
        return T::from_f64(a[0] * a[1] - b[0] * b[1]);
    }
    let products = [a, b].map(|[x, y]| Double::product_of(x, y));
    let are_right = |product: Double, factors: [f64; 2]| product.is_in_range() || factors.contains(&0.0);
    if are_right(products[0], a) && are_right(products[1], b) {
        return T::from_f64(products[0].minus(products[1]).value());
    }
    far_difference(a, b)
}

/// [`difference`] where a product leaves the range.
#[cold]
#[inline(never)]
fn far_difference<T: Scalar>(a: [f64; 2], b: [f64; 2]) -> T {
    let [a, b] = [a, b].map(|[x, y]| Unbounded::product_of(x, y));
    T::from_f64(a.minus(b).value())
}

/// y = x / |x| along the last axis; dx = (g - y (y . g)) / |x|.
///
/// Rows are multiplied by a power of two first, so that tiny and huge ones keep their digits. A row of zeros gives
/// zeros, with gradient 0. Where the gradient of a tiny row would overflow, it is the largest finite number.
#[derive(Clone, Copy)]
pub struct Normalize;

/// A power of two that takes rows of this largest element close to 1; 0 for 0.
fn scale<T: Scalar>(largest: T) -> T {
    let most = if size_of::<T>() == 4 { 126 } else { 1022 };
    if largest == T::ZERO { T::ZERO } else { T::from_f64(power_of_two((-exponent(largest)).clamp(-most, most))) }
}

/// The norm of `row * down`, with the products written to `unit`.
fn scaled_norm<T: Scalar>(row: &[T], down: T, unit: &mut [T], squares: &mut [T]) -> T {
    for ((unit, square), &x) in unit.iter_mut().zip(squares.iter_mut()).zip(row) {
        *unit = x * down;
        *square = *unit * *unit;
    }
    raygrad_tensor::sum(squares).sqrt()
}

/// The gradient of one row, in place of `g`.
fn row_gradient<T: Scalar>(x: &[T], g: &mut [T], unit: &mut [T], products: &mut [T]) {
    let largest = largest(x);
    if largest == T::ZERO {
        g.fill(T::ZERO);
        return;
    }
    let down = scale(largest);
    let norm = scaled_norm(x, down, unit, products);
    let (mut least, mut size, mut has_terms) = (T::ONE, T::ZERO, false);
    for (((unit, product), &x), &g) in unit.iter_mut().zip(products.iter_mut()).zip(x).zip(g.iter()) {
        *unit = *unit / norm;
        *product = *unit * g;
        least = if x != T::ZERO && unit.abs() < least { unit.abs() } else { least };
        size = if product.abs() > size { product.abs() } else { size };
        has_terms |= x != T::ZERO && g != T::ZERO;
    }
    let along = raygrad_tensor::sum(products);
    // Products of an element of the unit vector and of `along`, in units of its largest term, are in range.
    let [low, high, normal] = if size_of::<T>() == 4 { [-100, 100, -126] } else { [-900, 1000, -1022] }
        .map(|exponent| T::from_f64(power_of_two(exponent)));
    let inverse = down / norm;
    let is_inverse = inverse >= normal && inverse.is_finite();
    let is_term = least >= normal && least * size >= low && size <= high;
    if !(is_inverse && (is_term || !has_terms)) {
        return wide_row_gradient(x, g, down, norm, products);
    }
    for (g, &unit) in g.iter_mut().zip(unit.iter()) {
        let across = *g - unit * along;
        *g = limited(across * inverse, across);
    }
}

/// `quotient`, or the largest number of its sign where it overflows although `across` does not.
fn limited<T: Scalar>(quotient: T, across: T) -> T {
    if quotient.is_finite() || !across.is_finite() {
        return quotient;
    }
    T::from_f64(if size_of::<T>() == 4 { f32::MAX.into() } else { f64::MAX }) * quotient.sign()
}

/// [`row_gradient`] where a product leaves the range.
#[cold]
#[inline(never)]
fn wide_row_gradient<T: Scalar>(x: &[T], g: &mut [T], down: T, norm: T, products: &mut [T]) {
    let unit = |x: T| x.wide() * down.wide() / norm.wide();
    // y . g in units of its largest term.
    let term = |x: T, g: T| exponent(x) + exponent(down) - exponent(norm) + exponent(g);
    let top = x.iter().zip(g.iter()).map(|(&x, &g)| term(x, g)).fold(-20_000, i64::max);
    for (product, (&x, &g)) in products.iter_mut().zip(x.iter().zip(g.iter())) {
        *product = (unit(x) * g.wide() * wide_power::<T>(-top)).narrow();
    }
    let sum = raygrad_tensor::sum(products);
    let along = sum.wide() * wide_power::<T>(top);
    for (g, &x) in g.iter_mut().zip(x) {
        // The difference in units of the larger number.
        let larger = exponent(*g).max(term(x, sum) + top);
        let [small, large] = [-larger, larger].map(wide_power::<T>);
        let across = (g.wide() * small).narrow() - (unit(x) * along * small).narrow();
        *g = limited((across.wide() / norm.wide() * down.wide() * large).narrow(), across);
    }
}

impl<T: Scalar> Op<T> for Normalize {
    fn name(&self) -> &'static str {
        "normalize"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        if x[0].is_empty() { Err("a scalar has no direction".into()) } else { Ok(x[0].into()) }
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let mut out = pool.tensor(x[0].shape());
        let width = x[0].shape()[x[0].ndim() - 1].max(1);
        let mut squares = vec![T::ZERO; width];
        for (x, y) in x[0].as_slice().chunks_exact(width).zip(out.as_mut_slice().chunks_exact_mut(width)) {
            let largest = largest(x);
            if largest == T::ZERO {
                y.fill(T::ZERO);
                continue;
            }
            let norm = scaled_norm(x, scale(largest), y, &mut squares);
            y.iter_mut().for_each(|y| *y = *y / norm);
        }
        out
    }

    fn reads(&self) -> Reads {
        Reads::INPUTS
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        Grads::one(cx.tape().apply(GradientOp { op: *self, input: 0 }, &[&cx.x(0), cx.g()]))
    }

    fn reference<'t>(&self, x: &[Var<'t, T>]) -> Option<Var<'t, T>> {
        let (tape, shape) = (x[0].tape(), x[0].shape());
        let mut column = Shape::from_slice(shape);
        let width = std::mem::replace(&mut column[shape.len() - 1], 1);
        let sizes: Vec<T> = match width {
            0 => vec![T::ONE; column.iter().product()],
            _ => x[0].value().as_slice().chunks_exact(width).map(largest).collect(),
        };
        // The scale of a row cancels, so it is a constant. A row of zeros has scale 0, so that its gradient is 0.
        let of_sizes = |f: &dyn Fn(T) -> T| tape.constant(Tensor::from_fn(&column, |i| f(sizes[i])));
        let down = of_sizes(&scale);
        let one = of_sizes(&|size| if size == T::ZERO { T::ONE } else { T::ZERO });
        let unit = &x[0] * down;
        let square = unit.square().sum_over(Axes::from(-1).keepdims());
        Some(unit / (square + one).sqrt())
    }
}

impl<T: Scalar> FusedGradient<T> for Normalize {
    const GRADIENT: &'static str = "normalize_grad";

    fn gradient(&self, _input: usize, x: &[&Tensor<T>], g: &Tensor<T>, _pool: &Pool<T>) -> Tensor<T> {
        let mut grad = g.clone();
        let width = x[0].shape()[x[0].ndim() - 1].max(1);
        let (mut unit, mut products) = (vec![T::ZERO; width], vec![T::ZERO; width]);
        for (x, g) in x[0].as_slice().chunks_exact(width).zip(grad.as_mut_slice().chunks_exact_mut(width)) {
            row_gradient(x, g, &mut unit, &mut products);
        }
        grad
    }
}

impl<'t, T: Scalar> Var<'t, T> {
    /// The cross product along the last axis, whose extent is 3. Other axes broadcast. Differences keep their digits, even
    /// if products cancel or are out of range.
    ///
    /// # Panics
    /// If a last axis does not have three entries, or the shapes do not broadcast.
    #[track_caller]
    pub fn cross(&self, other: impl Operand<'t, T>) -> Self {
        self.tape().apply(Cross, &[self, &other.on(self.tape())])
    }

    /// Normalises the rows of the last axis to length 1. Rows of any size keep their digits (1e-40 and 1e30 alike).
    ///
    /// A row of zeros gives zeros, with gradient 0. Where the gradient of a tiny row would overflow, it is the largest
    /// finite number. A row with NaN gives NaN. In a row with an infinite element, such elements give NaN and
    /// others 0, as in PyTorch; the gradient is NaN.
    ///
    /// ```
    /// use raygrad_autograd::{Tape, Tensor};
    /// let tape = Tape::<f32>::new();
    /// let tiny = 2.0_f32.powi(-100); // its square is 0
    /// let x = tape.leaf(Tensor::from([[3.0 * tiny, 4.0 * tiny], [0.0, 0.0]]));
    /// assert_eq!(x.normalize().value(), [[0.6, 0.8], [0.0, 0.0]]);
    /// ```
    ///
    /// # Panics
    /// If this is a scalar.
    #[track_caller]
    pub fn normalize(&self) -> Self {
        self.tape().apply(Normalize, &[self])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Tape;

    #[test]
    fn rows_of_any_size_keep_their_digits() {
        for scale in [1e-44_f32, 1e-40, 1e-23, 1.0, 1e20, f32::MAX / 4.0] {
            let tape = Tape::<f32>::new();
            let row = [3.0 * scale, -4.0 * scale, 0.0];
            let x = tape.leaf(Tensor::from_vec(&[3], row.to_vec()));
            let y = x.normalize();
            let length = row.iter().map(|&x| f64::from(x).powi(2)).sum::<f64>().sqrt();
            for (&y, &x) in y.value().as_slice().iter().zip(&row) {
                assert!((f64::from(y) - f64::from(x) / length).abs() <= 1.2e-7, "{scale:e}: {y}");
            }
            // Across the row the gradient is 1 / length; along it, 0.
            let across = y.slice_axis(0, 2..3).sum().grad(&[&x]).remove(0);
            let expected = (1.0 / length).min(f32::MAX.into());
            assert!((f64::from(across.as_slice()[2]) / expected - 1.0).abs() < 1e-6, "{scale:e}: {across:?}");
            let along = (&y * &y).sum().grad(&[&x]).remove(0);
            assert!(along.is_finite());
        }
    }

    #[test]
    fn a_row_of_zeros_has_no_gradient_of_any_order() {
        let tape = Tape::<f64>::new();
        let x = tape.leaf(Tensor::from_vec(&[2, 2], vec![0.0, 0.0, 3.0, 4.0]));
        let y = x.normalize();
        let first = y.slice_axis(1, ..1).sum().grad_graph(&[&x]).remove(0);
        assert_eq!(first.value().as_slice()[..2], [0.0, 0.0]);
        assert!((first.value().as_slice()[2] - 0.128).abs() < 1e-15, "{first:?}");
        let second = first.square().sum().grad(&[&x]).remove(0);
        assert_eq!(second.as_slice()[..2], [0.0, 0.0]);
        assert!(second.is_finite() && second.as_slice()[2] != 0.0);
    }

    #[test]
    fn a_nan_stays_in_its_row() {
        let tape = Tape::<f32>::new();
        let x = tape.leaf(Tensor::from_vec(&[2, 2], vec![1.0, f32::NAN, 0.0, 2.0]));
        let y = x.normalize();
        assert!(y.value().as_slice()[..2].iter().all(|y| y.is_nan()));
        assert_eq!(y.value().as_slice()[2..], [0.0, 1.0]);
    }
}
