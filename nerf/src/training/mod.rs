//! Fitting a model to photographs.

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
