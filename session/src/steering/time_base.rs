//! Converts times of the server to stamps of the chain of decisions, and back.

use kinematics::Stamp;
use std::time::{Duration, Instant};

/// Two clocks at the same moment. Both are monotonic and run at the same rate.
#[derive(Clone, Copy, Debug)]
pub(super) struct TimeBase {
    instant: Instant,
    stamp: Stamp,
}

impl TimeBase {
    /// The clocks of this process now.
    pub(super) fn now() -> Self {
        Self {
            instant: Instant::now(),
            stamp: drivers::clock::now(),
        }
    }

    /// The stamp of an instant.
    pub(super) fn stamp(self, at: Instant) -> Stamp {
        // Durations cannot be negative, so one of the two differences is 0.
        let after = at.saturating_duration_since(self.instant);
        let before = self.instant.saturating_duration_since(at);
        let nanos = |span: Duration| i64::try_from(span.as_nanos()).unwrap_or(i64::MAX);
        let shift = nanos(after).saturating_sub(nanos(before));
        Stamp(self.stamp.0.saturating_add(shift))
    }

    /// The instant of a stamp.
    pub(super) fn instant(self, stamp: Stamp) -> Instant {
        let nanos = stamp.0.saturating_sub(self.stamp.0);
        let span = Duration::from_nanos(nanos.unsigned_abs());
        let moved = if nanos < 0 {
            self.instant.checked_sub(span)
        } else {
            self.instant.checked_add(span)
        };
        // Only a time before the computer started has no instant.
        moved.unwrap_or(self.instant)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_before_and_after_are_converted_in_both_directions() {
        let base = TimeBase {
            instant: Instant::now() + Duration::from_secs(10),
            stamp: Stamp(50_000_000_000),
        };
        for nanos in [49_000_000_001, 50_000_000_000, 51_234_567_890] {
            assert_eq!(base.stamp(base.instant(Stamp(nanos))), Stamp(nanos));
        }
        let later = base.instant + Duration::from_millis(3);
        assert_eq!(base.stamp(later), Stamp(50_003_000_000));
    }
}
