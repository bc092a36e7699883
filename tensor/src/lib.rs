//! Dense CPU tensors of `f32` or `f64` on top of [`ndarray`], and the kernels that work on them.
//!
//! Start with [`Tensor`]. This crate has no gradients: the tape is in `raygrad-autograd`.
//!
//! ```
//! use raygrad_tensor::{Tensor, s};
//! let x = Tensor::from([[1.0, 2.0], [3.0, 4.0_f32]]);
//! assert_eq!(x.slice(s![.., 1]), [2.0, 4.0]); // a view, without a copy
//! assert_eq!(x.matmul(&x.t()), [[5.0, 11.0], [11.0, 25.0]]);
//! let mean = x.mean_over(0); // of each column
//! assert_eq!(&x - &mean, [[-1.0, -1.0], [1.0, 1.0]]); // broadcasts as in NumPy
//! ```
//!
//! * [`Tensor`]: a shared buffer with a shape and strides. Clones and views do not copy it.
//! * [`Pool`]: reuses the buffers of dropped tensors.
//! * [`matmul`]: matrix products; transposed operands are not copied.
//! * [`map`] and [`lanes`]: elementwise loops with NumPy's broadcasting, vectorised for the processor at run time.
//! * [`map_fused`] and [`lanes_fused`]: several results of one such loop.
//! * [`sum`], [`sum_axes`], [`sum_to`]: pairwise sums.
//! * [`Layout`]: the strides of a view: broadcast, permute, slice, flip, diagonal, windows, and their adjoints.
//! * [`Windows`]: the windows of a convolution or pooling.
//! * [`Indices`], [`Mask`]: integer and boolean arrays, for sorting, searching, gathering, comparing and selecting.
//! * `random` (with the feature `rand`): uniform and normal numbers, permutations.
//! * [`rows`] and [`extremum`]: softmax, layer normalisation and cross-entropy; the largest and smallest elements.
//! * [`vmath`]: exp, sin, tanh and others, in a form that vectorises in loops.
//!
//! Work on large tensors runs on all threads of the caller's rayon pool; see [`parallel`]. The bits of results do not
//! depend on the number of threads.

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
pub mod scale;
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
pub use lane::{EXACT, Lane, PLAIN, QUICK, has_angle};
pub use layout::{INFER, Layout, checked_len, inferred};
pub use mask::{Mask, choose};
pub use pool::Pool;
pub use real::{Plain, Real, Wide};
pub use reduce::{mean_to, sum, sum_axes, sum_rows, sum_to};
pub use scalar::Scalar;
pub use statistics::{norm_to, variance_to};
pub use tensor::{Shape, Tensor};
pub use windows::Windows;
