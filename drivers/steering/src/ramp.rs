//! How speed depends on distance.

use crate::check::check;
use crate::error::Error;

/// Speed as a fraction of full speed: 1 at `slow_m` and beyond, decreasing linearly to 0 at
/// `stop_m`, but at least `creep`, so that the stop distance is reached and left again.
pub(crate) fn speed_scale(distance_m: f64, stop_m: f64, slow_m: f64, creep: f64) -> f64 {
    ((distance_m - stop_m) / (slow_m - stop_m)).clamp(creep, 1.0)
}

/// Checks the distances and the speed of a ramp.
pub(crate) fn check_ramp(what: &str, stop_m: f64, slow_m: f64, creep: f64) -> Result<(), Error> {
    check(
        format!("{what}.stop_m"),
        stop_m,
        stop_m >= 0.0,
        "0 or a positive number",
    )?;
    let is_valid = slow_m > stop_m && slow_m.is_finite();
    check(
        format!("{what}.slow_m"),
        slow_m,
        is_valid,
        "more than stop_m",
    )?;
    let is_valid = creep > 0.0 && creep <= 1.0;
    check(
        format!("{what}.creep_frac"),
        creep,
        is_valid,
        "more than 0 and at most 1",
    )
}
