//! Encodings: what networks see in place of bare coordinates.

pub mod hash_grid;
pub(crate) mod sinusoids;
pub(crate) mod spherical;

pub use sinusoids::PositionalEncoding;
pub use spherical::SphericalHarmonics;
