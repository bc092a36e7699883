//! The backward pass: from the root down the tape, through the nodes alone that lead to a wanted gradient.

use crate::op::Given;
use crate::path::Path;
use crate::sum::Sum;
use crate::tape::{LEAF, Node};
use crate::{Error, Grads, Op, Tape, Var, Vjp};
use raygrad_tensor::Scalar;
use smallvec::SmallVec;
use std::panic::Location;

/// The state of the graph after a backward pass.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum Keep {
    /// The graph stays as it is.
    Graph,
    /// Saved values are freed after their last use.
    Nothing,
    /// The graph stays, and the gradients are recorded on it if the tape records.
    GraphAndGradients,
}

/// The contributions to each of `wrt`, if any, to the gradient of `sum(root * seed)`.
pub(crate) fn sweep<'t, T: Scalar>(
    root: &Var<'t, T>,
    seed: Var<'t, T>,
    wrt: &[&Var<'t, T>],
    keep: Keep,
    at: &'static Location<'static>,
) -> Result<Vec<Option<Sum<'t, T>>>, Error> {
    sums(root, seed, wrt, keep, false, at)
}

/// As an unrecorded pass that frees the graph, but keeps the contributions to each of `leaves` apart, in the order of
/// their arrival. Added to a sum, they give the bits of an uninterrupted pass.
#[inline(never)]
pub(crate) fn parts<'t, T: Scalar>(
    root: &Var<'t, T>,
    seed: Var<'t, T>,
    leaves: &[&Var<'t, T>],
    at: &'static Location<'static>,
) -> Result<Vec<Vec<Given<'t, T>>>, Error> {
    let parts = |sum| if let Some(Sum::Apart(parts)) = sum { parts } else { vec![] };
    Ok(sums(root, seed, leaves, Keep::Nothing, true, at)?.into_iter().map(parts).collect())
}

#[inline(never)]
fn sums<'t, T: Scalar>(
    root: &Var<'t, T>,
    seed: Var<'t, T>,
    wrt: &[&Var<'t, T>],
    keep: Keep,
    apart: bool,
    at: &'static Location<'static>,
) -> Result<Vec<Option<Sum<'t, T>>>, Error> {
    let tape = root.tape;
    let Some(top) = root.node else { return Ok(vec![None; wrt.len()]) };
    let scratch = tape.scratch.borrow_mut().pop().unwrap_or_default();
    let path = Path::new(&tape.nodes, scratch, top, wrt.iter().filter_map(|x| x.node));
    let places: SmallVec<[Option<usize>; 8]> = wrt.iter().map(|x| x.node.and_then(|node| path.place(node))).collect();
    let mut sweep = Sweep { tape, keep, at, arrived: Arrived::new(path.nodes().len()), path };
    if apart {
        places.iter().flatten().for_each(|&place| *sweep.arrived.slot(place) = Some(Sum::Apart(vec![])));
    }
    if sweep.path.needs(top) {
        sweep.arrive(0, Given::Dense(seed), root.shape());
    }
    let recording = keep == Keep::GraphAndGradients && tape.is_recording();
    tape.with_recording(recording, || (0..sweep.path.nodes().len()).try_for_each(|place| sweep.visit(place)))?;
    let sums = places.iter().map(|place| place.and_then(|place| sweep.arrived.get(place).cloned())).collect();
    tape.scratch.borrow_mut().push(sweep.path.into_scratch());
    Ok(sums)
}

/// A backward pass in progress.
struct Sweep<'t, T: Scalar> {
    tape: &'t Tape<T>,
    keep: Keep,
    /// The line that requested it.
    at: &'static Location<'static>,
    path: Path,
    arrived: Arrived<'t, T>,
}

impl<'t, T: Scalar> Sweep<'t, T> {
    fn arrive(&mut self, place: usize, given: Given<'t, T>, shape: &[usize]) {
        Sum::gather(self.arrived.slot(place), given, shape, self.tape);
    }

    /// Passes the gradient of a node, if one has arrived, to its inputs.
    fn visit(&mut self, place: usize) -> Result<(), Error> {
        let (tape, leads, checks) = (self.tape, self.path.leads(place), self.tape.checks_finite());
        if !(leads || checks) || self.arrived.get(place).is_none() {
            return Ok(());
        }
        let number = self.path.nodes()[place];
        let held = tape.nodes.place(number).borrow();
        let Some(node) = &*held else {
            return if leads { Err(Error::Freed { at: self.at }) } else { Ok(()) };
        };
        if checks && let Some(sum) = self.arrived.get(place) {
            let (what, name) = match &node.op {
                Some(op) => ("the gradient of the output", op.name()),
                None => ("the gradient", LEAF),
            };
            sum.check(tape, what, name, node.at)?;
        }
        let (true, Some(op)) = (leads, &node.op) else { return Ok(()) };
        let sum = if self.path.wants(place) { self.arrived.get(place).cloned() } else { self.arrived.take(place) };
        if let Some(sum) = sum {
            tape.differentiating(node.at, || self.hand_on(number, node, &**op, sum.dense(tape)))?;
        }
        drop(held);
        if self.keep == Keep::Nothing {
            tape.nodes.free(number);
        }
        Ok(())
    }

    fn hand_on(&mut self, number: u32, node: &Node<T>, op: &dyn Op<T>, g: Var<'t, T>) -> Result<(), Error> {
        let tape = self.tape;
        let edges: SmallVec<[u32; 4]> = tape.nodes.with_edges(|edges| SmallVec::from_slice(edges.of(number)));
        let needs: SmallVec<[bool; 4]> = edges.iter().map(|&input| self.path.needs(input)).collect();
        let Node { inputs, output, at, .. } = node;
        let cx = Vjp { tape, g, op: op.name(), edges: &edges, inputs, output, node: number, needs: &needs };
        let given = differentiate(op, &cx, self.at)?.0;
        drop(cx);
        assert_eq!(given.len(), inputs.len(), "{}: as many gradients as inputs", op.name());
        for (i, share) in given.into_iter().enumerate() {
            let (Some(share), true) = (share, needs[i]) else { continue };
            let shape = inputs[i].shape();
            share.check(op.name(), i, shape, tape.is_recording());
            if tape.checks_finite() {
                let mut alone = None;
                Sum::gather(&mut alone, share.clone(), shape, tape);
                alone.map_or(Ok(()), |sum| sum.check(tape, &format!("the gradient of input {i}"), op.name(), at))?;
            }
            if let Some(place) = self.path.place(edges[i]) {
                self.arrive(place, share, shape);
            }
        }
        Ok(())
    }
}

/// The sums in progress. A sum takes a slot when its first contribution arrives, and returns the slot when the pass has
/// used it. So there are as many slots as sums in progress at a time, for any length of the path.
struct Arrived<'t, T: Scalar> {
    /// For each place of the path, the slot of its sum counted from 1; 0 if it has none.
    slots: Vec<u32>,
    sums: Vec<Option<Sum<'t, T>>>,
    free: Vec<u32>,
}

impl<'t, T: Scalar> Arrived<'t, T> {
    fn new(len: usize) -> Self {
        Arrived { slots: vec![0; len], sums: vec![], free: vec![] }
    }

    fn get(&self, place: usize) -> Option<&Sum<'t, T>> {
        self.sums.get((self.slots[place] as usize).checked_sub(1)?)?.as_ref()
    }

    fn slot(&mut self, place: usize) -> &mut Option<Sum<'t, T>> {
        if self.slots[place] == 0 {
            self.slots[place] = self.free.pop().unwrap_or_else(|| {
                self.sums.push(None);
                self.sums.len() as u32
            });
        }
        &mut self.sums[self.slots[place] as usize - 1]
    }

    fn take(&mut self, place: usize) -> Option<Sum<'t, T>> {
        let slot = std::mem::take(&mut self.slots[place]);
        let sum = self.sums.get_mut((slot as usize).checked_sub(1)?)?.take();
        self.free.push(slot);
        sum
    }
}

/// One vector-Jacobian product; through the reference of a fused operation if the result is recorded.
fn differentiate<'t, T: Scalar>(
    op: &dyn Op<T>,
    cx: &Vjp<'t, '_, T>,
    at: &'static Location<'static>,
) -> Result<Grads<'t, T>, Error> {
    if cx.recording() && op.is_fused() {
        // Fresh copies on the graph: an input that depends on another one is to get its own share only.
        let inputs: Vec<_> = (0..cx.len()).map(|i| cx.x(i).alias()).collect();
        if let Some(y) = op.reference(&inputs) {
            let wanted: Vec<_> = inputs.iter().zip(cx.needs).filter(|(_, needed)| **needed).map(|(x, _)| x).collect();
            let mut sums = sweep(&y, cx.g.clone(), &wanted, Keep::GraphAndGradients, at)?.into_iter();
            let mut given = || sums.next().flatten().map(|sum| sum.dense(cx.tape));
            return Ok(Grads::new(cx.needs.iter().map(|&needed| if needed { given() } else { None })));
        }
    }
    op.try_vjp(cx)
}
