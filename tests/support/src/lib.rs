//! What tests of several crates use: damage to files, how much memory reading them takes, and records of tests that skip.
//!
//! A test program that links this crate counts its allocations ([`memory`]).

pub mod campaign;
pub mod damage;
pub mod memory;
pub mod skip;
pub mod tally;
