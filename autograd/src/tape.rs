//! The tape: a list of operations in the order in which they ran, which is a topological order.

use crate::op::Kept;
use crate::{Error, Op, Var};
use raygrad_tensor::{Pool, Scalar, Shape, Tensor};
use smallvec::SmallVec;
use std::cell::{Cell, RefCell};
use std::panic::Location;
use std::sync::Arc;

/// One recorded operation.
pub(crate) struct Node<T: Scalar> {
    /// None for a leaf.
    pub op: Option<Box<dyn Op<T>>>,
    pub inputs: SmallVec<[(Option<u32>, Kept<T>); 2]>,
    pub output: Kept<T>,
    pub at: &'static Location<'static>,
}

/// Records operations and differentiates them. One tape belongs to one thread at a time; any number of tapes work
/// side by side, since nothing is global.
///
/// ```
/// use raygrad_autograd::Tape;
/// use raygrad_tensor::Tensor;
/// let tape = Tape::<f64>::new();
/// let x = tape.leaf(Tensor::from_vec(&[3], vec![1.0, 2.0, 3.0]));
/// let y = (&x * &x).sum();
/// assert_eq!(y.item(), 14.0);
/// assert_eq!(y.grad(&[&x])[0].as_slice(), [2.0, 4.0, 6.0]);
/// ```
pub struct Tape<T: Scalar> {
    pub(crate) nodes: RefCell<Vec<Option<Arc<Node<T>>>>>,
    pool: Pool<T>,
    recording: Cell<bool>,
    check_finite: Cell<bool>,
}

impl<T: Scalar> Default for Tape<T> {
    fn default() -> Self {
        Tape::new()
    }
}

impl<T: Scalar> Tape<T> {
    /// An empty tape with a pool of its own.
    pub fn new() -> Self {
        Tape::with_pool(Pool::new())
    }

    /// An empty tape whose tensors come from `pool`.
    pub fn with_pool(pool: Pool<T>) -> Self {
        Tape { nodes: RefCell::default(), pool, recording: Cell::new(true), check_finite: Cell::new(false) }
    }

    /// Forgets every operation; the pool stays. The borrow proves that no [`Var`] is left.
    pub fn clear(&mut self) {
        self.nodes.get_mut().clear();
    }

    /// The pool that the tensors of this tape come from.
    pub fn pool(&self) -> &Pool<T> {
        &self.pool
    }

    /// Number of recorded operations and leaves.
    pub fn len(&self) -> usize {
        self.nodes.borrow().len()
    }

    /// Whether nothing is recorded.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Turns the NaN finder on or off: every value and every gradient is checked, and the first one that is infinite
    /// or NaN is an error that says operation, line and index.
    pub fn check_finite(&self, on: bool) {
        self.check_finite.set(on);
    }

    pub(crate) fn checks_finite(&self) -> bool {
        self.check_finite.get()
    }

    /// Whether operations are recorded now.
    pub fn is_recording(&self) -> bool {
        self.recording.get()
    }

    /// Runs `f` without recording: its results are constants.
    pub fn no_grad<R>(&self, f: impl FnOnce() -> R) -> R {
        self.with_recording(false, f)
    }

    pub(crate) fn with_recording<R>(&self, on: bool, f: impl FnOnce() -> R) -> R {
        /// Restores the flag even if `f` panics.
        struct Restore<'a>(&'a Cell<bool>, bool);
        impl Drop for Restore<'_> {
            fn drop(&mut self) {
                self.0.set(self.1);
            }
        }
        let _restore = Restore(&self.recording, self.recording.replace(on));
        f()
    }

    /// A variable that gradients can be taken with respect to.
    #[track_caller]
    pub fn leaf(&self, value: Tensor<T>) -> Var<'_, T> {
        let output = Kept::Shape(Shape::from_slice(value.shape()));
        let node = Node { op: None, inputs: SmallVec::new(), output, at: Location::caller() };
        Var { tape: self, value, node: Some(self.push(node)) }
    }

    /// A value that gradients do not flow into.
    pub fn constant(&self, value: Tensor<T>) -> Var<'_, T> {
        Var { tape: self, value, node: None }
    }

    fn push(&self, node: Node<T>) -> u32 {
        let mut nodes = self.nodes.borrow_mut();
        let index = nodes.len();
        nodes.push(Some(Arc::new(node)));
        match u32::try_from(index) {
            Ok(index) => index,
            Err(_) => panic!("a tape holds at most 2^32 operations: clear it between steps"),
        }
    }

    /// Runs an operation, and records it if an input is on the graph.
    ///
    /// # Panics
    /// If the shapes do not fit, an input belongs to another tape, or the NaN finder is on and finds something; the
    /// message names the operation and the caller's line.
    #[track_caller]
    pub fn apply<'t>(&'t self, op: impl Op<T>, inputs: &[&Var<'t, T>]) -> Var<'t, T> {
        match self.try_apply(op, inputs) {
            Ok(y) => y,
            Err(error) => panic!("{error}"),
        }
    }

    /// As [`apply`](Self::apply), with an error instead of a panic.
    ///
    /// # Errors
    /// If the shapes do not fit, or the NaN finder is on and finds something.
    ///
    /// # Panics
    /// If an input belongs to another tape.
    #[track_caller]
    pub fn try_apply<'t>(&'t self, op: impl Op<T>, inputs: &[&Var<'t, T>]) -> Result<Var<'t, T>, Error> {
        let at = Location::caller();
        let shape = self.check_shapes(&op, inputs, at)?;
        let values: SmallVec<[&Tensor<T>; 4]> = inputs.iter().map(|x| &x.value).collect();
        let value = op.forward(&values, &self.pool);
        debug_assert_eq!(value.shape(), shape.as_slice(), "{}: `forward` and `shape` disagree", op.name());
        if self.checks_finite() {
            find_non_finite(op.name(), "output", &value, at)?;
        }
        Ok(self.record(op, inputs, value, at))
    }

    /// Records an operation whose output is known already, from an earlier unrecorded run on the same inputs.
    ///
    /// # Panics
    /// If the shapes do not fit, or `value` has not the shape of the output.
    #[track_caller]
    pub fn apply_known<'t>(&'t self, op: impl Op<T>, inputs: &[&Var<'t, T>], value: Tensor<T>) -> Var<'t, T> {
        let at = Location::caller();
        match self.check_shapes(&op, inputs, at) {
            Ok(shape) => assert_eq!(value.shape(), shape.as_slice(), "{}: a known output of another shape", op.name()),
            Err(error) => panic!("{error}"),
        }
        self.record(op, inputs, value, at)
    }

    /// The shape of the output.
    fn check_shapes(
        &self,
        op: &impl Op<T>,
        inputs: &[&Var<'_, T>],
        at: &'static Location<'static>,
    ) -> Result<Shape, Error> {
        for x in inputs {
            assert!(std::ptr::eq(x.tape, self), "{}: an input belongs to another tape", op.name());
        }
        let shapes: SmallVec<[&[usize]; 4]> = inputs.iter().map(|x| x.shape()).collect();
        op.shape(&shapes).map_err(|what| Error::Shape {
            op: op.name(),
            shapes: shapes.iter().map(|shape| Shape::from_slice(shape)).collect(),
            what,
            at,
        })
    }

    fn record<'t>(
        &'t self,
        op: impl Op<T>,
        inputs: &[&Var<'t, T>],
        value: Tensor<T>,
        at: &'static Location<'static>,
    ) -> Var<'t, T> {
        let node = if self.recording.get() && inputs.iter().any(|x| x.node.is_some()) {
            let reads = op.reads();
            let kept = |(i, x): (usize, &&Var<'t, T>)| (x.node, Kept::new(&x.value, reads.input(i)));
            let inputs = inputs.iter().enumerate().map(kept).collect();
            let output = Kept::new(&value, reads.output());
            Some(self.push(Node { op: Some(Box::new(op)), inputs, output, at }))
        } else {
            None
        };
        Var { tape: self, value, node }
    }
}

/// The first element that is not finite, as an error.
pub(crate) fn find_non_finite<T: Scalar>(
    op: &'static str,
    what: &str,
    value: &Tensor<T>,
    at: &'static Location<'static>,
) -> Result<(), Error> {
    let Some(position) = value.as_slice().iter().position(|x| !x.is_finite()) else { return Ok(()) };
    let mut index = Shape::from_elem(0, value.ndim());
    let mut rest = position;
    for (i, &extent) in index.iter_mut().zip(value.shape()).rev() {
        *i = rest % extent;
        rest /= extent;
    }
    Err(Error::NonFinite { op, what: what.into(), value: value.as_slice()[position].to_f64(), index, at })
}
