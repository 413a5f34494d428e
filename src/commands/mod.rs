//! The subcommands, one file each.

pub(crate) mod bench;
pub(crate) mod calibrate;
pub(crate) mod devices;
pub(crate) mod doctor;
pub(crate) mod eval;
pub(crate) mod export;
pub(crate) mod fk;
pub(crate) mod metrics;
pub(crate) mod move_arm;
pub(crate) mod record;
pub(crate) mod render;
pub(crate) mod run;
pub(crate) mod sim;
pub(crate) mod train;
pub(crate) mod view;

use std::ops::RangeInclusive;

/// Returns a parser for a numeric flag that accepts values in the given range.
fn number_in_range(
    range: RangeInclusive<f64>,
) -> impl Fn(&str) -> Result<f64, String> + Clone + Send + Sync {
    move |text| {
        let number = text.parse().ok().filter(|number| range.contains(number));
        number.ok_or_else(|| format!("must be {} to {}", range.start(), range.end()))
    }
}
