//! The tape: a list of operations in the order in which they ran, which is a topological order.

use crate::nodes::{CONSTANT, Nodes};
use crate::op::Kept;
use crate::{Error, Op, ShapeError, Var};
use raygrad_tensor::{Pool, Scalar, Shape, Tensor, checked_len};
use smallvec::SmallVec;
use std::any::Any;
use std::cell::{Cell, RefCell};
use std::fmt;
use std::panic::{AssertUnwindSafe, Location, catch_unwind, resume_unwind};

/// Records operations and differentiates them (TensorFlow's `GradientTape`). A tape belongs to one thread at a time.
/// Any number of tapes work side by side, since there is no global state.
///
/// ```
/// use raygrad_autograd::Tape;
/// use raygrad_tensor::Tensor;
/// let tape = Tape::<f64>::new();
/// let x = tape.leaf(Tensor::from([1.0, 2.0, 3.0]));
/// let y = (&x * &x).sum();
/// assert_eq!(y.item(), 14.0);
/// assert_eq!(y.grad(&[&x])[0], [2.0, 4.0, 6.0]);
/// ```
pub struct Tape<T: Scalar> {
    pub(crate) nodes: Nodes<Node<T>>,
    /// Scratch memory of backward passes, reused by the next: one for each level of nesting.
    pub(crate) scratch: RefCell<Vec<Vec<u32>>>,
    pool: Pool<T>,
    recording: Cell<bool>,
    check_finite: Cell<bool>,
    /// Whether errors go to [`Tape::try_run`].
    trying: Cell<bool>,
    /// While a gradient is computed: the line of the user's code that recorded the differentiated operation.
    differentiating: Cell<Option<&'static Location<'static>>>,
    /// While a method that consists of several operations runs: the line of the user's code that called it.
    within: Cell<Option<&'static Location<'static>>>,
    /// Outputs being saved, and outputs being reused ([`crate::CachedOutputs`]).
    pub(crate) cached: Cell<Option<Vec<Tensor<T>>>>,
    pub(crate) reused: Cell<Option<std::vec::IntoIter<Tensor<T>>>>,
}

/// One recorded operation, or a leaf. [`Nodes`] holds the edges to its inputs.
pub(crate) struct Node<T: Scalar> {
    /// None for a leaf.
    pub op: Option<Box<dyn Op<T>>>,
    pub inputs: SmallVec<[Kept<T>; 2]>,
    pub output: Kept<T>,
    pub at: &'static Location<'static>,
}

impl<T: Scalar> fmt::Debug for Tape<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Tape<{}> of {} operations", T::NAME, self.len())
    }
}

impl<T: Scalar> Default for Tape<T> {
    fn default() -> Self {
        Tape::new()
    }
}

impl<T: Scalar> Tape<T> {
    /// An empty tape with a new pool.
    pub fn new() -> Self {
        Tape::with_pool(Pool::new())
    }

    /// An empty tape whose tensors come from `pool`.
    pub fn with_pool(pool: Pool<T>) -> Self {
        Tape {
            nodes: Nodes::new(),
            scratch: RefCell::default(),
            pool,
            recording: Cell::new(true),
            check_finite: Cell::new(false),
            trying: Cell::new(false),
            differentiating: Cell::new(None),
            within: Cell::new(None),
            cached: Cell::default(),
            reused: Cell::default(),
        }
    }

    /// An empty tape for a part of this one's work, with the same [`check_finite`](Self::check_finite) setting and line,
    /// and the same pool if it has the same type.
    pub(crate) fn nested<U: Scalar>(&self) -> Tape<U> {
        let pool = (&self.pool as &dyn Any).downcast_ref::<Pool<U>>();
        let tape = Tape::with_pool(pool.cloned().unwrap_or_default());
        tape.check_finite.set(self.check_finite.get());
        tape.trying.set(self.trying.get());
        tape.differentiating.set(self.differentiating.get());
        tape
    }

    /// Removes every operation; the pool stays. The exclusive borrow proves that no [`Var`] is left.
    pub fn clear(&mut self) {
        self.nodes.clear();
    }

    /// Frees the recorded operations, and the values that they alone hold. Variables keep their values, but have no
    /// gradient any more.
    pub fn free(&self) {
        self.nodes.free_those(|node| node.op.is_some());
    }

    /// The pool that the tensors of this tape come from.
    pub fn pool(&self) -> &Pool<T> {
        &self.pool
    }

    /// Number of recorded operations and leaves.
    pub fn len(&self) -> usize {
        self.nodes.len()
    }

    /// Whether the tape has neither operations nor leaves.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Turns the search for NaN and infinity on or off.
    ///
    /// If it is on, the tape checks every leaf, every output, and every contribution to a gradient and their sums. The
    /// first one that is not finite is an error with the operation, the line of the user's code and the index. For a
    /// recorded gradient, the line is that of the operation whose gradient it is. Values inside a vector-Jacobian
    /// product may overflow, as long as the resulting gradient is finite.
    ///
    /// ```
    /// use raygrad_autograd::{Tape, Tensor};
    /// let tape = Tape::<f64>::new();
    /// tape.check_finite(true);
    /// let x = tape.leaf(Tensor::from([4.0, 0.0]));
    /// let error = x.sqrt().sum().try_grad(&[&x]).unwrap_err();
    /// assert!(error.to_string().starts_with("sqrt: the gradient of input 0 is inf at index [1]"));
    /// ```
    pub fn check_finite(&self, on: bool) {
        self.check_finite.set(on);
    }

    pub(crate) fn checks_finite(&self) -> bool {
        self.check_finite.get()
    }

    /// Whether values are checked now. They are not while a gradient is computed, since the gradient itself is checked
    /// then.
    fn checks_values(&self) -> bool {
        self.check_finite.get() && self.differentiating.get().is_none()
    }

    /// Whether operations are recorded now.
    pub fn is_recording(&self) -> bool {
        self.recording.get()
    }

    /// Runs `f` without recording: its results are constants (`torch.no_grad`).
    ///
    /// The gradient of such a constant is an error. Code that takes a gradient inside a computation, such as a force
    /// from an energy, records it with [`enable_grad`](Self::enable_grad).
    pub fn no_grad<R>(&self, f: impl FnOnce() -> R) -> R {
        self.with_recording(false, f)
    }

    /// Runs `f` with recording, also inside [`no_grad`](Self::no_grad). For a computation that includes a gradient.
    ///
    /// ```
    /// use raygrad_autograd::{Tape, Tensor, Var};
    /// /// The force in a field of energy x^4: works with any x, whether anything is recorded or not.
    /// fn force<'t>(x: &Var<'t, f64>) -> Var<'t, f64> {
    ///     let x = x.tracked(); // a constant has no gradients
    ///     let energy = x.tape().enable_grad(|| x.powi(4).sum());
    ///     -energy.grad_graph(&[&x]).remove(0)
    /// }
    /// let tape = Tape::new();
    /// let x = tape.leaf(Tensor::scalar(2.0));
    /// assert_eq!(force(&x).grad(&[&x])[0].item(), -48.0); // -12 x^2: the force is recorded
    /// let value = tape.no_grad(|| force(&x));
    /// assert!(value.item() == -32.0 && !value.is_on_graph());
    /// assert_eq!(force(&tape.constant(Tensor::scalar(2.0))).item(), -32.0);
    /// ```
    pub fn enable_grad<R>(&self, f: impl FnOnce() -> R) -> R {
        self.with_recording(true, f)
    }

    /// Runs `f`, and returns the first [`Error`] of an operation or a gradient of this tape instead of panicking. So
    /// code with plain methods and operators can process unchecked input: a user's model, or shapes from a file.
    ///
    /// The error unwinds out of `f` like a panic, but prints no message. Other panics pass through. The operations that
    /// `f` recorded before the error stay. In a program built with `panic = "abort"`, errors abort it; use
    /// [`try_apply`](Self::try_apply) and the `try_` gradients there, which do not unwind.
    ///
    /// ```
    /// use raygrad_autograd::{Error, Tape, Tensor};
    /// let tape = Tape::<f32>::new();
    /// let (x, w) = (tape.leaf(Tensor::ones(&[4, 3])), tape.leaf(Tensor::ones(&[2, 5])));
    /// let error = tape.try_run(|| (x.exp().matmul(&w) + 1.0).sum()).unwrap_err();
    /// assert!(matches!(error, Error::Shape { op: "matmul", .. }));
    /// assert_eq!(tape.try_run(|| x.sum().item()).unwrap(), 12.0);
    /// ```
    ///
    /// # Errors
    /// If shapes do not fit, [`check_finite`](Self::check_finite) finds a value that is not finite, or a gradient does
    /// not exist. The error has the text of the panic.
    pub fn try_run<R>(&self, f: impl FnOnce() -> R) -> Result<R, Error> {
        // Nothing is left half done in the tape: cells get their values back as the stack unwinds, and a node is recorded
        // after everything that can fail.
        catch_unwind(AssertUnwindSafe(|| with_cell(&self.trying, true, f).0)).or_else(|panic| {
            match panic.downcast::<Raised>() {
                Ok(raised) => Err(raised.0),
                Err(other) => resume_unwind(other),
            }
        })
    }

    /// The value, or the error as a panic with its text; inside [`try_run`](Self::try_run) as the unwinding that it
    /// catches.
    #[track_caller]
    pub(crate) fn or_raise<R>(&self, result: Result<R, Error>) -> R {
        match result {
            Ok(value) => value,
            Err(error) if self.trying.get() => resume_unwind(Box::new(Raised(error))),
            Err(error) => panic!("{error}"),
        }
    }

    /// The value, or the mismatch of the inputs of operation `op`, raised as by [`or_raise`](Self::or_raise).
    #[track_caller]
    pub(crate) fn fits<R>(&self, op: &'static str, inputs: &[&Var<'_, T>], result: Result<R, ShapeError>) -> R {
        let at = self.line();
        let shapes = || inputs.iter().map(|x| Shape::from_slice(x.shape())).collect();
        self.or_raise(result.map_err(|what| Error::Shape { op, shapes: shapes(), what, at }))
    }

    pub(crate) fn with_recording<R>(&self, on: bool, f: impl FnOnce() -> R) -> R {
        with_cell(&self.recording, on, f).0
    }

    /// Runs `f` as part of the gradient of the operation recorded at `at`. Nodes that it adds carry that line.
    pub(crate) fn differentiating<R>(&self, at: &'static Location<'static>, f: impl FnOnce() -> R) -> R {
        with_cell(&self.differentiating, Some(at), f).0
    }

    /// The line of the user's code that an operation belongs to.
    #[track_caller]
    pub(crate) fn line(&self) -> &'static Location<'static> {
        self.differentiating.get().or(self.within.get()).unwrap_or(Location::caller())
    }

    /// Runs operations that belong to the caller's line, even where closures hide it.
    #[track_caller]
    pub(crate) fn as_one<R>(&self, f: impl FnOnce() -> R) -> R {
        with_cell(&self.within, Some(self.line()), f).0
    }

    /// A leaf: a variable to differentiate by (`requires_grad=True` in PyTorch).
    ///
    /// # Panics
    /// If [`check_finite`](Self::check_finite) is on and the value is not finite.
    #[track_caller]
    pub fn leaf(&self, value: Tensor<T>) -> Var<'_, T> {
        let at = self.line();
        if self.checks_values() {
            self.or_raise(find_non_finite(LEAF, "the value", &value, at));
        }
        self.unchecked_leaf(value, at)
    }

    /// A leaf whose value [`check_finite`](Self::check_finite) does not check.
    pub(crate) fn unchecked_leaf(&self, value: Tensor<T>, at: &'static Location<'static>) -> Var<'_, T> {
        let output = Kept::Shape(Shape::from_slice(value.shape()));
        let node = self.nodes.push(Node { op: None, inputs: SmallVec::new(), output, at }, std::iter::empty());
        Var { tape: self, value, node: Some(node) }
    }

    /// A constant: a variable without a gradient.
    pub fn constant(&self, value: Tensor<T>) -> Var<'_, T> {
        Var { tape: self, value, node: None }
    }

    /// Runs an operation, and records it if an input is on the graph.
    ///
    /// # Panics
    /// If the shapes do not fit, an input belongs to another tape, or [`check_finite`](Self::check_finite) is on and
    /// the output is not finite. The message names the operation and the caller's line. Also if the operation breaks
    /// its contract: its number of inputs or the shape of its output.
    #[track_caller]
    pub fn apply<'t>(&'t self, op: impl Op<T>, inputs: &[&Var<'t, T>]) -> Var<'t, T> {
        self.or_raise(self.try_apply(op, inputs))
    }

    /// As [`apply`](Self::apply), with an error instead of a panic.
    ///
    /// # Errors
    /// If the shapes do not fit, or [`check_finite`](Self::check_finite) is on and the output is not finite.
    ///
    /// # Panics
    /// If an input belongs to another tape, or the operation breaks its contract.
    #[track_caller]
    pub fn try_apply<'t>(&'t self, op: impl Op<T>, inputs: &[&Var<'t, T>]) -> Result<Var<'t, T>, Error> {
        self.apply_boxed(Box::new(op), inputs, self.line())
    }

    /// [`try_apply`](Self::try_apply) for a boxed operation, so that it is compiled once.
    #[track_caller]
    fn apply_boxed<'t>(
        &'t self,
        op: Box<dyn Op<T>>,
        inputs: &[&Var<'t, T>],
        at: &'static Location<'static>,
    ) -> Result<Var<'t, T>, Error> {
        let value = self.run(&*op, inputs, at)?;
        Ok(self.record(op, inputs, value, at))
    }

    /// The output of an operation, not recorded. It comes from the memo if there is one.
    #[track_caller]
    fn run(&self, op: &dyn Op<T>, inputs: &[&Var<'_, T>], at: &'static Location<'static>) -> Result<Tensor<T>, Error> {
        let shape = self.check_shapes(op, inputs, at)?;
        let recalled = if op.is_cacheable() { self.reuse(op.name(), &shape) } else { None };
        let value = recalled.unwrap_or_else(|| {
            let values: SmallVec<[&Tensor<T>; 4]> = inputs.iter().map(|x| &x.value).collect();
            op.forward(&values, &self.pool)
        });
        assert_eq!(value.shape(), shape.as_slice(), "{}: `forward` and `shape` disagree", op.name());
        self.check_output(op.name(), inputs, &value, at)?;
        if op.is_cacheable() {
            self.cache(&value);
        }
        Ok(value)
    }

    /// If [`check_finite`](Self::check_finite) is on and the output is not finite: an error that also names the first
    /// such input.
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
        if let Some(arity) = op.arity()
            && arity != inputs.len()
        {
            panic!("{}: {} inputs instead of {arity}", op.name(), inputs.len());
        }
        let shapes: SmallVec<[&[usize]; 4]> = inputs.iter().map(|x| x.shape()).collect();
        let shape = op.shape(&shapes).and_then(|shape| match checked_len(&shape) {
            Some(_) => Ok(shape),
            None => Err(format!("a result of shape {shape:?} has too many elements")),
        });
        shape.map_err(|what| Error::Shape {
            op: op.name(),
            shapes: shapes.iter().map(|shape| Shape::from_slice(shape)).collect(),
            what,
            at,
        })
    }

    pub(crate) fn record<'t>(
        &'t self,
        op: Box<dyn Op<T>>,
        inputs: &[&Var<'t, T>],
        value: Tensor<T>,
        at: &'static Location<'static>,
    ) -> Var<'t, T> {
        if !self.recording.get() || inputs.iter().all(|x| x.node.is_none()) {
            return self.constant(value);
        }
        // Where a gradient is differentiated, the reference of a fused operation takes all inputs.
        let reads = if op.is_fused() { op.reads() } else { op.reads_for(&|i| inputs[i].node.is_some()) };
        let edges = inputs.iter().map(|x| x.node.unwrap_or(CONSTANT));
        let inputs = inputs.iter().enumerate().map(|(i, x)| Kept::new(&x.value, reads.input(i))).collect();
        let output = Kept::new(&value, reads.output());
        let node = Some(self.nodes.push(Node { op: Some(op), inputs, output, at }, edges));
        Var { tape: self, value, node }
    }
}

/// An error on its way to [`Tape::try_run`].
struct Raised(Error);

/// The name of a node without operation in errors and drawings.
pub(crate) const LEAF: &str = "leaf";

/// Runs `f` with another value in a cell, and returns the result and the final value. The old value returns, even if
/// `f` panics.
pub(crate) fn with_cell<V: Default, R>(cell: &Cell<V>, value: V, f: impl FnOnce() -> R) -> (R, V) {
    struct Restore<'a, V: Default>(&'a Cell<V>, V);
    impl<V: Default> Drop for Restore<'_, V> {
        fn drop(&mut self) {
            self.0.set(std::mem::take(&mut self.1));
        }
    }
    let restore = Restore(cell, cell.replace(value));
    let result = f();
    let value = cell.take();
    drop(restore);
    (result, value)
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_only_constants_would_read_is_not_kept() {
        let tape = Tape::<f64>::new();
        let x = tape.leaf(Tensor::full(&[3, 3], 2.0));
        let (c, tall) = (tape.constant(Tensor::full(&[3, 3], 3.0)), tape.constant(Tensor::full(&[1, 1, 3, 3], 1.0)));
        let kept = |y: Var<'_, f64>| {
            let node = tape.nodes.place(y.node.unwrap()).borrow();
            let inputs = &node.as_ref().unwrap().inputs;
            inputs.iter().map(|kept| matches!(kept, Kept::Value(_))).collect::<Vec<_>>()
        };
        assert_eq!(kept(&x * &c), [false, true]);
        assert_eq!(kept(&c * &x), [true, false]);
        assert_eq!(kept(&x / 8.0), [false, true]);
        assert_eq!(kept(&x * &x), [true, true]);
        assert_eq!(kept(x.matmul(&c)), [false, true]);
        assert_eq!(kept(c.matmul(&x)), [true, false]);
        assert_eq!(kept(x.where_(&c.gt(1.0), &c)), [false, false]);
        let image = x.reshape(&[1, 1, 3, 3]);
        assert_eq!(kept(image.conv2d(&tall, &Default::default())), [false, true]);
        assert_eq!(kept(tall.conv2d(&image, &Default::default())), [true, false]);
    }
}
