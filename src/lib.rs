//! Automatic differentiation over ndarray tensors, and NeRF on top of it: photographs and camera poses go in, new views
//! come out. On a CPU.
//!
//! What a model is made of stands at the top: [`Tensor`], [`Tape`], [`Var`], [`Params`], layers, optimisers. It comes from
//! the crates
//! * [`tensor`]: arrays and kernels;
//! * [`autograd`]: the tape, operations, gradient checks;
//! * [`nn`]: parameters, layers, optimisers and their files;
//!
//! and, with the feature `nerf` (on by default), from
//! * [`nerf`](https://docs.rs/raygrad-nerf): cameras, datasets, encodings, fields, sampling, rendering, training.
//!
//! [`guide`] leads from a first gradient to a custom operation and a trained model.

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
