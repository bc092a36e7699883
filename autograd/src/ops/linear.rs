//! A dense layer as one fused operation: matrix product, bias and activation.

use crate::{Grads, Op, Reads, ShapeError, Var, Vjp};
use raygrad_tensor::matmul::{Matrix, gemm};
use raygrad_tensor::parallel::chunks;
use raygrad_tensor::{Pool, Scalar, Shape, Tensor, map, simd, sum_to};
use serde::{Deserialize, Serialize};

/// The activation at the output of a dense layer. Its derivative follows from the output alone.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Activation {
    /// No activation.
    Identity,
    /// `max(x, 0)`.
    Relu,
}

/// y = activation(x w + b), with x `[.., inputs]`, w `[inputs, outputs]` and an optional b `[outputs]`.
///
/// With h the gradient of the activation's input: dx = h w', dw = x' h, db = sum of the rows of h.
#[derive(Clone, Copy)]
pub struct LinearOp(
    /// The activation.
    pub Activation,
);

/// Elements of a block for one thread, about.
const PIECE: usize = 1 << 15;

/// Adds the bias to each row and applies ReLU, in place.
#[inline(always)]
fn finish_rows<'a, T: Scalar>(rows: impl Iterator<Item = &'a mut [T]>, bias: Option<&[T]>, relu: bool) {
    for row in rows {
        if let Some(bias) = bias {
            for (y, &b) in row.iter_mut().zip(bias) {
                *y += b;
            }
        }
        if relu {
            // `y > 0 ? y : 0` would turn a NaN into 0.
            for y in row.iter_mut() {
                *y = if *y < T::ZERO { T::ZERO } else { *y };
            }
        }
    }
}

impl<T: Scalar> Op<T> for LinearOp {
    fn name(&self) -> &'static str {
        "linear"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        let &[inputs, outputs] = x[1] else { return Err("the weight must have two axes".into()) };
        if x[0].last() != Some(&inputs) {
            return Err(format!("the weight takes {inputs} inputs"));
        }
        if x.len() > 2 && x[2] != [outputs] {
            return Err(format!("the bias must have shape [{outputs}]"));
        }
        let mut shape = Shape::from_slice(x[0]);
        shape[x[0].len() - 1] = outputs;
        Ok(shape)
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let (input, weight) = (Matrix::rows_of(x[0]), Matrix::rows_of(x[1]));
        let outputs = weight.columns();
        let mut shape = Shape::from_slice(x[0].shape());
        shape[x[0].ndim() - 1] = outputs;
        let mut y = pool.tensor(&shape);
        gemm(input, weight, y.as_mut_slice(), false);
        let relu = self.0 == Activation::Relu;
        let bias = x.get(2).map(|bias| bias.as_slice());
        if (bias.is_some() || relu) && outputs > 0 {
            let (y, rows) = (y.as_mut_slice(), (PIECE / outputs).max(1));
            let work = y.len() * 4;
            chunks(y, rows * outputs, work, || (), &|_, _, y| {
                simd::dispatch(
                    #[inline(always)]
                    || finish_rows(y.chunks_exact_mut(outputs), bias, relu),
                );
            });
        }
        y
    }

    fn reads(&self) -> Reads {
        Reads::ALL
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        let (x, w) = (cx.x(0).into_value(), cx.x(1).into_value());
        let h = match self.0 {
            Activation::Identity => cx.g().value().clone(),
            Activation::Relu => map(
                [cx.g().value(), cx.y().value()],
                cx.pool(),
                #[inline(always)]
                |[g, y]| if y > T::ZERO { g } else { T::ZERO },
            ),
        };
        let product = |shape: &[usize], a, b| {
            let mut out = cx.pool().tensor(shape);
            gemm(a, b, out.as_mut_slice(), false);
            cx.constant(out)
        };
        let dx = cx.needs(0).then(|| product(x.shape(), Matrix::rows_of(&h), Matrix::rows_of(&w).t()));
        let dw = cx.needs(1).then(|| product(w.shape(), Matrix::rows_of(&x).t(), Matrix::rows_of(&h)));
        if cx.len() < 3 {
            return Grads::new([dx, dw]);
        }
        let db = cx.needs(2).then(|| cx.constant(sum_to(&h, cx.shape(2), cx.pool())));
        Grads::new([dx, dw, db])
    }

    fn is_fused(&self) -> bool {
        true
    }

    fn reference<'t>(&self, x: &[Var<'t, T>]) -> Option<Var<'t, T>> {
        let (inputs, outputs) = (x[1].shape()[0], x[1].shape()[1]);
        let rows: usize = x[0].shape()[..x[0].shape().len() - 1].iter().product();
        let mut shape = Shape::from_slice(x[0].shape());
        shape[x[0].shape().len() - 1] = outputs;
        let mut y = x[0].reshape(&[rows, inputs]).matmul(&x[1]);
        if let Some(bias) = x.get(2) {
            y += bias;
        }
        if self.0 == Activation::Relu {
            y = y.relu();
        }
        Some(y.reshape(&shape))
    }
}

impl<'t, T: Scalar> Var<'t, T> {
    /// A dense layer in one fused operation: `activation(self weight + bias)`.
    ///
    /// This tensor is `[.., inputs]`, `weight` is `[inputs, outputs]` and `bias` is `[outputs]`. The result is
    /// `[.., outputs]`. `weight` is the transpose of PyTorch's.
    ///
    /// # Panics
    /// If the shapes do not fit.
    #[track_caller]
    pub fn linear(&self, weight: &Self, bias: Option<&Self>, activation: Activation) -> Self {
        match bias {
            Some(bias) => self.tape().apply(LinearOp(activation), &[self, weight, bias]),
            None => self.tape().apply(LinearOp(activation), &[self, weight]),
        }
    }
}
