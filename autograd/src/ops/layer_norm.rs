//! Layer normalisation as one fused operation.

use super::gradient_op::{FusedGradient, GradientOp};
use crate::{Axes, Grads, Op, Reads, ShapeError, Var, Vjp};
use raygrad_tensor::rows::{RowUnits, layer_norm_rows, layer_norm_rows_grad};
use raygrad_tensor::scale::power_of_two;
use raygrad_tensor::{Pool, Scalar, Shape, Tensor};

/// y = (x - mean) / sqrt(variance + eps) gain + bias along the last axis, for x `[.., n]`, gain and bias `[n]`. The
/// gradients are those of [`layer_norm_rows_grad`].
#[derive(Clone, Copy)]
pub struct LayerNorm {
    /// Added to the variance.
    pub eps: f64,
}

impl<T: Scalar> Op<T> for LayerNorm {
    fn name(&self) -> &'static str {
        "layer_norm"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        let Some(&n) = x[0].last() else { return Err("a scalar has no last axis".into()) };
        if x[1] != [n] || x[2] != [n] {
            return Err(format!("gain and bias must have shape [{n}]"));
        }
        Ok(Shape::from_slice(x[0]))
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let mut out = pool.tensor(x[0].shape());
        let [x, gain, bias] = [x[0], x[1], x[2]].map(Tensor::as_slice);
        layer_norm_rows(x, gain, bias, self.eps, out.as_mut_slice());
        out
    }

    fn reads(&self) -> Reads {
        Reads::only(&[0, 1])
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        let (x, gain, g, pool) = (cx.x(0), cx.x(1), cx.g(), cx.pool());
        if cx.recording() {
            let bias = cx.constant(pool.full(cx.shape(2), T::ZERO));
            let by = |input| cx.tape().apply(GradientOp { op: *self, input }, &[&x, &gain, &bias, g]);
            let of_bias = cx.needs(2).then(|| g.sum_to(cx.shape(2)));
            return Grads::new([cx.needs(0).then(|| by(0)), cx.needs(1).then(|| by(1)), of_bias]);
        }
        let mut dx = pool.tensor(cx.shape(0));
        let are_wanted = cx.needs(1) || cx.needs(2);
        let mut sums = are_wanted.then(|| [cx.shape(1), cx.shape(2)].map(|shape| pool.tensor(shape)));
        let [x, gain, g] = [x.value(), gain.value(), g.value()].map(Tensor::as_slice);
        let slices = sums.as_mut().map(|sums| sums.each_mut().map(Tensor::as_mut_slice));
        layer_norm_rows_grad(x, gain, g, self.eps, dx.as_mut_slice(), slices, pool);
        let [dgain, dbias] = sums.map_or([None, None], |sums| sums.map(|sum| Some(cx.constant(sum))));
        Grads::new([Some(cx.constant(dx)), dgain, dbias])
    }

    fn reference<'t>(&self, x: &[Var<'t, T>]) -> Option<Var<'t, T>> {
        let kept = Axes::from(-1).resolve(x[0].shape()).kept();
        // In units of powers of two for each row, in which squares are in range. They cancel, so they are constants.
        let (value, n) = (x[0].value(), x[1].value().len());
        let rows = kept.iter().product();
        let units: Vec<_> = (0..rows).map(|i| RowUnits::new(&value.as_slice()[i * n..][..n], self.eps)).collect();
        let column = |f: &dyn Fn(&RowUnits<T>) -> T| x[0].tape().constant(Tensor::from_fn(&kept, |i| f(&units[i])));
        let centred = ((&x[0] - column(&|row| row.first)) * column(&|row| row.down)).centred(&kept);
        // In two factors, which are finite.
        let power = |exponent: i64| T::from_f64(power_of_two(exponent.min(120)));
        let [half, rest] = [0, 1].map(|odd| column(&|row| power((row.rest + odd) >> 1)));
        let variance = (&centred * &half * &rest).square().mean_to(&kept);
        Some(centred * half / (variance + column(&|row| row.eps)).sqrt() * &x[1] * rest + &x[2])
    }
}

impl<T: Scalar> FusedGradient<T> for LayerNorm {
    const GRADIENT: &'static str = "layer_norm_grad";

    fn gradient(&self, input: usize, x: &[&Tensor<T>], g: &Tensor<T>, pool: &Pool<T>) -> Tensor<T> {
        let mut grads = [x[0], x[1], x[2]].map(|x| pool.tensor(x.shape()));
        let [dx, dgain, dbias] = grads.each_mut().map(Tensor::as_mut_slice);
        let [x, gain, g] = [x[0], x[1], g].map(Tensor::as_slice);
        layer_norm_rows_grad(x, gain, g, self.eps, dx, (input > 0).then_some([dgain, dbias]), pool);
        grads.into_iter().nth(input).unwrap_or_else(|| unreachable!("there are three inputs"))
    }
}

impl<'t, T: Scalar> Var<'t, T> {
    /// Layer normalisation along the last axis, `(self - mean) / sqrt(variance + eps) * gain + bias`.
    ///
    /// This tensor is `[.., n]`; `gain` and `bias` are `[n]`. The variance is divided by `n`. Mean and variance take
    /// two passes, so a large mean loses no digits.
    ///
    /// ```
    /// use raygrad_autograd::{Tape, Tensor};
    /// let tape = Tape::<f64>::new();
    /// let x = tape.leaf(Tensor::from_vec(&[1, 2], vec![10.0, 14.0]));
    /// let (gain, bias) = (tape.leaf(Tensor::ones(&[2])), tape.leaf(Tensor::full(&[2], 0.5)));
    /// assert_eq!(x.layer_norm(&gain, &bias, 0.0).value(), [[-0.5, 1.5]]);
    /// ```
    ///
    /// # Panics
    /// If the shapes do not fit.
    #[track_caller]
    pub fn layer_norm(&self, gain: &Self, bias: &Self, eps: f64) -> Self {
        self.tape().apply(LayerNorm { eps }, &[self, gain, bias])
    }
}
