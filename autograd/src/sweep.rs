//! The backward pass: from the root down the tape, through the nodes alone that lead to a wanted gradient.

use crate::op::Given;
use crate::path::Path;
use crate::sum::Sum;
use crate::tape::{LEAF, Node};
use crate::{Error, Grads, Op, Tape, Var, Vjp};
use raygrad_tensor::Scalar;
use smallvec::SmallVec;
use std::cell::Cell;
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
    Ok(sweep(root, seed, leaves, Keep::Nothing, true, at)?.into_iter().map(parts).collect())
}

/// The contributions to each of `wrt`, if any, to the gradient of `sum(root * seed)`: each alone if they stay `apart`.
#[inline(never)]
pub(crate) fn sweep<'t, T: Scalar>(
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
    let recording = keep == Keep::GraphAndGradients && tape.is_recording();
    if sweep.path.needs(top) {
        // Gradients are linear in the seed. With the seed on the graph, all those of a recorded pass are on it.
        let seed = if recording && seed.node.is_none() { tape.unchecked_leaf(seed.value, at) } else { seed };
        sweep.arrive(0, Given::Dense(seed), root.shape());
    }
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
    #[inline(always)]
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

    #[inline(always)]
    fn hand_on(&mut self, number: u32, node: &Node<T>, op: &dyn Op<T>, g: Var<'t, T>) -> Result<(), Error> {
        let tape = self.tape;
        let edges: SmallVec<[u32; 4]> = tape.nodes.with_edges(|edges| SmallVec::from_slice(edges.of(number)));
        let needs: SmallVec<[bool; 4]> = edges.iter().map(|&input| self.path.needs(input)).collect();
        let Node { inputs, output, at, .. } = node;
        let (of_output, start, plain) = (g.node, tape.len() as u32, Cell::new(None));
        let cx = Vjp { tape, g, op: op.name(), edges: &edges, inputs, output, node: number, needs: &needs, plain };
        let given = differentiate(op, &cx, self.at)?.0;
        let plain = cx.plain.get();
        drop(cx);
        assert_eq!(given.len(), inputs.len(), "{}: as many gradients as inputs", op.name());
        if tape.is_recording() {
            let outside = outside_of_the_tape(&given, &needs, plain, of_output, start);
            outside.map_or(Ok(()), |what| Err(Error::Unrecorded { op: op.name(), what, at }))?;
        }
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

/// What an operation computed outside of the tape in a recorded pass, if anything. `plain` is the operand that it read
/// as a tensor. Separate from the pass, which is faster then.
#[inline(never)]
fn outside_of_the_tape<T: Scalar>(
    given: &[Option<Given<'_, T>>],
    needs: &[bool],
    plain: Option<usize>,
    of_output: Option<u32>,
    start: u32,
) -> Option<String> {
    match plain {
        Some(i) if i < given.len() => return Some(format!("`vjp` reads input {i} with `Vjp::input`")),
        Some(_) => return Some("`vjp` reads the output with `Vjp::output`".into()),
        None => {}
    }
    let on_the_tape = |share: &Option<_>| share.as_ref().is_none_or(|share| depends(share, of_output, start));
    let i = given.iter().zip(needs).position(|(share, needed)| *needed && !on_the_tape(share))?;
    Some(format!("the gradient of input {i} does not depend on that of the output"))
}

/// Whether a gradient depends on node `g`, the gradient of the output, or is 0. A recorded vector-Jacobian product
/// added the nodes from `start` on.
fn depends<T: Scalar>(share: &Given<'_, T>, g: Option<u32>, start: u32) -> bool {
    let (Given::Dense(grad), Some(g)) = (share, g) else { return true };
    let Some(node) = grad.node else { return false };
    grad.tape.nodes.with_edges(|edges| {
        if node == g || edges.of(node).contains(&g) {
            return true;
        }
        // `Var::vjp` and `Var::grad_graph` return zeros as leaves.
        if edges.of(node).is_empty() {
            return node >= start && grad.value.iter().all(|x| x == T::ZERO);
        }
        let mut depend: Vec<bool> = Vec::new();
        for node in start..=node {
            let depends = |&input: &u32| {
                let earlier = input.checked_sub(start).and_then(|place| depend.get(place as usize));
                input == g || earlier.is_some_and(|&depends| depends)
            };
            let depends = edges.of(node).iter().any(depends);
            depend.push(depends);
        }
        depend.last().is_some_and(|&depends| depends)
    })
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
            let mut sums = sweep(&y, cx.g.clone(), &wanted, Keep::GraphAndGradients, false, at)?.into_iter();
            let mut given = || sums.next().flatten().map(|sum| sum.dense(cx.tape));
            return Ok(Grads::new(cx.needs.iter().map(|&needed| if needed { given() } else { None })));
        }
    }
    op.try_vjp(cx)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Reads;
    use crate::derivatives::{hessian, hvp, jacobian, jvp};
    use raygrad_tensor::{Pool, Shape, Tensor, map};

    /// y = x^2, with several ways to compute its gradient.
    #[derive(Clone, Copy, PartialEq)]
    enum Square {
        Variables,
        Tensors,
        TensorOfGradient,
        TensorOfInput,
        TensorOfOutput,
        /// With tensors, and a reference for recorded passes.
        Fused,
    }

    impl<T: Scalar> Op<T> for Square {
        fn name(&self) -> &'static str {
            "square"
        }

        fn shape(&self, x: &[&[usize]]) -> Result<Shape, crate::ShapeError> {
            Ok(x[0].into())
        }

        fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
            map([x[0]], pool, |[x]| x * x)
        }

        fn reads(&self) -> Reads {
            Reads::ALL
        }

        fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
            let (x, g) = (cx.x(0), cx.g());
            let twice = |x: &Tensor<T>| cx.constant(map([x], cx.pool(), |[x]| x + x));
            Grads::one(match self {
                Square::Variables => g * x * 2.0,
                Square::Tensors | Square::Fused => cx.constant(twice(g.value()).value() * x.value()),
                Square::TensorOfGradient => twice(g.value()) * x,
                Square::TensorOfInput => g * twice(cx.input(0)),
                Square::TensorOfOutput => g * twice(&map([cx.output()], cx.pool(), |[y]| y.sqrt())),
            })
        }

        fn is_fused(&self) -> bool {
            *self == Square::Fused
        }

        fn reference<'t>(&self, x: &[Var<'t, T>]) -> Option<Var<'t, T>> {
            (*self == Square::Fused).then(|| &x[0] * &x[0])
        }
    }

    #[track_caller]
    fn square<'t>(x: &Var<'t, f64>, how: Square) -> Var<'t, f64> {
        x.tape().apply(how, &[x])
    }

    /// One of the two is 0, where the gradient is 0 too.
    fn at() -> [Tensor<f64>; 1] {
        [Tensor::from([3.0, 0.0])]
    }

    fn ones<'t>(x: &Var<'t, f64>) -> Var<'t, f64> {
        x.tape().constant(Tensor::ones(x.shape()))
    }

    type Pass = for<'t> fn(&Var<'t, f64>, &Var<'t, f64>);
    const RECORDED: [(&str, Pass); 8] = [
        ("grad_graph", |x, y| drop(y.sum().grad_graph(&[x]))),
        ("vjp", |x, y| drop(y.vjp(&ones(y), &[x]))),
        ("jvp", |x, y| drop(y.jvp(&[x], &[&ones(x)]))),
        ("hvp", |x, y| drop(y.sum().hvp(&[x], &[&ones(x)]))),
        ("hessian", |x, y| drop(y.sum().hessian(&[x]))),
        ("jacobian by columns", |x, y| drop(Var::concat(&[y, y], 0).jacobian(&[x]))),
        ("where the gradient depends on the input", |x, y| drop((x * y).exp().sum().grad_graph(&[x]))),
        ("where the gradient is 0", |x, y| drop((y * 0.0).sum().grad_graph(&[x]))),
    ];

    const OF_OUTPUT: &str = "square: the gradient of input 0 does not depend on that of the output, so";
    const OUTSIDE: [(Square, &str); 4] = [
        (Square::Tensors, OF_OUTPUT),
        (Square::TensorOfGradient, OF_OUTPUT),
        (Square::TensorOfInput, "square: `vjp` reads input 0 with `Vjp::input`, so"),
        (Square::TensorOfOutput, "square: `vjp` reads the output with `Vjp::output`, so"),
    ];

    #[test]
    fn recorded_passes_refuse_gradients_outside_of_the_tape() {
        for (how, text) in OUTSIDE {
            for (name, pass) in RECORDED {
                let tape = Tape::new();
                let x = tape.leaf(at()[0].clone());
                let (y, place) = (square(&x, how), format!("(recorded at {}:{}:", file!(), line!()));
                let error = tape.try_run(|| pass(&x, &y)).expect_err(name);
                assert!(matches!(error, Error::Unrecorded { op: "square", .. }), "{name}: {error}");
                let error = error.to_string();
                assert!(error.starts_with(text) && error.contains(&place), "{name}: {error}");
            }
            let tape = Tape::new();
            let x = tape.leaf(at()[0].clone());
            let y = tape.checkpoint(&[&x], move |x| square(&x[0].sin(), how)).sum();
            assert!(y.try_grad(&[&x]).is_ok());
            assert!(matches!(y.try_grad_graph(&[&x]), Err(Error::Unrecorded { op: "square", .. })));
        }
    }

    #[test]
    fn unrecorded_passes_accept_gradients_outside_of_the_tape() {
        for how in [Square::Variables, Square::Fused].into_iter().chain(OUTSIDE.map(|(how, _)| how)) {
            let tape = Tape::new();
            let x = tape.leaf(at()[0].clone());
            let y = square(&x, how);
            let sum = y.sum();
            assert_eq!(sum.grad(&[&x])[0], [6.0, 0.0]);
            assert_eq!(tape.no_grad(|| sum.grad_graph(&[&x]))[0].value(), [6.0, 0.0]);
            assert_eq!(y.jacobian(&[&x])[0], [[6.0, 0.0], [0.0, 0.0]]);
        }
    }

    #[test]
    fn gradients_on_the_tape_have_derivatives() {
        for how in [Square::Variables, Square::Fused] {
            let diagonal = [[2.0, 0.0], [0.0, 2.0]];
            assert_eq!(hessian(|x| square(&x[0], how).sum(), &at())[0][0], diagonal);
            assert_eq!(hvp(|x| square(&x[0], how).sum(), &at(), &[Tensor::ones(&[2])])[0], [2.0, 2.0]);
            assert_eq!(jvp(|x| square(&x[0], how), &at(), &[Tensor::ones(&[2])]).1, [6.0, 0.0]);
            let by_columns = jacobian(|x| square(&Var::concat(&[&x[0], &x[0]], 0), how), &at());
            assert_eq!(by_columns[0], [[6.0, 0.0], [0.0, 0.0], [6.0, 0.0], [0.0, 0.0]]);
        }
    }

    /// y = 1, with several ways to return its gradient of 0.
    #[derive(Clone, Copy)]
    enum One {
        None,
        /// By a gradient inside of the vector-Jacobian product.
        Nested,
        Zeros,
    }

    impl<T: Scalar> Op<T> for One {
        fn name(&self) -> &'static str {
            "one"
        }

        fn shape(&self, x: &[&[usize]]) -> Result<Shape, crate::ShapeError> {
            Ok(x[0].into())
        }

        fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
            pool.full(x[0].shape(), T::ONE)
        }

        fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
            let (x, ones) = (cx.x(0).tracked(), cx.constant(Tensor::ones(cx.shape(0))));
            Grads::new([match self {
                One::None => None,
                One::Nested => Some(ones.tracked().vjp(cx.g(), &[&x]).remove(0)),
                One::Zeros => Some(cx.constant(Tensor::zeros(cx.shape(0)))),
            }])
        }
    }

    #[test]
    fn gradients_of_0_are_told_from_those_outside_of_the_tape() {
        let second = |how: One| {
            let tape = Tape::new();
            let x = tape.leaf(at()[0].clone());
            tape.try_run(|| (tape.apply(how, &[&x]) * x.square()).sum().hessian(&[&x]).remove(0).remove(0))
        };
        for how in [One::None, One::Nested] {
            assert_eq!(second(how).unwrap(), [[2.0, 0.0], [0.0, 2.0]]);
        }
        assert!(matches!(second(One::Zeros), Err(Error::Unrecorded { op: "one", .. })));
        // A formula without slopes.
        let (tape, x) = (Tape::new(), at());
        let x = tape.leaf(x[0].clone());
        let first = (x.floor() * x.sign()).sum().grad_graph(&[&x]).remove(0);
        assert_eq!((first.value(), &first.sum().grad(&[&x])[0]), (&Tensor::zeros(&[2]), &Tensor::zeros(&[2])));
    }

    #[test]
    fn a_recorded_pass_adds_a_leaf_for_its_seed() {
        let added = |f: for<'t> fn(&Var<'t, f64>) -> Var<'t, f64>| {
            let tape = Tape::new();
            let x = tape.leaf(at()[0].clone());
            let y = f(&x);
            let before = tape.len();
            let gradient = y.grad_graph(&[&x]).remove(0);
            assert!(gradient.is_on_graph());
            tape.len() - before
        };
        assert_eq!(added(|x| x.sum()), 2); // the seed and its broadcast
        assert_eq!(added(|x| (x * 3.0).sum()), 3);
        assert_eq!(added(|x| x.sin().sum()), 4);
        assert_eq!(added(|x| x.floor().sum()), 3); // the last is the gradient of 0
    }
}
