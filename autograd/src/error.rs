//! Errors of a graph: what was asked, of which shapes, at which line of the user's code.

use raygrad_tensor::Shape;
use std::panic::Location;

/// Why an operation or a gradient could not be computed. The panicking forms show the same text.
#[derive(Debug, Clone, thiserror::Error)]
pub enum Error {
    /// The shapes do not fit the operation.
    #[error("{op}{shapes:?}: {what} (recorded at {at})")]
    Shape {
        /// The operation.
        op: &'static str,
        /// The shapes of its inputs.
        shapes: Vec<Shape>,
        /// What does not fit.
        what: String,
        /// The line of the user's code that asked for it.
        at: &'static Location<'static>,
    },
    /// [`Tape::check_finite`](crate::Tape::check_finite) is on and a value is infinite or NaN.
    #[error("{op}: {what} is {value} at index {index:?} (recorded at {at})")]
    NonFinite {
        /// The operation.
        op: &'static str,
        /// `output`, or the input whose gradient it is.
        what: String,
        /// The first bad value.
        value: f64,
        /// Its index.
        index: Shape,
        /// The line of the user's code that recorded the operation.
        at: &'static Location<'static>,
    },
    /// A gradient was asked of something that is not one number.
    #[error("gradient of a tensor of shape {shape:?}: reduce it to one element first, or use `Var::vjp` (at {at})")]
    NotScalar {
        /// Its shape.
        shape: Shape,
        /// The line of the user's code.
        at: &'static Location<'static>,
    },
    /// A gradient was asked of a constant.
    #[error(
        "gradient of a constant: it was computed from constants only, or while nothing was recorded (in `no_grad`); what a \
         gradient is taken of begins with a leaf (`Tape::leaf`, `Var::tracked`) and is recorded (`Tape::enable_grad`) (at {at})"
    )]
    OfConstant {
        /// The line that asked for the gradient.
        at: &'static Location<'static>,
    },
    /// A gradient was asked with respect to a constant.
    #[error(
        "gradient with respect to a constant, number {index} of the variables asked for: make it a leaf (`Tape::leaf`), or \
         begin with `Var::tracked` where an argument may be a constant (at {at})"
    )]
    ByConstant {
        /// Which of the variables it is, from 0.
        index: usize,
        /// The line that asked for the gradient.
        at: &'static Location<'static>,
    },
    /// The graph was freed by an earlier [`Var::backward`](crate::Var::backward) or [`Tape::free`](crate::Tape::free).
    #[error(
        "the graph was freed by an earlier `backward` or `Tape::free`; use `grad` for all gradients but the last (at {at})"
    )]
    Freed {
        /// The line that asked for the gradient.
        at: &'static Location<'static>,
    },
}

/// What an operation says of shapes that do not fit it.
pub type ShapeError = String;

/// Nothing, or what does not fit.
pub(crate) fn ensure(holds: bool, what: impl FnOnce() -> String) -> Result<(), ShapeError> {
    if holds { Ok(()) } else { Err(what()) }
}
