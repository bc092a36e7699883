//! What tests of several crates use: damage to files, and how much memory reading them takes.
//!
//! A test program that links this counts what it allocates ([`memory`]).

pub mod campaign;
pub mod damage;
pub mod memory;
pub mod tally;
