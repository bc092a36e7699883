//! What training minimises.

pub(crate) mod interlevel;
pub(crate) mod photometric;

pub use interlevel::interlevel;
pub use photometric::Loss;
