//! Checks values of a configuration.

use crate::error::Error;

/// Returns an error if a value of a configuration is not valid. NaN fails every comparison, so
/// `is_valid` is a comparison that must hold.
pub(crate) fn check(
    what: impl Into<String>,
    value: f64,
    is_valid: bool,
    expected: &'static str,
) -> Result<(), Error> {
    if is_valid {
        return Ok(());
    }
    Err(Error::Value {
        what: what.into(),
        value,
        expected,
    })
}

/// Checks that a value is positive and finite.
pub(crate) fn positive(what: impl Into<String>, value: f64) -> Result<(), Error> {
    let is_valid = value > 0.0 && value.is_finite();
    check(what, value, is_valid, "a positive number")
}
