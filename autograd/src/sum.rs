//! The gradient that accumulates at a node during a backward pass.

use crate::op::Given;
use crate::tape::find_non_finite;
use crate::{Error, Gradient, SparseGrad, Tape, Var};
use raygrad_tensor::{Scalar, Tensor};
use std::panic::Location;
use std::sync::Arc;

/// The contributions to a gradient so far.
#[derive(Clone)]
pub(crate) enum Sum<'t, T: Scalar> {
    /// The sum of dense contributions.
    Dense(Var<'t, T>),
    /// The dense sum, if there is one, and sparse contributions in the order of their arrival.
    Mixed(Option<Var<'t, T>>, Vec<Arc<dyn SparseGrad<T>>>),
    /// Contributions that the caller adds, in the order of their arrival.
    Apart(Vec<Given<'t, T>>),
}

impl<'t, T: Scalar> Sum<'t, T> {
    /// Adds `given`, a contribution to a gradient of this shape.
    pub fn gather(sum: &mut Option<Self>, given: Given<'t, T>, shape: &[usize], tape: &'t Tape<T>) {
        match (&mut *sum, given) {
            (_, Given::Parts(parts)) => parts.into_iter().for_each(|part| Sum::gather(sum, part, shape, tape)),
            (Some(Sum::Apart(parts)), given) => parts.push(given),
            (None, Given::Dense(grad)) => *sum = Some(Sum::Dense(grad)),
            (Some(Sum::Dense(sum) | Sum::Mixed(Some(sum), _)), Given::Dense(grad)) => add(sum, grad),
            (Some(Sum::Mixed(dense, _)), Given::Dense(grad)) => *dense = Some(grad),
            (_, Given::Sparse(share)) => {
                let (mut dense, mut sparse) = match sum.take() {
                    Some(Sum::Dense(dense)) => (Some(dense), vec![]),
                    Some(Sum::Mixed(dense, sparse)) => (dense, sparse),
                    _ => (None, vec![]),
                };
                if share.is_passing() {
                    let sum = dense.get_or_insert_with(|| tape.constant(tape.pool().full(shape, T::ZERO)));
                    share.add_to(&mut sum.value);
                    assert_eq!(sum.shape(), shape, "the shape of a gradient after `SparseGrad::add_to`");
                } else {
                    sparse.push(share);
                }
                *sum = Some(match dense {
                    Some(dense) if sparse.is_empty() => Sum::Dense(dense),
                    dense => Sum::Mixed(dense, sparse),
                });
            }
        }
    }

    /// The sum as one variable.
    pub fn dense(self, tape: &'t Tape<T>) -> Var<'t, T> {
        match self {
            Sum::Dense(sum) => sum,
            Sum::Mixed(dense, sparse) => tape.constant(gradient(dense, sparse).into_dense(tape.pool())),
            Sum::Apart(_) => unreachable!("shares are left apart at leaves only"),
        }
    }

    /// The gradient of a variable of this shape.
    pub fn gradient(sum: Option<Self>, shape: &[usize]) -> Gradient<T> {
        match sum {
            None => Gradient::zero(shape),
            Some(Sum::Dense(sum)) => Gradient::from(sum.value),
            Some(Sum::Mixed(dense, sparse)) => gradient(dense, sparse),
            Some(Sum::Apart(_)) => unreachable!("shares are left apart for a checkpoint only"),
        }
    }

    /// An error for the first element that is not finite.
    pub fn check(
        &self,
        tape: &'t Tape<T>,
        what: &str,
        op: &'static str,
        at: &'static Location<'static>,
    ) -> Result<(), Error> {
        match self {
            Sum::Dense(sum) => find_non_finite(op, what, &sum.value, at),
            Sum::Mixed(..) => find_non_finite(op, what, &self.clone().dense(tape).value, at),
            Sum::Apart(_) => Ok(()),
        }
    }
}

fn gradient<T: Scalar>(dense: Option<Var<'_, T>>, sparse: Vec<Arc<dyn SparseGrad<T>>>) -> Gradient<T> {
    let shape = dense.as_ref().map(Var::shape).or(sparse.first().map(|share| share.shape()));
    let mut gradient = Gradient::zero(shape.unwrap_or(&[]));
    dense.into_iter().for_each(|dense| gradient.add_dense(dense.value));
    sparse.into_iter().for_each(|share| gradient.add_sparse(share));
    gradient
}

/// Adds `share` as a recorded operation if the tape records, else in place.
fn add<'t, T: Scalar>(sum: &mut Var<'t, T>, share: Var<'t, T>) {
    if sum.tape.is_recording() {
        *sum = &*sum + share;
    } else {
        add_share(&mut sum.value, &share.value);
    }
}

/// Adds a dense contribution to a sum of the same shape.
pub(crate) fn add_share<T: Scalar>(sum: &mut Tensor<T>, share: &Tensor<T>) {
    if share.len() == 1 {
        // The loop is not worth its start.
        sum.as_mut_slice()[0] += share.item();
    } else {
        *sum += share;
    }
}
