//! Statistics of the datagrams of one device.

use std::fmt;
use std::net::SocketAddr;

/// Statistics of the datagrams of one device since it was opened.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct DatagramCounts {
    /// Number of received datagrams.
    pub n_received: u64,
    /// Number of datagrams with a wrong format, another device name, or an impossible stamp.
    pub n_rejected: u64,
    /// Number of missing sequence numbers and missing parts of scans.
    pub n_lost: u64,
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

/// Addresses of senders. Each port should have one sender; a restarted sender usually has a new address.
#[derive(Debug, Default)]
pub(super) struct Senders {
    newest: Option<SocketAddr>,
    n_changes: u64,
}

impl Senders {
    pub(super) fn note(&mut self, device: &str, from: SocketAddr) {
        if self.newest.replace(from).is_some_and(|before| before != from) {
            count_and_warn(
                device,
                &mut self.n_changes,
                1,
                format_args!("now receiving from {from}; another sender used this port before"),
            );
        }
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
        let Self { n_received, n_rejected, n_lost, n_late, n_dropped, n_uncertain, n_restarts, n_clock_restarts } =
            self;
        if [n_rejected, n_lost, n_late, n_dropped, n_uncertain, n_restarts, n_clock_restarts].iter().any(|n| **n > 0) {
            log::warn!(
                "{device}: {n_received} datagrams: {n_rejected} rejected, {n_late} late or duplicate, {n_dropped} dropped because \
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
