//! A thread that writes the output of the program, so that a blocked terminal or disk does not block
//! the program.

use std::sync::mpsc::{Receiver, SyncSender};

/// A part of the output.
pub enum OutputChunk {
    /// Bytes to write.
    Bytes(Vec<u8>),
    /// A request that is acknowledged once all earlier chunks have been written.
    Flush(SyncSender<()>),
}

/// Starts a thread that calls `write` for each chunk, until all senders are dropped.
///
/// # Errors
///
/// Fails if the thread cannot be started.
pub fn start(
    chunks: Receiver<OutputChunk>,
    mut write: impl FnMut(&[u8]) + Send + 'static,
) -> std::io::Result<()> {
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
        })
        .map(drop)
}
