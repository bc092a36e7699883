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
/// Numbers of cases.
pub(crate) const INF: f64 = f64::INFINITY;
pub(crate) const NAN: f64 = f64::NAN;
pub(crate) const PI: f64 = std::f64::consts::PI;

pub use catalogue::{Cases, Entry, Examined, Extreme, catalogue};
pub use function::{Check, Report, check_function};
pub use op::check_op;
