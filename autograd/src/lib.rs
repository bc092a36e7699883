//! Reverse-mode automatic differentiation over [`raygrad_tensor`], with gradients of gradients. This crate knows no
//! models: parameters, layers and optimisers are in `raygrad-nn`.
//!
//! ```
//! use raygrad_autograd::{Tape, Tensor};
//! let tape = Tape::<f64>::new();
//! let x = tape.leaf(Tensor::from([3.0, -1.0]));
//! let y = (x.square() * &x).sum();
//! assert_eq!(y.grad(&[&x])[0], [27.0, 3.0]); // 3 x^2
//! ```
//!
//! * [`Tape`], [`Var`]: what is recorded; every operation is a method of [`Var`].
//! * [`derivatives`]: of functions: Jacobian, Hessian, and products with them.
//! * [`conventions`]: values and gradients at ties, kinks and the edges of domains.
//! * [`Formula`], [`formula!`]: custom elementwise operations, in one pass forward and one backward.
//! * [`Op`]: any other operation.
//! * [`Gradient`], [`SparseGrad`]: what an optimiser gets: a dense sum, and shares of a few rows beside it.
//! * `check` (with the feature of this name): the examination that every operation here has to pass.

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
mod sum;
mod sweep;
mod tape;
mod var;

pub use cases::{Cases, Extreme};
pub use dual::Dual;
pub use error::{Error, ShapeError};
pub use formula::{Elementwise, Formula};
pub use gradient::{Gradient, RowShare, SparseGrad};
pub use memo::Memo;
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
