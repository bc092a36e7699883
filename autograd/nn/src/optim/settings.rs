//! Settings out of their range.

use raygrad_tensor::Scalar;

/// A setting of an optimizer or a schedule that is out of its range.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("`{name}` {what}")]
pub struct SettingError {
    /// The name of the setting.
    pub name: &'static str,
    /// Its value and its range.
    pub what: String,
}

/// An error unless `value` is in its range, which `range` describes. NaN is in no range.
pub(crate) fn check(name: &'static str, value: f64, inside: bool, range: &str) -> Result<(), SettingError> {
    if inside { Ok(()) } else { Err(SettingError { name, what: format!("is {value:?}; use {range}") }) }
}

/// An error unless `value` is at least 0 and at least 8 units below 1. The complement of a decay nearer to 1 has no correct
/// digit in the type.
pub(crate) fn check_decay<T: Scalar>(name: &'static str, value: f64) -> Result<(), SettingError> {
    let least = 8.0 * T::EPSILON;
    check(name, value, value >= 0.0 && 1.0 - value >= least, &format!("0 to 1 - 2^{}", least.log2()))
}

/// An error unless `value` is a valid weight decay or learning rate: 0 to 1e30, which leaves f32 room for multiples.
pub(crate) fn check_rate(name: &'static str, value: f64) -> Result<(), SettingError> {
    check(name, value, (0.0..=1e30).contains(&value), "0 to 1e30")
}

/// Panics if a setting is out of its range; for constructors.
#[track_caller]
pub(crate) fn or_panic(checked: Result<(), SettingError>) {
    if let Err(error) = checked {
        panic!("{error}");
    }
}
