//! What this crate promises from outside.

mod accepted;
mod lenses;
mod modules;
