//! Helpers for tests of several crates: damage to files, and memory measurements of parsers.
//!
//! A test program that links this crate counts its allocations ([`memory`]).

pub mod campaign;
pub mod damage;
pub mod memory;
pub mod tally;
