//! Fitting a model to photographs.

pub(crate) mod slot;
pub(crate) mod startup;
pub(crate) mod trainer;

pub use trainer::{Budget, StepStats, Trainer};
