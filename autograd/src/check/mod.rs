//! Gradient checks of functions and operations: finite differences, dual numbers, both precisions, exact values. Start
//! with [`check_function`].
//!
//! * [`check_function`]: the derivatives of any function against finite differences.
//! * [`check_op`]: all checks of one operation. An [`Entry`] is the operation with its sample inputs.
//! * [`catalogue`](catalogue()): the entries of all operations of this crate.

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
