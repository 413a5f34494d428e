//! Statistics of the datagrams of one device.

use kinematics::Stamp;
use parking_lot::Mutex;
use std::collections::VecDeque;
use std::fmt;
use std::net::SocketAddr;
use std::sync::Arc;
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
    /// Number of times that the clock of the sender restarted or jumped. If this keeps increasing,
    /// the clock does not count nanoseconds.
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
}

impl DatagramMonitor {
    pub(super) fn new(device: &str, address: SocketAddr) -> Self {
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

    /// Address on which it listens.
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

    pub(super) fn set_counts(&self, counts: DatagramCounts) {
        self.state.lock().counts = counts;
    }

    pub(super) fn set_last_rejection(&self, reason: String) {
        self.state.lock().last_rejection = Some(reason);
    }
}

/// Message for a restart of the sender's clock.
pub(super) const CLOCK_RESTARTED: &str =
    "the sender's clock restarted or jumped, or it does not count nanoseconds";

/// Another sender may replace the current one after this time without a datagram from it. A
/// restarted sender usually has a new address. A shorter time would let two programs alternate when
/// one of them pauses; a longer one delays the data of a restarted sender.
const MAX_SENDER_SILENCE: Duration = Duration::from_secs(2);

/// If this many datagrams come from different ports of one host, one program has opened a socket
/// for each of them. Up to four programs that keep their sockets would have used a port again.
const MIN_NEW_PORTS: usize = 5;
/// Number of recent ports of such a program that are stored. It is small, because the system
/// chooses ports at random and may soon choose one again.
const MAX_RECENT_PORTS: usize = 8;

/// The current sender: one at a time, so that the data of two programs cannot mix.
#[derive(Debug, Default)]
pub(super) struct Senders {
    current: Option<(SocketAddr, Stamp)>,
    /// Whether the current sender has used its port more than once.
    keeps_port: bool,
    /// Whether the current sender uses a new port for each datagram, so that only the host
    /// identifies it.
    has_new_ports: bool,
    /// Recent ports of the current sender's host, the newest last; empty if the sender keeps its
    /// port.
    recent_ports: VecDeque<u16>,
    n_changes: u64,
}

impl Senders {
    /// Returns whether to use a datagram from this address. Counts and logs the others.
    pub(super) fn accepts(
        &mut self,
        device: &str,
        from: SocketAddr,
        at: Stamp,
        n_foreign: &mut u64,
    ) -> bool {
        match self.current {
            Some((current, last)) if !self.is_current(current, from) => {
                let is_silent = at.duration_since(last) >= MAX_SENDER_SILENCE;
                // Asked first, because such a sender is never silent: each datagram would otherwise
                // be ignored as that of another program.
                if self.finds_new_ports(current, from) {
                    log::warn!(
                        "{device}: every datagram comes from another port of {}, so its sender opens a socket for each of \
                         them; datagrams from all ports of this host are used from now on. Let the sender keep one \
                         socket, so that a second sender on this host can be ignored",
                        from.ip()
                    );
                } else if is_silent {
                    let what = format_args!(
                        "now receiving from {from}; {current} was silent for more than {MAX_SENDER_SILENCE:?}"
                    );
                    count_and_warn(device, &mut self.n_changes, 1, what);
                    // The ports seen so far are those of another program.
                    if self.has_new_ports || current.ip() != from.ip() {
                        self.has_new_ports = false;
                        self.recent_ports = VecDeque::new();
                    }
                } else {
                    let ports = if self.has_new_ports {
                        ", with a new port for each datagram,"
                    } else {
                        ""
                    };
                    let what = format_args!(
                        "ignored a datagram from {from}, because {current}{ports} is also sending; stop one of them"
                    );
                    count_and_warn(device, n_foreign, 1, what);
                    // Nothing of the current sender changes: ignored datagrams must not keep it
                    // alive.
                    return false;
                }
                self.keeps_port = false;
            }
            // A second datagram from one port: this sender keeps its socket.
            Some(_) if !self.has_new_ports => {
                self.keeps_port = true;
                self.recent_ports.clear();
            }
            _ => {}
        }
        if self.has_new_ports && self.recent_ports.back() != Some(&from.port()) {
            self.recent_ports.push_back(from.port());
            if self.recent_ports.len() > MAX_RECENT_PORTS {
                self.recent_ports.pop_front();
            }
        }
        self.current = Some((from, at));
        true
    }

    /// Whether a datagram comes from the current sender.
    fn is_current(&self, current: SocketAddr, from: SocketAddr) -> bool {
        if self.has_new_ports {
            // A port that was used before belongs to a second program, which keeps its socket.
            current.ip() == from.ip() && !self.recent_ports.contains(&from.port())
        } else {
            current == from
        }
    }

    /// Notes a datagram from another address than the current one. Returns whether it shows that
    /// the sender uses a new port for each datagram.
    fn finds_new_ports(&mut self, current: SocketAddr, from: SocketAddr) -> bool {
        // A sender that keeps its port is known to be one program; another port of its host is
        // another program.
        if self.has_new_ports || self.keeps_port || current.ip() != from.ip() {
            return false;
        }
        if self.recent_ports.contains(&from.port()) {
            // A second program, which keeps its port.
            self.recent_ports.clear();
        }
        if self.recent_ports.is_empty() {
            self.recent_ports.push_back(current.port());
        }
        self.recent_ports.push_back(from.port());
        self.has_new_ports = self.recent_ports.len() >= MIN_NEW_PORTS;
        self.has_new_ports
    }
}

/// Adds `more` to a count, and logs the count if it has at least doubled. Thus the first events are
/// logged, and the log is not flooded.
pub(super) fn count_and_warn(device: &str, n: &mut u64, more: u64, what: impl fmt::Display) {
    let before = n.checked_ilog2();
    *n = n.saturating_add(more);
    // The logarithm changes at 1, 2, 4, 8 and so on.
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
    use super::*;

    #[test]
    fn second_sender_waits_until_the_first_is_silent() {
        let (mut senders, mut n_foreign) = (Senders::default(), 0);
        let [first, second] = [1, 2].map(|port| SocketAddr::from(([127, 0, 0, 1], port)));
        let mut accepts = |from, millis: i64| {
            senders.accepts("arm", from, Stamp(millis * 1_000_000), &mut n_foreign)
        };
        assert!(accepts(first, 0) && accepts(first, 1000));
        assert!(!accepts(second, 1001) && !accepts(second, 2999));
        assert!(accepts(second, 3000), "the first has been silent for 2 s");
        assert!(!accepts(first, 3001) && accepts(second, 3002));
        assert_eq!(n_foreign, 3);
    }

    #[test]
    fn sender_with_a_new_port_for_each_datagram_is_identified_by_its_host() {
        let (mut senders, mut n_foreign) = (Senders::default(), 0);
        let at_port = |port| SocketAddr::from(([127, 0, 0, 1], port));
        let elsewhere = SocketAddr::from(([127, 0, 0, 2], 1000));
        let mut accepts = |from, millis: i64| {
            senders.accepts("arm", from, Stamp(millis * 1_000_000), &mut n_foreign)
        };
        assert!(accepts(at_port(1), 0));
        let accepted: Vec<bool> = (2..100)
            .map(|ix| accepts(at_port(ix), 10 * i64::from(ix)))
            .collect();
        assert!(
            !accepted[..3].contains(&true) && !accepted[3..].contains(&false),
            "{accepted:?}"
        );
        assert!(!accepts(elsewhere, 1000), "another host");
        assert!(
            !accepts(at_port(98), 1001),
            "a second program on the host, which keeps its port"
        );
        assert!(accepts(at_port(100), 1002) && !accepts(at_port(98), 1003));
        assert!(
            accepts(elsewhere, 3002) && !accepts(at_port(101), 3003),
            "a host that was silent is replaced"
        );
        assert!(accepts(elsewhere, 3004));
        assert_eq!(n_foreign, 7);
    }

    #[test]
    fn several_senders_that_keep_their_ports_do_not_mix() {
        let (mut senders, mut n_foreign) = (Senders::default(), 0);
        let at_port = |port| SocketAddr::from(([127, 0, 0, 1], port));
        let mut accepts = |from, millis: i64| {
            senders.accepts("arm", from, Stamp(millis * 1_000_000), &mut n_foreign)
        };
        for round in 0..50 {
            let n_accepted = (1..=4)
                .filter(|port| accepts(at_port(*port), 10 * round + i64::from(*port)))
                .count();
            assert_eq!(n_accepted, 1, "round {round}");
        }
        // The first one has stopped.
        let until_silent = (50..240).flat_map(|round| [2, 3].map(|port| (port, 10 * round)));
        let n_accepted = until_silent
            .filter(|(port, millis)| accepts(at_port(*port), *millis))
            .count();
        assert_eq!(n_accepted, 0);
        assert!(
            accepts(at_port(2), 2501) && !accepts(at_port(3), 2502) && accepts(at_port(2), 2503)
        );
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
