//! Tests of the crate's public interface, and of its modules.

mod accepted;
mod lenses;
mod modules;
