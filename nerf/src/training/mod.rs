//! Fitting a model to photographs.

pub(crate) mod groups;
pub(crate) mod pass;
pub(crate) mod startup;
mod state;
pub(crate) mod stats;
pub(crate) mod trainer;

pub use stats::{Budget, StepStats};
pub use trainer::Trainer;
