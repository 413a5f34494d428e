//! A thread that writes the output of the program, so that a blocked terminal or disk does not block
//! the program.

use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::time::Duration;

/// A part of the output.
enum OutputChunk {
    /// Bytes to write.
    Bytes(Vec<u8>),
    /// A request that is acknowledged once all earlier chunks have been written.
    Flush(SyncSender<()>),
}

/// The queue of a thread that writes output. The thread ends when the queue is dropped.
#[derive(Clone, Debug)]
pub struct OutputQueue(SyncSender<OutputChunk>);

impl OutputQueue {
    /// Starts a thread that calls `write` for each chunk.
    ///
    /// * `max_waiting`: maximum number of chunks that wait to be written. The queue has a limit,
    ///   because an output that blocks accepts none of them.
    ///
    /// # Errors
    ///
    /// Fails if the thread cannot be started.
    pub fn start(
        max_waiting: usize,
        mut write: impl FnMut(&[u8]) + Send + 'static,
    ) -> std::io::Result<Self> {
        let (sender, chunks) = sync_channel(max_waiting);
        std::thread::Builder::new()
            .name("output".to_owned())
            .spawn(move || {
                for chunk in chunks {
                    match chunk {
                        OutputChunk::Bytes(bytes) => write(&bytes),
                        // The program may have stopped waiting.
                        OutputChunk::Flush(done) => drop(done.send(())),
                    }
                }
            })?;
        Ok(Self(sender))
    }

    /// Queues a chunk without waiting. Returns whether the queue has accepted it.
    pub fn push(&self, bytes: Vec<u8>) -> bool {
        self.0.try_send(OutputChunk::Bytes(bytes)).is_ok()
    }

    /// Requests that everything queued so far is written. Returns `None` if the queue is full.
    #[must_use]
    pub fn request_flush(&self) -> Option<PendingFlush> {
        let (done, is_done) = sync_channel(1);
        let is_requested = self.0.try_send(OutputChunk::Flush(done)).is_ok();
        is_requested.then_some(PendingFlush(is_done))
    }
}

/// A request to write everything that was queued before it.
#[derive(Debug)]
pub struct PendingFlush(Receiver<()>);

impl PendingFlush {
    /// Waits until everything is written, at most for this time. Returns whether it is written.
    #[must_use]
    pub fn wait(&self, max: Duration) -> bool {
        self.0.recv_timeout(max).is_ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::{Arc, Mutex, PoisonError};

    const MAX_WAITING: usize = 16;
    /// Far longer than a thread needs to write a few bytes, also on a busy machine.
    const MAX_FLUSH: Duration = Duration::from_secs(60);

    #[test]
    fn a_blocked_output_blocks_neither_the_program_nor_other_outputs() {
        let blocked = OutputQueue::start(MAX_WAITING, |_| {
            loop {
                std::thread::park();
            }
        });
        let blocked = blocked.expect("a thread");
        let written = Arc::new(Mutex::new(Vec::new()));
        let sink = Arc::clone(&written);
        let other = OutputQueue::start(MAX_WAITING, move |bytes| {
            let mut sink = sink.lock().unwrap_or_else(PoisonError::into_inner);
            sink.extend_from_slice(bytes);
        });
        let other = other.expect("a thread");
        let n_queued = (0..2 * MAX_WAITING)
            .filter(|_| blocked.push(b"log".to_vec()))
            .count();
        // The thread may hold one more chunk than the queue.
        assert!(
            (MAX_WAITING..=MAX_WAITING + 1).contains(&n_queued),
            "{n_queued}"
        );
        assert!(other.push(b"result".to_vec()));
        let flush = other.request_flush().expect("a place in the queue");
        assert!(flush.wait(MAX_FLUSH), "it is not blocked");
        let written = written.lock().unwrap_or_else(PoisonError::into_inner);
        assert_eq!(*written, b"result");
    }
}
