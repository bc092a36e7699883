//! Settings out of their range.

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

/// An error unless `value` is at least 0 and below 1.
pub(crate) fn check_share(name: &'static str, value: f64) -> Result<(), SettingError> {
    check(name, value, (0.0..1.0).contains(&value), "at least 0 and less than 1")
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
