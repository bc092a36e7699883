//! Views of a model.

pub(crate) mod dense;
pub(crate) mod normals;
pub(crate) mod picture;
pub(crate) mod pixel;
mod tiles;
mod view;

pub use dense::ReferenceRender;
pub use picture::{Render, RenderOptions};
pub use pixel::Pixel;
