//! Multiresolution hash encoding (Müller et al. 2022, "Instant Neural Graphics Primitives with a Multiresolution Hash
//! Encoding", section 3).
//!
//! [`HashGrid`] is the geometry of levels and table rows, [`HashEncoding`] the operation. Its table's gradient is a
//! sparse [`HashGrad`], which a lazy optimizer ([`Params::set_lazy`](raygrad_nn::Params::set_lazy)) sums level by
//! level.

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
