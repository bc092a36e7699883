//! Parameters on a tape.

use super::{Names, ParamId};
use raygrad_autograd::{Gradient, Tape, Var};
use raygrad_tensor::Scalar;
use std::ops::Index;
use std::sync::Arc;

/// The names and handles of a store, without values. It binds variables in place of parameters, to check a whole model
/// or inside a checkpoint. Cloning copies a reference.
///
/// ```
/// use raygrad_autograd::{Tape, Tensor};
/// use raygrad_nn::Params;
/// let mut params = Params::<f64>::new();
/// let weight = params.add("weight", Tensor::full(&[2], 3.0));
/// let layout = params.layout();
/// let tape = Tape::new();
/// let x = tape.leaf(Tensor::full(&[2], 0.5));
/// let y = tape.checkpoint(&[&x], move |x| layout.bind(x.to_vec())[weight].square().sum());
/// assert_eq!(y.item(), 0.5);
/// ```
#[derive(Debug, Clone)]
pub struct ParamLayout(pub(super) Arc<Names>);

impl ParamLayout {
    /// Binds variables in place of the parameters, in the order of the store.
    ///
    /// # Panics
    /// If there is not one for each parameter.
    #[track_caller]
    pub fn bind<'t, T: Scalar>(&self, vars: Vec<Var<'t, T>>) -> Bound<'t, T> {
        assert_eq!(vars.len(), self.0.names.len(), "one variable for each parameter");
        Bound { names: self.0.clone(), tape: vars.first().map(|var| var.tape()), vars }
    }
}

/// Parameters on a tape; index it with a [`ParamId`].
#[derive(Debug)]
pub struct Bound<'t, T: Scalar> {
    pub(super) names: Arc<Names>,
    pub(super) vars: Vec<Var<'t, T>>,
    /// None if there are no parameters.
    pub(super) tape: Option<&'t Tape<T>>,
}

impl<'t, T: Scalar> Bound<'t, T> {
    /// The parameters that are not frozen, in the order of the store. Gradients can be taken with respect to these.
    pub fn vars(&self) -> Vec<&Var<'t, T>> {
        self.vars.iter().filter(|var| var.is_on_graph()).collect()
    }

    /// The gradients of a one-element tensor, one for each parameter that is not frozen, in the order of the store.
    /// They are for [`Optimizer::update`](crate::Optimizer::update). [`Params::grad`](crate::Params::grad) finds that
    /// of a handle.
    ///
    /// This ends a training step. It drops the bound parameters and frees the recorded operations with the values that
    /// they hold. So an update changes the parameters in place; it copies a parameter first if other code still holds
    /// it. Variables keep their values, but cannot be differentiated any more. To use the graph further, call
    /// [`Var::backward`](raygrad_autograd::Var::backward) with [`vars`](Self::vars).
    ///
    /// ```
    /// use raygrad_autograd::{Tape, Tensor};
    /// use raygrad_nn::{Adam, AdamConfig, Optimizer, Params};
    /// let mut params = Params::<f32>::new();
    /// let x = params.add("x", Tensor::full(&[2], 3.0));
    /// let mut adam = Adam::new(AdamConfig::default());
    /// let tape = Tape::new();
    /// let bound = params.bind(&tape);
    /// let loss = bound[x].square().sum();
    /// let grads = bound.backward(&loss);
    /// let place = params.get(x).as_slice().as_ptr();
    /// let moved = adam.update(&mut params, &grads, 0.1).check();
    /// assert_eq!((moved, params.get(x).as_slice().as_ptr()), (Ok(2), place));
    /// ```
    ///
    /// # Panics
    /// Where [`Var::grad`](raygrad_autograd::Var::grad) panics.
    #[track_caller]
    pub fn backward(self, loss: &Var<'t, T>) -> Vec<Gradient<T>> {
        let wanted = self.vars();
        let grads = if wanted.is_empty() { vec![] } else { loss.backward(&wanted) };
        loss.tape().free();
        grads
    }

    /// The tape of the parameters.
    ///
    /// # Panics
    /// If [`ParamLayout::bind`] made this without any variables.
    #[track_caller]
    pub fn tape(&self) -> &'t Tape<T> {
        self.tape.unwrap_or_else(|| panic!("the tape of no parameters"))
    }
}

impl<'t, T: Scalar> Index<ParamId> for Bound<'t, T> {
    type Output = Var<'t, T>;

    /// The parameter of a handle.
    ///
    /// # Panics
    /// If the handle belongs to another store.
    #[track_caller]
    fn index(&self, id: ParamId) -> &Var<'t, T> {
        &self.vars[self.names.place(id)]
    }
}
