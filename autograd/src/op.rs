//! An operation: a forward kernel and a vector-Jacobian product.

use crate::nodes::CONSTANT;
use crate::reading::Reading;
use crate::{Error, ShapeError, SparseGrad, Tape, Var};
use raygrad_tensor::{Pool, Scalar, Shape, Tensor};
use smallvec::SmallVec;
use std::cell::Cell;
use std::sync::Arc;

/// An operation with one output. Implement it for a custom operation, and run it with [`Tape::apply`].
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
    /// The operation's name, for errors and the catalogue.
    fn name(&self) -> &'static str;

    /// The number of inputs, if it is fixed; the tape then checks it. With `None`, [`shape`](Self::shape) has to check
    /// it.
    fn arity(&self) -> Option<usize> {
        None
    }

    /// The shape of the output for inputs of these shapes.
    ///
    /// # Errors
    /// If the shapes do not fit. The tape adds the operation, the shapes and the line to the message.
    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError>;

    /// Computes the output. [`shape`](Self::shape) has accepted the shapes of the inputs.
    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T>;

    /// The values that [`vjp`](Self::vjp) reads (PyTorch's `save_for_backward`). The tape saves these.
    fn reads(&self) -> Reads {
        Reads::INPUTS
    }

    /// As [`reads`](Self::reads), where `has_gradient(i)` tells whether input `i` is on the graph. Inputs that are not
    /// need no gradient, so values read for their gradients alone need not be saved. The tape calls this method, unless
    /// the operation [is fused](Self::is_fused).
    fn reads_for(&self, _has_gradient: &dyn Fn(usize) -> bool) -> Reads {
        self.reads()
    }

    /// The gradient of each input, given the gradient `cx.g()` of the output.
    ///
    /// Each gradient has the shape of its input. An input for which `cx.needs(i)` is false may get `None`. A wrong
    /// number of gradients or a wrong shape makes the backward pass panic.
    ///
    /// In a recorded pass ([`Var::grad_graph`], [`Var::hessian`]), the gradients are differentiated too. So compute
    /// them with operations on the variables [`Vjp::g`], [`Vjp::x`] and [`Vjp::y`]. Code on plain tensors needs a
    /// [`reference`](Self::reference) and [`is_fused`](Self::is_fused), which give the derivatives instead.
    ///
    /// A recorded pass fails with [`Error::Unrecorded`] if a gradient does not depend on [`Vjp::g`], or if this method
    /// calls [`Vjp::input`] or [`Vjp::output`]. Return `None` for a gradient that is 0. The pass cannot see that a
    /// factor comes from [`Var::value`] or [`Var::detach`]; the second derivatives of `check::check_op` do.
    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T>;

    /// As [`vjp`](Self::vjp), for an operation that takes gradients itself and returns their errors. The backward pass
    /// calls this method.
    ///
    /// # Errors
    /// None, unless the operation overrides it.
    fn try_vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Result<Grads<'t, T>, Error> {
        Ok(self.vjp(cx))
    }

    /// Whether [`Tape::cache_outputs`] saves the output, for [`Tape::reuse_outputs`]. Return true if computing the
    /// output takes far longer than copying it.
    ///
    /// Each row of the output along the first axis must follow from the same row of the first input. All other inputs
    /// must affect every row alike, as parameters do.
    fn is_cacheable(&self) -> bool {
        false
    }

    /// Whether a recorded backward pass goes through [`reference`](Self::reference) instead of [`vjp`](Self::vjp). The
    /// reference must then return a value, and [`reads`](Self::reads) must list all inputs. An operation whose
    /// [`vjp`](Self::vjp) can be recorded returns false; its reference, if any, then serves tests alone.
    fn is_fused(&self) -> bool {
        false
    }

    /// The same function made of unfused operations, for a fused operation. Tests compare the operation with it. A
    /// recorded backward pass differentiates it instead of calling [`vjp`](Self::vjp).
    fn reference<'t>(&self, _x: &[Var<'t, T>]) -> Option<Var<'t, T>> {
        None
    }
}

/// The values that an operation's [`vjp`](Op::vjp) reads. Shapes are always available.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Reads {
    inputs: u32,
    output: bool,
}

impl Reads {
    /// Shapes alone.
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

    /// These values, and `more` if `so` is true.
    pub const fn and_if(self, so: bool, more: Reads) -> Reads {
        if so { Reads { inputs: self.inputs | more.inputs, output: self.output || more.output } } else { self }
    }

    /// Whether input `i` is read. Inputs from number 31 on share one flag.
    pub fn input(self, i: usize) -> bool {
        self.inputs >> i.min(31) & 1 == 1
    }

    /// Whether the output is read.
    pub fn output(self) -> bool {
        self.output
    }
}

/// The saved value of one operand, or its shape alone.
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

/// The arguments of [`Op::vjp`]: the gradient of the output, saved values and shapes.
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
    /// The last operand on the graph whose value a recorded pass read as a tensor: an input, or the output after all of
    /// them.
    pub(crate) plain: Cell<Option<usize>>,
}

impl<'t, T: Scalar> Vjp<'t, '_, T> {
    /// The gradient of the output.
    pub fn g(&self) -> &Var<'t, T> {
        &self.g
    }

    /// Input `i` as a variable. It is on the graph if this pass is recorded.
    ///
    /// # Panics
    /// If the operation's [`Reads`] leave it out.
    #[track_caller]
    pub fn x(&self, i: usize) -> Var<'t, T> {
        let node = Some(self.edges[i]).filter(|&node| node != CONSTANT);
        self.kept(&self.inputs[i], node, "an input")
    }

    /// The output as a variable. It is on the graph if this pass is recorded.
    ///
    /// # Panics
    /// If the operation's [`Reads`] leave it out.
    #[track_caller]
    pub fn y(&self) -> Var<'t, T> {
        self.kept(self.output, Some(self.node), "the output")
    }

    /// The value of input `i`, for a pass that is not recorded. A recorded one fails with [`Error::Unrecorded`] if the
    /// input is on the graph. Where a value only selects between cases, as a mask does, use `x(i).value()`.
    ///
    /// # Panics
    /// As [`x`](Self::x).
    #[track_caller]
    pub fn input(&self, i: usize) -> &Tensor<T> {
        if self.edges[i] != CONSTANT {
            self.plain.set(Some(i));
        }
        self.value_of(&self.inputs[i], "an input")
    }

    /// The value of the output, for a pass that is not recorded; see [`input`](Self::input).
    ///
    /// # Panics
    /// As [`y`](Self::y).
    #[track_caller]
    pub fn output(&self) -> &Tensor<T> {
        self.plain.set(Some(self.len()));
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

    /// Whether the gradient of input `i` is needed.
    pub fn needs(&self, i: usize) -> bool {
        self.needs[i]
    }

    /// Whether this backward pass is itself recorded. If not, `vjp` may work on tensors directly.
    pub fn recording(&self) -> bool {
        self.tape.is_recording()
    }

    /// The tape.
    pub fn tape(&self) -> &'t Tape<T> {
        self.tape
    }

    /// The tape's pool, for temporary tensors and results.
    pub fn pool(&self) -> &'t Pool<T> {
        self.tape.pool()
    }

    /// A tensor as a constant of this tape.
    pub fn constant(&self, value: Tensor<T>) -> Var<'t, T> {
        self.tape.constant(value)
    }
}

/// The gradients of an operation's inputs, in order.
pub struct Grads<'t, T: Scalar>(pub(crate) SmallVec<[Option<Given<'t, T>>; 2]>);

/// One gradient that an operation returns.
#[derive(Clone)]
pub(crate) enum Given<'t, T: Scalar> {
    Dense(Var<'t, T>),
    Sparse(Arc<dyn SparseGrad<T>>),
    /// Several contributions to add in this order, none of them `Parts`.
    Parts(Vec<Given<'t, T>>),
}

impl<T: Scalar> Given<'_, T> {
    /// Panics if this is not a valid gradient for input `i` of this shape.
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

    /// The gradients of several inputs; `None` where a gradient is 0 or not needed.
    pub fn new(grads: impl IntoIterator<Item = Option<Var<'t, T>>>) -> Self {
        Grads(grads.into_iter().map(|grad| grad.map(Given::Dense)).collect())
    }

    /// Replaces the gradient of input `i` with a sparse one. Use it only where the pass is not recorded. A sparse
    /// gradient cannot be differentiated, so a recorded backward pass panics.
    ///
    /// # Panics
    /// If there is no input `i`.
    #[track_caller]
    pub fn with_sparse(mut self, i: usize, grad: Arc<dyn SparseGrad<T>>) -> Self {
        self.0[i] = Some(Given::Sparse(grad));
        self
    }
}
