//! What became of the datagrams of one device.

use std::fmt;
use std::net::SocketAddr;

/// Datagrams of one device since it was opened.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct DatagramCounts {
    /// That came.
    pub n_received: u64,
    /// That do not follow the format, name another device, or have an impossible stamp.
    pub n_rejected: u64,
    /// Scans or poses whose numbers were passed over, and parts of scans that never came.
    pub n_lost: u64,
    /// That came twice, or after a later one.
    pub n_late: u64,
    /// That gave way to newer ones because nobody took them.
    pub n_dropped: u64,
    /// Poses that their sender is less sure of than the rig file asks.
    pub n_uncertain: u64,
    /// How often the sender began to count anew.
    pub n_restarts: u64,
    /// How often its own clock began again or jumped; over and over, it does not count nanoseconds.
    pub n_clock_restarts: u64,
}

/// What is said of a clock that did that.
pub(super) const CLOCK_RESTARTED: &str = "the sender's clock began again or jumped, or it does not count nanoseconds";

/// Who sends; there should be one a port, and one that began anew has another port of its own.
#[derive(Debug, Default)]
pub(super) struct Senders {
    newest: Option<SocketAddr>,
    n_changes: u64,
}

impl Senders {
    pub(super) fn note(&mut self, device: &str, from: SocketAddr) {
        if self.newest.replace(from).is_some_and(|before| before != from) {
            count_and_warn(device, &mut self.n_changes, 1, format_args!("{from} sends, another one did before"));
        }
    }
}

/// Counts `more` of a kind, and logs it where that doubles the count at least: soon at first, and never a flood.
pub(super) fn count_and_warn(device: &str, n: &mut u64, more: u64, what: impl fmt::Display) {
    let before = n.checked_ilog2();
    *n = n.saturating_add(more);
    if n.checked_ilog2() != before {
        log::warn!("{device}: {what} ({n} so far)");
    }
}

impl DatagramCounts {
    /// Logs what went wrong, if anything did.
    pub(super) fn summarize(&self, device: &str) {
        let Self { n_received, n_rejected, n_lost, n_late, n_dropped, n_uncertain, n_restarts, n_clock_restarts } =
            self;
        if [n_rejected, n_lost, n_late, n_dropped, n_uncertain, n_restarts, n_clock_restarts].iter().any(|n| **n > 0) {
            log::warn!(
                "{device}: of {n_received} datagrams {n_rejected} were refused, {n_late} came late or twice, {n_dropped} gave way \
                 to newer ones, {n_uncertain} were too unsure; {n_lost} scans, poses or parts were lost; the sender began anew {n_restarts} times, \
                 its clock {n_clock_restarts} times"
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
            count_and_warn("it", &mut n, 1, "comes");
        }
        count_and_warn("it", &mut n, 0, "does not");
        assert_eq!(n, 1_000_000);
        count_and_warn("it", &mut n, u64::MAX, "comes at once");
        assert_eq!(n, u64::MAX);
    }
}
