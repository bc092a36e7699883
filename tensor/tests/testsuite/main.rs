//! What this crate promises from outside.

mod naive;
mod ulp;
mod views;
