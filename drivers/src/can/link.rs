//! Checks the configuration of a CAN interface and returns the command that repairs it.

use super::config::BusConfig;
use super::interfaces::interfaces;
use crate::Error;
use socketcan::CanInterface;
use socketcan::nl::{CanState, InterfaceDetails, Mtu};
use std::io;
use std::path::Path;

/// Time from a bus-off to the automatic restart, in milliseconds. The printed commands set this
/// time. With a shorter time, a node with a permanent fault would disturb the bus more often. With
/// a longer time, the gap in the joint states would be longer. The gap must stay below one second,
/// because a motor then counts as silent.
const RESTART_MILLIS: u32 = 100;

/// State of a controller according to its error counters.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum State {
    /// Both error counters are below 96.
    Active,
    /// An error counter has reached 96.
    Warning,
    /// An error counter has reached 128. The controller no longer sends active error flags, which
    /// would destroy the frames of other nodes.
    Passive,
    /// The transmit error counter has exceeded 255. The controller takes no part in the bus until
    /// it is restarted.
    BusOff,
    /// The controller is down or asleep.
    Stopped,
}

/// Configuration of an interface as reported by the kernel.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Link {
    /// Name.
    pub interface: String,
    /// Whether it is up.
    pub is_up: bool,
    /// Whether it accepts FD frames.
    pub is_fd: bool,
    /// Bit rate, bit/s; `None` for virtual interfaces, or if none is set.
    pub bitrate_hz: Option<u32>,
    /// Bit rate of the data phase of FD frames, bit/s.
    pub data_bitrate_hz: Option<u32>,
    /// Time from a bus-off to the automatic restart, milliseconds; 0 means no restart.
    pub restart_millis: Option<u32>,
    /// State of the controller according to its error counters; `None` for virtual interfaces.
    pub state: Option<State>,
    /// Current transmit and receive error counters.
    pub n_errors: Option<[u16; 2]>,
}

/// A problem with an interface.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LinkProblem {
    /// Description of the problem.
    pub problem: String,
    /// Shell command that fixes it.
    pub command: String,
}

impl Link {
    /// Reads the configuration from the kernel.
    ///
    /// # Errors
    /// If the interface does not exist. The error lists the existing ones.
    pub fn read(interface: &str) -> Result<Self, Error> {
        let details = CanInterface::open(interface).and_then(|open| open.details());
        details
            .map(|details| Self::of(interface, &details))
            .map_err(|error| {
                let reason = match io_error(error) {
                    error if error.raw_os_error() == Some(ENODEV) => missing_interface(interface),
                    error => error,
                };
                Error::CanBus {
                    interface: interface.to_owned(),
                    reason,
                }
            })
    }

    fn of(interface: &str, details: &InterfaceDetails) -> Self {
        let can = &details.can;

        Self {
            interface: interface.to_owned(),
            is_up: details.is_up,
            is_fd: details.mtu == Some(Mtu::Fd),
            bitrate_hz: bit_rate_hz(can.bit_timing),
            data_bitrate_hz: bit_rate_hz(can.data_bit_timing),
            restart_millis: can.restart_ms,
            // A virtual interface has no controller, so its driver reports no state.
            state: can.state.map(|state| match state {
                CanState::ErrorActive => State::Active,
                CanState::ErrorWarning => State::Warning,
                CanState::ErrorPassive => State::Passive,
                CanState::BusOff => State::BusOff,
                CanState::Stopped | CanState::Sleeping => State::Stopped,
            }),
            n_errors: can
                .berr_counter
                .map(|counter| [counter.txerr, counter.rxerr]),
        }
    }

    /// Whether it is a virtual interface, which has neither a bit rate nor error counters.
    fn is_virtual(&self) -> bool {
        self.state.is_none()
    }

    /// Problems that must be fixed before motors can be read with `config`. Empty if there are
    /// none.
    pub fn problems(&self, config: &BusConfig) -> Vec<LinkProblem> {
        // One command configures the interface completely, so it fixes every problem.
        let command = set_up_command(&self.interface, self.is_virtual(), config);
        self.problem_texts(config)
            .into_iter()
            .map(|problem| LinkProblem {
                problem,
                command: command.clone(),
            })
            .collect()
    }

    /// Descriptions of the problems, the most basic first.
    fn problem_texts(&self, config: &BusConfig) -> Vec<String> {
        let mut problems = Vec::new();
        if !self.is_up {
            problems.push("it is down".to_owned());
        }
        if config.data_bitrate_hz.is_some() && !self.is_fd {
            problems.push("it does not accept FD frames".to_owned());
        }
        // A virtual interface has no bit rate that could be wrong, and cannot go bus-off.
        if self.is_virtual() {
            return problems;
        }
        match self.bitrate_hz {
            Some(bitrate_hz) if bitrate_hz == config.bitrate_hz => {}
            Some(bitrate_hz) => {
                problems.push(format!(
                    "its bit rate is {bitrate_hz}, but the rig file requires {}",
                    config.bitrate_hz
                ));
            }
            None => problems.push(format!(
                "no bit rate is set; the rig file requires {}",
                config.bitrate_hz
            )),
        }
        if let Some(data_bitrate_hz) = config
            .data_bitrate_hz
            .filter(|rate| self.data_bitrate_hz != Some(*rate))
        {
            let reported = self
                .data_bitrate_hz
                .map_or_else(|| "not set".to_owned(), |rate| rate.to_string());
            problems.push(format!(
                "its bit rate for FD data is {reported}, but the rig file requires {data_bitrate_hz}"
            ));
        }
        // Without a restart, one bus-off would end the reading of the arm until somebody sets up
        // the interface again.
        if self.restart_millis == Some(0) && !config.accept_no_restart {
            problems.push(format!(
                "it does not restart after a bus-off (restart-ms 0; for an adapter without automatic restart, on a serial \
                 line for instance, set arm.bus.{}.accept_no_restart = true)",
                self.interface
            ));
        }
        // An interface that is down is `Stopped`, which is reported above.
        if self.is_up && self.state >= Some(State::BusOff) {
            problems.push(
                "it is bus-off: check wiring, termination and the bit rate of the other nodes"
                    .to_owned(),
            );
        }
        problems
    }

    /// Returns the first problem as an error.
    pub fn check(&self, config: &BusConfig) -> Result<(), Error> {
        match self.problems(config).into_iter().next() {
            Some(LinkProblem { problem, command }) => Err(Error::CanLink {
                interface: self.interface.clone(),
                problem,
                command,
            }),
            None => Ok(()),
        }
    }
}

impl std::fmt::Display for Link {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(
            f,
            "{}: {}",
            self.interface,
            if self.is_up { "up" } else { "down" }
        )?;
        match (self.bitrate_hz, self.data_bitrate_hz) {
            (Some(rate), Some(data)) => write!(f, ", {rate} and {data} bit/s")?,
            (Some(rate), None) => write!(f, ", {rate} bit/s")?,
            (None, _) if self.is_virtual() => write!(f, ", virtual")?,
            (None, _) => {}
        }
        if let Some(state) = self.state {
            write!(f, ", state {}", format!("{state:?}").to_lowercase())?;
        }
        match self.n_errors {
            Some([sent, received]) => write!(f, ", {sent} errors sending and {received} receiving"),
            None => Ok(()),
        }
    }
}

/// Shell command that configures an interface as in the rig file.
fn set_up_command(interface: &str, is_virtual: bool, config: &BusConfig) -> String {
    if is_virtual {
        return match config.data_bitrate_hz {
            // The MTU cannot be changed while the interface is up.
            Some(_) => {
                format!("sudo ip link set {interface} down; sudo ip link set {interface} mtu 72 up")
            }
            None => format!("sudo ip link set {interface} up"),
        };
    }
    // An interface must be down while its bit rate changes, so the command takes it down first.
    // This step has no effect if the interface is down already.
    let fd = config
        .data_bitrate_hz
        .map_or_else(String::new, |rate| format!(" dbitrate {rate} fd on"));
    // For adapters that do not support `restart-ms`, `ip` would refuse the whole command.
    let restart = if config.accept_no_restart {
        String::new()
    } else {
        format!(" restart-ms {RESTART_MILLIS}")
    };
    format!(
        "sudo ip link set {interface} down; sudo ip link set {interface} up type can bitrate {}{fd}{restart}",
        config.bitrate_hz
    )
}

/// The bit rate in a timing, bit/s. The kernel reports 0 if none is set.
fn bit_rate_hz(timing: Option<socketcan::nl::CanBitTiming>) -> Option<u32> {
    timing
        .map(|timing| timing.bitrate)
        .filter(|bitrate_hz| *bitrate_hz > 0)
}

/// `errno` for "no such device".
const ENODEV: i32 = 19;

fn missing_interface(interface: &str) -> io::Error {
    // A virtual interface is missing if nobody has created it, so a list of the hardware would not
    // help.
    if interface.starts_with("vcan") {
        let create_command = format!(
            "sudo modprobe vcan; sudo ip link add dev {interface} type vcan; sudo ip link set {interface} up"
        );
        return io::Error::new(
            io::ErrorKind::NotFound,
            format!("no such interface; create a virtual one with: {create_command}"),
        );
    }
    let others = match interfaces(Path::new("/sys")).as_slice() {
        [] => {
            "this computer has none; check that the adapter is connected and its driver is loaded"
                .to_owned()
        }
        names => format!("existing interfaces: {}", names.join(", ")),
    };
    io::Error::new(
        io::ErrorKind::NotFound,
        format!("no such interface: {others}"),
    )
}

/// The error of the system, with its number if it has one.
fn io_error(error: socketcan::Error) -> io::Error {
    match error {
        socketcan::Error::Io(error) => error,
        socketcan::Error::Nl(error) => error.errno().map_or_else(
            || io::Error::other(error.to_string()),
            io::Error::from_raw_os_error,
        ),
        error => io::Error::other(error.to_string()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn config(data_bitrate_hz: Option<u32>) -> BusConfig {
        BusConfig {
            interface: "can0".to_owned(),
            bitrate_hz: 1_000_000,
            data_bitrate_hz,
            accept_no_restart: false,
        }
    }

    fn good_link() -> Link {
        Link {
            interface: "can0".to_owned(),
            is_up: true,
            is_fd: false,
            bitrate_hz: Some(1_000_000),
            data_bitrate_hz: None,
            restart_millis: Some(100),
            state: Some(State::Active),
            n_errors: Some([0, 0]),
        }
    }

    #[test]
    fn problems_come_with_the_command_that_fixes_them() {
        const EXPECTED_COMMAND: &str = "sudo ip link set can0 down; sudo ip link set can0 up type can bitrate 1000000 restart-ms 100";
        assert_eq!(good_link().problems(&config(None)), []);
        let broken_links: [(Link, &str); 5] = [
            (
                Link {
                    is_up: false,
                    state: Some(State::Stopped),
                    ..good_link()
                },
                "it is down",
            ),
            (
                Link {
                    bitrate_hz: Some(500_000),
                    ..good_link()
                },
                "its bit rate is 500000, but the rig file requires 1000000",
            ),
            (
                Link {
                    bitrate_hz: None,
                    ..good_link()
                },
                "no bit rate is set",
            ),
            (
                Link {
                    restart_millis: Some(0),
                    ..good_link()
                },
                "does not restart after a bus-off",
            ),
            (
                Link {
                    state: Some(State::BusOff),
                    ..good_link()
                },
                "bus-off",
            ),
        ];
        for (link, what) in broken_links {
            let problems = link.problems(&config(None));
            assert_eq!(problems.len(), 1, "{problems:?}");
            assert!(problems[0].problem.contains(what), "{problems:?}");
            assert_eq!(problems[0].command, EXPECTED_COMMAND);
            assert!(
                link.check(&config(None))
                    .is_err_and(|error| error.to_string().contains(EXPECTED_COMMAND))
            );
        }
    }

    #[test]
    fn can_fd_requires_fd_enabled() {
        let problems = good_link().problems(&config(Some(5_000_000)));
        assert_eq!(problems.len(), 2, "{problems:?}");
        assert!(
            problems[0]
                .command
                .ends_with("bitrate 1000000 dbitrate 5000000 fd on restart-ms 100")
        );
        let link = Link {
            is_fd: true,
            data_bitrate_hz: Some(5_000_000),
            ..good_link()
        };
        assert_eq!(link.problems(&config(Some(5_000_000))), []);
    }

    #[test]
    fn virtual_interfaces_only_need_to_be_up() {
        let slcan = BusConfig {
            accept_no_restart: true,
            ..config(None)
        };
        assert_eq!(
            Link {
                restart_millis: Some(0),
                ..good_link()
            }
            .problems(&slcan),
            []
        );
        let link = Link {
            bitrate_hz: None,
            restart_millis: None,
            state: None,
            n_errors: None,
            ..good_link()
        };
        assert_eq!(link.problems(&config(None)), []);
        let down = Link {
            is_up: false,
            ..link
        };
        assert_eq!(
            down.problems(&config(None))[0].command,
            "sudo ip link set can0 up"
        );
    }
}
