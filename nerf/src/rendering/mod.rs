//! Rendering of images, depth, opacity and normals from a trained model.
//!
//! Start with [`Model::render`](crate::Model::render), or
//! [`Model::render_cancellable`](crate::Model::render_cancellable) for crops and cancellation. [`ReferenceRender`] is a
//! slow render in full precision, to measure others against.

pub(crate) mod dense;
pub(crate) mod normals;
pub(crate) mod picture;
pub(crate) mod pixel;
mod tiles;
mod view;

pub use dense::ReferenceRender;
pub use picture::{Render, RenderOptions};
pub use pixel::Pixel;
