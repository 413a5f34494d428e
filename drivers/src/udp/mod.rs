//! Range scanners and bases that send JSON datagrams; the format is in `docs/udp.md`, its codec in `wire/datagram.rs`.

mod base;
mod counts;
pub(crate) mod order;
mod receiver;
mod scanner;
#[cfg(test)]
mod tests;

pub use base::UdpBase;
pub use counts::Counts;
pub use scanner::UdpScanner;
