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

/// Returns a parser for the size of an image, whose sides are 1 to `max_side_px` pixels.
pub(crate) fn size_up_to(
    max_side_px: u32,
) -> impl Fn(&str) -> Result<[u32; 2], String> + Clone + Send + Sync {
    move |text| {
        let sides = text
            .split_once('x')
            .and_then(|(width, height)| Some([width.parse().ok()?, height.parse().ok()?]));
        sides
            .filter(|sides: &[u32; 2]| sides.iter().all(|side| (1..=max_side_px).contains(side)))
            .ok_or_else(|| {
                format!("expected WIDTHxHEIGHT, such as 1280x720, each from 1 to {max_side_px}")
            })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_have_two_sides_within_the_limit() {
        let size = size_up_to(16_384);
        assert_eq!(size("640x480"), Ok([640, 480]));
        for invalid in ["640", "640x", "0x480", "99999x1", "640x480x3"] {
            assert!(size(invalid).is_err(), "{invalid}");
        }
    }
}
