//! Dense tensors of `f32` or `f64` over [`ndarray`], and the kernels that work on them. This crate knows no graph.
//!
//! * [`Tensor`]: a shared buffer seen through a shape and strides; clones and views copy nothing.
//! * [`Pool`]: gives the buffers of dropped tensors to the next ones.
//! * [`matmul`]: matrix products with transposed operands by stride.
//! * [`map`] and [`lanes`]: elementwise loops with NumPy's broadcasting, vectorised for the processor at run time.
//! * [`map_fused`] and [`lanes_fused`]: several results of one such loop.
//! * [`sum`], [`sum_axes`], [`sum_to`]: pairwise sums.
//! * [`Layout`]: the strides of a view: broadcast, permute, slice, flip, diagonal, windows, and their adjoints.
//! * [`Windows`]: what a convolution or a pooling sees of an image.
//! * [`Indices`], [`Mask`]: integer and boolean arrays, for sorting, searching, gathering, comparing and picking.
//! * `random` (with the feature `rand`): uniform and normal numbers, permutations.
//! * [`rows`] and [`extremum`]: softmax, layer normalisation and the like; the greatest and smallest elements.
//! * [`vmath`]: exp, sin, tanh and the like, written so that loops over them vectorise.
//!
//! Work on large tensors is spread over the threads of the caller's rayon pool; see [`parallel`]. The bits do not depend on
//! it.

mod arithmetic;
mod arrange;
mod axes;
mod convert;
mod create;
mod elementwise;
pub mod extremum;
mod fused;
mod indices;
mod lane;
mod layout;
mod mask;
pub mod matmul;
pub mod parallel;
mod pool;
#[cfg(feature = "rand")]
pub mod random;
mod real;
mod reduce;
pub mod rows;
mod scalar;
pub mod simd;
mod statistics;
mod tensor;
mod view;
pub mod vmath;
mod walk;
mod windows;

/// Slices for [`Tensor::slice`] and [`Tensor::slice_axis`], as in ndarray: `s![.., -1, 1..3, ..;-1]`.
pub use ndarray::{Slice, SliceInfoElem, s};

pub use arrange::{repeated, split_places, tiled};
pub use axes::{Axes, Reduction, axis_of, find_axis};
pub use create::concat;
#[doc(hidden)]
pub use elementwise::map_block;
pub use elementwise::{add_assign, broadcast_shape, lanes, map};
pub use fused::{Block, lanes_fused, map_fused};
pub use indices::Indices;
pub use lane::{Lane, has_angle};
pub use layout::{INFER, Layout, checked_len, inferred};
pub use mask::{Mask, choose};
pub use pool::Pool;
pub use real::Real;
pub use reduce::{sum, sum_axes, sum_rows, sum_to};
pub use scalar::Scalar;
pub use tensor::{Shape, Tensor};
pub use windows::Windows;
