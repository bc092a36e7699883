//! Encodings of positions and directions: [`hash_grid`], [`PositionalEncoding`] and [`SphericalHarmonics`].

mod detail;
pub mod hash_grid;
pub(crate) mod sinusoids;
pub(crate) mod spherical;

pub use detail::detail_weights;
pub use sinusoids::PositionalEncoding;
pub use spherical::SphericalHarmonics;
