//! A function made of operations, wrapped as one operation, so that the same checks apply to it.

use super::Entry;
use crate::{Grads, Op, ShapeError, Tape, Var, Vjp};
use raygrad_tensor::{Pool, Scalar, Shape, Tensor};

/// A function of variables that may be called on any tape.
type Function<T> = dyn for<'t> Fn(&[Var<'t, T>]) -> Var<'t, T> + Send + Sync;

/// A function as an operation. It is in a box, so that this is compiled once for each scalar type.
struct Composed<T: Scalar> {
    name: &'static str,
    f: Box<Function<T>>,
}

impl<T: Scalar> Op<T> for Composed<T> {
    fn name(&self) -> &'static str {
        self.name
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        let tape = Tape::new();
        let zeros: Vec<_> = x.iter().map(|shape| tape.leaf(Tensor::zeros(shape))).collect();
        Ok((self.f)(&zeros).shape().into())
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let tape = Tape::with_pool(pool.clone());
        // Leaves, so that `f` may take gradients.
        let x: Vec<_> = x.iter().map(|&x| tape.leaf(x.clone())).collect();
        (self.f)(&x).into_value()
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        let tape = Tape::with_pool(cx.pool().clone());
        let x: Vec<_> = (0..cx.len()).map(|i| tape.leaf(cx.x(i).into_value())).collect();
        let grads = (self.f)(&x).tracked().vjp(&tape.constant(cx.g().value().clone()), &x.iter().collect::<Vec<_>>());
        Grads::new(grads.into_iter().map(|grad| Some(cx.constant(grad.into_value()))))
    }

    fn is_fused(&self) -> bool {
        true
    }

    fn reference<'t>(&self, x: &[Var<'t, T>]) -> Option<Var<'t, T>> {
        Some((self.f)(&x.iter().map(Var::tracked).collect::<Vec<_>>()))
    }
}

impl Entry {
    /// An entry for a function made of operations, given once for each precision. The checks treat it as one operation.
    ///
    /// ```
    /// use raygrad_autograd::check::{Check, Entry, check_op};
    /// let entry = Entry::function("swish", |x| &x[0] * x[0].sigmoid(), |x| &x[0] * x[0].sigmoid());
    /// check_op(&Check::default(), &entry.sample(&[&[2, 3]])).unwrap();
    /// ```
    pub fn function(
        name: &'static str,
        f64: impl for<'t> Fn(&[Var<'t, f64>]) -> Var<'t, f64> + Send + Sync + 'static,
        f32: impl for<'t> Fn(&[Var<'t, f32>]) -> Var<'t, f32> + Send + Sync + 'static,
    ) -> Self {
        Entry::of(Composed::<f64> { name, f: Box::new(f64) }, Composed::<f32> { name, f: Box::new(f32) })
    }
}
