//! A variable: a value and its place on the tape.

use crate::{ShapeError, Tape};
use raygrad_tensor::{Axes, Reduction, Scalar, Tensor, find_axis};
use std::fmt;

/// A variable: a tensor on a tape. Cloning is cheap: it copies a reference.
///
/// Operators work on references and values. Each operand is a variable, a tensor or a number, with NumPy's
/// broadcasting. Tensors and numbers become constants ([`Operand`](crate::Operand)).
#[derive(Clone)]
pub struct Var<'t, T: Scalar> {
    pub(crate) tape: &'t Tape<T>,
    pub(crate) value: Tensor<T>,
    /// None for a constant.
    pub(crate) node: Option<u32>,
}

impl<'t, T: Scalar> Var<'t, T> {
    /// The value of this variable.
    pub fn value(&self) -> &Tensor<T> {
        &self.value
    }

    /// The value of this variable, without its place on the tape.
    pub fn into_value(self) -> Tensor<T> {
        self.value
    }

    /// The shape of the value.
    pub fn shape(&self) -> &[usize] {
        self.value.shape()
    }

    /// The one element of a one-element value.
    ///
    /// # Panics
    /// If the value has not exactly one element.
    #[track_caller]
    pub fn item(&self) -> T {
        self.value.item()
    }

    /// The tape of this variable.
    pub fn tape(&self) -> &'t Tape<T> {
        self.tape
    }

    /// The same value as a constant: gradients do not flow through it.
    pub fn detach(&self) -> Self {
        self.tape.constant(self.value.clone())
    }

    /// This variable if it is on the graph, else a new leaf with the same value. Use it in functions that differentiate
    /// by an argument which may be a constant; [`Tape::enable_grad`] has an example.
    #[track_caller]
    pub fn tracked(&self) -> Self {
        match self.node {
            Some(_) => self.clone(),
            None => self.tape.unchecked_leaf(self.value.clone(), self.tape.line()),
        }
    }

    /// A scalar constant on the same tape.
    pub fn constant(&self, value: f64) -> Self {
        self.tape.constant(self.tape.pool().full(&[], T::from_f64(value)))
    }

    /// The value, or the mismatch of this input of operation `op`, raised as an error of the tape.
    #[track_caller]
    pub(crate) fn fits<R>(&self, op: &'static str, result: Result<R, ShapeError>) -> R {
        self.tape.fits(op, &[self], result)
    }

    /// The index of an axis; negative numbers count from the last axis.
    #[track_caller]
    pub(crate) fn axis(&self, op: &'static str, axis: isize) -> usize {
        self.fits(op, find_axis(axis, self.shape()))
    }

    /// The axes of a reduction.
    #[track_caller]
    pub(crate) fn axes(&self, op: &'static str, axes: impl Into<Axes>) -> Reduction {
        self.fits(op, axes.into().find(self.shape()))
    }

    /// Whether this variable is on the graph, so that gradients can flow to it.
    pub fn is_on_graph(&self) -> bool {
        self.node.is_some()
    }
}

impl<T: Scalar> fmt::Debug for Var<'_, T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.node {
            Some(node) => write!(f, "Var #{node} {:?}", self.value),
            None => write!(f, "Var constant {:?}", self.value),
        }
    }
}
