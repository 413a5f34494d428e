//! Maps the clock of a controller to ours, and counts the states that the controller skipped.

use super::state::RobotState;
use crate::udp::sequence::SequenceTracker;
use crate::wire::datagram::{Clock, DatagramHeader};
use kinematics::Stamp;

/// A step of the controller's clock beyond this, in seconds, is a restart or a jump, not a gap.
/// Within this time, the driver closes a connection that is silent.
const MAX_GAP_SECS: f64 = 10.0;

/// A state on our clock.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Timed {
    pub(super) stamp: Stamp,
    /// Number of states that the controller skipped since the previous one.
    pub(super) n_skipped: u64,
}

/// Tracks the clock of one controller, also across connections.
#[derive(Debug)]
pub(super) struct StateTiming {
    rate_hz: f64,
    newest_secs: Option<f64>,
    /// Only the stamps of the tracker are used. The states have no numbers.
    tracker: SequenceTracker,
}

impl StateTiming {
    /// * `rate_hz`: states per second of the controller's clock.
    pub(super) fn new(rate_hz: f64) -> Self {
        Self {
            rate_hz,
            newest_secs: None,
            tracker: SequenceTracker::default(),
        }
    }

    /// Number of restarts of the controller's clock.
    pub(super) fn n_restarts(&self) -> u64 {
        self.tracker.n_clock_restarts()
    }

    /// The time of a state. `None` if its stamp is not after the newest one.
    pub(super) fn time(&mut self, state: &RobotState, arrival: Stamp) -> Option<Timed> {
        let step_secs = self
            .newest_secs
            .map_or(0.0, |newest| state.timestamp_secs - newest);
        self.newest_secs = Some(state.timestamp_secs);
        let header = DatagramHeader {
            seq: 0,
            clock: Clock::Device,
            stamp_nanos: nanos(state.timestamp_secs),
        };
        // The controller sends at a steady rate, but the network and the scheduler delay the
        // arrival. The map between the clocks removes that jitter.
        let stamp = self.tracker.stamp(&header, arrival)?;
        let n_steps = if (0.0..MAX_GAP_SECS).contains(&step_secs) {
            count(step_secs * self.rate_hz)
        } else {
            0
        };
        Some(Timed {
            stamp,
            n_skipped: n_steps.saturating_sub(1),
        })
    }
}

/// Seconds in nanoseconds.
#[expect(
    clippy::cast_possible_truncation,
    reason = "a cast saturates, and no controller runs for 292 years"
)]
fn nanos(secs: f64) -> i64 {
    (secs * 1e9).round() as i64
}

/// A small positive number, rounded.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "at most MAX_GAP_SECS times the rate"
)]
fn count(number: f64) -> u64 {
    number.round() as u64
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A state at a time of the controller's clock.
    fn at(timestamp_secs: f64) -> RobotState {
        RobotState {
            timestamp_secs,
            ..RobotState::default()
        }
    }

    fn arrival(secs: f64) -> Stamp {
        Stamp::default().plus_secs(1000.0 + secs)
    }

    #[test]
    fn skipped_states_are_counted_at_both_rates() {
        for rate_hz in [125.0, 500.0] {
            let mut timing = StateTiming::new(rate_hz);
            // Half a step as the offset: rounding the time itself would count wrong steps.
            let secs = |ix: f64| (ix + 0.5) / rate_hz;
            let mut n_skipped = 0;
            for ix in (0..1000).filter(|ix| ix % 100 != 99) {
                let secs = secs(f64::from(ix));
                n_skipped += timing.time(&at(secs), arrival(secs)).unwrap().n_skipped;
            }
            assert_eq!(
                n_skipped, 9,
                "one of a hundred, and the last one is not noticed"
            );
        }
    }

    #[test]
    fn late_arrivals_do_not_shift_stamps() {
        let mut timing = StateTiming::new(500.0);
        for ix in 0..5000 {
            let secs = f64::from(ix) * 0.002;
            let delay_secs = if ix % 7 == 0 { 1e-4 } else { 5e-3 };
            let timed = timing.time(&at(secs), arrival(secs + delay_secs)).unwrap();
            if ix > 1000 {
                let error_secs = timed.stamp.secs_since(arrival(secs + 1e-4));
                assert!(error_secs.abs() < 1e-4, "{error_secs}");
            }
        }
    }

    #[test]
    fn a_restarted_controller_is_followed() {
        let mut timing = StateTiming::new(500.0);
        for ix in 0..2000 {
            let secs = f64::from(ix) * 0.002;
            timing.time(&at(5000.0 + secs), arrival(secs)).unwrap();
        }
        let timed = timing.time(&at(0.5), arrival(60.0)).unwrap();
        assert_eq!((timed.stamp, timed.n_skipped), (arrival(60.0), 0));
        assert_eq!(timing.n_restarts(), 1);
        assert_eq!(
            timing.time(&at(0.5), arrival(60.001)),
            None,
            "the same state again"
        );
    }
}
