//! The gradient of a fused operation, as an operation.

use crate::{Grads, Op, ShapeError, Var, Vjp};
use raygrad_tensor::scale::power_of_two;
use raygrad_tensor::{Pool, Scalar, Shape, Tensor, simd};
use std::any::Any;

/// An operation with a kernel for its gradients.
pub(crate) trait FusedGradient<T: Scalar>: Op<T> + Clone {
    /// The name of the gradients.
    const GRADIENT: &'static str;
    /// Whether derivatives of the gradients are always in f64.
    const WIDENS: bool = false;

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
/// [`recorded`](FusedGradient::recorded), in f64 where those of the type are not finite: factors of a derivative may
/// leave the range of f32 where their product does not.
#[derive(Clone)]
pub struct GradientOp<O> {
    /// The operation.
    pub op: O,
    /// The input.
    pub input: usize,
}

impl<T: Scalar, O: FusedGradient<T> + FusedGradient<f64>> Op<T> for GradientOp<O> {
    fn name(&self) -> &'static str {
        <O as FusedGradient<T>>::GRADIENT
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        let Some((g, x)) = x.split_last() else { return Err("there is no gradient".into()) };
        if Op::<T>::shape(&self.op, x)?[..] != **g {
            return Err("the gradient must have the shape of the result".into());
        }
        Ok(Shape::from_slice(x[self.input]))
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let (g, x) = (x[x.len() - 1], &x[..x.len() - 1]);
        self.op.gradient(self.input, x, g, pool)
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        if !<O as FusedGradient<T>>::WIDENS {
            let grads = nested::<T, T>(cx, |x| self.reference(x));
            if size_of::<T>() > 4 || grads.iter().flatten().all(Tensor::is_finite) {
                return given(cx, grads);
            }
        }
        given(cx, nested::<T, f64>(cx, |x| self.reference(x)))
    }

    fn is_fused(&self) -> bool {
        true
    }

    fn reference<'t>(&self, x: &[Var<'t, T>]) -> Option<Var<'t, T>> {
        let (g, x) = x.split_last()?;
        self.op.recorded(self.input, x, g)
    }
}

/// Whether an element is far from 1, so that ordinary products of it and some others may leave the range: above 2^30, or
/// below 2^-63 and not 0. In f64, above 2^300 or below 2^-300.
pub(crate) fn has_far<T: Scalar>(x: &Tensor<T>) -> bool {
    let ends = if size_of::<T>() == 4 { [-63, 30] } else { [-300, 300] };
    let [least, most] = ends.map(|exponent| T::from_f64(power_of_two(exponent)));
    let has = |values: &[T]| {
        simd::dispatch(
            #[inline(always)]
            || {
                // A block has no early end, so that it is vectorised.
                let is_far = |x: T| (x.abs() > most) | ((x.abs() < least) & (x != T::ZERO));
                values.chunks(1024).any(|block| block.iter().fold(false, |any, &x| any | is_far(x)))
            },
        )
    };
    if x.buffer().len() == 1 || x.is_packed() {
        return has(if x.is_packed() { x.as_slice() } else { x.buffer() });
    }
    // Repeated elements count once, and an order of elements without gaps needs no copy.
    let layout = x.layout();
    let is_repeated = |&axis: &usize| layout.strides()[axis] == 0 && layout.shape()[axis] > 1;
    let once = (0..x.ndim()).filter(is_repeated).fold(x.clone(), |x, axis| x.slice_axis(axis as isize, 0..1));
    has(if once.buffer().len() == once.len() { once.buffer() } else { once.as_slice() })
}

/// The gradients of the inputs by a `reference` in numbers of type `U`. On a tape of its own, so the pass must not be
/// recorded.
fn nested<T: Scalar, U: Scalar>(
    cx: &Vjp<'_, '_, T>,
    reference: impl for<'n> FnOnce(&[Var<'n, U>]) -> Option<Var<'n, U>>,
) -> Vec<Option<Tensor<T>>> {
    let tape = cx.tape().nested();
    // Values on the way may overflow. The results are checked as those of any gradient.
    tape.check_finite(false);
    let x: Vec<_> = (0..cx.len()).map(|i| tape.leaf(cast(cx.x(i).value()))).collect();
    let wanted: Vec<_> = (0..cx.len()).filter(|&i| cx.needs(i)).map(|i| &x[i]).collect();
    let Some(y) = reference(&x) else { unreachable!("a fused operation has a reference") };
    let h = tape.constant(cast(cx.g().value()));
    let mut grads = tape.no_grad(|| y.tracked().vjp(&h, &wanted)).into_iter();
    let mut next = || grads.next().map(|grad| cast(grad.value()));
    (0..cx.len()).map(|i| if cx.needs(i) { next() } else { None }).collect()
}

fn given<'t, T: Scalar>(cx: &Vjp<'t, '_, T>, grads: Vec<Option<Tensor<T>>>) -> Grads<'t, T> {
    Grads::new(grads.into_iter().map(|grad| grad.map(|grad| cx.constant(grad))))
}

/// The tensor itself if it has the type, else a copy.
fn cast<T: Scalar, U: Scalar>(x: &Tensor<T>) -> Tensor<U> {
    (x as &dyn Any).downcast_ref().cloned().unwrap_or_else(|| x.cast())
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
