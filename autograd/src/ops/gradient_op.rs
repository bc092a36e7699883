//! The gradient of a fused operation, as an operation.

use crate::{Grads, Op, ShapeError, Var, Vjp};
use raygrad_tensor::{Pool, Scalar, Shape, Tensor};

/// An operation with a kernel for its gradients.
pub(crate) trait FusedGradient<T: Scalar>: Op<T> + Clone {
    /// The name of the gradients.
    const GRADIENT: &'static str;

    /// The gradient of an input, given all inputs `x` and the gradient `g` of the output.
    fn gradient(&self, input: usize, x: &[&Tensor<T>], g: &Tensor<T>, pool: &Pool<T>) -> Tensor<T>;

    /// The same of unfused operations, from which its derivatives follow. `x[input]` may be a constant.
    fn recorded<'t>(&self, input: usize, x: &[Var<'t, T>], g: &Var<'t, T>) -> Option<Var<'t, T>> {
        let mut x = x.to_vec();
        x[input] = x[input].tracked();
        Some(self.reference(&x)?.vjp(g, &[&x[input]]).remove(0))
    }
}

/// The gradient of one input, as an operation of all inputs and the gradient of the output.
///
/// Recorded gradients then have the accuracy and the speed of the kernel. Their derivatives go through
/// [`recorded`](FusedGradient::recorded).
#[derive(Clone)]
pub struct GradientOp<O> {
    /// The operation.
    pub op: O,
    /// The input.
    pub input: usize,
}

impl<T: Scalar, O: FusedGradient<T>> Op<T> for GradientOp<O> {
    fn name(&self) -> &'static str {
        O::GRADIENT
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        let Some((g, x)) = x.split_last() else { return Err("there is no gradient".into()) };
        if self.op.shape(x)?[..] != **g {
            return Err("the gradient must have the shape of the result".into());
        }
        Ok(Shape::from_slice(x[self.input]))
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let (g, x) = (x[x.len() - 1], &x[..x.len() - 1]);
        self.op.gradient(self.input, x, g, pool)
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        // On a tape of its own, since this pass is not recorded.
        let tape = cx.tape().nested();
        let x: Vec<_> = (0..cx.len()).map(|i| tape.leaf(cx.x(i).into_value())).collect();
        let wanted: Vec<_> = (0..cx.len()).filter(|&i| cx.needs(i)).map(|i| &x[i]).collect();
        let Some(dx) = self.reference(&x) else { unreachable!("a fused operation has a reference") };
        let h = tape.constant(cx.g().value().clone());
        let mut grads = tape.no_grad(|| dx.tracked().vjp(&h, &wanted)).into_iter();
        let mut next = || grads.next().map(|grad| cx.constant(grad.into_value()));
        Grads::new((0..cx.len()).map(|i| if cx.needs(i) { next() } else { None }))
    }

    fn is_fused(&self) -> bool {
        true
    }

    fn reference<'t>(&self, x: &[Var<'t, T>]) -> Option<Var<'t, T>> {
        let (g, x) = x.split_last()?;
        self.op.recorded(self.input, x, g)
    }
}

#[cfg(test)]
mod tests {
    use super::GradientOp;
    use crate::ops::vector::Normalize;
    use crate::{Tape, Tensor};

    #[test]
    #[should_panic(expected = "the gradient must have the shape of the result")]
    fn gradients_of_another_shape_are_refused() {
        let tape = Tape::<f32>::new();
        let [x, g] = [[2, 3], [3, 2]].map(|shape| tape.constant(Tensor::ones(&shape)));
        let _ = tape.apply(GradientOp { op: Normalize, input: 0 }, &[&x, &g]);
    }
}
