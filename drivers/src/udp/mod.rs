//! Arms, range scanners and bases that send JSON datagrams. The format is described in
//! `docs/reference/udp.md`; its codec is `wire/datagram.rs`. Sockets and statistics, which do not
//! depend on the format, are in `datagrams/`.

mod arm;
mod base;
mod driven_base;
#[cfg(test)]
mod driven_base_tests;
#[cfg(any(test, feature = "emulation"))]
mod emulated_base;
#[cfg(any(test, fuzzing))]
pub(crate) mod fuzz;
mod reader;
mod scanner;
pub(crate) mod sequence;
#[cfg(test)]
mod tests;

pub use crate::datagrams::counts::{DatagramCounts, DatagramMonitor};
pub use arm::UdpArm;
pub use base::UdpBase;
pub use driven_base::UdpDrivenBase;
#[cfg(any(test, feature = "emulation"))]
pub use emulated_base::EmulatedBase;
pub use scanner::UdpScanner;
