//! Gradients of a variable with respect to other variables.

use crate::sum::Sum;
use crate::sweep::{Keep, sweep};
use crate::{Error, Gradient, Tape, Var};
use raygrad_tensor::{Scalar, Shape, Tensor};
use std::panic::Location;

impl<'t, T: Scalar> Var<'t, T> {
    /// The gradients of this one-element tensor with respect to `wrt`, in their order (`torch.autograd.grad`). A
    /// gradient is zero where this tensor does not depend on the variable. The graph stays, so further gradients can be
    /// taken.
    ///
    /// # Panics
    /// If this tensor has not exactly one element, or if the graph was freed. If this tensor or one of `wrt` is a
    /// constant, which has no gradient, or if one of `wrt` belongs to another tape. If [`Tape::check_finite`] is on and
    /// finds a value that is not finite.
    #[track_caller]
    pub fn grad(&self, wrt: &[&Var<'t, T>]) -> Vec<Tensor<T>> {
        self.tape.or_raise(self.try_grad(wrt))
    }

    /// As [`grad`](Self::grad), with an error instead of a panic.
    ///
    /// # Errors
    /// Where [`grad`](Self::grad) panics, except for a variable of another tape.
    ///
    /// # Panics
    /// If one of `wrt` belongs to another tape.
    #[track_caller]
    pub fn try_grad(&self, wrt: &[&Var<'t, T>]) -> Result<Vec<Tensor<T>>, Error> {
        let sums = self.sums(self.seed()?, wrt, Keep::Graph)?;
        let value = |(sum, x): (_, &&Var<'t, T>)| dense(sum, x.shape(), self.tape).value;
        Ok(sums.into_iter().zip(wrt).map(value).collect())
    }

    /// The gradients for a training step: as [`grad`](Self::grad), but it frees the graph and keeps sparse gradients
    /// sparse.
    ///
    /// Each [`Gradient`] keeps sparse contributions, such as the rows of a table, apart from the dense sum. The
    /// backward pass frees each saved value after its last use, so that the pool can reuse its buffer. For all other
    /// purposes use [`grad`](Self::grad).
    ///
    /// ```
    /// use raygrad_autograd::{Tape, Tensor};
    /// let tape = Tape::<f64>::new();
    /// let x = tape.leaf(Tensor::scalar(3.0));
    /// let y = x.square();
    /// let gradient = y.backward(&[&x]).remove(0);
    /// assert_eq!(gradient.into_dense(tape.pool()).item(), 6.0);
    /// assert!(y.try_grad(&[&x]).is_err()); // the graph is gone
    /// ```
    ///
    /// # Panics
    /// As [`grad`](Self::grad).
    #[track_caller]
    pub fn backward(&self, wrt: &[&Var<'t, T>]) -> Vec<Gradient<T>> {
        self.tape.or_raise(self.try_backward(wrt))
    }

    /// As [`backward`](Self::backward), with an error instead of a panic.
    ///
    /// # Errors
    /// As [`try_grad`](Self::try_grad).
    ///
    /// # Panics
    /// As [`try_grad`](Self::try_grad).
    #[track_caller]
    pub fn try_backward(&self, wrt: &[&Var<'t, T>]) -> Result<Vec<Gradient<T>>, Error> {
        let sums = self.sums(self.seed()?, wrt, Keep::Nothing)?;
        Ok(sums.into_iter().zip(wrt).map(|(sum, x)| Sum::gradient(sum, x.shape())).collect())
    }

    /// The gradients as variables on the graph, which can be differentiated again (PyTorch's `create_graph`). In
    /// [`Tape::no_grad`] they are constants.
    ///
    /// ```
    /// use raygrad_autograd::Tape;
    /// use raygrad_tensor::Tensor;
    /// let tape = Tape::<f64>::new();
    /// let x = tape.leaf(Tensor::scalar(0.5));
    /// let mut y = x.sin();
    /// for _ in 0..3 {
    ///     y = y.grad_graph(&[&x]).remove(0);
    /// }
    /// assert!((y.item() + 0.5_f64.cos()).abs() < 1e-15); // the third derivative of sin is -cos
    /// ```
    ///
    /// # Panics
    /// As [`grad`](Self::grad).
    #[track_caller]
    #[doc(alias = "create_graph")]
    pub fn grad_graph(&self, wrt: &[&Var<'t, T>]) -> Vec<Var<'t, T>> {
        self.tape.or_raise(self.try_grad_graph(wrt))
    }

    /// As [`grad_graph`](Self::grad_graph), with an error instead of a panic.
    ///
    /// # Errors
    /// As [`try_grad`](Self::try_grad).
    ///
    /// # Panics
    /// As [`try_grad`](Self::try_grad).
    #[track_caller]
    pub fn try_grad_graph(&self, wrt: &[&Var<'t, T>]) -> Result<Vec<Var<'t, T>>, Error> {
        self.recorded(self.seed()?, wrt)
    }

    /// The vector-Jacobian product: the gradients of `sum(self * seed)` with respect to `wrt`. They are variables on
    /// the graph, as those of [`grad_graph`](Self::grad_graph). This tensor may have any shape.
    ///
    /// # Panics
    /// If `seed` has another shape than this tensor or belongs to another tape, and where [`grad`](Self::grad) panics,
    /// except for the number of elements.
    #[track_caller]
    pub fn vjp(&self, seed: &Var<'t, T>, wrt: &[&Var<'t, T>]) -> Vec<Var<'t, T>> {
        self.tape.or_raise(self.try_vjp(seed, wrt))
    }

    /// As [`vjp`](Self::vjp), with an error instead of a panic.
    ///
    /// # Errors
    /// If `seed` has another shape than this tensor, and where [`try_grad`](Self::try_grad) fails, except for the
    /// number of elements.
    ///
    /// # Panics
    /// If `seed` belongs to another tape, and as [`try_grad`](Self::try_grad).
    #[track_caller]
    pub fn try_vjp(&self, seed: &Var<'t, T>, wrt: &[&Var<'t, T>]) -> Result<Vec<Var<'t, T>>, Error> {
        if seed.shape() != self.shape() {
            return Err(Error::Shape {
                op: "vjp",
                shapes: [self, seed].map(|x| Shape::from_slice(x.shape())).into(),
                what: "the seed of a vector-Jacobian product has the shape of the output".into(),
                at: Location::caller(),
            });
        }
        self.recorded(seed.clone(), wrt)
    }

    #[track_caller]
    fn seed(&self) -> Result<Var<'t, T>, Error> {
        if self.value.len() != 1 {
            return Err(Error::NotScalar { shape: self.shape().into(), at: Location::caller() });
        }
        Ok(self.tape.constant(self.tape.pool().full(self.shape(), T::ONE)))
    }

    /// The gradients as variables, all of them on the graph if the tape records. A constant gradient can be
    /// differentiated again too; its gradient is zero.
    #[track_caller]
    fn recorded(&self, seed: Var<'t, T>, wrt: &[&Var<'t, T>]) -> Result<Vec<Var<'t, T>>, Error> {
        let sums = self.sums(seed, wrt, Keep::GraphAndGradients)?;
        let gradient = |(sum, x): (_, &&Var<'t, T>)| {
            let gradient = dense(sum, x.shape(), self.tape);
            if self.tape.is_recording() { gradient.tracked() } else { gradient.detach() }
        };
        Ok(sums.into_iter().zip(wrt).map(gradient).collect())
    }

    /// The backward pass from this variable, if it and all of `wrt` can have a gradient.
    #[track_caller]
    fn sums(&self, seed: Var<'t, T>, wrt: &[&Var<'t, T>], keep: Keep) -> Result<Vec<Option<Sum<'t, T>>>, Error> {
        assert!(std::ptr::eq(seed.tape, self.tape), "a gradient with a seed of another tape");
        self.check_graph(wrt)?;
        sweep(self, seed, wrt, keep, false, Location::caller())
    }

    /// Checks that this variable and all of `wrt` are on the graph of one tape.
    #[track_caller]
    pub(crate) fn check_graph(&self, wrt: &[&Var<'t, T>]) -> Result<(), Error> {
        let at = Location::caller();
        for x in wrt {
            assert!(std::ptr::eq(x.tape, self.tape), "a gradient with respect to a variable of another tape");
        }
        if self.node.is_none() {
            return Err(Error::OfConstant { at });
        }
        wrt.iter().position(|x| x.node.is_none()).map_or(Ok(()), |index| Err(Error::ByConstant { index, at }))
    }
}

fn dense<'t, T: Scalar>(sum: Option<Sum<'t, T>>, shape: &[usize], tape: &'t Tape<T>) -> Var<'t, T> {
    match sum {
        Some(sum) => sum.dense(tape),
        None => tape.constant(tape.pool().full(shape, T::ZERO)),
    }
}
