//! Range checks of settings.

use crate::{Error, Result};
use glam::DVec3;
use raygrad_nn::Schedule;
use serde::Deserialize;
use serde::de::IntoDeserializer;
use serde::de::value::{Error as Unknown, StrDeserializer};
use std::fmt;

/// The default of factors in files.
pub(crate) fn one() -> f64 {
    1.0
}

/// The enum variant with this name in files.
pub(crate) fn by_name<'a, V: Deserialize<'a>>(name: &'a str) -> Option<V> {
    let name: StrDeserializer<'a, Unknown> = name.into_deserializer();
    V::deserialize(name).ok()
}

/// Checks that `low <= value <= high`.
pub(crate) fn check_range<V: PartialOrd + fmt::Display>(name: &str, value: V, low: V, high: V) -> Result<()> {
    if value >= low && value <= high {
        return Ok(());
    }
    Err(Error::setting(name, format!("is {value}; use {low} to {high}")))
}

/// Checks the corners of a box.
pub(crate) fn check_bounds([low, high]: [DVec3; 2]) -> Result<()> {
    if low.is_finite() && high.is_finite() && low.cmplt(high).all() {
        return Ok(());
    }
    Err(Error::setting("bounds", format!("is {low} to {high}; use finite corners, the lower below the upper")))
}

/// Checks the number of a field's parameters: a failed allocation would abort the program.
pub(crate) fn check_parameters(count: usize) -> Result<()> {
    const MOST: usize = 1 << 33;
    if count <= MOST {
        return Ok(());
    }
    Err(Error::setting("field", format!("has {count} parameters; use smaller sizes, for at most {MOST}")))
}
/// Checks a learning-rate schedule, if there is one.
pub(crate) fn check_schedule(name: &str, schedule: Option<Schedule>) -> Result<()> {
    let Some(schedule) = schedule else { return Ok(()) };
    schedule.check().map_err(|error| Error::setting(format!("{name}.{}.{}", schedule.name(), error.name), error.what))
}
