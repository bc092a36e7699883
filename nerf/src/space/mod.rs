//! The map from the scene to the unit cube ([`Space`]), scene [contraction](contract) and occupancy grids
//! ([`occupancy`]).

pub(crate) mod contraction;
pub(crate) mod cube;
pub mod occupancy;
pub(crate) mod silhouette;
pub(crate) mod visibility;

pub use contraction::{Contraction, contract};
pub use cube::Space;
