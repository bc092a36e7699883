//! What this crate promises from outside.
//!
//! Without the feature `gemm`, only what goes through the other backend of matrix products is tested.

mod naive;
#[cfg(feature = "gemm")]
mod ulp;
#[cfg(feature = "gemm")]
mod views;
