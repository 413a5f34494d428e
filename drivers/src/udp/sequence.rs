//! Tracks sequence numbers and stamps of a sender, both of which must increase.

use crate::wire::datagram::{Clock, DatagramHeader};
use kinematics::{ClockMap, Stamp};
use std::time::Duration;

/// Maximum gap in the sequence numbers. A larger difference means that the sender restarted. A gap
/// of 1000 is a second of joint states at 1 kHz. With a larger limit, a restart could count as lost
/// values.
const MAX_SEQUENCE_GAP: u64 = 1000;
/// Maximum delay of a reordered datagram. If the newest datagram is older than this, a lower
/// sequence number means that the sender restarted.
const MAX_REORDER_AGE: Duration = Duration::from_secs(1);
/// Maximum age of a stamp that is on this computer's clock. Older stamps are invalid, and so are
/// stamps that are ahead by more than [`MAX_AHEAD`]. No network delays a datagram for this long, so
/// such a stamp comes from another clock.
const MAX_AGE: Duration = Duration::from_secs(5);
/// Maximum time by which a stamp may be in the future. It only allows for rounding.
const MAX_AHEAD: Duration = Duration::from_millis(1);

/// Position of a datagram in the sequence.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum SequencePosition {
    /// The datagram begins a new scan or value, after `n_lost` missing ones.
    New { n_lost: u64 },
    /// The datagram belongs to the newest scan or value.
    Current,
    /// The datagram belongs to an older scan or value.
    Late,
    /// The datagram is the first after a restart of the sender.
    Restart,
}

/// Sequence numbers and stamps of one sender.
#[derive(Clone, Debug, Default)]
pub(crate) struct SequenceTracker {
    clock: ClockMap,
    newest: Option<(u64, Stamp)>,
    newest_stamp: Option<Stamp>,
}

impl SequenceTracker {
    /// Determines the position of a datagram from its sequence number.
    pub(crate) fn position(&mut self, seq: u64, arrival: Stamp) -> SequencePosition {
        let Some((newest, since)) = self.newest else {
            self.newest = Some((seq, arrival));
            return SequencePosition::New { n_lost: 0 };
        };
        let is_near = seq.abs_diff(newest) <= MAX_SEQUENCE_GAP;
        let position = if is_near && seq > newest {
            SequencePosition::New {
                n_lost: seq - newest - 1,
            }
        } else if is_near && arrival.duration_since(since) <= MAX_REORDER_AGE {
            // A late datagram does not become the newest one.
            return if seq == newest {
                SequencePosition::Current
            } else {
                SequencePosition::Late
            };
        } else {
            SequencePosition::Restart
        };
        self.newest = Some((seq, arrival));
        position
    }

    /// Number of times that the sender's clock restarted, jumped, or did not count nanoseconds.
    pub(crate) fn n_clock_restarts(&self) -> u64 {
        self.clock.n_restarts()
    }

    /// Stamp of a new datagram on our clock. `None` if it is impossible or not after the newest
    /// one.
    pub(crate) fn stamp(&mut self, header: &DatagramHeader, arrival: Stamp) -> Option<Stamp> {
        let stamp = match header.clock {
            Clock::Monotonic => Stamp(header.stamp_nanos),
            Clock::Device => self.clock.stamp(header.stamp_nanos, arrival),
        };
        let is_recent = stamp >= arrival - MAX_AGE && stamp <= arrival + MAX_AHEAD;
        // Histories and the merging of devices need increasing stamps, but the clock map may move a
        // stamp slightly back.
        let is_after = self.newest_stamp.is_none_or(|newest| stamp > newest);
        if !(is_recent && is_after) {
            return None;
        }
        // A rejected stamp is not stored: one stamp far ahead would otherwise reject all later
        // ones.
        self.newest_stamp = Some(stamp);
        Some(stamp)
    }
}

/// Returns why a stamp is invalid, with a possible cause.
pub(crate) fn rejection(header: &DatagramHeader, arrival: Stamp) -> String {
    let stamp_nanos = header.stamp_nanos;
    let hint = hint(header, arrival);
    format!("the stamp {stamp_nanos} is not after the previous one, or not recent{hint}")
}

/// Possible cause of an invalid stamp.
fn hint(header: &DatagramHeader, arrival: Stamp) -> &'static str {
    match header.clock {
        Clock::Monotonic if Stamp(header.stamp_nanos) > arrival + MAX_AHEAD => {
            ": set \"clock\" to \"device\" unless stamps are of CLOCK_MONOTONIC on this computer"
        }
        _ => "",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SEC: i64 = 1_000_000_000;

    #[test]
    fn gaps_duplicates_and_reordering_are_distinguished() {
        let mut sequence = SequenceTracker::default();
        let mut at = |seq, millis: i64| sequence.position(seq, Stamp(millis * 1_000_000));
        assert_eq!(at(40, 0), SequencePosition::New { n_lost: 0 });
        assert_eq!(at(40, 1), SequencePosition::Current);
        assert_eq!(at(41, 2), SequencePosition::New { n_lost: 0 });
        assert_eq!(at(45, 3), SequencePosition::New { n_lost: 3 });
        assert_eq!(at(43, 4), SequencePosition::Late);
        assert_eq!(at(46, 5), SequencePosition::New { n_lost: 0 });
    }

    #[test]
    fn restarted_sequence_is_followed() {
        let mut sequence = SequenceTracker::default();
        let mut at = |seq, secs: i64| sequence.position(seq, Stamp(secs * SEC));
        assert_eq!(at(5000, 0), SequencePosition::New { n_lost: 0 });
        assert_eq!(at(0, 0), SequencePosition::Restart, "far behind");
        assert_eq!(at(u64::MAX, 0), SequencePosition::Restart, "far ahead");
        assert_eq!(at(1, 0), SequencePosition::Restart);
        assert_eq!(at(2, 0), SequencePosition::New { n_lost: 0 });
        assert_eq!(at(0, 1), SequencePosition::Late, "a second later");
        assert_eq!(at(0, 2), SequencePosition::Restart, "two seconds later");
        assert_eq!(
            at(0, 4),
            SequencePosition::Restart,
            "always the same number"
        );
    }

    #[test]
    fn clock_not_in_nanoseconds_is_detected() {
        for (per_nano, is_right) in [(1.0, true), (1e-3, false), (1e-6, false), (1e3, false)] {
            let mut sequence = SequenceTracker::default();
            for ix in 0..1000_i64 {
                let nanos = ix * 10_000_000;
                #[expect(clippy::cast_possible_truncation, reason = "ten seconds")]
                let stamp_nanos = (nanos as f64 * per_nano) as i64;
                sequence.stamp(
                    &DatagramHeader {
                        seq: 0,
                        clock: Clock::Device,
                        stamp_nanos,
                    },
                    Stamp(nanos),
                );
            }
            assert_eq!(
                sequence.n_clock_restarts() == 0,
                is_right,
                "{per_nano}: {}",
                sequence.n_clock_restarts()
            );
        }
    }

    #[test]
    fn stamps_increase_and_precede_arrival() {
        let mut sequence = SequenceTracker::default();
        let mut at = |clock, stamp_nanos, arrival| {
            sequence.stamp(
                &DatagramHeader {
                    seq: 0,
                    clock,
                    stamp_nanos,
                },
                Stamp(arrival),
            )
        };
        let now = 1000 * SEC;
        assert_eq!(at(Clock::Monotonic, now - 7, now), Some(Stamp(now - 7)));
        for wrong in [
            now - 7,
            now - 8,
            now - 6 * SEC,
            now + SEC,
            i64::MAX,
            i64::MIN,
            0,
        ] {
            assert_eq!(at(Clock::Monotonic, wrong, now), None, "{wrong}");
        }
        let wall_clock = DatagramHeader {
            seq: 0,
            clock: Clock::Monotonic,
            stamp_nanos: 1_790_000_000 * SEC,
        };
        assert!(hint(&wall_clock, Stamp(now)).contains("device"));
        assert_eq!(
            hint(
                &DatagramHeader {
                    clock: Clock::Device,
                    ..wall_clock
                },
                Stamp(now)
            ),
            ""
        );
        assert_eq!(
            hint(
                &DatagramHeader {
                    stamp_nanos: now - 7,
                    ..wall_clock
                },
                Stamp(now)
            ),
            ""
        );
        // A device clock may have any value.
        assert_eq!(at(Clock::Device, -5, now), Some(Stamp(now)));
        assert_eq!(
            at(Clock::Device, SEC - 5, now + SEC),
            Some(Stamp(now + SEC))
        );
        assert_eq!(
            at(Clock::Device, SEC - 5, now + SEC + 1000),
            None,
            "the same time again"
        );
        for wild in [i64::MAX, i64::MIN, 0] {
            let mapped = at(Clock::Device, wild, now + 2 * SEC);
            assert!(
                mapped.is_none_or(|stamp| stamp <= Stamp(now + 2 * SEC)),
                "{wild}: {mapped:?}"
            );
        }
    }
}
