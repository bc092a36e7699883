//! Tests across crates: gradients, stability, training from end to end.

mod determinism;
mod doctor;
mod documents;
mod gradients;
mod learning;
mod parts;
mod pictures;
mod refine;
mod stability;
mod startup;
mod tape;
mod training;
