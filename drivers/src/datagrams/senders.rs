//! Selects one of the programs that send datagrams to a socket.

use super::counts::count_and_warn;
use kinematics::Stamp;
use std::collections::VecDeque;
use std::net::SocketAddr;
use std::time::Duration;

/// Another sender may replace the current one after this time without a datagram from it. A
/// restarted sender usually has a new address. With a shorter time, two programs would alternate
/// when one of them pauses. A longer time delays the data of a restarted sender.
const MAX_SENDER_SILENCE: Duration = Duration::from_secs(2);

/// If this many datagrams come from different ports of one host, a single program opens a new
/// socket for each datagram. Up to four programs that keep their sockets would have used one of the
/// ports twice.
const MIN_NEW_PORTS: usize = 5;
/// Number of recent ports that are stored for a program that opens a new socket for each datagram.
/// The number is small, because the system chooses ports at random and may soon choose a port
/// again.
const MAX_RECENT_PORTS: usize = 8;

/// The current sender. There is only one at a time, so that the data of two programs cannot mix.
#[derive(Debug, Default)]
pub(crate) struct Senders {
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
    pub(crate) fn accepts(
        &mut self,
        device: &str,
        from: SocketAddr,
        at: Stamp,
        n_foreign: &mut u64,
    ) -> bool {
        match self.current {
            Some((current, last)) if !self.is_current(current, from) => {
                let is_silent = at.duration_since(last) >= MAX_SENDER_SILENCE;
                // A sender with a new port for each datagram is detected first, because it is never
                // silent. Otherwise, each of its datagrams would be ignored as a datagram of
                // another program.
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
                    // The ports seen so far belong to another program.
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
                    // The state of the current sender does not change, because ignored datagrams
                    // must not keep it alive.
                    return false;
                }
                self.keeps_port = false;
            }
            // A second datagram from the same port shows that this sender keeps its socket.
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
        // If a sender keeps its port, datagrams from another port of its host come from another
        // program.
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
}
