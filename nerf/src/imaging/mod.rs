//! Pictures: how far apart two are, maps in colour, and files.

pub mod colormap;
pub mod lpips;
pub mod metrics;
pub(crate) mod output;

pub use output::quantise;
