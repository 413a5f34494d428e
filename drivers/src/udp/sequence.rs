//! What follows what: numbers that grow, stamps that grow.

use crate::wire::datagram::{Clock, Head};
use kinematics::{ClockMap, Stamp};
use std::time::Duration;

/// Numbers further apart than this are no gap: the sender counts anew.
const MAX_GAP: u64 = 1000;
/// When the newest number is this old, a lower one is no late one: the sender counts anew.
const MAX_LATE: Duration = Duration::from_secs(1);
/// A stamp of our own clock further back than this, or ahead by more than [`MAX_AHEAD`], is wrong.
const MAX_AGE: Duration = Duration::from_secs(5);
/// Room for what rounding does; nothing is sent before it happened.
const MAX_AHEAD: Duration = Duration::from_millis(1);

/// Where a datagram belongs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Place {
    /// It begins a new scan or pose, and so many before it did not come.
    New { n_lost: u64 },
    /// It is of the newest one.
    Newest,
    /// It is of an older one.
    Late,
    /// It is the first of a sender that counts anew.
    Restart,
}

/// The numbers and stamps of one sender.
#[derive(Clone, Debug, Default)]
pub(crate) struct Order {
    clock: ClockMap,
    newest: Option<(u64, Stamp)>,
    newest_stamp: Option<Stamp>,
}

impl Order {
    /// Where a datagram that arrived then belongs, by its number.
    pub(crate) fn place(&mut self, seq: u64, arrival: Stamp) -> Place {
        let Some((newest, since)) = self.newest else {
            self.newest = Some((seq, arrival));
            return Place::New { n_lost: 0 };
        };
        let is_near = seq.abs_diff(newest) <= MAX_GAP;
        let place = match seq > newest {
            true if is_near => Place::New { n_lost: seq - newest - 1 },
            false if is_near && arrival.duration_since(since) <= MAX_LATE => {
                return if seq == newest { Place::Newest } else { Place::Late };
            }
            _ => Place::Restart,
        };
        self.newest = Some((seq, arrival));
        place
    }

    /// How often the sender's clock was found to have begun again, jumped, or not to count nanoseconds.
    pub(crate) fn n_clock_restarts(&self) -> u64 {
        self.clock.n_restarts()
    }

    /// Our time of what a new datagram tells; `None` where that cannot be, or is not after the newest.
    pub(crate) fn stamp(&mut self, head: &Head, arrival: Stamp) -> Option<Stamp> {
        let stamp = match head.clock {
            Clock::Monotonic => Stamp(head.stamp_nanos),
            Clock::Device => self.clock.stamp(head.stamp_nanos, arrival),
        };
        let is_recent = stamp >= arrival - MAX_AGE && stamp <= arrival + MAX_AHEAD;
        let is_after = self.newest_stamp.is_none_or(|newest| stamp > newest);
        if !(is_recent && is_after) {
            return None;
        }
        self.newest_stamp = Some(stamp);
        Some(stamp)
    }
}

/// What may be wrong with a stamp that cannot be.
pub(crate) fn hint(head: &Head, arrival: Stamp) -> &'static str {
    match head.clock {
        Clock::Monotonic if Stamp(head.stamp_nanos) > arrival + MAX_AHEAD => {
            ": \"monotonic\" is CLOCK_MONOTONIC of this computer; the time of day, or a clock elsewhere, is \"device\""
        }
        _ => "",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SEC: i64 = 1_000_000_000;

    #[test]
    fn gaps_doubles_and_disorder_are_told_apart() {
        let mut order = Order::default();
        let mut at = |seq, millis: i64| order.place(seq, Stamp(millis * 1_000_000));
        assert_eq!(at(40, 0), Place::New { n_lost: 0 });
        assert_eq!(at(40, 1), Place::Newest);
        assert_eq!(at(41, 2), Place::New { n_lost: 0 });
        assert_eq!(at(45, 3), Place::New { n_lost: 3 });
        assert_eq!(at(43, 4), Place::Late);
        assert_eq!(at(46, 5), Place::New { n_lost: 0 });
    }

    #[test]
    fn a_sender_that_counts_anew_is_followed() {
        let mut order = Order::default();
        let mut at = |seq, secs: i64| order.place(seq, Stamp(secs * SEC));
        assert_eq!(at(5000, 0), Place::New { n_lost: 0 });
        assert_eq!(at(0, 0), Place::Restart, "far behind");
        assert_eq!(at(u64::MAX, 0), Place::Restart, "far ahead");
        assert_eq!(at(1, 0), Place::Restart);
        assert_eq!(at(2, 0), Place::New { n_lost: 0 });
        assert_eq!(at(0, 1), Place::Late, "a second later");
        assert_eq!(at(0, 2), Place::Restart, "two seconds later");
        assert_eq!(at(0, 4), Place::Restart, "always the same number");
    }

    #[test]
    fn a_clock_that_does_not_count_nanoseconds_is_noticed() {
        for (per_nano, is_right) in [(1.0, true), (1e-3, false), (1e-6, false), (1e3, false)] {
            let mut order = Order::default();
            for ix in 0..1000_i64 {
                let nanos = ix * 10_000_000;
                #[expect(clippy::cast_possible_truncation, reason = "ten seconds")]
                let stamp_nanos = (nanos as f64 * per_nano) as i64;
                order.stamp(&Head { seq: 0, clock: Clock::Device, stamp_nanos }, Stamp(nanos));
            }
            assert_eq!(order.n_clock_restarts() == 0, is_right, "{per_nano}: {}", order.n_clock_restarts());
        }
    }

    #[test]
    fn stamps_grow_and_lie_shortly_before_their_arrival() {
        let mut order = Order::default();
        let mut at = |clock, stamp_nanos, arrival| order.stamp(&Head { seq: 0, clock, stamp_nanos }, Stamp(arrival));
        let now = 1000 * SEC;
        assert_eq!(at(Clock::Monotonic, now - 7, now), Some(Stamp(now - 7)));
        for wrong in [now - 7, now - 8, now - 6 * SEC, now + SEC, i64::MAX, i64::MIN, 0] {
            assert_eq!(at(Clock::Monotonic, wrong, now), None, "{wrong}");
        }
        let by_the_calendar = Head { seq: 0, clock: Clock::Monotonic, stamp_nanos: 1_790_000_000 * SEC };
        assert!(hint(&by_the_calendar, Stamp(now)).contains("device"));
        assert_eq!(hint(&Head { clock: Clock::Device, ..by_the_calendar }, Stamp(now)), "");
        assert_eq!(hint(&Head { stamp_nanos: now - 7, ..by_the_calendar }, Stamp(now)), "");
        // A clock of its own, at any time.
        assert_eq!(at(Clock::Device, -5, now), Some(Stamp(now)));
        assert_eq!(at(Clock::Device, SEC - 5, now + SEC), Some(Stamp(now + SEC)));
        assert_eq!(at(Clock::Device, SEC - 5, now + SEC + 1000), None, "the same instant again");
        for wild in [i64::MAX, i64::MIN, 0] {
            let mapped = at(Clock::Device, wild, now + 2 * SEC);
            assert!(mapped.is_none_or(|stamp| stamp <= Stamp(now + 2 * SEC)), "{wild}: {mapped:?}");
        }
    }
}
