//! What can go wrong when the server starts.

use std::net::SocketAddr;

/// Errors of the render server.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// Another program holds the port.
    #[error(
        "the address {address} is in use by another program: stop that program or choose another port with --listen"
    )]
    AddressInUse {
        /// What was asked for.
        address: SocketAddr,
    },
    /// The address could be reached from other machines, and there is no encryption yet.
    #[error(
        "the address {address} can be reached from other machines, which needs TLS that does not exist yet: \
         listen on a loopback address such as 127.0.0.1:7007"
    )]
    NotLoopback {
        /// What was asked for.
        address: SocketAddr,
    },
    /// The system refuses the address.
    #[error("cannot listen on {address}")]
    Listen {
        /// What was asked for.
        address: SocketAddr,
        /// The system's word.
        source: std::io::Error,
    },
    /// The system gives no thread or no event loop.
    #[error("cannot start the server thread")]
    Thread {
        /// The system's word.
        source: std::io::Error,
    },
}
