//! Multiresolution hash encoding: trainable features on grids of rising resolution, a small table for each (Müller et
//! al. 2022, "Instant Neural Graphics Primitives with a Multiresolution Hash Encoding", section 3).
//!
//! [`HashGrid`] is the geometry: which rows of the table the eight corners of a cell are, on each level.
//! [`HashEncoding`] is the operation on the tape, and [`TableOptimizer`] trains the table without ever making a dense
//! gradient on a tape.

mod encode;
mod grid;
mod kernel;
mod optimizer;

pub use encode::HashEncoding;
#[cfg(feature = "check")]
pub(crate) use encode::entries;
pub use grid::{HashGrid, HashGridConfig, HashLevel};
pub use optimizer::{HashGrad, TableOptimizer, TableStats};

#[cfg(test)]
mod tests;
