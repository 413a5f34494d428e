//! Times of the map: 32 bits per voxel instead of 64.

use kinematics::Stamp;

/// Time before the first image for which images of other cameras are accepted.
const BEFORE_FIRST_NANOS: i64 = 60_000_000_000;

const NANOS_PER_MILLI: i64 = 1_000_000;

/// Counts milliseconds from one minute before the first image, for up to 49 days.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct MapClock {
    start: Option<Stamp>,
}

impl MapClock {
    /// The first image starts the clock.
    pub(crate) fn start(&mut self, stamp: Stamp) {
        let start = Stamp(stamp.0.saturating_sub(BEFORE_FIRST_NANOS));
        self.start.get_or_insert(start);
    }

    /// Milliseconds, rounded down so that ages are never too small; `None` outside of the range.
    pub(crate) fn millis(self, stamp: Stamp) -> Option<u32> {
        let nanos = stamp.nanos_since(self.start?);
        // The largest value means that nothing was seen.
        u32::try_from(nanos.div_euclid(NANOS_PER_MILLI))
            .ok()
            .filter(|millis| *millis < u32::MAX)
    }

    /// Time from `millis` to `now`, at least 0.
    pub(crate) fn age_secs(self, millis: u32, now: Stamp) -> f64 {
        let start = self.start.unwrap_or(now);
        let seen = Stamp(start.0.saturating_add(i64::from(millis) * NANOS_PER_MILLI));
        now.secs_since(seen).max(0.0)
    }
}
