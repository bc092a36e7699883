//! Automatic differentiation over ndarray tensors, and NeRF on top of it: photographs and camera poses go in, new views
//! come out. On a CPU.
//!
//! This crate re-exports the three that it is made of:
//! * [`tensor`]: arrays and kernels;
//! * [`autograd`]: the tape, operations, gradient checks, layers, optimisers;
//! * [`nerf`]: cameras, datasets, encodings, fields, sampling, rendering, training.

pub use raygrad_autograd as autograd;
pub use raygrad_nerf as nerf;
pub use raygrad_tensor as tensor;

/// The README's examples, as tests.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
pub struct Readme;
