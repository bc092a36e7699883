//! What an operation is: a forward kernel and a vector-Jacobian product.

use crate::nodes::CONSTANT;
use crate::reading::Reading;
use crate::{Error, ShapeError, SparseGrad, Tape, Var};
use raygrad_tensor::{Pool, Scalar, Shape, Tensor};
use smallvec::SmallVec;
use std::sync::Arc;

/// An operation of one output. A user's own operation implements this too, and runs with [`Tape::apply`].
///
/// ```
/// use raygrad_autograd::{Grads, Op, ShapeError, Tape, Vjp};
/// use raygrad_tensor::{Pool, Scalar, Shape, Tensor, map};
///
/// /// y = x^3; dx = 3 g x^2.
/// struct Cube;
/// impl<T: Scalar> Op<T> for Cube {
///     fn name(&self) -> &'static str { "cube" }
///     fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> { Ok(Shape::from_slice(x[0])) }
///     fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> { map([x[0]], pool, |[x]| x * x * x) }
///     fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
///         let x = cx.x(0);
///         Grads::one(cx.g() * &x * &x * 3.0) // written with `Var`s, so it has derivatives of its own
///     }
/// }
///
/// let tape = Tape::<f64>::new();
/// let x = tape.leaf(Tensor::scalar(2.0));
/// let y = tape.apply(Cube, &[&x]);
/// let first = &y.grad_graph(&[&x])[0];
/// assert_eq!(first.item(), 12.0);
/// assert_eq!(first.grad(&[&x])[0].item(), 12.0); // second derivative: 6 x
/// ```
pub trait Op<T: Scalar>: Send + Sync + 'static {
    /// The operation's name, as errors and the catalogue show it.
    fn name(&self) -> &'static str;

    /// The number of inputs, if it is always the same: the tape then sees to it. With `None` that is up to
    /// [`shape`](Self::shape).
    fn arity(&self) -> Option<usize> {
        None
    }

    /// The shape of the output for inputs of these shapes.
    ///
    /// # Errors
    /// If the shapes do not fit, in words that need no further context.
    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError>;

    /// The output. Shapes were accepted by [`shape`](Self::shape).
    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T>;

    /// What [`vjp`](Self::vjp) reads and the tape therefore keeps.
    fn reads(&self) -> Reads {
        Reads::INPUTS
    }

    /// As [`reads`](Self::reads), where `has_gradient` says which inputs are on the graph: the others need no gradient, so
    /// that what only theirs would read is not kept. The tape calls this one, unless the operation
    /// [is fused](Self::is_fused).
    fn reads_for(&self, _has_gradient: &dyn Fn(usize) -> bool) -> Reads {
        self.reads()
    }

    /// The gradient of each input, given the gradient `cx.g()` of the output. Inputs for which `cx.needs(i)` is false
    /// may be left out. There is an entry for each input, of its shape, or the sweep panics.
    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T>;

    /// As [`vjp`](Self::vjp), for an operation that takes gradients itself and hands their errors on. The sweep calls
    /// this one.
    ///
    /// # Errors
    /// None, unless the operation overrides it.
    fn try_vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Result<Grads<'t, T>, Error> {
        Ok(self.vjp(cx))
    }

    /// Whether [`Tape::cache_outputs`] keeps the output, for [`Tape::reuse_outputs`] to take it from there: worth it for an operation
    /// that costs far more than a copy of its output. Each row of the output along the first axis must follow from the
    /// same row of the first input and from inputs that no row is special in (parameters).
    fn is_cacheable(&self) -> bool {
        false
    }

    /// Whether the tape goes through [`reference`](Self::reference), which then gives a value, where a gradient is itself
    /// differentiated. The operation then reads all its inputs. An operation whose [`vjp`](Self::vjp) can be recorded
    /// leaves this false, and may still have a reference as an oracle.
    fn is_fused(&self) -> bool {
        false
    }

    /// For a fused operation: the same function out of plain operations. It is the oracle of its tests, and where a
    /// gradient is itself differentiated the tape goes through it instead of [`vjp`](Self::vjp).
    fn reference<'t>(&self, _x: &[Var<'t, T>]) -> Option<Var<'t, T>> {
        None
    }
}

/// Which values an operation's [`vjp`](Op::vjp) reads. Shapes are always known.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Reads {
    inputs: u32,
    output: bool,
}

impl Reads {
    /// Shapes only.
    pub const NOTHING: Reads = Reads { inputs: 0, output: false };
    /// Every input.
    pub const INPUTS: Reads = Reads { inputs: !0, output: false };
    /// The output.
    pub const OUTPUT: Reads = Reads { inputs: 0, output: true };
    /// Every input and the output.
    pub const ALL: Reads = Reads { inputs: !0, output: true };

    /// The inputs with these numbers (below 32).
    pub const fn only(inputs: &[u32]) -> Reads {
        let (mut mask, mut i) = (0, 0);
        while i < inputs.len() {
            mask |= 1 << inputs[i];
            i += 1;
        }
        Reads { inputs: mask, output: false }
    }

    /// The inputs whose bits are set, and with the highest bit the output.
    pub(crate) fn of_bits(bits: u32) -> Reads {
        Reads { inputs: bits & !Reading::OUTPUT, output: bits & Reading::OUTPUT != 0 }
    }

    /// These and the output.
    pub const fn and_output(self) -> Reads {
        Reads { output: true, ..self }
    }

    /// These, and `more` where that is so.
    pub const fn and_if(self, so: bool, more: Reads) -> Reads {
        if so { Reads { inputs: self.inputs | more.inputs, output: self.output || more.output } } else { self }
    }

    /// Whether input `i` is read. Operations of more than 32 inputs read all or none of the rest, as input 31.
    pub fn input(self, i: usize) -> bool {
        self.inputs >> i.min(31) & 1 == 1
    }

    /// Whether the output is read.
    pub fn output(self) -> bool {
        self.output
    }
}

/// What the tape remembers of one operand.
pub(crate) enum Kept<T: Scalar> {
    Value(Tensor<T>),
    Shape(Shape),
}

impl<T: Scalar> Kept<T> {
    pub(crate) fn new(value: &Tensor<T>, keep: bool) -> Self {
        if keep { Kept::Value(value.clone()) } else { Kept::Shape(Shape::from_slice(value.shape())) }
    }

    pub(crate) fn shape(&self) -> &[usize] {
        match self {
            Kept::Value(value) => value.shape(),
            Kept::Shape(shape) => shape,
        }
    }
}

/// What [`Op::vjp`] may use.
pub struct Vjp<'t, 'a, T: Scalar> {
    pub(crate) tape: &'t Tape<T>,
    pub(crate) g: Var<'t, T>,
    pub(crate) op: &'static str,
    /// For each input its node, or [`CONSTANT`].
    pub(crate) edges: &'a [u32],
    pub(crate) inputs: &'a [Kept<T>],
    pub(crate) output: &'a Kept<T>,
    pub(crate) node: u32,
    pub(crate) needs: &'a [bool],
}

impl<'t, T: Scalar> Vjp<'t, '_, T> {
    /// The gradient of the output.
    pub fn g(&self) -> &Var<'t, T> {
        &self.g
    }

    /// Input `i`, on the graph if this pass is recorded.
    ///
    /// # Panics
    /// If the operation's [`Reads`] leave it out.
    #[track_caller]
    pub fn x(&self, i: usize) -> Var<'t, T> {
        let node = Some(self.edges[i]).filter(|&node| node != CONSTANT);
        self.kept(&self.inputs[i], node, "an input")
    }

    /// The output, on the graph if this pass is recorded.
    ///
    /// # Panics
    /// If the operation's [`Reads`] leave it out.
    #[track_caller]
    pub fn y(&self) -> Var<'t, T> {
        self.kept(self.output, Some(self.node), "the output")
    }

    /// The value of input `i`, for a pass that is not recorded.
    ///
    /// # Panics
    /// As [`x`](Self::x).
    #[track_caller]
    pub fn input(&self, i: usize) -> &Tensor<T> {
        self.value_of(&self.inputs[i], "an input")
    }

    /// The value of the output, for a pass that is not recorded.
    ///
    /// # Panics
    /// As [`y`](Self::y).
    #[track_caller]
    pub fn output(&self) -> &Tensor<T> {
        self.value_of(self.output, "the output")
    }

    #[track_caller]
    fn kept(&self, kept: &Kept<T>, node: Option<u32>, what: &str) -> Var<'t, T> {
        Var { tape: self.tape, value: self.value_of(kept, what).clone(), node }
    }

    #[track_caller]
    fn value_of<'k>(&self, kept: &'k Kept<T>, what: &str) -> &'k Tensor<T> {
        match kept {
            Kept::Value(value) => value,
            Kept::Shape(_) => panic!("{}: `vjp` reads {what} that `reads` leaves out", self.op),
        }
    }

    /// The shape of input `i`.
    pub fn shape(&self, i: usize) -> &[usize] {
        self.inputs[i].shape()
    }

    /// Number of inputs.
    pub fn len(&self) -> usize {
        self.inputs.len()
    }

    /// Whether the operation has no inputs.
    pub fn is_empty(&self) -> bool {
        self.inputs.is_empty()
    }

    /// Whether anybody wants the gradient of input `i`.
    pub fn needs(&self, i: usize) -> bool {
        self.needs[i]
    }

    /// Whether this pass is itself recorded. If not, `vjp` may work on tensors directly.
    pub fn recording(&self) -> bool {
        self.tape.is_recording()
    }

    /// The tape.
    pub fn tape(&self) -> &'t Tape<T> {
        self.tape
    }

    /// The tape's pool, for tensors that `vjp` makes itself.
    pub fn pool(&self) -> &'t Pool<T> {
        self.tape.pool()
    }

    /// A tensor as a constant of this tape.
    pub fn constant(&self, value: Tensor<T>) -> Var<'t, T> {
        self.tape.constant(value)
    }
}

/// The gradients of an operation's inputs, in their order.
pub struct Grads<'t, T: Scalar>(pub(crate) SmallVec<[Option<Given<'t, T>>; 2]>);

/// One gradient that an operation gives.
#[derive(Clone)]
pub(crate) enum Given<'t, T: Scalar> {
    Dense(Var<'t, T>),
    Sparse(Arc<dyn SparseGrad<T>>),
    /// Several gradients to add in this order, none of them `Parts`.
    Parts(Vec<Given<'t, T>>),
}

impl<T: Scalar> Given<'_, T> {
    /// Panics if it is not what an operation may give for its input `i` of this shape.
    pub(crate) fn check(&self, op: &str, i: usize, shape: &[usize], recording: bool) {
        let given = match self {
            Given::Dense(grad) => grad.shape(),
            Given::Sparse(_) if recording => panic!(
                "{op}: the gradient of input {i} is sparse in a recorded pass, but a sparse gradient cannot be \
                 differentiated: see `Vjp::recording`"
            ),
            Given::Sparse(share) => share.shape(),
            Given::Parts(parts) => return parts.iter().for_each(|part| part.check(op, i, shape, recording)),
        };
        assert_eq!(given, shape, "{op}: the gradient of input {i} has another shape than the input");
    }
}

impl<'t, T: Scalar> Grads<'t, T> {
    /// The gradient of a single input.
    pub fn one(grad: Var<'t, T>) -> Self {
        Grads(smallvec::smallvec![Some(Given::Dense(grad))])
    }

    /// The gradients of several inputs; `None` where it is zero or nobody needs it.
    pub fn new(grads: impl IntoIterator<Item = Option<Var<'t, T>>>) -> Self {
        Grads(grads.into_iter().map(|grad| grad.map(Given::Dense)).collect())
    }

    /// The same with a sparse gradient for input `i`. Only where the pass is not recorded: a sparse gradient cannot be
    /// differentiated, and a recorded sweep that gets one panics.
    ///
    /// # Panics
    /// If there is no input `i`.
    #[track_caller]
    pub fn with_sparse(mut self, i: usize, grad: Arc<dyn SparseGrad<T>>) -> Self {
        self.0[i] = Some(Given::Sparse(grad));
        self
    }
}
