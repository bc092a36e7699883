//! Reverse-mode automatic differentiation of [`raygrad_tensor`] tensors, with gradients of gradients.
//!
//! Start with [`Tape`] and [`Var`]. Parameters, layers and optimizers are in `raygrad-nn`.
//!
//! ```
//! use raygrad_autograd::{Tape, Tensor};
//! let tape = Tape::<f64>::new();
//! let x = tape.leaf(Tensor::from([3.0, -1.0]));
//! let y = (x.square() * &x).sum();
//! assert_eq!(y.grad(&[&x])[0], [27.0, 3.0]); // 3 x^2
//! ```
//!
//! * [`Tape`], [`Var`]: the record of a computation, and a tensor on it. Every operation is a method of [`Var`].
//! * [`derivatives`]: derivatives of functions: Jacobian, Hessian, and products with them.
//! * [`conventions`]: values and gradients at ties, kinks and the edges of domains.
//! * [`Formula`], [`formula!`]: custom elementwise operations, in one forward and one backward pass.
//! * [`Op`]: any other custom operation.
//! * [`Gradient`], [`SparseGrad`]: the gradient of a training step: a dense sum, and sparse rows beside it.
//! * `check` (with the feature of this name): gradient checks, which every operation here passes.

mod cases;
#[cfg(feature = "check")]
pub mod check;
mod checkpoint;
pub mod conventions;
pub mod derivatives;
mod dot;
mod dual;
mod error;
mod formula;
mod grad;
mod gradient;
mod hook;
mod memo;
mod nodes;
mod number;
mod op;
mod operand;
mod ops;
mod path;
mod reading;
mod recorded;
mod row_sums;
mod slopes;
mod sum;
mod sweep;
mod tape;
mod var;

pub use cases::{Cases, Extreme};
pub use dual::Dual;
pub use error::{Error, ShapeError};
pub use formula::{Elementwise, Formula};
pub use gradient::{Gradient, ReadSparse, RowShare, SparseGrad, SparseParts};
pub use memo::CachedOutputs;
pub use number::{Number, Term};
pub use op::{Grads, Op, Reads, Vjp};
pub use operand::{Constant, Operand};
pub use ops::{Activation, Conv2dConfig, Pool2dConfig, RowGrad, Segments};
#[doc(hidden)]
pub use raygrad_tensor::has_angle;
pub use raygrad_tensor::{Axes, INFER, Indices, Mask, Pool, Real, Scalar, Shape, Slice, SliceInfoElem, Tensor, s};
pub use recorded::{Recorded, record};
pub use row_sums::{RowAdder, RowSums};
pub use tape::Tape;
pub use var::Var;
