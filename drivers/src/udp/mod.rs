//! Arms, range scanners and bases that send JSON datagrams. The format is described in
//! `docs/reference/udp.md`; its codec is `wire/datagram.rs`.

mod arm;
mod base;
mod counts;
#[cfg(any(test, fuzzing))]
pub(crate) mod fuzz;
mod reader;
mod receiver;
mod scanner;
pub(crate) mod sequence;
#[cfg(test)]
mod tests;

pub use arm::UdpArm;
pub use base::UdpBase;
pub use counts::{DatagramCounts, DatagramMonitor};
pub use scanner::UdpScanner;
