//! Parsers of numeric flags.

use std::ops::RangeInclusive;

/// Returns a parser for a numeric flag that accepts values in the given range.
pub(crate) fn number_in_range(
    range: RangeInclusive<f64>,
) -> impl Fn(&str) -> Result<f64, String> + Clone + Send + Sync {
    move |text| {
        let number = text.parse().ok().filter(|number| range.contains(number));
        number.ok_or_else(|| format!("must be {} to {}", range.start(), range.end()))
    }
}
