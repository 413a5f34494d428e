//! TLS handshakes of shared servers.

use crate::server::guarded_stream::GuardedStream;
use std::io;
use std::time::Duration;
use tokio::io::AsyncWriteExt;
use tokio_rustls::TlsAcceptor;
use tokio_rustls::server::TlsStream;

/// A connection is closed if its handshake takes longer than this. Until then, it takes one of the
/// places for connections.
const HANDSHAKE_TIMEOUT: Duration = Duration::from_secs(3);
/// Maximum amount of encrypted data that waits for the kernel, bytes. It is one record, so that
/// little data becomes outdated while it waits.
const BUFFER_BYTES: usize = 16 * 1024;
/// First byte of a TLS connection: a handshake record.
const HANDSHAKE_RECORD: u8 = 0x16;
/// The response to a client without TLS.
const TLS_REQUIRED: &[u8] =
    b"HTTP/1.1 400 Bad Request\r\nContent-Type: text/plain\r\nConnection: close\r\n\r\n\
    this server requires TLS: open its address with https:// instead of http://\n";

/// Performs the handshake of a new connection. A client without TLS gets one sentence.
pub(crate) async fn accept(
    acceptor: &TlsAcceptor,
    stream: GuardedStream,
) -> io::Result<TlsStream<GuardedStream>> {
    match tokio::time::timeout(HANDSHAKE_TIMEOUT, handshake(acceptor, stream)).await {
        Ok(result) => result,
        Err(_) => Err(io::Error::new(
            io::ErrorKind::TimedOut,
            "the TLS handshake took too long",
        )),
    }
}

async fn handshake(
    acceptor: &TlsAcceptor,
    mut stream: GuardedStream,
) -> io::Result<TlsStream<GuardedStream>> {
    // People often type the address without https. A TLS alert would only show that something
    // failed.
    if stream.first_byte().await? != HANDSHAKE_RECORD {
        stream.write_all(TLS_REQUIRED).await?;
        stream.shutdown().await?;
        return Err(io::Error::new(
            io::ErrorKind::InvalidData,
            "the client does not use TLS",
        ));
    }
    acceptor
        .accept_with(stream, |connection| {
            connection.set_buffer_limit(Some(BUFFER_BYTES))
        })
        .await
}
