//! Reverse-mode automatic differentiation over [`raygrad_tensor`], with gradients of gradients, gradient checks, layers
//! and optimisers. This crate knows no rays.
//!
//! ```
//! use raygrad_autograd::{Tape, Tensor};
//! let tape = Tape::<f64>::new();
//! let x = tape.leaf(Tensor::from_vec(&[2], vec![3.0, -1.0]));
//! let y = (x.square() * &x).sum();
//! assert_eq!(y.grad(&[&x])[0].as_slice(), [27.0, 3.0]); // 3 x^2
//! ```
//!
//! * [`guide`]: from a first gradient to an operation of one's own and a trained model.
//! * [`Tape`], [`Var`]: what is recorded; every operation is a method of [`Var`].
//! * [`derivatives`]: of functions: Jacobian, Hessian, and products with them.
//! * [`conventions`]: values and gradients at ties, kinks and the edges of domains.
//! * [`Op`], [`Unary`], [`Binary`]: operations of one's own; [`check_op`] examines them, [`catalogue`](catalogue()) lists
//!   this crate's.
//! * [`Params`], [`Layer`], [`Optimizer`]: models and their training.

mod axes;
mod catalogue;
mod catalogue_arrays;
mod check;
mod check_op;
mod checkpoint;
mod composed;
pub mod conventions;
pub mod derivatives;
mod dot;
mod dual;
mod elementwise;
mod error;
mod files;
mod grad;
mod gradient;
pub mod guide;
mod hook;
mod layers;
mod nodes;
mod npz;
mod op;
mod ops;
mod optim;
mod optim_rows;
mod params;
mod path;
mod row_sums;
mod storage;
mod sum;
mod sweep;
mod tape;
mod var;

pub use axes::Axes;
pub use catalogue::{Cases, Entry, Extreme, catalogue};
pub use check::{Check, Report, check_function};
pub use check_op::check_op;
pub use dual::Dual;
pub use elementwise::{Binary, Map, Unary, Zip};
pub use error::{Error, ShapeError};
pub use files::write_atomic;
pub use gradient::{Gradient, RowShare, SparseGrad};
pub use layers::{Conv2d, Dropout, Embedding, Init, Layer, LayerNorm, Linear, Mlp, Pass, Sequential};
pub use npz::NpzError;
pub use op::{Grads, Op, Reads, Vjp};
pub use ops::{Activation, Conv2dConfig, INFER, Pool2dConfig, RowGrad, Segments};
pub use optim::{Adam, AdamConfig, AdamW, Clipped, Ema, Move, NonFinite, Optimizer, OptimizerState, Schedule};
pub use optim::{SettingError, Sgd, SgdConfig, StateError, UpdateReport};
pub use optim::{clip_norm, clip_value, global_norm};
pub use optim_rows::{RowAdam, RowStats};
pub use params::{Bound, Layout, ParamId, Params};
pub use raygrad_tensor::{Indices, Pool, Real, Scalar, Shape, Tensor};
pub use row_sums::{RowAdder, RowSums};
pub use storage::{ParamsError, Storage};
pub use tape::Tape;
pub use var::Var;
