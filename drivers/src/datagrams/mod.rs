//! Receives UDP datagrams of any format: the socket and its thread, the choice of one sender, and
//! statistics. `udp/` uses it for JSON datagrams.

pub(crate) mod counts;
pub(crate) mod receiver;
pub(crate) mod senders;
pub(crate) mod silence;
