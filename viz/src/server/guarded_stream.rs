//! The stream of a connection: limits the time of writes, and ends the admission of the connection.

use crate::server::admission::{Admission, Connection};
use std::io;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};
use std::time::Duration;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::TcpStream;
use tokio::time::{Sleep, sleep};

/// A connection whose peer accepts no bytes for this long is closed.
const WRITE_TIMEOUT: Duration = Duration::from_secs(5);

/// A stream that times out if its peer does not read, and leaves the [`Admission`] when it is
/// dropped.
#[derive(Debug)]
pub(crate) struct GuardedStream {
    stream: TcpStream,
    connection: Arc<Connection>,
    admission: Arc<Admission>,
    write_timeout: Duration,
    /// Runs while the peer accepts no bytes.
    write_timer: Option<Pin<Box<Sleep>>>,
}

impl GuardedStream {
    /// Admits a new connection.
    pub(crate) fn new(stream: TcpStream, admission: Arc<Admission>) -> Self {
        Self {
            connection: admission.admit(stream.peer_addr().ok()),
            stream,
            admission,
            write_timeout: WRITE_TIMEOUT,
            write_timer: None,
        }
    }

    /// Its entry in the [`Admission`].
    pub(crate) fn connection(&self) -> &Arc<Connection> {
        &self.connection
    }

    /// Waits for the first byte from the peer, which stays unread.
    pub(crate) async fn first_byte(&self) -> io::Result<u8> {
        let mut byte = [0];
        // The peer has closed the connection without sending anything.
        if self.stream.peek(&mut byte).await? == 0 {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        Ok(byte[0])
    }

    /// Resizes the kernel's buffer if this was requested. A failure affects only latency.
    #[cfg(unix)]
    fn resize_send_buffer(&self) {
        let Some(n_bytes) = self.connection.take_send_buffer() else {
            return;
        };
        if let Err(error) = rustix::net::sockopt::set_socket_send_buffer_size(&self.stream, n_bytes)
        {
            log::debug!("cannot resize a socket's buffer: {error}");
        }
    }

    #[cfg(not(unix))]
    fn resize_send_buffer(&self) {}

    /// Lets the runtime of this thread watch the socket, if the thread has changed. Otherwise, the
    /// thread that accepted the connection would have to notice each message. A failure affects only
    /// latency.
    #[cfg(unix)]
    fn change_runtime(&mut self) {
        use std::os::fd::AsFd;
        if !self.connection.take_thread_change() {
            return;
        }
        // A runtime watches a descriptor as long as it is open, so the socket gets another one.
        let moved = self.stream.as_fd().try_clone_to_owned();
        match moved.and_then(|socket| TcpStream::from_std(socket.into())) {
            Ok(stream) => {
                self.stream = stream;
                self.write_timer = None;
            }
            Err(error) => log::debug!("cannot move a connection to another thread: {error}"),
        }
    }

    #[cfg(not(unix))]
    fn change_runtime(&mut self) {}

    /// Runs a write, and closes the connection if the peer accepts no bytes for too long.
    fn write(
        &mut self,
        context: &mut Context<'_>,
        write: impl FnOnce(Pin<&mut TcpStream>, &mut Context<'_>) -> Poll<io::Result<usize>>,
    ) -> Poll<io::Result<usize>> {
        self.change_runtime();
        self.resize_send_buffer();
        let written = write(Pin::new(&mut self.stream), context);
        if written.is_ready() {
            self.write_timer = None;
            // Shows that a download makes progress, even if no request follows.
            self.connection.record_progress();
            return written;
        }
        // The timer is kept across polls, so that it measures the whole time for which the write is
        // blocked.
        let write_timeout = self.write_timeout;
        let timer = self
            .write_timer
            .get_or_insert_with(|| Box::pin(sleep(write_timeout)));
        ready!(timer.as_mut().poll(context));
        self.connection.close("its peer does not read");
        Poll::Ready(Err(io::ErrorKind::TimedOut.into()))
    }
}

impl AsyncRead for GuardedStream {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        self.change_runtime();
        Pin::new(&mut self.stream).poll_read(context, buffer)
    }
}

impl AsyncWrite for GuardedStream {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        self.write(context, |stream, context| stream.poll_write(context, bytes))
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        slices: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        self.write(context, |stream, context| {
            stream.poll_write_vectored(context, slices)
        })
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(context)
    }
}

impl Drop for GuardedStream {
    fn drop(&mut self) {
        if self.connection.is_closed() {
            // Data that the peer has not read is discarded. Otherwise, the kernel would keep it for
            // minutes.
            if let Err(error) = self.stream.set_zero_linger() {
                log::debug!("cannot discard unread bytes: {error}");
            }
        }
        self.admission.remove(&self.connection);
    }
}

#[cfg(test)]
mod tests;
