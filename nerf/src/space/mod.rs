//! The region of a scene: which parts of it hold something, and all of space in a ball.

pub(crate) mod contraction;
pub(crate) mod cube;
pub mod occupancy;
pub(crate) mod silhouette;
pub(crate) mod visibility;

pub use contraction::{Contraction, contract};
pub use cube::Space;
