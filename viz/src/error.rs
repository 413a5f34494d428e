//! Errors that occur when the server starts.

use messages::Setting;
use std::net::SocketAddr;
use std::path::PathBuf;

/// Errors of the render server.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// Another program uses the port.
    #[error(
        "the address {address} is in use by another program: stop that program or choose another port with {}",
        Setting::Listen
    )]
    AddressInUse {
        /// Requested address.
        address: SocketAddr,
    },
    /// The address is reachable from other machines, but the server is not shared.
    #[error(
        "other machines can reach the address {address}: add {}, which encrypts the page and requires a token",
        Setting::Share
    )]
    NotLoopback {
        /// Requested address.
        address: SocketAddr,
    },
    /// A certificate or its private key cannot be used.
    #[error("cannot use the TLS certificate in {}: {reason}", file.display())]
    Certificate {
        /// File that was read.
        file: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// Other users can read the private key.
    #[error("other users of this computer can read the private key in {0}: run `chmod 600 {0}`", file.display())]
    PublicKeyFile {
        /// File with the key.
        file: PathBuf,
    },
    /// The certificate that is kept across runs cannot be created.
    #[error("cannot create the TLS certificate in {}", file.display())]
    WriteCertificate {
        /// File to create.
        file: PathBuf,
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// A file is no workspace.
    #[error("{} is no workspace that this version can open: {reason}", file.display())]
    Workspace {
        /// File that was read.
        file: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// There are no random numbers for the tokens of a shared page.
    #[error("cannot create a token")]
    Token {
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// The TLS library rejected a certificate.
    #[error("cannot set up TLS")]
    Tls {
        /// Error of the TLS library.
        source: rustls::Error,
    },
    /// The address for Foxglove is reachable from other machines.
    #[error(
        "other machines can reach the address {address}, and the protocol of Foxglove has no login: use a loopback address, \
         and `ssh -L {port}:localhost:{port} HOST` on the other machine", port = address.port()
    )]
    FoxgloveNotLoopback {
        /// Requested address.
        address: SocketAddr,
    },
    /// Foxglove is requested, but this build lacks it.
    #[error(
        "{}: this program was built without Foxglove support: build with `--features foxglove`",
        Setting::Foxglove
    )]
    FoxgloveNotBuilt,
    /// The server for Foxglove could not start.
    #[error("cannot serve Foxglove on {address}: {reason}")]
    Foxglove {
        /// Requested address.
        address: SocketAddr,
        /// Error of the Foxglove library.
        reason: String,
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
