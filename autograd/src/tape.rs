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
    /// While a gradient is worked out: the line of the user's code that recorded what is being differentiated.
    differentiating: Cell<Option<&'static Location<'static>>>,
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
        Tape {
            nodes: RefCell::default(),
            pool,
            recording: Cell::new(true),
            check_finite: Cell::new(false),
            differentiating: Cell::new(None),
        }
    }

    /// Forgets every operation; the pool stays. The borrow proves that no [`Var`] is left.
    pub fn clear(&mut self) {
        self.nodes.get_mut().clear();
    }

    /// Frees the operations that are recorded and the values that they hold; their variables stay.
    pub(crate) fn free(&self) {
        for node in self.nodes.borrow_mut().iter_mut() {
            node.take_if(|node| node.op.is_some());
        }
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

    /// Turns the NaN finder on or off: every leaf, every value, every share of a gradient and every sum of shares is
    /// checked, and the first one that is infinite or NaN is an error that says operation, line and index.
    ///
    /// The line is always the user's own: where a recorded gradient is at fault, that of the operation whose gradient
    /// it is. What an operation computes inside its vector-Jacobian product may overflow as long as the gradient that
    /// comes out is finite.
    ///
    /// ```
    /// use raygrad_autograd::{Tape, Tensor};
    /// let tape = Tape::<f64>::new();
    /// tape.check_finite(true);
    /// let x = tape.leaf(Tensor::from_vec(&[2], vec![4.0, 0.0]));
    /// let error = x.sqrt().sum().try_grad(&[&x]).unwrap_err();
    /// assert!(error.to_string().starts_with("sqrt: the gradient of input 0 is inf at index [1]"));
    /// ```
    pub fn check_finite(&self, on: bool) {
        self.check_finite.set(on);
    }

    pub(crate) fn checks_finite(&self) -> bool {
        self.check_finite.get()
    }

    /// Whether values are checked now: not while a gradient is worked out, since the gradient itself is checked then.
    fn checks_values(&self) -> bool {
        self.check_finite.get() && self.differentiating.get().is_none()
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
        with_cell(&self.recording, on, f)
    }

    /// Runs `f` as part of the gradient of what was recorded at `at`: nodes that it adds carry that line.
    pub(crate) fn differentiating<R>(&self, at: &'static Location<'static>, f: impl FnOnce() -> R) -> R {
        with_cell(&self.differentiating, Some(at), f)
    }

    /// The line of the user's code that an operation belongs to.
    #[track_caller]
    pub(crate) fn line(&self) -> &'static Location<'static> {
        self.differentiating.get().unwrap_or(Location::caller())
    }

    /// A variable that gradients can be taken with respect to.
    ///
    /// # Panics
    /// If the NaN finder is on and the value is not finite.
    #[track_caller]
    pub fn leaf(&self, value: Tensor<T>) -> Var<'_, T> {
        let at = self.line();
        if self.checks_values()
            && let Err(error) = find_non_finite(LEAF, "the value", &value, at)
        {
            panic!("{error}");
        }
        let output = Kept::Shape(Shape::from_slice(value.shape()));
        let node = Node { op: None, inputs: SmallVec::new(), output, at };
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
        let at = self.line();
        let value = self.run(&op, inputs, at)?;
        Ok(self.record(op, inputs, value, at))
    }

    /// The output of an operation, without a record. It takes any operation, so that it is compiled once.
    fn run(&self, op: &dyn Op<T>, inputs: &[&Var<'_, T>], at: &'static Location<'static>) -> Result<Tensor<T>, Error> {
        let shape = self.check_shapes(op, inputs, at)?;
        let values: SmallVec<[&Tensor<T>; 4]> = inputs.iter().map(|x| &x.value).collect();
        let value = op.forward(&values, &self.pool);
        debug_assert_eq!(value.shape(), shape.as_slice(), "{}: `forward` and `shape` disagree", op.name());
        self.check_output(op.name(), inputs, &value, at)?;
        Ok(value)
    }

    /// Records an operation whose output is known already, from an earlier unrecorded run on the same inputs.
    ///
    /// # Panics
    /// If the shapes do not fit, `value` has not the shape of the output, or the NaN finder is on and finds something.
    #[track_caller]
    pub fn apply_known<'t>(&'t self, op: impl Op<T>, inputs: &[&Var<'t, T>], value: Tensor<T>) -> Var<'t, T> {
        let at = self.line();
        match self.check_shapes(&op, inputs, at) {
            Ok(shape) => assert_eq!(value.shape(), shape.as_slice(), "{}: a known output of another shape", op.name()),
            Err(error) => panic!("{error}"),
        }
        if let Err(error) = self.check_output(op.name(), inputs, &value, at) {
            panic!("{error}");
        }
        self.record(op, inputs, value, at)
    }

    /// If the NaN finder is on and the output is not finite: an error that also says which input was so before.
    fn check_output(
        &self,
        op: &'static str,
        inputs: &[&Var<'_, T>],
        value: &Tensor<T>,
        at: &'static Location<'static>,
    ) -> Result<(), Error> {
        if !self.checks_values() {
            return Ok(());
        }
        find_non_finite(op, "output", value, at).map_err(|mut error| {
            if let Error::NonFinite { what, .. } = &mut error
                && let Some(input) = inputs.iter().position(|x| !x.value.is_finite())
            {
                *what = format!("output (and input {input} was not finite before)");
            }
            error
        })
    }

    /// The shape of the output.
    fn check_shapes(
        &self,
        op: &dyn Op<T>,
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

    pub(crate) fn record<'t>(
        &'t self,
        op: impl Op<T>,
        inputs: &[&Var<'t, T>],
        value: Tensor<T>,
        at: &'static Location<'static>,
    ) -> Var<'t, T> {
        if self.recording.get() && inputs.iter().any(|x| x.node.is_some()) {
            self.append(Box::new(op), inputs, value, at)
        } else {
            self.constant(value)
        }
    }

    fn append<'t>(
        &'t self,
        op: Box<dyn Op<T>>,
        inputs: &[&Var<'t, T>],
        value: Tensor<T>,
        at: &'static Location<'static>,
    ) -> Var<'t, T> {
        let reads = op.reads();
        let kept = |(i, x): (usize, &&Var<'t, T>)| (x.node, Kept::new(&x.value, reads.input(i)));
        let inputs = inputs.iter().enumerate().map(kept).collect();
        let output = Kept::new(&value, reads.output());
        let node = Some(self.push(Node { op: Some(op), inputs, output, at }));
        Var { tape: self, value, node }
    }
}

/// What errors and drawings call a node without operation.
pub(crate) const LEAF: &str = "leaf";

/// Runs `f` with another value in a cell, which gets its own back even if `f` panics.
fn with_cell<C: Copy, R>(cell: &Cell<C>, value: C, f: impl FnOnce() -> R) -> R {
    struct Restore<'a, C: Copy>(&'a Cell<C>, C);
    impl<C: Copy> Drop for Restore<'_, C> {
        fn drop(&mut self) {
            self.0.set(self.1);
        }
    }
    let _restore = Restore(cell, cell.replace(value));
    f()
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
