//! Automatic differentiation of ndarray tensors on a CPU, and neural radiance fields (NeRF) on top of it.
//!
//! Start with [`guide`], which leads from a first gradient to a custom operation and a trained model. In short:
//!
//! ```
//! use raygrad::{Tape, Tensor};
//! let tape = Tape::<f32>::new();
//! let x = tape.leaf(Tensor::from([[1.0, 2.0], [3.0, 4.0]]));
//! let loss = (x.matmul(&x.t()) * 0.5).sum();
//! assert_eq!(loss.item(), 26.0);
//! assert_eq!(loss.grad(&[&x])[0], [[4.0, 6.0], [4.0, 6.0]]); // the sums of the columns
//! ```
//!
//! The parts of a model are at the top level: [`Tensor`], [`Tape`], [`Var`], [`Params`], layers, optimizers. They come
//! from these crates:
//! * [`tensor`]: arrays and kernels;
//! * [`autograd`]: the tape, operations, gradient checks;
//! * [`nn`]: parameters, layers, optimizers and their files.
//!
//! The feature `nerf` (on by default) adds one more:
//! * `nerf`: cameras, datasets, encodings, fields, sampling, rendering, training.

pub mod guide;

pub use raygrad_autograd as autograd;
pub use raygrad_autograd::*;
#[cfg(feature = "nerf")]
pub use raygrad_nerf as nerf;
pub use raygrad_nn as nn;
pub use raygrad_nn::*;
pub use raygrad_tensor as tensor;

/// The examples of the README and of the book's library pages, as tests.
#[cfg(all(doctest, feature = "nerf"))]
mod documents {
    #[doc = include_str!("../README.md")]
    pub struct Readme;
    #[doc = include_str!("../docs/library/tutorial.md")]
    pub struct Tutorial;
    #[doc = include_str!("../docs/library/custom-operation.md")]
    pub struct CustomOperation;
    #[doc = include_str!("../docs/library/custom-field.md")]
    pub struct CustomField;
}
