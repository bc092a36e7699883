//! Settings within their ranges.

use crate::{Error, Result};
use std::fmt;

/// An error unless `low <= value <= high`.
pub(crate) fn check_range<V: PartialOrd + fmt::Display>(name: &str, value: V, low: V, high: V) -> Result<()> {
    if value >= low && value <= high {
        return Ok(());
    }
    Err(Error::setting(name, format!("is {value}; use {low} to {high}")))
}

/// An error if a field would have more parameters than fit the memory of any machine that this runs on: an allocation that
/// fails ends the program.
pub(crate) fn check_parameters(count: usize) -> Result<()> {
    const MOST: usize = 1 << 33;
    if count <= MOST {
        return Ok(());
    }
    Err(Error::setting("field", format!("has {count} parameters; use smaller numbers, for at most {MOST} parameters")))
}
