//! The stress suite: inputs at which floating point fails, with the right results.
//!
//! Each module has the related rows of the stress matrix and of the failure catalogue, in f32 and f64 (`single::` and
//! `double::`), through the public interface. Expected values that are not obvious come from
//! `reference/constants.json`, which `reference/constants.py` computes with 50 digits. docs/library/numerics.md lists
//! the rows of each module, and the failures that each guard prevents.

#[macro_use]
mod support;

mod accepted;
mod activations;
mod alpha;
mod color;
mod composite;
mod distortion;
mod doctor;
mod encoding;
mod fuzz;
mod geometry;
mod hash_grid;
mod init;
mod march;
mod metrics;
mod optimizer;
mod properties;
mod rotation;
mod sampling;
mod shapes;
mod skipping;
mod sums;
