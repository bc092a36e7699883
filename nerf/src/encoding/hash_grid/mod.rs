//! Multiresolution hash encoding: trainable features on grids of rising resolution, a small table for each (Müller et
//! al. 2022, "Instant Neural Graphics Primitives with a Multiresolution Hash Encoding", section 3).
//!
//! [`HashGrid`] is the geometry: which rows of the table the eight corners of a cell are, on each level.
//! [`HashEncoding`] is the operation on the tape. The gradient of its table is a [`HashGrad`], which a lazy optimiser (see
//! [`Params::set_lazy`](raygrad_nn::Params::set_lazy)) adds up level by level, in parallel, and never makes dense.

mod encode;
mod gradient;
mod grid;
mod kernel;

pub use encode::HashEncoding;
#[cfg(any(test, feature = "check"))]
pub(crate) use encode::entries;
pub use gradient::HashGrad;
pub use grid::{HashGrid, HashGridConfig, HashLevel};

#[cfg(test)]
mod tests;
