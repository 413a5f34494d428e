//! Statistics of the datagrams of one device.

use parking_lot::Mutex;
use std::fmt;
use std::net::SocketAddr;
use std::sync::Arc;

/// Statistics of the datagrams of one device since it was opened.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct DatagramCounts {
    /// Number of received datagrams.
    pub n_received: u64,
    /// Number of datagrams with a wrong format, another device name, or an impossible stamp.
    pub n_rejected: u64,
    /// Number of joint states, poses or scans that did not arrive, according to gaps in the
    /// sequence numbers, plus the number of missing parts of scans that arrived in part.
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
    /// Number of times that the clock of the sender restarted or jumped. If this keeps increasing,
    /// the sender's stamps are probably in a unit other than nanoseconds.
    pub n_clock_restarts: u64,
}

/// Statistics of the datagrams of a device that is read by another thread. Clones share them.
#[derive(Clone, Debug)]
pub struct DatagramMonitor {
    device: String,
    address: SocketAddr,
    state: Arc<Mutex<MonitorState>>,
}

#[derive(Debug, Default)]
struct MonitorState {
    counts: DatagramCounts,
    last_rejection: Option<String>,
    unmatched_names: Option<String>,
}

impl DatagramMonitor {
    pub(crate) fn new(device: &str, address: SocketAddr) -> Self {
        Self {
            device: device.to_owned(),
            address,
            state: Arc::default(),
        }
    }

    /// Name of the device in messages.
    pub fn device(&self) -> &str {
        &self.device
    }

    /// Local address on which fieldrig listens for the datagrams of the device.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Statistics of the datagrams read so far.
    pub fn counts(&self) -> DatagramCounts {
        self.state.lock().counts
    }

    /// Reason for the last rejection; `None` if no datagram was rejected.
    pub fn last_rejection(&self) -> Option<String> {
        self.state.lock().last_rejection.clone()
    }

    /// Names of the first joint state that names none of the arm's joints, beside those of the arm;
    /// `None` if there was no such state.
    pub fn unmatched_names(&self) -> Option<String> {
        self.state.lock().unmatched_names.clone()
    }

    pub(crate) fn set_unmatched_names(&self, names: String) {
        self.state.lock().unmatched_names = Some(names);
    }

    pub(crate) fn set_counts(&self, counts: DatagramCounts) {
        self.state.lock().counts = counts;
    }

    pub(crate) fn set_last_rejection(&self, reason: String) {
        self.state.lock().last_rejection = Some(reason);
    }
}

/// Message for a restart of the sender's clock.
pub(crate) const CLOCK_RESTARTED: &str =
    "the sender's clock restarted or jumped, or it does not count nanoseconds";

/// Adds `more` to a count, and logs the count if it has at least doubled. Thus the first events are
/// logged, and the log is not flooded.
pub(crate) fn count_and_warn(device: &str, n: &mut u64, more: u64, what: impl fmt::Display) {
    let before = n.checked_ilog2();
    *n = n.saturating_add(more);
    // The logarithm changes at 1, 2, 4, 8 and so on.
    if n.checked_ilog2() != before {
        log::warn!("{device}: {what} ({n} so far)");
    }
}

impl DatagramCounts {
    /// Logs a summary if there were any problems.
    pub(crate) fn summarize(&self, device: &str) {
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
        let problems = [
            n_rejected,
            n_lost,
            n_foreign,
            n_late,
            n_dropped,
            n_uncertain,
            n_restarts,
            n_clock_restarts,
        ];
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
    use super::count_and_warn;

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
