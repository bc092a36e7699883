//! What this crate promises from outside.

mod concurrency;
mod optim_formulas;
mod optim_peers;
mod optimizers;
