//! Errors of a graph: the operation, the shapes, and the line of the user's code.

use raygrad_tensor::Shape;
use std::panic::Location;

/// The reason that an operation or a gradient cannot be computed. The panicking methods show the same text.
#[derive(Debug, Clone, thiserror::Error)]
pub enum Error {
    /// The shapes do not fit the operation.
    #[error("{op}{shapes:?}: {what} (recorded at {at})")]
    Shape {
        /// The operation.
        op: &'static str,
        /// The shapes of its inputs.
        shapes: Vec<Shape>,
        /// The mismatch.
        what: String,
        /// The line of the user's code that called it.
        at: &'static Location<'static>,
    },
    /// [`Tape::check_finite`](crate::Tape::check_finite) is on and a value is infinite or NaN.
    #[error("{op}: {what} is {value} at index {index:?} (recorded at {at})")]
    NonFinite {
        /// The operation.
        op: &'static str,
        /// `output`, or the input whose gradient is not finite.
        what: String,
        /// The first value that is not finite.
        value: f64,
        /// Its index.
        index: Shape,
        /// The line of the user's code that recorded the operation.
        at: &'static Location<'static>,
    },
    /// The gradient of a tensor that has not exactly one element.
    #[error("gradient of a tensor of shape {shape:?}: reduce it to one element first, or use `Var::vjp` (at {at})")]
    NotScalar {
        /// Its shape.
        shape: Shape,
        /// The line of the user's code.
        at: &'static Location<'static>,
    },
    /// The gradient of a constant.
    #[error(
        "gradient of a constant: it was computed from constants only, or while nothing was recorded (in `no_grad`); what a \
         gradient is taken of begins with a leaf (`Tape::leaf`, `Var::tracked`) and is recorded (`Tape::enable_grad`) (at {at})"
    )]
    OfConstant {
        /// The line that requested the gradient.
        at: &'static Location<'static>,
    },
    /// The gradient with respect to a constant.
    #[error(
        "gradient with respect to a constant, number {index} of the variables asked for: make it a leaf (`Tape::leaf`), or \
         begin with `Var::tracked` where an argument may be a constant (at {at})"
    )]
    ByConstant {
        /// Number of the constant among the variables, from 0.
        index: usize,
        /// The line that requested the gradient.
        at: &'static Location<'static>,
    },
    /// In a recorded backward pass, the [`vjp`](crate::Op::vjp) of an operation computed a gradient outside of the
    /// tape. Its derivative would be 0 without reason.
    #[error(
        "{op}: {what}, so the gradient has no derivative; write `vjp` with operations on `Var`s, give the operation a \
         `reference` and set `is_fused`, or return `None` for a gradient of 0 (recorded at {at})"
    )]
    Unrecorded {
        /// The operation.
        op: &'static str,
        /// The gradient or the value that `vjp` took from the tape.
        what: String,
        /// The line of the user's code that recorded the operation.
        at: &'static Location<'static>,
    },
    /// The graph was freed by an earlier [`Var::backward`](crate::Var::backward) or [`Tape::free`](crate::Tape::free).
    #[error(
        "the graph was freed by an earlier `backward` or `Tape::free`; use `grad` for all gradients but the last (at {at})"
    )]
    Freed {
        /// The line that requested the gradient.
        at: &'static Location<'static>,
    },
}

/// The text of a shape error, as [`Op::shape`](crate::Op::shape) returns it.
pub type ShapeError = String;

/// Ok, or the mismatch as an error.
pub(crate) fn ensure(holds: bool, what: impl FnOnce() -> String) -> Result<(), ShapeError> {
    if holds { Ok(()) } else { Err(what()) }
}
