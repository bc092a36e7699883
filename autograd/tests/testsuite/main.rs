//! What this crate promises from outside.

mod accuracy;
mod catalogue;
mod conventions;
mod formula;
mod harness;
mod one_way;
mod peers;
mod random_graphs;
mod range;
mod reductions;
mod rows;
mod scans;
