//! The backward sweep: from the root down the tape, visiting only what leads to the wanted gradients.

use crate::op::Given;
use crate::tape::{LEAF, find_non_finite};
use crate::{Error, Gradient, Grads, Op, SparseGrad, Tape, Var, Vjp};
use raygrad_tensor::{Scalar, Tensor, add_assign};
use smallvec::SmallVec;
use std::panic::Location;
use std::sync::Arc;

/// What a sweep leaves behind.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Keep {
    /// The graph stays as it is.
    Graph,
    /// Saved values are freed as the sweep passes.
    Nothing,
    /// The graph stays, and the gradients are recorded on it.
    GraphAndGradients,
}

impl<'t, T: Scalar> Var<'t, T> {
    /// The gradients of this one-element tensor with respect to `wrt`; zeros where it does not depend on one. The graph
    /// stays, so further gradients can be taken.
    ///
    /// # Panics
    /// If this tensor has not exactly one element, the graph was freed, or the NaN finder is on and finds something.
    #[track_caller]
    pub fn grad(&self, wrt: &[&Var<'t, T>]) -> Vec<Tensor<T>> {
        or_panic(self.try_grad(wrt))
    }

    /// As [`grad`](Self::grad), with an error instead of a panic.
    ///
    /// # Errors
    /// If this tensor has not exactly one element, the graph was freed, or the NaN finder is on and finds something.
    #[track_caller]
    pub fn try_grad(&self, wrt: &[&Var<'t, T>]) -> Result<Vec<Tensor<T>>, Error> {
        Ok(values(self.tape, sweep(self, self.seed()?, wrt, Keep::Graph)?))
    }

    /// As [`grad`](Self::grad), but frees the saved values as the sweep passes, so that their buffers serve again at
    /// once: what a training step wants.
    ///
    /// # Panics
    /// As [`grad`](Self::grad).
    #[track_caller]
    pub fn grad_once(&self, wrt: &[&Var<'t, T>]) -> Vec<Tensor<T>> {
        or_panic(self.try_grad_once(wrt))
    }

    /// As [`grad_once`](Self::grad_once), with an error instead of a panic.
    ///
    /// # Errors
    /// As [`try_grad`](Self::try_grad).
    #[track_caller]
    pub fn try_grad_once(&self, wrt: &[&Var<'t, T>]) -> Result<Vec<Tensor<T>>, Error> {
        Ok(values(self.tape, sweep(self, self.seed()?, wrt, Keep::Nothing)?))
    }

    /// The gradients of this one-element tensor with respect to `wrt` in the form in which operations give them: sparse
    /// shares, such as the rows of a table, stay apart. Frees the saved values as the sweep passes, so that their buffers
    /// serve again at once: what a training step wants.
    ///
    /// # Panics
    /// As [`grad`](Self::grad).
    #[track_caller]
    pub fn backward(&self, wrt: &[&Var<'t, T>]) -> Vec<Gradient<T>> {
        or_panic(self.try_backward(wrt))
    }

    /// As [`backward`](Self::backward), with an error instead of a panic.
    ///
    /// # Errors
    /// As [`try_grad`](Self::try_grad).
    #[track_caller]
    pub fn try_backward(&self, wrt: &[&Var<'t, T>]) -> Result<Vec<Gradient<T>>, Error> {
        let sums = sums(self, self.seed()?, wrt, Keep::Nothing, false)?;
        let gradient = |(sum, x): (Option<Sum<'t, T>>, &&Var<'t, T>)| {
            let mut gradient = Gradient::zero(x.shape());
            if let Some(Sum::Added(dense, sparse)) = sum {
                dense.into_iter().for_each(|dense| gradient.add_dense(dense.value));
                sparse.into_iter().for_each(|share| gradient.add_sparse(share));
            }
            gradient
        };
        Ok(sums.into_iter().zip(wrt).map(gradient).collect())
    }

    /// The gradients as variables on the graph: they can be differentiated again.
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
    pub fn grad_graph(&self, wrt: &[&Var<'t, T>]) -> Vec<Var<'t, T>> {
        let sums = or_panic(sweep(self, or_panic(self.seed()), wrt, Keep::GraphAndGradients));
        sums.into_iter().map(|sum| sum.dense(self.tape)).collect()
    }

    /// The vector-Jacobian product: the gradients of `sum(self * seed)` with respect to `wrt`, recorded on the graph.
    ///
    /// # Panics
    /// If `seed` has another shape than this tensor, and as [`grad`](Self::grad).
    #[track_caller]
    pub fn vjp(&self, seed: &Var<'t, T>, wrt: &[&Var<'t, T>]) -> Vec<Var<'t, T>> {
        assert_eq!(seed.shape(), self.shape(), "the seed of a vector-Jacobian product has the shape of the output");
        let sums = or_panic(sweep(self, seed.clone(), wrt, Keep::GraphAndGradients));
        sums.into_iter().map(|sum| sum.dense(self.tape)).collect()
    }

    /// The vector-Jacobian product without a record of it: the gradients of `sum(self * seed)` with respect to `wrt`.
    ///
    /// # Panics
    /// If `seed` has another shape than this tensor, and as [`grad`](Self::grad).
    #[track_caller]
    pub fn grad_with(&self, seed: &Tensor<T>, wrt: &[&Var<'t, T>]) -> Vec<Tensor<T>> {
        assert_eq!(seed.shape(), self.shape(), "the seed of a vector-Jacobian product has the shape of the output");
        values(self.tape, or_panic(sweep(self, self.tape.constant(seed.clone()), wrt, Keep::Graph)))
    }

    #[track_caller]
    fn seed(&self) -> Result<Var<'t, T>, Error> {
        if self.value.len() != 1 {
            return Err(Error::NotScalar { shape: self.shape().into(), at: Location::caller() });
        }
        Ok(self.tape.constant(self.tape.pool().full(self.shape(), T::ONE)))
    }
}

#[track_caller]
fn or_panic<R>(result: Result<R, Error>) -> R {
    match result {
        Ok(value) => value,
        Err(error) => panic!("{error}"),
    }
}

fn values<T: Scalar>(tape: &Tape<T>, sums: Vec<Sum<'_, T>>) -> Vec<Tensor<T>> {
    sums.into_iter().map(|sum| sum.dense(tape).value).collect()
}

/// What has arrived at a node so far.
#[derive(Clone)]
enum Sum<'t, T: Scalar> {
    /// The sum of the dense shares and the sparse ones, in the order in which they came.
    Added(Option<Var<'t, T>>, Vec<Arc<dyn SparseGrad<T>>>),
    /// Shares that somebody else is to add, in the order in which they came.
    Parts(Vec<Given<'t, T>>),
}

impl<'t, T: Scalar> Sum<'t, T> {
    /// What is there after `given` has arrived.
    fn gather(sum: Option<Self>, given: Given<'t, T>, tape: &'t Tape<T>) -> Option<Self> {
        if let Given::Parts(parts) = given {
            return parts.into_iter().fold(sum, |sum, part| Sum::gather(sum, part, tape));
        }
        let mut sum = sum.unwrap_or(Sum::Added(None, vec![]));
        match (&mut sum, given) {
            (Sum::Parts(parts), given) => parts.push(given),
            (Sum::Added(_, sparse), Given::Sparse(share)) => sparse.push(share),
            (Sum::Added(Some(dense), _), Given::Dense(grad)) if tape.is_recording() => *dense = &*dense + grad,
            (Sum::Added(Some(dense), _), Given::Dense(grad)) => {
                add_assign(dense.value.as_mut_slice(), grad.value.as_slice());
            }
            (Sum::Added(dense, _), Given::Dense(grad)) => *dense = Some(grad),
            (Sum::Added(..), Given::Parts(_)) => unreachable!("taken apart above"),
        }
        Some(sum)
    }

    /// The first bad element, if the NaN finder is on.
    fn check(
        &self,
        tape: &'t Tape<T>,
        what: &str,
        op: &'static str,
        at: &'static Location<'static>,
    ) -> Result<(), Error> {
        match self {
            _ if !tape.checks_finite() => Ok(()),
            Sum::Added(Some(dense), sparse) if sparse.is_empty() => find_non_finite(op, what, &dense.value, at),
            Sum::Added(..) => find_non_finite(op, what, &self.clone().dense(tape).value, at),
            Sum::Parts(_) => Ok(()),
        }
    }

    /// One variable. In a recorded pass sparse shares become constants, which is what they are.
    fn dense(self, tape: &'t Tape<T>) -> Var<'t, T> {
        let Sum::Added(dense, sparse) = self else { unreachable!("shares are left apart at leaves only") };
        if tape.is_recording()
            && let Some(dense) = &dense
            && !sparse.is_empty()
        {
            return dense + Sum::Added(None, sparse).dense(tape);
        }
        let mut sum = match (dense, sparse.first()) {
            (Some(dense), _) => dense,
            (None, Some(share)) => tape.constant(tape.pool().full(share.shape(), T::ZERO)),
            (None, None) => unreachable!("a sum has a share"),
        };
        sparse.iter().for_each(|share| share.add_to(&mut sum.value));
        sum
    }
}

/// The gradients of `sum(root * seed)` with respect to `wrt`.
#[track_caller]
fn sweep<'t, T: Scalar>(
    root: &Var<'t, T>,
    seed: Var<'t, T>,
    wrt: &[&Var<'t, T>],
    keep: Keep,
) -> Result<Vec<Sum<'t, T>>, Error> {
    let tape = root.tape;
    let zeros = |x: &Var<'t, T>| Sum::Added(Some(tape.constant(tape.pool().full(x.shape(), T::ZERO))), vec![]);
    let sums = sums(root, seed, wrt, keep, false)?;
    Ok(sums.into_iter().zip(wrt).map(|(sum, x)| sum.unwrap_or_else(|| zeros(x))).collect())
}

/// As an unrecorded sweep that frees the graph, but with the shares of each of `leaves` apart, in the order in which they
/// came. Who adds them to a sum gets the bits of a sweep that had not been interrupted.
#[track_caller]
pub(crate) fn parts<'t, T: Scalar>(
    root: &Var<'t, T>,
    seed: Var<'t, T>,
    leaves: &[&Var<'t, T>],
) -> Result<Vec<Vec<Given<'t, T>>>, Error> {
    let parts = |sum| if let Some(Sum::Parts(parts)) = sum { parts } else { vec![] };
    Ok(sums(root, seed, leaves, Keep::Nothing, true)?.into_iter().map(parts).collect())
}

/// What has arrived at each of `wrt`, if anything; with `apart` they are leaves and their shares are not added.
#[track_caller]
fn sums<'t, T: Scalar>(
    root: &Var<'t, T>,
    seed: Var<'t, T>,
    wrt: &[&Var<'t, T>],
    keep: Keep,
    apart: bool,
) -> Result<Vec<Option<Sum<'t, T>>>, Error> {
    let (tape, at) = (root.tape, Location::caller());
    for x in wrt {
        assert!(std::ptr::eq(x.tape, tape), "a gradient with respect to a variable of another tape");
    }
    let lowest = wrt.iter().filter_map(|x| x.node).min();
    let (Some(top), Some(bottom)) = (root.node, lowest) else { return Ok(vec![None; wrt.len()]) };
    let needed = reach(tape, bottom, top, wrt);
    // One slot for each node between the lowest variable and the root.
    let mut grads: Vec<Option<Sum<'t, T>>> = vec![None; needed.len()];
    let place =
        |x: &Var<'t, T>| x.node.filter(|&node| node >= bottom && node <= top).map(|node| (node - bottom) as usize);
    if apart {
        wrt.iter().filter_map(|x| place(x)).for_each(|slot| grads[slot] = Some(Sum::Parts(vec![])));
    }
    if top >= bottom && needed[(top - bottom) as usize] {
        let slot = &mut grads[(top - bottom) as usize];
        *slot = Sum::gather(slot.take(), Given::Dense(seed), tape);
    }
    tape.with_recording(keep == Keep::GraphAndGradients, || {
        for index in (bottom..=top).rev() {
            let slot = (index - bottom) as usize;
            if grads[slot].is_none() {
                continue;
            }
            let node = match keep {
                // A leaf holds no values, and may be one of other graphs too.
                Keep::Nothing => tape.nodes.borrow_mut()[index as usize].take_if(|node| node.op.is_some()),
                _ => None,
            };
            let node = node.or_else(|| tape.nodes.borrow()[index as usize].clone());
            let Some(node) = node else { return Err(Error::Freed { at }) };
            if node.op.is_none() && !tape.checks_finite() {
                continue;
            }
            let wanted = wrt.iter().any(|x| x.node == Some(index));
            let Some(sum) = (if wanted { grads[slot].clone() } else { grads[slot].take() }) else { continue };
            let name = node.op.as_ref().map_or(LEAF, |op| op.name());
            let what = if node.op.is_some() { "the gradient of the output" } else { "the gradient" };
            sum.check(tape, what, name, node.at)?;
            let Some(op) = &node.op else { continue };
            let g = sum.dense(tape);
            let needs: SmallVec<[bool; 4]> =
                node.inputs.iter().map(|&(input, _)| leads(input, bottom, &needed)).collect();
            let cx = Vjp { tape, g, op: name, inputs: &node.inputs, output: &node.output, node: index, needs: &needs };
            tape.differentiating(node.at, || {
                let given = differentiate(&**op, &cx)?;
                drop(cx);
                for (i, grad) in given.0.into_iter().enumerate() {
                    let (Some(grad), Some(input)) = (grad, node.inputs[i].0) else { continue };
                    if !needs[i] {
                        continue;
                    }
                    if let Given::Dense(grad) = &grad {
                        debug_assert_eq!(grad.shape(), node.inputs[i].1.shape(), "gradient of input {i} of {name}");
                    }
                    if tape.checks_finite() {
                        let sum = Sum::gather(None, grad.clone(), tape);
                        sum.map_or(Ok(()), |sum| {
                            sum.check(tape, &format!("the gradient of input {i}"), name, node.at)
                        })?;
                    }
                    let slot = &mut grads[(input - bottom) as usize];
                    *slot = Sum::gather(slot.take(), grad, tape);
                }
                Ok(())
            })?;
        }
        Ok(())
    })?;
    Ok(wrt.iter().map(|x| place(x).and_then(|slot| grads[slot].clone())).collect())
}

/// Whether an input is a node that the sweep passes and that depends on a wanted variable.
fn leads(input: Option<u32>, bottom: u32, needed: &[bool]) -> bool {
    input.is_some_and(|i| i >= bottom && needed[(i - bottom) as usize])
}

/// Which nodes between `bottom` and `top` depend on a wanted variable.
fn reach<T: Scalar>(tape: &Tape<T>, bottom: u32, top: u32, wrt: &[&Var<'_, T>]) -> Vec<bool> {
    let nodes = tape.nodes.borrow();
    let mut needed = vec![false; (top.max(bottom) - bottom) as usize + 1];
    for x in wrt {
        if let Some(node) = x.node
            && let Some(flag) = needed.get_mut((node - bottom) as usize)
        {
            *flag = true;
        }
    }
    for slot in 0..needed.len() {
        needed[slot] = needed[slot]
            || match nodes.get(bottom as usize + slot) {
                Some(Some(node)) => node.inputs.iter().any(|&(input, _)| leads(input, bottom, &needed)),
                // A freed node: if the sweep arrives there, it reports it.
                _ => true,
            };
    }
    needed
}

/// One vector-Jacobian product; through the reference of a fused operation if the result is recorded.
fn differentiate<'t, T: Scalar>(op: &dyn Op<T>, cx: &Vjp<'t, '_, T>) -> Result<Grads<'t, T>, Error> {
    if cx.recording() && op.is_fused() {
        // Fresh copies on the graph: an input that depends on another one is to get its own share only.
        let inputs: Vec<_> = (0..cx.len()).map(|i| cx.x(i).alias()).collect();
        if let Some(y) = op.reference(&inputs) {
            let wanted: Vec<_> = inputs.iter().zip(cx.needs).filter(|(_, needed)| **needed).map(|(x, _)| x).collect();
            let sums = sweep(&y, cx.g.clone(), &wanted, Keep::GraphAndGradients)?;
            let mut given = sums.into_iter().map(|sum| sum.dense(cx.tape));
            return Ok(Grads::new(cx.needs.iter().map(|&needed| if needed { given.next() } else { None })));
        }
    }
    op.try_vjp(cx)
}
