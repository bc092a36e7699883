//! Image metrics ([`metrics`], [`lpips`]), colour maps ([`colormap`]) and PNG and JPEG output of an
//! [`Image`](crate::Image).

pub mod colormap;
pub mod lpips;
pub mod metrics;
pub(crate) mod output;

pub use output::quantise;
