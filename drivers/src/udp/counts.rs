//! Statistics of the datagrams of one device.

use kinematics::Stamp;
use std::fmt;
use std::net::SocketAddr;
use std::time::Duration;

/// Statistics of the datagrams of one device since it was opened.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct DatagramCounts {
    /// Number of received datagrams.
    pub n_received: u64,
    /// Number of datagrams with a wrong format, another device name, or an impossible stamp.
    pub n_rejected: u64,
    /// Number of missing sequence numbers and missing parts of scans.
    pub n_lost: u64,
    /// Number of joint states that name none of the arm's joints.
    pub n_other: u64,
    /// Number of datagrams from senders other than the current one.
    pub n_foreign: u64,
    /// Number of datagrams that were duplicates or arrived after a later one.
    pub n_late: u64,
    /// Number of datagrams dropped because the caller was too slow.
    pub n_dropped: u64,
    /// Number of poses whose uncertainty exceeds the limits of the rig file.
    pub n_uncertain: u64,
    /// Number of times that the sequence numbers of the sender restarted.
    pub n_restarts: u64,
    /// Number of times that the clock of the sender restarted or jumped. If this keeps increasing, the clock does not
    /// count nanoseconds.
    pub n_clock_restarts: u64,
}

/// Message for a restart of the sender's clock.
pub(super) const CLOCK_RESTARTED: &str = "the sender's clock restarted or jumped, or it does not count nanoseconds";

/// Another sender may replace the current one after this time without a datagram from it. A restarted sender usually has a
/// new address.
const MAX_SENDER_SILENCE: Duration = Duration::from_secs(2);

/// The current sender: one at a time, so that the data of two programs cannot mix.
#[derive(Debug, Default)]
pub(super) struct Senders {
    current: Option<(SocketAddr, Stamp)>,
    n_changes: u64,
}

impl Senders {
    /// Returns whether to use a datagram from this address. Counts and logs the others.
    pub(super) fn accepts(&mut self, device: &str, from: SocketAddr, at: Stamp, n_foreign: &mut u64) -> bool {
        match self.current {
            Some((current, last)) if current != from && at.duration_since(last) < MAX_SENDER_SILENCE => {
                let what =
                    format_args!("ignored a datagram from {from}, because {current} is also sending; stop one of them");
                count_and_warn(device, n_foreign, 1, what);
                return false;
            }
            Some((current, _)) if current != from => {
                let what = format_args!(
                    "now receiving from {from}; {current} was silent for more than {MAX_SENDER_SILENCE:?}"
                );
                count_and_warn(device, &mut self.n_changes, 1, what);
            }
            _ => {}
        }
        self.current = Some((from, at));
        true
    }
}

/// Adds `more` to a count, and logs the count if it has at least doubled. Thus the first events are logged, and the log
/// is not flooded.
pub(super) fn count_and_warn(device: &str, n: &mut u64, more: u64, what: impl fmt::Display) {
    let before = n.checked_ilog2();
    *n = n.saturating_add(more);
    if n.checked_ilog2() != before {
        log::warn!("{device}: {what} ({n} so far)");
    }
}

impl DatagramCounts {
    /// Logs a summary if there were any problems.
    pub(super) fn summarize(&self, device: &str) {
        let Self {
            n_received,
            n_rejected,
            n_lost,
            n_other,
            n_foreign,
            n_late,
            n_dropped,
            n_uncertain,
            n_restarts,
            n_clock_restarts,
        } = self;
        // States of other joints are no problem.
        let problems = [n_rejected, n_lost, n_foreign, n_late, n_dropped, n_uncertain, n_restarts, n_clock_restarts];
        if problems.iter().any(|n| **n > 0) {
            log::warn!(
                "{device}: {n_received} datagrams: {n_rejected} rejected, {n_foreign} from another sender, {n_other} without any joint of the arm, {n_late} late or duplicate, {n_dropped} dropped because \
                 the program was too slow, {n_uncertain} too uncertain; {n_lost} scans, poses or parts did not arrive; \
                 the sender's sequence numbers restarted {n_restarts} times, its clock {n_clock_restarts} times"
            );
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn second_sender_waits_until_the_first_is_silent() {
        let (mut senders, mut n_foreign) = (Senders::default(), 0);
        let [first, second] = [1, 2].map(|port| SocketAddr::from(([127, 0, 0, 1], port)));
        let mut accepts = |from, millis: i64| senders.accepts("arm", from, Stamp(millis * 1_000_000), &mut n_foreign);
        assert!(accepts(first, 0) && accepts(first, 1000));
        assert!(!accepts(second, 1001) && !accepts(second, 2999));
        assert!(accepts(second, 3000), "the first has been silent for 2 s");
        assert!(!accepts(first, 3001) && accepts(second, 3002));
        assert_eq!(n_foreign, 3);
    }

    #[test]
    fn counts_saturate() {
        let mut n = 0;
        for _ in 0..1_000_000 {
            count_and_warn("device", &mut n, 1, "one event");
        }
        count_and_warn("device", &mut n, 0, "no event");
        assert_eq!(n, 1_000_000);
        count_and_warn("device", &mut n, u64::MAX, "many events");
        assert_eq!(n, u64::MAX);
    }
}
