//! Automatic differentiation over ndarray tensors, and NeRF on top of it: photographs and camera poses go in, new views
//! come out. On a CPU.
//!
//! What a model is made of stands at the top: [`Tensor`], [`Tape`], [`Var`], [`Params`], layers, optimisers. It comes from
//! the crates
//! * [`tensor`]: arrays and kernels;
//! * [`autograd`]: the tape, operations, gradient checks;
//! * [`nn`]: parameters, layers, optimisers and their files;
//!
//! and on them [`nerf`]: cameras, datasets, encodings, fields, sampling, rendering, training. [`guide`] leads from a first
//! gradient to an operation of one's own and a trained model.

pub mod guide;

pub use raygrad_autograd as autograd;
pub use raygrad_autograd::*;
pub use raygrad_nerf as nerf;
pub use raygrad_nn as nn;
pub use raygrad_nn::*;
pub use raygrad_tensor as tensor;

/// The README's examples, as tests.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
pub struct Readme;
