//! Training of models on images.
//!
//! Start with [`Trainer`]; the crate's landing page has an example. [`Budget`] is the length of a run, and
//! [`fitted_cameras`] aligns held-out cameras to a trained model.

mod across;
mod fitted;
pub(crate) mod groups;
pub(crate) mod pass;
pub(crate) mod startup;
mod state;
pub(crate) mod stats;
pub(crate) mod trainer;

pub use fitted::fitted_cameras;
pub use stats::{Budget, StepStats};
pub use trainer::Trainer;
