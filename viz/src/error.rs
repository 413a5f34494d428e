//! Errors that occur when the server starts.

use std::net::SocketAddr;

/// Errors of the render server.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// Another program uses the port.
    #[error(
        "the address {address} is in use by another program: stop that program or choose another port with --listen"
    )]
    AddressInUse {
        /// Requested address.
        address: SocketAddr,
    },
    /// The address is reachable from other machines, and the server does not support encryption yet.
    #[error(
        "the address {address} can be reached from other machines, but the server does not support TLS yet: \
         listen on a loopback address such as 127.0.0.1:7007"
    )]
    NotLoopback {
        /// Requested address.
        address: SocketAddr,
    },
    /// The operating system rejected the address.
    #[error("cannot listen on {address}")]
    Listen {
        /// Requested address.
        address: SocketAddr,
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// The operating system could not create a thread or an event loop.
    #[error("cannot start the server thread")]
    Thread {
        /// Error of the operating system.
        source: std::io::Error,
    },
}
