//! Arms, range scanners and bases that send JSON datagrams; the format is in `docs/reference/udp.md`, its codec in `wire/datagram.rs`.

mod arm;
mod base;
mod counts;
#[cfg(any(test, fuzzing))]
pub(crate) mod hostile;
pub(crate) mod order;
mod receiver;
mod scanner;
#[cfg(test)]
mod tests;
mod whole;

pub use arm::UdpArm;
pub use base::UdpBase;
pub use counts::Counts;
pub use scanner::UdpScanner;
