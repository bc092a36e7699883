//! Derivatives of functions: gradient, vector-Jacobian and Jacobian-vector products, Jacobian, Hessian and
//! Hessian-vector products. Start with [`value_and_grad`].
//!
//! Each function here takes a closure from variables to one variable, and the tensors to differentiate at. The [`Var`]
//! methods of the same names work on a recorded graph. Those that record ([`Var::vjp`], [`Var::jvp`], [`Var::hvp`],
//! [`Var::grad_graph`]) can be nested to any order:
//!
//! ```
//! use raygrad_autograd::{Tape, Tensor};
//! let tape = Tape::<f64>::new();
//! let x = tape.leaf(Tensor::scalar(2.0));
//! let one = tape.constant(Tensor::scalar(1.0));
//! let y = x.square() * x.square();
//! let first = y.jvp(&[&x], &[&one]); // 4 x^3
//! let second = first.jvp(&[&x], &[&one]); // 12 x^2
//! assert_eq!((first.item(), second.item()), (32.0, 48.0));
//! assert_eq!(second.grad(&[&x])[0].item(), 48.0); // 24 x
//! ```
//!
//! Where an operation is not differentiable, the [conventions](crate::conventions) apply.

use crate::error::ensure;
use crate::{Error, Tape, Var};
use raygrad_tensor::{Scalar, Shape, Tensor};

/// Runs `f` at `x` on a temporary tape, and `then` on the result and the leaves.
fn at<T: Scalar, R>(
    f: impl for<'t> Fn(&[Var<'t, T>]) -> Var<'t, T>,
    x: &[Tensor<T>],
    then: impl for<'t> FnOnce(Var<'t, T>, &[&Var<'t, T>]) -> R,
) -> R {
    let tape = Tape::new();
    let leaves: Vec<_> = x.iter().map(|x| tape.leaf(x.clone())).collect();
    // A function that does not depend on its inputs has derivatives too, all of them 0.
    let y = f(&leaves).tracked();
    then(y, &leaves.iter().collect::<Vec<_>>())
}

/// As [`at`], with the first error of `f` or of `then`.
fn try_at<T: Scalar, R>(
    f: impl for<'t> Fn(&[Var<'t, T>]) -> Var<'t, T>,
    x: &[Tensor<T>],
    then: impl for<'t> FnOnce(Var<'t, T>, &[&Var<'t, T>]) -> Result<R, Error>,
) -> Result<R, Error> {
    let tape = Tape::new();
    let leaves: Vec<_> = x.iter().map(|x| tape.leaf(x.clone())).collect();
    let y = tape.try_run(|| f(&leaves))?.tracked();
    then(y, &leaves.iter().collect::<Vec<_>>())
}

/// The value of a function with a one-element result, and its gradient with respect to each input
/// (`jax.value_and_grad`).
///
/// ```
/// use raygrad_autograd::{Tensor, derivatives::value_and_grad};
/// let x = Tensor::from([3.0, -1.0]);
/// let (y, grads) = value_and_grad(|x| x[0].square().sum(), &[x]);
/// assert_eq!((y, grads[0].as_slice()), (10.0, &[6.0, -2.0][..]));
/// ```
///
/// # Panics
/// If the result has not exactly one element.
#[track_caller]
pub fn value_and_grad<T: Scalar>(
    f: impl for<'t> Fn(&[Var<'t, T>]) -> Var<'t, T>,
    x: &[Tensor<T>],
) -> (T, Vec<Tensor<T>>) {
    at(f, x, |y, wrt| (y.item(), y.grad(wrt)))
}

/// As [`value_and_grad`], with an error instead of a panic.
///
/// ```
/// use raygrad_autograd::{Error, Tensor, derivatives::try_value_and_grad};
/// let x = Tensor::from([3.0, -1.0]);
/// let error = try_value_and_grad(|x| x[0].square(), &[x]).unwrap_err(); // not one element
/// assert!(matches!(error, Error::NotScalar { .. }));
/// ```
///
/// # Errors
/// If the result has not exactly one element, or an operation of `f` fails, as in [`Tape::try_run`].
pub fn try_value_and_grad<T: Scalar>(
    f: impl for<'t> Fn(&[Var<'t, T>]) -> Var<'t, T>,
    x: &[Tensor<T>],
) -> Result<(T, Vec<Tensor<T>>), Error> {
    try_at(f, x, |y, wrt| y.try_grad(wrt).map(|grads| (y.item(), grads)))
}

/// The value and the vector-Jacobian product (reverse mode): for each input, the gradient of `sum(f(x) * seed)`.
///
/// ```
/// use raygrad_autograd::{Tensor, derivatives::vjp};
/// let x = Tensor::from([3.0, -1.0]);
/// let (y, grads) = vjp(|x| x[0].square(), &[x], &Tensor::from([1.0, 10.0]));
/// assert_eq!((y.as_slice(), grads[0].as_slice()), (&[9.0, 1.0][..], &[6.0, -20.0][..]));
/// ```
///
/// # Panics
/// If `seed` has another shape than the result.
#[track_caller]
pub fn vjp<T: Scalar>(
    f: impl for<'t> Fn(&[Var<'t, T>]) -> Var<'t, T>,
    x: &[Tensor<T>],
    seed: &Tensor<T>,
) -> (Tensor<T>, Vec<Tensor<T>>) {
    at(f, x, |y, wrt| (y.value().clone(), y.tape().or_raise(y.vjp_values(seed, wrt))))
}

/// The value and the Jacobian-vector product (forward mode): the derivative of `f(x + h v)` by `h` at 0. It has the
/// shape of the result. [`Var::jvp`] describes the method and its work.
///
/// ```
/// use raygrad_autograd::{Tensor, derivatives::jvp};
/// let vector = |values: [f64; 2]| Tensor::from_vec(&[2], values.to_vec());
/// let (y, slope) = jvp(|x| &x[0] * &x[1], &[vector([3.0, -1.0]), vector([2.0, 5.0])], &[vector([1.0, 0.0]), vector([0.0, 1.0])]);
/// assert_eq!((y.as_slice(), slope.as_slice()), (&[6.0, -5.0][..], &[2.0, -1.0][..]));
/// ```
///
/// # Panics
/// If there is not one `v` of the same shape for each `x`.
#[track_caller]
pub fn jvp<T: Scalar>(
    f: impl for<'t> Fn(&[Var<'t, T>]) -> Var<'t, T>,
    x: &[Tensor<T>],
    v: &[Tensor<T>],
) -> (Tensor<T>, Tensor<T>) {
    at(f, x, |y, wrt| {
        let v: Vec<_> = v.iter().map(|v| y.tape().constant(v.clone())).collect();
        (y.value().clone(), y.jvp(wrt, &v.iter().collect::<Vec<_>>()).into_value())
    })
}

/// The Jacobian: for each input, a tensor whose shape is that of the result followed by that of the input.
/// [`Var::jacobian`] states the work.
///
/// ```
/// use raygrad_autograd::{Tensor, derivatives::jacobian};
/// let x = Tensor::from([3.0, -1.0]);
/// let j = jacobian(|x| x[0].square(), &[x]);
/// assert_eq!((j[0].shape(), j[0].as_slice()), (&[2, 2][..], &[6.0, 0.0, 0.0, -2.0][..]));
/// ```
pub fn jacobian<T: Scalar>(f: impl for<'t> Fn(&[Var<'t, T>]) -> Var<'t, T>, x: &[Tensor<T>]) -> Vec<Tensor<T>> {
    at(f, x, |y, wrt| y.jacobian(wrt))
}

/// As [`jacobian`], with an error instead of a panic.
///
/// # Errors
/// If an operation of `f` fails, as in [`Tape::try_run`].
pub fn try_jacobian<T: Scalar>(
    f: impl for<'t> Fn(&[Var<'t, T>]) -> Var<'t, T>,
    x: &[Tensor<T>],
) -> Result<Vec<Tensor<T>>, Error> {
    try_at(f, x, |y, wrt| y.try_jacobian(wrt))
}

/// The Hessian of a function with a one-element result: `[i][j]` is the derivative of the gradient of input `i` by
/// input `j`. Its shape is that of input `i` followed by that of input `j`.
///
/// ```
/// use raygrad_autograd::{Tensor, derivatives::hessian};
/// let x = Tensor::from([3.0, -1.0]);
/// let h = hessian(|x| x[0].square().sum() * &x[1], &[x, Tensor::scalar(0.5)]);
/// assert_eq!(h[0][0], [[1.0, 0.0], [0.0, 1.0]]);
/// assert_eq!((h[0][1].as_slice(), h[1][0].as_slice()), (&[6.0, -2.0][..], &[6.0, -2.0][..]));
/// assert_eq!(h[1][1].item(), 0.0);
/// ```
///
/// # Panics
/// If the result has not exactly one element.
#[track_caller]
pub fn hessian<T: Scalar>(f: impl for<'t> Fn(&[Var<'t, T>]) -> Var<'t, T>, x: &[Tensor<T>]) -> Vec<Vec<Tensor<T>>> {
    at(f, x, |y, wrt| y.hessian(wrt))
}

/// As [`hessian`], with an error instead of a panic.
///
/// # Errors
/// If the result has not exactly one element, or an operation of `f` fails, as in [`Tape::try_run`].
pub fn try_hessian<T: Scalar>(
    f: impl for<'t> Fn(&[Var<'t, T>]) -> Var<'t, T>,
    x: &[Tensor<T>],
) -> Result<Vec<Vec<Tensor<T>>>, Error> {
    try_at(f, x, |y, wrt| y.try_hessian(wrt))
}

/// The Hessian-vector product of a function with a one-element result. `v` holds a tensor for each input. The work is
/// about that of three gradients, for any number of inputs.
///
/// ```
/// use raygrad_autograd::{Tensor, derivatives::hvp};
/// let vector = |values: [f64; 2]| Tensor::from_vec(&[2], values.to_vec());
/// let product = hvp(|x| (x[0].square() * &x[0]).sum(), &[vector([3.0, -1.0])], &[vector([1.0, 10.0])]);
/// assert_eq!(product[0], [18.0, -60.0]);
/// ```
///
/// # Panics
/// If the result has not exactly one element, or there is not one `v` of the same shape for each `x`.
#[track_caller]
pub fn hvp<T: Scalar>(
    f: impl for<'t> Fn(&[Var<'t, T>]) -> Var<'t, T>,
    x: &[Tensor<T>],
    v: &[Tensor<T>],
) -> Vec<Tensor<T>> {
    at(f, x, |y, wrt| {
        let v: Vec<_> = v.iter().map(|v| y.tape().constant(v.clone())).collect();
        y.hvp(wrt, &v.iter().collect::<Vec<_>>()).into_iter().map(Var::into_value).collect()
    })
}

impl<'t, T: Scalar> Var<'t, T> {
    /// The Jacobian-vector product, recorded: the derivative of this tensor when each of `wrt` moves along its tangent.
    ///
    /// It is the gradient of a gradient. The vector-Jacobian product `u J` is linear in its seed `u`, so the gradient
    /// of `(u J) . v` by `u` is `J v`, at any `u`. This takes one recorded backward pass and one more, about three
    /// times the work of a gradient. It works for any operation, without a forward-mode rule.
    ///
    /// # Panics
    /// If there is not one tangent of the same shape for each variable, or the graph was freed. Also if
    /// [`Tape::check_finite`] is on and finds a value that is not finite.
    #[track_caller]
    pub fn jvp(&self, wrt: &[&Var<'t, T>], tangents: &[&Var<'t, T>]) -> Var<'t, T> {
        let slope = self.tape.enable_grad(|| {
            let seed = self.tape.leaf(self.tape.pool().full(self.shape(), T::ZERO));
            let grads = self.vjp(&seed, wrt);
            inner(self.tape, "jvp", &grads, tangents).tracked().grad_graph(&[&seed]).remove(0)
        });
        slope.recorded_or_constant()
    }

    /// The Hessian-vector product of this one-element tensor, recorded: for each of `wrt`, the derivative of its
    /// gradient when all move along their tangents. Tangents may depend on the variables; the product treats them as
    /// constants, and is recorded as a function of both.
    ///
    /// # Panics
    /// If this tensor has not exactly one element, and where [`jvp`](Self::jvp) panics.
    #[track_caller]
    pub fn hvp(&self, wrt: &[&Var<'t, T>], tangents: &[&Var<'t, T>]) -> Vec<Var<'t, T>> {
        let products = self.tape.enable_grad(|| {
            let grads = self.grad_graph(wrt);
            check_tangents(self.tape, "hvp", &grads, tangents);
            // The Hessian is symmetric. A gradient of `grads . tangents` would also differentiate the tangents.
            match joined(&grads.iter().collect::<Vec<_>>()).zip(joined(tangents)) {
                Some((grads, tangents)) => grads.tracked().vjp(&tangents, wrt),
                None => vec![],
            }
        });
        products.into_iter().map(Var::recorded_or_constant).collect()
    }

    /// The Jacobian with respect to each of `wrt`. Each has the shape of this tensor followed by that of the variable.
    ///
    /// It takes one backward pass for each element of this tensor, or for each element of the variables, whichever are
    /// fewer.
    ///
    /// # Panics
    /// If the graph was freed, or if [`Tape::check_finite`] is on and finds a value that is not finite. If this tensor
    /// or one of `wrt` is a constant, or if one of `wrt` belongs to another tape.
    #[track_caller]
    pub fn jacobian(&self, wrt: &[&Var<'t, T>]) -> Vec<Tensor<T>> {
        self.tape.or_raise(self.try_jacobian(wrt))
    }

    /// As [`jacobian`](Self::jacobian), with an error instead of a panic.
    ///
    /// # Errors
    /// Where [`jacobian`](Self::jacobian) panics, except for a variable of another tape.
    ///
    /// # Panics
    /// If one of `wrt` belongs to another tape.
    #[track_caller]
    pub fn try_jacobian(&self, wrt: &[&Var<'t, T>]) -> Result<Vec<Tensor<T>>, Error> {
        self.check_graph(wrt)?;
        let inputs: usize = wrt.iter().map(|x| x.value.len()).sum();
        let outputs = self.value.len();
        let shape = |x: &Var<'t, T>| -> Shape { self.shape().iter().chain(x.shape()).copied().collect() };
        let mut all: Vec<_> = wrt.iter().map(|x| Tensor::zeros(&shape(x))).collect();
        if inputs >= outputs {
            // Row by row.
            for row in 0..outputs {
                for (whole, grad) in all.iter_mut().zip(self.vjp_values(&unit(self.shape(), row), wrt)?) {
                    let width = grad.len();
                    whole.as_mut_slice()[row * width..(row + 1) * width].copy_from_slice(grad.as_slice());
                }
            }
            return Ok(all);
        }
        // Column by column: the gradient by the seed of the vector-Jacobian product.
        let seed = self.tape.leaf(Tensor::zeros(self.shape()));
        for (whole, grad) in all.iter_mut().zip(self.tape.enable_grad(|| self.try_vjp(&seed, wrt))?) {
            let width = grad.value.len();
            for column in 0..width {
                let values = grad.vjp_values(&unit(grad.shape(), column), &[&seed])?.remove(0);
                for (whole, &value) in whole.as_mut_slice()[column..].iter_mut().step_by(width).zip(values.as_slice()) {
                    *whole = value;
                }
            }
        }
        Ok(all)
    }

    /// The Hessian of this one-element tensor: `[i][j]` is the derivative of the gradient of `wrt[i]` by `wrt[j]`. Its
    /// shape is that of `wrt[i]` followed by that of `wrt[j]`.
    ///
    /// It takes one recorded backward pass, and one more for each element of the variables.
    ///
    /// # Panics
    /// If this tensor has not exactly one element, and where [`jacobian`](Self::jacobian) panics.
    #[track_caller]
    pub fn hessian(&self, wrt: &[&Var<'t, T>]) -> Vec<Vec<Tensor<T>>> {
        self.tape.or_raise(self.try_hessian(wrt))
    }

    /// As [`hessian`](Self::hessian), with an error instead of a panic.
    ///
    /// # Errors
    /// If this tensor has not exactly one element, and where [`try_jacobian`](Self::try_jacobian) fails.
    ///
    /// # Panics
    /// If one of `wrt` belongs to another tape.
    #[track_caller]
    pub fn try_hessian(&self, wrt: &[&Var<'t, T>]) -> Result<Vec<Vec<Tensor<T>>>, Error> {
        let grads = self.tape.enable_grad(|| self.try_grad_graph(wrt))?;
        grads.iter().map(|grad| grad.try_jacobian(wrt)).collect()
    }

    /// The vector-Jacobian product without a record of it.
    #[track_caller]
    fn vjp_values(&self, seed: &Tensor<T>, wrt: &[&Var<'t, T>]) -> Result<Vec<Tensor<T>>, Error> {
        let grads = self.tape.no_grad(|| self.try_vjp(&self.tape.constant(seed.clone()), wrt))?;
        Ok(grads.into_iter().map(Var::into_value).collect())
    }

    /// This result as a constant if the tape does not record ([`Tape::no_grad`]).
    fn recorded_or_constant(self) -> Self {
        if self.tape.is_recording() { self } else { self.detach() }
    }
}

/// Checks that there is a tangent of the same shape for each gradient.
#[track_caller]
fn check_tangents<'t, T: Scalar>(tape: &'t Tape<T>, op: &'static str, a: &[Var<'t, T>], v: &[&Var<'t, T>]) {
    let count = || format!("{} tangents for {} variables", v.len(), a.len());
    tape.fits(op, v, ensure(a.len() == v.len(), count));
    for (a, v) in a.iter().zip(v) {
        let shape = || "a tangent has the shape of its variable".to_owned();
        tape.fits(op, &[a, *v], ensure(a.shape() == v.shape(), shape));
    }
}

/// All elements in one row; the variable itself if there is only one.
fn joined<'t, T: Scalar>(all: &[&Var<'t, T>]) -> Option<Var<'t, T>> {
    match all {
        [] => None,
        [one] => Some((*one).clone()),
        all => {
            let rows: Vec<_> = all.iter().map(|x| x.reshape(&[x.value().len()])).collect();
            Some(Var::concat(&rows.iter().collect::<Vec<_>>(), 0))
        }
    }
}

/// `sum_i a_i . v_i`, for the derivative `op` along the tangents v.
#[track_caller]
fn inner<'t, T: Scalar>(tape: &'t Tape<T>, op: &'static str, a: &[Var<'t, T>], v: &[&Var<'t, T>]) -> Var<'t, T> {
    check_tangents(tape, op, a, v);
    let mut total: Option<Var<'t, T>> = None;
    for (a, v) in a.iter().zip(v) {
        let product = (a * *v).sum();
        total = Some(match total {
            Some(total) => total + product,
            None => product,
        });
    }
    total.unwrap_or_else(|| tape.constant(Tensor::scalar(T::ZERO)))
}

/// 1 at one place, else 0.
fn unit<T: Scalar>(shape: &[usize], place: usize) -> Tensor<T> {
    let mut unit = Tensor::zeros(shape);
    unit.as_mut_slice()[place] = T::ONE;
    unit
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Activation;
    use std::slice::from_ref;

    fn vector(values: &[f64]) -> Tensor<f64> {
        Tensor::from_vec(&[values.len()], values.to_vec())
    }

    #[track_caller]
    fn assert_close(got: &[f64], expected: &[f64], tolerance: f64) {
        assert_eq!(got.len(), expected.len());
        for (got, expected) in got.iter().zip(expected) {
            let error = (got - expected).abs() / expected.abs().max(1.0);
            assert!(error <= tolerance, "{got} instead of {expected}");
        }
    }

    /// `[a^2 b, sin a, e^b]` from `[a, b]`.
    fn curve<'t>(x: &[Var<'t, f64>]) -> Var<'t, f64> {
        let (a, b) = (x[0].slice_axis(0, ..1), x[0].slice_axis(0, 1..2));
        Var::concat(&[&(a.square() * &b), &a.sin(), &b.exp()], 0)
    }

    const AT: [f64; 2] = [0.7, -1.3];

    /// The Jacobian of `curve`, by hand.
    fn slopes() -> [f64; 6] {
        let [a, b] = AT;
        [2.0 * a * b, a * a, a.cos(), 0.0, 0.0, b.exp()]
    }

    #[test]
    fn a_jacobian_is_right_by_rows_and_by_columns() {
        // Three results of two inputs go by columns, the transposed relation by rows.
        let tall = jacobian(curve, &[vector(&AT)]).remove(0);
        assert_eq!(tall.shape(), [3, 2]);
        assert_close(tall.as_slice(), &slopes(), 1e-14);
        let wide = jacobian(|x| curve(x).slice_axis(0, ..2), &[vector(&AT)]).remove(0);
        assert_eq!(wide.shape(), [2, 2]);
        assert_close(wide.as_slice(), &slopes()[..4], 1e-14);
        // Two inputs, of which one has no influence, and shapes of several axes.
        let both = jacobian(|x| x[0].reshape(&[1, 2, 1]) * 3.0, &[vector(&AT), Tensor::ones(&[2, 2])]);
        assert_eq!((both[0].shape(), both[1].shape()), (&[1, 2, 1, 2][..], &[1, 2, 1, 2, 2][..]));
        assert_eq!((both[0].as_slice(), both[1].as_slice()), (&[3.0, 0.0, 0.0, 3.0][..], &[0.0; 8][..]));
    }

    #[test]
    fn jvp_and_vjp_agree_with_jacobian() {
        let (v, u) = ([0.3, -2.0], [1.0, -0.5, 4.0]);
        let j = slopes();
        let (y, slope) = jvp(curve, &[vector(&AT)], &[vector(&v)]);
        assert_close(y.as_slice(), &[AT[0] * AT[0] * AT[1], AT[0].sin(), AT[1].exp()], 1e-14);
        assert_close(slope.as_slice(), &[0, 1, 2].map(|i| j[2 * i] * v[0] + j[2 * i + 1] * v[1]), 1e-14);
        let (y, grads) = vjp(curve, &[vector(&AT)], &vector(&u));
        assert_eq!(y.shape(), [3]);
        assert_close(grads[0].as_slice(), &[0, 1].map(|k| (0..3).map(|i| u[i] * j[2 * i + k]).sum()), 1e-14);
    }

    /// A small network of fused layers, its input and weights as variables.
    fn network<'t>(x: &[Var<'t, f64>]) -> Var<'t, f64> {
        let h = x[0].linear(&x[1], Some(&x[2]), Activation::Relu);
        (h.linear(&x[3], None, Activation::Identity).tanh() * &x[0]).square().sum()
    }

    fn network_inputs() -> Vec<Tensor<f64>> {
        let shapes: [&[usize]; 4] = [&[3, 2], &[2, 4], &[4], &[4, 2]];
        let value = |salt: usize| move |i: usize| ((i * 7 + salt * 5 + 3) as f64 * 0.77).sin();
        shapes.iter().enumerate().map(|(k, shape)| Tensor::from_fn(shape, value(k))).collect()
    }

    #[test]
    fn hessian_is_symmetric_gradient_derivative() {
        let x = network_inputs();
        let whole = hessian(network, &x);
        let v: Vec<_> = x.iter().map(|x| Tensor::from_fn(x.shape(), |i| (i as f64 * 1.3 + 0.2).cos())).collect();
        let product = hvp(network, &x, &v);
        let mut differences = 0;
        for i in 0..x.len() {
            let mut row = vec![0.0; x[i].len()];
            for j in 0..x.len() {
                let (a, b) = (whole[i][j].as_slice(), whole[j][i].as_slice());
                let width = x[j].len();
                for (k, row) in row.iter_mut().enumerate() {
                    for l in 0..width {
                        assert!((a[k * width + l] - b[l * x[i].len() + k]).abs() <= 1e-13);
                        *row += a[k * width + l] * v[j].as_slice()[l];
                    }
                }
            }
            assert_close(product[i].as_slice(), &row, 1e-12);
            differences += row.len();
        }
        assert_eq!(differences, 6 + 8 + 4 + 8);
        // The same product from differences of gradients.
        let gradient = |h: f64| {
            let moved: Vec<_> = x
                .iter()
                .zip(&v)
                .map(|(x, v)| Tensor::from_fn(x.shape(), |i| x.as_slice()[i] + h * v.as_slice()[i]))
                .collect();
            value_and_grad(network, &moved).1
        };
        let (plus, minus) = (gradient(1e-6), gradient(-1e-6));
        for ((plus, minus), product) in plus.iter().zip(&minus).zip(&product) {
            for i in 0..plus.len() {
                let numeric = (plus.as_slice()[i] - minus.as_slice()[i]) / 2e-6;
                let error = (numeric - product.as_slice()[i]).abs() / numeric.abs().max(1.0);
                assert!(error < 1e-7, "{} instead of {numeric}", product.as_slice()[i]);
            }
        }
    }

    #[test]
    fn orders_mix_freely() {
        // f = sin(a) e^(b): every mixed derivative is known.
        let tape = Tape::<f64>::new();
        let (a, b) = (tape.leaf(Tensor::scalar(0.4)), tape.leaf(Tensor::scalar(-0.2)));
        let (one, zero) = (tape.constant(Tensor::scalar(1.0)), tape.constant(Tensor::scalar(0.0)));
        let f = a.sin() * b.exp();
        let (s, c, e) = (0.4_f64.sin(), 0.4_f64.cos(), (-0.2_f64).exp());
        let fa = f.jvp(&[&a, &b], &[&one, &zero]);
        let faa = fa.grad_graph(&[&a]).remove(0);
        let faab = faa.jvp(&[&b], &[&one]);
        let faabb = faab.vjp(&one, &[&b]).remove(0);
        let values = [&fa, &faa, &faab, &faabb].map(|x| x.item());
        assert_close(&values, &[c * e, -s * e, -s * e, -s * e], 1e-14);
        let third = fa.hvp(&[&a, &b], &[&one, &one]);
        // d/da and d/db of f_a along (1, 1): f_aaa + f_aab, f_aab + f_abb.
        assert_close(&[third[0].item(), third[1].item()], &[(-c - s) * e, (-s + c) * e], 1e-14);
        // In a scope that records nothing the result is a constant.
        let inside = tape.no_grad(|| f.jvp(&[&a], &[&one]));
        assert!(!inside.is_on_graph() && inside.item() == fa.item());
        assert_close(fa.jacobian(&[&a, &b])[1].as_slice(), &[c * e], 1e-14);
    }

    /// A gradient of `grads . tangents` would differentiate the tangents too.
    #[test]
    fn hessian_products_hold_tangents_fixed() {
        let tape = Tape::<f64>::new();
        let x = tape.leaf(Tensor::scalar(2.0));
        let product = x.powi(3).hvp(&[&x], &[&x]).remove(0);
        // 6 x v, and as a function of x = v its derivative 12 x.
        assert_eq!([product.item(), product.grad(&[&x])[0].item()], [24.0, 24.0]);
        let [a, b] = [[1.0, -2.0], [0.5, 3.0]].map(|x| tape.leaf(Tensor::from(x)));
        let y = ((&a * &b).sin() + a.square() * &b).sum();
        let tangents = y.grad_graph(&[&a, &b]);
        let fixed: Vec<_> = tangents.iter().map(Var::detach).collect();
        let [moving, fixed] = [&tangents, &fixed].map(|v| y.hvp(&[&a, &b], &v.iter().collect::<Vec<_>>()));
        for (moving, fixed) in moving.iter().zip(fixed) {
            assert_eq!(moving.value(), fixed.value());
        }
        // Half of the squared norm of the gradient has the gradient H g.
        let norm = (tangents[0].square().sum() + tangents[1].square().sum()) * 0.5;
        for (gradient, product) in norm.grad(&[&a, &b]).iter().zip(&moving) {
            assert_close(gradient.as_slice(), product.value().as_slice(), 1e-14);
        }
    }

    #[test]
    fn empty_and_scalar_tensors_have_derivatives_too() {
        let empty = || Tensor::<f64>::zeros(&[0, 2]);
        assert_eq!(jacobian(|x| x[0].exp(), &[empty()])[0].shape(), [0, 2, 0, 2]);
        assert_eq!(jacobian(|x| x[0].sum(), &[empty()])[0].shape(), [0, 2]);
        let (y, slope) = jvp(|x| x[0].exp(), &[empty()], &[empty()]);
        assert_eq!((y.shape(), slope.shape()), (&[0, 2][..], &[0, 2][..]));
        assert_eq!(jvp(|x| x[0].exp().sum(), &[empty()], &[empty()]).1, Tensor::scalar(0.0));
        assert_eq!(vjp(|x| x[0].exp(), &[empty()], &empty()).1[0].shape(), [0, 2]);
        assert_eq!(hessian(|x| x[0].square().sum(), &[empty()])[0][0].shape(), [0, 2, 0, 2]);
        assert_eq!(hvp(|x| x[0].square().sum(), &[empty()], &[empty()])[0].shape(), [0, 2]);
        let at = Tensor::scalar(3.0);
        assert_eq!(jacobian(|x| x[0].square(), from_ref(&at))[0], Tensor::scalar(6.0));
        assert_eq!(hessian(|x| x[0].square(), from_ref(&at))[0][0], Tensor::scalar(2.0));
        // A function that does not depend on its input.
        let (y, slope) = jvp(|x| x[0].constant(1.0), from_ref(&at), from_ref(&at));
        assert_eq!((y.item(), slope.item()), (1.0, 0.0));
        assert_eq!(hessian(|x| x[0].constant(1.0), &[at])[0][0], Tensor::scalar(0.0));
    }

    #[test]
    fn try_forms_return_what_the_others_raise() {
        let x = [vector(&AT)];
        assert_eq!(try_value_and_grad(|x| curve(x).sum(), &x).unwrap(), value_and_grad(|x| curve(x).sum(), &x));
        assert_eq!(try_jacobian(curve, &x).unwrap(), jacobian(curve, &x));
        assert_eq!(try_hessian(|x| curve(x).sum(), &x).unwrap(), hessian(|x| curve(x).sum(), &x));
        assert!(matches!(try_value_and_grad(curve, &x), Err(Error::NotScalar { .. })));
        assert!(matches!(try_hessian(curve, &x), Err(Error::NotScalar { .. })));
        // An operation of the function.
        fn misfit<'t>(x: &[Var<'t, f64>]) -> Var<'t, f64> {
            (&x[0] + Tensor::ones(&[3])).sum()
        }
        assert!(matches!(try_value_and_grad(misfit, &x), Err(Error::Shape { op: "add", .. })));
        assert!(matches!(try_jacobian(misfit, &x), Err(Error::Shape { op: "add", .. })));
        assert!(matches!(try_hessian(misfit, &x), Err(Error::Shape { op: "add", .. })));
        // On a graph: by rows and by columns, and after the graph was freed.
        let tape = Tape::<f64>::new();
        let x = tape.leaf(vector(&AT));
        let y = curve(from_ref(&x));
        assert_eq!(y.try_jacobian(&[&x]).unwrap(), y.jacobian(&[&x]));
        let constant = tape.constant(vector(&AT));
        assert!(matches!(constant.try_jacobian(&[&x]), Err(Error::OfConstant { .. })));
        assert!(matches!(y.try_jacobian(&[&constant]), Err(Error::ByConstant { .. })));
        assert!(matches!(y.sum().try_hessian(&[&constant]), Err(Error::ByConstant { .. })));
        let sum = y.sum();
        tape.free();
        for y in [&y, &sum] {
            assert!(matches!(y.try_jacobian(&[&x]), Err(Error::Freed { .. })));
        }
        assert!(matches!(sum.try_hessian(&[&x]), Err(Error::Freed { .. })));
    }

    #[test]
    #[should_panic(expected = "a tangent has the shape of its variable")]
    fn a_tangent_of_another_shape_is_refused() {
        jvp(|x| x[0].exp(), &[vector(&AT)], &[Tensor::scalar(1.0)]);
    }

    #[test]
    fn tangents_that_do_not_fit_are_errors_of_shape() {
        let tape = Tape::<f64>::new();
        let (x, one) = (tape.leaf(vector(&AT)), tape.constant(Tensor::scalar(1.0)));
        let named = |result: Result<Vec<Var<'_, f64>>, Error>, name: &str, text: &str| {
            let error = result.unwrap_err();
            assert!(
                matches!(error, Error::Shape { op, .. } if op == name) && error.to_string().contains(text),
                "{error}"
            );
        };
        let shape = "a tangent has the shape of its variable";
        named(tape.try_run(|| vec![x.exp().jvp(&[&x], &[&one])]), "jvp", shape);
        named(tape.try_run(|| vec![x.exp().jvp(&[&x], &[])]), "jvp", "0 tangents for 1 variables");
        named(tape.try_run(|| x.exp().sum().hvp(&[&x], &[&one])), "hvp", shape);
    }
}
