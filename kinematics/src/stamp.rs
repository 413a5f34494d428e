//! Time stamps on one monotonic clock.

use std::ops::{Add, AddAssign, Sub};
use std::time::Duration;

/// A time in nanoseconds on one monotonic clock. Images are stamped at mid-exposure, if the device
/// reports it.
///
/// ```
/// use kinematics::Stamp;
///
/// let shutter = Stamp(1_500_000_000);
/// assert_eq!(shutter.plus_secs(0.25).secs(), 1.75);
/// assert_eq!(shutter.secs_since(Stamp(2_000_000_000)), -0.5);
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Stamp(pub i64);

const NANOS_PER_SEC: f64 = 1e9;

impl Stamp {
    /// The stamp closest to `secs` after the clock's zero. Values beyond the range become the end
    /// of the range, and NaN becomes zero.
    ///
    /// The result is exact to a nanosecond up to 104 days from zero. For longer times, seconds as
    /// f64 have a coarser resolution.
    #[expect(
        clippy::cast_possible_truncation,
        reason = "a float to integer cast saturates, as documented"
    )]
    pub fn from_secs(secs: f64) -> Self {
        Self((secs * NANOS_PER_SEC).round() as i64)
    }

    /// Seconds after the clock's zero.
    pub fn secs(self) -> f64 {
        self.0 as f64 / NANOS_PER_SEC
    }

    /// Seconds from `earlier` to this stamp. The result is negative if `earlier` is later.
    ///
    /// The difference is computed in nanoseconds first, so short spans are exact at any clock time.
    pub fn secs_since(self, earlier: Self) -> f64 {
        self.nanos_since(earlier) as f64 / NANOS_PER_SEC
    }

    /// Nanoseconds from `earlier` to this stamp. The result is negative if `earlier` is later.
    pub fn nanos_since(self, earlier: Self) -> i64 {
        self.0.saturating_sub(earlier.0)
    }

    /// The stamp that is `secs` later than this stamp. If `secs` is negative, it is earlier.
    pub fn plus_secs(self, secs: f64) -> Self {
        Self(self.0.saturating_add(Self::from_secs(secs).0))
    }

    /// Time from `earlier` to this stamp. The result is zero if `earlier` is later.
    pub fn duration_since(self, earlier: Self) -> Duration {
        Duration::from_nanos(u64::try_from(self.nanos_since(earlier)).unwrap_or(0))
    }
}

fn nanos(duration: Duration) -> i64 {
    i64::try_from(duration.as_nanos()).unwrap_or(i64::MAX)
}

impl Add<Duration> for Stamp {
    type Output = Self;

    fn add(self, duration: Duration) -> Self {
        Self(self.0.saturating_add(nanos(duration)))
    }
}

impl AddAssign<Duration> for Stamp {
    fn add_assign(&mut self, duration: Duration) {
        *self = *self + duration;
    }
}

impl Sub<Duration> for Stamp {
    type Output = Self;

    fn sub(self, duration: Duration) -> Self {
        Self(self.0.saturating_sub(nanos(duration)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn seconds_round_to_nearest_nanosecond() {
        assert_eq!(Stamp::from_secs(1.5), Stamp(1_500_000_000));
        assert_eq!(Stamp::from_secs(-0.000_000_000_6), Stamp(-1));
        assert_eq!(Stamp::from_secs(f64::INFINITY), Stamp(i64::MAX));
        assert_eq!(Stamp::from_secs(f64::NAN), Stamp(0));
        assert_eq!(Stamp(2_250_000_000).secs(), 2.25);
    }

    #[test]
    fn short_spans_are_exact_at_large_stamps() {
        let late = Stamp(1_800_000_000_123_456_789);
        assert_eq!((late + Duration::from_nanos(1)).secs_since(late), 1e-9);
        assert_eq!(late.secs_since(late + Duration::from_millis(250)), -0.25);
        assert_eq!(late.plus_secs(-0.25) + Duration::from_millis(250), late);
    }

    #[test]
    fn durations_are_never_negative_and_saturate() {
        assert_eq!(Stamp(5).duration_since(Stamp(2)), Duration::from_nanos(3));
        assert_eq!(Stamp(2).duration_since(Stamp(5)), Duration::ZERO);
        assert_eq!(Stamp(i64::MAX) + Duration::from_secs(1), Stamp(i64::MAX));
        assert_eq!(Stamp(i64::MIN) - Duration::from_secs(1), Stamp(i64::MIN));
    }
}
