//! Where rays are sampled.

pub mod hierarchical;
pub mod marching;
pub mod steps;
