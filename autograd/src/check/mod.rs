//! The examination of operations: finite differences, dual numbers, precisions, extremes, second order.
//!
//! * [`check_function`]: the derivatives of any function against finite differences.
//! * [`check_op`]: of one operation all that it promises; an [`Entry`] is the operation with what to feed it.
//! * [`catalogue`](catalogue()): every operation of this crate.

mod arrays;
mod catalogue;
mod composed;
mod function;
mod op;

pub(crate) use catalogue::spread;

pub use crate::cases::{Cases, Extreme};
pub use catalogue::{Entry, catalogue};
pub use function::{Check, Report, check_function};
pub use op::check_op;
