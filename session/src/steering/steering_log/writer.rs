//! Writes a steering log on a separate thread, so that decisions never wait for the disk.
//!
//! The file consists of gzip members (RFC 1952, section 2.2), each with a checksum, so that common
//! tools can read it. Compressed data is passed on to the operating system as soon as no line
//! waits, so that a killed program loses nothing that it had logged.

use super::line::Line;
use super::place::{FILE, OLDER_FILE};
use flate2::Compression;
use flate2::write::GzEncoder;
use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, TryRecvError, sync_channel};
use std::thread::JoinHandle;

/// Maximum number of lists of lines that wait for the disk: ten seconds.
pub(super) const MAX_WAITING: usize = 2048;
/// Size at which a file ends: half an hour of motion near surfaces, or several hours otherwise.
/// There are at most two files.
const MAX_FILE_BYTES: u64 = 256 << 20;
/// Size of the lines at which a member ends. Readers hold a whole member in memory.
const MEMBER_BYTES: usize = 1 << 20;

/// Sends lines to the thread. Dropping this value waits until all lines are written.
pub(super) struct LogWriter {
    /// `None` while it is dropped.
    sender: Option<SyncSender<Vec<Line>>>,
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

#[derive(Debug, Default)]
struct Shared {
    n_waiting: AtomicUsize,
    /// Whether the next start should begin a new file.
    wants_start: AtomicBool,
}

impl LogWriter {
    /// Starts the thread. It creates the file with the first line.
    pub(super) fn start(folder: &Path) -> std::io::Result<Self> {
        Self::with_file_size(folder, MAX_FILE_BYTES)
    }

    /// A writer that begins a new file at a size.
    pub(super) fn with_file_size(folder: &Path, max_bytes: u64) -> std::io::Result<Self> {
        Self::spawn(folder, max_bytes, |files, lines| files.write_all(lines))
    }

    /// A writer whose disk does not respond until the returned value is dropped.
    #[cfg(test)]
    pub(super) fn blocked(folder: &Path) -> std::io::Result<(Self, SyncSender<()>)> {
        let (disk, blocked) = sync_channel(1);
        let writer = Self::spawn(folder, MAX_FILE_BYTES, move |files, lines| {
            let _ = blocked.recv(); // Returns when the sender is dropped.
            files.write_all(lines);
        })?;
        Ok((writer, disk))
    }

    fn spawn(
        folder: &Path,
        max_bytes: u64,
        work: impl FnOnce(Files, &Receiver<Vec<Line>>) + Send + 'static,
    ) -> std::io::Result<Self> {
        let (sender, lines) = sync_channel(MAX_WAITING);
        let shared = Arc::<Shared>::default();
        let files = Files {
            folder: folder.to_owned(),
            max_bytes,
            shared: Arc::clone(&shared),
            current: None,
        };
        let thread = std::thread::Builder::new()
            .name("steering log".to_owned())
            .spawn(move || work(files, &lines))?;
        Ok(Self {
            sender: Some(sender),
            shared,
            thread: Some(thread),
        })
    }

    /// Passes lines on, and returns whether there was room for them. It never waits.
    pub(super) fn send(&self, lines: Vec<Line>) -> bool {
        if lines.is_empty() {
            return true;
        }
        self.shared.n_waiting.fetch_add(1, Ordering::Relaxed);
        let sender = self.sender.as_ref();
        let is_sent = sender.is_some_and(|sender| sender.try_send(lines).is_ok());
        if !is_sent {
            self.shared.n_waiting.fetch_sub(1, Ordering::Relaxed);
        }
        is_sent
    }

    /// Whether half of the queue is free.
    pub(super) fn has_room(&self) -> bool {
        let n_waiting = self.shared.n_waiting.load(Ordering::Relaxed);
        n_waiting < MAX_WAITING / 2 && self.thread.as_ref().is_some_and(|it| !it.is_finished())
    }

    /// Whether the file is full since the last call, so that a start should be sent.
    pub(super) fn wants_start(&self) -> bool {
        self.shared.wants_start.swap(false, Ordering::Relaxed)
    }
}

impl Drop for LogWriter {
    fn drop(&mut self) {
        self.sender = None;
        if let Some(thread) = self.thread.take() {
            // The panic hook has already reported a panic of the thread.
            let _ = thread.join();
        }
    }
}

/// The files of a log.
struct Files {
    folder: PathBuf,
    max_bytes: u64,
    shared: Arc<Shared>,
    current: Option<OpenFile>,
}

/// The file that is written.
struct OpenFile {
    member: GzEncoder<File>,
    /// Size of the lines in the member.
    n_in_member: usize,
    /// Size of the members before.
    n_bytes: u64,
    is_full: bool,
}

impl Files {
    fn write_all(mut self, queue: &Receiver<Vec<Line>>) {
        if let Err(error) = self.try_write_all(queue) {
            log::warn!(
                "the steering log {} cannot be written, and the run continues without it: {error}",
                self.folder.join(FILE).display()
            );
        }
    }

    fn try_write_all(&mut self, queue: &Receiver<Vec<Line>>) -> std::io::Result<()> {
        loop {
            let next = match queue.try_recv() {
                Ok(lines) => Some(lines),
                Err(TryRecvError::Disconnected) => None,
                Err(TryRecvError::Empty) => {
                    if let Some(file) = &mut self.current {
                        file.member.flush()?;
                    }
                    queue.recv().ok()
                }
            };
            let Some(lines) = next else { break };
            self.shared.n_waiting.fetch_sub(1, Ordering::Relaxed);
            for line in &lines {
                self.write(line)?;
            }
        }
        self.current.take().map_or(Ok(()), OpenFile::finish)
    }

    fn write(&mut self, line: &Line) -> std::io::Result<()> {
        let is_full = self.current.as_ref().is_none_or(|file| file.is_full);
        let is_start = matches!(line, Line::Start(_));
        if is_full && is_start {
            self.begin()?;
        }
        let Some(file) = &mut self.current else {
            return Ok(()); // Every log begins with a start.
        };
        let mut text = serde_json::to_vec(line)?;
        text.push(b'\n');
        file.member.write_all(&text)?;
        file.n_in_member += text.len();
        if file.n_in_member >= MEMBER_BYTES {
            file.next_member()?;
        }
        if !file.is_full && file.n_bytes >= self.max_bytes {
            file.is_full = true;
            self.shared.wants_start.store(true, Ordering::Relaxed);
        }
        Ok(())
    }

    /// Begins a new file. The one before becomes the older part of the log.
    fn begin(&mut self) -> std::io::Result<()> {
        self.current.take().map_or(Ok(()), OpenFile::finish)?;
        let path = self.folder.join(FILE);
        if path.is_file() {
            std::fs::rename(&path, self.folder.join(OLDER_FILE))?;
        }
        self.current = Some(OpenFile {
            member: member(files::begin(&path)?),
            n_in_member: 0,
            n_bytes: 0,
            is_full: false,
        });
        Ok(())
    }
}

impl OpenFile {
    fn next_member(&mut self) -> std::io::Result<()> {
        self.member.try_finish()?;
        let file = self.member.get_ref();
        self.n_bytes = file.metadata()?.len();
        self.member = member(file.try_clone()?);
        self.n_in_member = 0;
        Ok(())
    }

    fn finish(self) -> std::io::Result<()> {
        self.member.finish().map(drop)
    }
}

/// A new member. The fastest compression is sufficient: most lines repeat the names and many of the
/// numbers of the line before.
fn member(file: File) -> GzEncoder<File> {
    GzEncoder::new(file, Compression::fast())
}
