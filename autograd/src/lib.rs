//! Reverse-mode automatic differentiation over [`raygrad_tensor`], with gradients of gradients. This crate knows no rays.

mod catalogue;
mod check;
mod checkpoint;
pub mod derivatives;
mod dot;
mod dual;
mod elementwise;
mod error;
mod hook;
mod layers;
mod op;
mod ops;
mod optim;
mod optim_rows;
mod params;
mod sweep;
mod tape;
mod var;

pub use catalogue::{Cases, Entry, Extreme, catalogue};
pub use check::{Check, Report, check_function, check_op};
pub use dual::Dual;
pub use elementwise::{Binary, Map, Unary, Zip};
pub use error::{Error, ShapeError};
pub use layers::{Init, Linear, Mlp};
pub use op::{Gradient, Grads, Op, Reads, SparseGrad, Vjp};
pub use ops::{Activation, RowGrad, Segments};
pub use optim::{Adam, AdamConfig, Schedule};
pub use optim_rows::{RowAdam, RowStats, Touched};
pub use params::{Bound, ParamId, Params, ParamsError};
pub use raygrad_tensor::{Pool, Real, Scalar, Shape, Tensor};
pub use tape::Tape;
pub use var::Var;
