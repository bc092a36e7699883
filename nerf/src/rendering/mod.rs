//! Views of a model.

pub(crate) mod dense;
pub(crate) mod picture;
pub(crate) mod view;

pub use dense::DenseView;
pub use picture::{Evaluations, Picture};
pub use view::Limits;
