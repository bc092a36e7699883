//! Parameters on a tape.

use super::{Names, ParamId};
use raygrad_autograd::{Gradient, Tape, Var};
use raygrad_tensor::Scalar;
use std::ops::Index;
use std::sync::Arc;

/// The names of a store's parameters and the handles that fit them, without values: it puts variables in the place of
/// parameters, in a check of a whole model or inside a checkpoint. A clone is a reference count.
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
    /// Variables in place of the parameters, in the order of the store.
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
    /// None where nothing tells.
    pub(super) tape: Option<&'t Tape<T>>,
}

impl<'t, T: Scalar> Bound<'t, T> {
    /// The parameters that gradients can be taken with respect to, in the order of the store: those that are not frozen.
    pub fn vars(&self) -> Vec<&Var<'t, T>> {
        self.vars.iter().filter(|var| var.is_on_graph()).collect()
    }

    /// The gradients of a one-element tensor, one for each parameter that is not frozen: what
    /// [`Optimizer::update`](crate::Optimizer::update) takes.
    ///
    /// This is the end of a training step. The parameters are given up and everything that the tape has recorded is freed
    /// with the values that it holds, so that an update moves the parameters where they are; a parameter that something
    /// still holds is copied first. Values of variables can be read on, but not differentiated. Where more than this is
    /// to be done with the graph, there is [`Var::backward`](raygrad_autograd::Var::backward) of [`vars`](Self::vars).
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
    /// As [`Var::grad`](raygrad_autograd::Var::grad).
    #[track_caller]
    pub fn backward(self, loss: &Var<'t, T>) -> Vec<Gradient<T>> {
        let wanted = self.vars();
        let grads = if wanted.is_empty() { vec![] } else { loss.backward(&wanted) };
        loss.tape().free();
        grads
    }

    /// The tape that the parameters are on.
    ///
    /// # Panics
    /// If there is no parameter to tell, in what [`ParamLayout::bind`] gave.
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
    /// If the handle is that of another store.
    #[track_caller]
    fn index(&self, id: ParamId) -> &Var<'t, T> {
        &self.vars[self.names.place(id)]
    }
}
