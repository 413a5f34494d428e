//! Linear map between SI values and unsigned integers, shared by MIT packing and Robstride.
//!
//! Source: `float_to_uint` and `uint_to_float` of Ben Katz's mini cheetah firmware, as in
//! `cmjang/DM_Control_Python`. The integer 0 is the lower end of the range, and the maximum integer
//! is the upper end. These sources truncate, but this module rounds to the nearest integer. Halves
//! are rounded down, so that 0 in a symmetric range is encoded as in these sources.

use super::CanError;

/// Range of a field, and the number of bits that encode it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Scale {
    /// Value that is encoded as 0.
    pub lower: f64,
    /// Value that is encoded as the maximum integer.
    pub upper: f64,
    /// Number of bits, at most 16.
    pub n_bits: u32,
}

impl Scale {
    /// A range that is symmetric about zero.
    pub const fn symmetric(max: f64, n_bits: u32) -> Self {
        Self {
            lower: -max,
            upper: max,
            n_bits,
        }
    }

    /// A range that starts at zero.
    pub const fn positive(max: f64, n_bits: u32) -> Self {
        Self {
            lower: 0.0,
            upper: max,
            n_bits,
        }
    }

    /// Difference of the values of two successive raw integers.
    pub fn step(&self) -> f64 {
        (self.upper - self.lower) / self.max_raw()
    }

    /// Converts to the nearest raw value. Values outside the range are clamped. NaN is an error
    /// that names `field`.
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "clamped to at most 16 bits first"
    )]
    pub fn raw_from_value(&self, field: &'static str, value: f64) -> Result<u16, CanError> {
        if value.is_nan() {
            return Err(CanError::NotFinite { field });
        }
        let unit_interval =
            (value.clamp(self.lower, self.upper) - self.lower) / (self.upper - self.lower);
        // `ceil(x - 0.5)` rounds halves down. The largest integer is odd, so 0 of a symmetric range
        // is encoded as half of the largest integer, rounded down. The sources truncate it to the
        // same integer.
        Ok((unit_interval * self.max_raw() - 0.5)
            .ceil()
            .clamp(0.0, self.max_raw()) as u16)
    }

    /// Converts a raw value.
    pub fn value_from_raw(&self, raw: u16) -> f64 {
        self.lower + f64::from(raw) * self.step()
    }

    fn max_raw(&self) -> f64 {
        f64::from((1_u32 << self.n_bits) - 1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use numbers::random::Random;

    #[test]
    fn counts_round_trip_and_values_within_half_a_step() {
        for (max, n_bits) in [(12.5, 16), (30.0, 12), (0.7, 5)] {
            for scale in [Scale::symmetric(max, n_bits), Scale::positive(max, n_bits)] {
                for raw in 0..=u16::try_from((1_u32 << n_bits) - 1).expect("16 bits") {
                    assert_eq!(
                        scale.raw_from_value("x", scale.value_from_raw(raw)),
                        Ok(raw)
                    );
                }
                let mut random = Random::new(7);
                for _ in 0..10_000 {
                    let value = random.uniform(scale.lower, scale.upper);
                    let back =
                        scale.value_from_raw(scale.raw_from_value("x", value).expect("a number"));
                    // Half a step, plus the rounding of doubles.
                    assert!(
                        (back - value).abs() <= scale.step() * (0.5 + 1e-9),
                        "{value} {back}"
                    );
                }
            }
        }
    }

    #[test]
    fn zero_matches_manufacturer_and_values_are_clamped() {
        let scale = Scale::symmetric(12.5, 16);
        for (value, raw) in [
            (0.0, 0x7FFF),
            (12.5, 0xFFFF),
            (-12.5, 0),
            (99.0, 0xFFFF),
            (-99.0, 0),
            (f64::INFINITY, 0xFFFF),
        ] {
            assert_eq!(scale.raw_from_value("x", value), Ok(raw), "{value}");
        }
        assert_eq!(
            scale.raw_from_value("position", f64::NAN),
            Err(CanError::NotFinite { field: "position" })
        );
    }
}
