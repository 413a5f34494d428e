//! The log in the folder of a run.
//!
//! It has the same records as the log on stderr, because `-v` and `RUST_LOG` apply to both. Records
//! from before the folder exists are kept in memory until then. A thread writes the file, so a disk
//! that blocks does not block the program. If the file cannot be written, the run continues without
//! it, with one warning.

use crate::run_folder::{LOG, OLDER_LOG};
use background::output_thread::OutputQueue;
use parking_lot::Mutex;
use std::fs::File;
use std::io::Write;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Above this size, the file is renamed and a new one is started. Only one older file is kept, so
/// the log takes at most twice this space. At the default level, a run writes about 10 KB per hour.
const MAX_BYTES: u64 = 8 << 20;
/// Maximum size of the records from before the folder exists. The start of a run logs some lines; a
/// command without a run folder can log without limit.
const MAX_EARLY_BYTES: usize = 256 << 10;
/// Maximum number of records that wait to be written. Further records are left out of the file.
const MAX_WAITING: usize = 1024;
/// At exit, the program waits at most this long for the file.
const MAX_FLUSH: Duration = Duration::from_secs(1);

/// Where records go.
enum Sink {
    /// Into memory, until the folder of the run is known.
    Early(String),
    /// To the thread that writes the file.
    Thread(OutputQueue),
    /// Nowhere, because the thread cannot be started.
    Nowhere,
}

static SINK: Mutex<Sink> = Mutex::new(Sink::Early(String::new()));

/// Adds a record, or several, with their line breaks.
pub fn record(text: &str) {
    match &mut *SINK.lock() {
        Sink::Early(early) => {
            if early.len() + text.len() <= MAX_EARLY_BYTES {
                early.push_str(text);
            }
        }
        // A record is dropped if the disk blocks. It was also printed to stderr.
        Sink::Thread(queue) => {
            queue.push(text.as_bytes().to_vec());
        }
        Sink::Nowhere => {}
    }
}

/// Starts the file in the folder of a run, with a header. A resumed run continues the file. Only
/// the first call has an effect: several models share the folder of their run.
pub fn begin(folder: &Path, header: &str) {
    let mut sink = SINK.lock();
    let Sink::Early(early) = &*sink else { return };
    let mut file = LogFile::new(folder);
    // The file is made here and not by the thread, because a run that fails removes its folder, and
    // a file that appears meanwhile would keep it. Errors are described at the first record.
    file.open = OpenFile::in_folder(folder).ok();
    // The header has its own line, and follows the records of an earlier part of the run.
    let start = format!("{header}\n{early}");
    let queue = OutputQueue::start(MAX_WAITING, move |bytes| {
        if let Some(problem) = file.write_or_describe(bytes) {
            log::warn!("{problem}; the run continues, and the log on stderr is complete");
        }
    });
    // Without a thread, there is no file. The early records are dropped, too.
    *sink = match queue {
        Ok(queue) => {
            queue.push(start.into_bytes());
            Sink::Thread(queue)
        }
        Err(_) => Sink::Nowhere,
    };
}

/// Waits until the records are written, for a limited time.
pub fn flush() {
    // The lock is released before waiting, because the thread may log a warning.
    let requested = match &*SINK.lock() {
        Sink::Early(_) | Sink::Nowhere => None,
        Sink::Thread(queue) => queue.request_flush(),
    };
    if let Some(flush) = requested {
        let _ = flush.wait(MAX_FLUSH); // After a timeout, the disk accepts no output.
    }
}

/// A log file that is bounded, and that follows its folder if the folder is made again.
struct LogFile {
    folder: PathBuf,
    open: Option<OpenFile>,
    /// Whether an error was described.
    has_failed: bool,
}

/// An open file, and the device and inode of its folder.
struct OpenFile {
    file: File,
    folder_id: Option<(u64, u64)>,
    n_bytes: u64,
}

impl LogFile {
    fn new(folder: &Path) -> Self {
        Self {
            folder: folder.to_owned(),
            open: None,
            has_failed: false,
        }
    }

    /// Writes records. Returns a description of the first error.
    fn write_or_describe(&mut self, bytes: &[u8]) -> Option<String> {
        let error = self.write(bytes).err()?;
        if std::mem::replace(&mut self.has_failed, true) {
            return None;
        }
        let path = self.folder.join(LOG);
        Some(format!("cannot write {}: {error}", path.display()))
    }

    fn write(&mut self, bytes: &[u8]) -> std::io::Result<()> {
        self.follow_folder();
        let n_bytes = bytes.len() as u64;
        if self
            .open
            .as_ref()
            .is_some_and(|open| open.n_bytes + n_bytes > MAX_BYTES)
        {
            self.open = None;
            std::fs::rename(self.folder.join(LOG), self.folder.join(OLDER_LOG))?;
        }
        let open = match &mut self.open {
            Some(open) => open,
            None => self.open.insert(OpenFile::in_folder(&self.folder)?),
        };
        open.file.write_all(bytes)?;
        open.n_bytes += n_bytes;
        Ok(())
    }

    /// Continues in a new file if the folder was removed or renamed, and made again by the run. A
    /// file that alone was removed is not made again, because its folder may be about to be removed.
    fn follow_folder(&mut self) {
        let Some(open) = &self.open else { return };
        let now = id(&self.folder);
        if now.is_some()
            && now != open.folder_id
            && let Ok(new) = OpenFile::in_folder(&self.folder)
        {
            self.open = Some(new);
        }
    }
}

impl OpenFile {
    fn in_folder(folder: &Path) -> std::io::Result<Self> {
        let file = files::append(&folder.join(LOG))?;
        Ok(Self {
            n_bytes: file.metadata()?.len(),
            file,
            folder_id: id(folder),
        })
    }
}

/// Device and inode of a folder; `None` if it does not exist.
fn id(folder: &Path) -> Option<(u64, u64)> {
    let metadata = folder.metadata().ok()?;
    Some((metadata.dev(), metadata.ino()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    fn text(folder: &Path) -> String {
        fs::read_to_string(folder.join(LOG)).expect("a log")
    }

    #[test]
    fn log_is_continued_and_bounded() {
        let folder = tempfile::tempdir().expect("a folder");
        let folder = folder.path();
        for part in ["one\n", "two\n"] {
            assert_eq!(
                LogFile::new(folder).write_or_describe(part.as_bytes()),
                None
            );
        }
        assert_eq!(text(folder), "one\ntwo\n");
        let mut log = LogFile::new(folder);
        let quarter = vec![b'x'; usize::try_from(MAX_BYTES).expect("small") / 4];
        for _ in 0..9 {
            assert_eq!(log.write_or_describe(&quarter), None);
        }
        for name in [LOG, OLDER_LOG] {
            let n_bytes = fs::metadata(folder.join(name)).expect("a log").len();
            assert!((1..=MAX_BYTES).contains(&n_bytes), "{name}: {n_bytes}");
        }
        assert_eq!(fs::read_dir(folder).expect("a folder").count(), 2);
    }

    #[test]
    fn log_follows_a_folder_that_is_made_again() {
        let parent = tempfile::tempdir().expect("a folder");
        let [run, moved] = ["run", "moved"].map(|name| parent.path().join(name));
        fs::create_dir(&run).expect("space");
        let mut log = LogFile::new(&run);
        assert_eq!(log.write_or_describe(b"one\n"), None);
        fs::rename(&run, &moved).expect("it exists");
        assert_eq!(
            log.write_or_describe(b"two\n"),
            None,
            "into the moved folder"
        );
        fs::create_dir(&run).expect("space");
        assert_eq!(log.write_or_describe(b"three\n"), None);
        assert_eq!(
            (text(&moved), text(&run)),
            ("one\ntwo\n".into(), "three\n".into())
        );
        // A folder from which only the log is removed may be about to be removed.
        fs::remove_file(run.join(LOG)).expect("it exists");
        assert_eq!(log.write_or_describe(b"four\n"), None);
        fs::remove_dir(&run).expect("it is empty");
    }

    #[test]
    fn links_are_replaced_and_problems_are_described_once() {
        let folder = tempfile::tempdir().expect("a folder");
        let target = folder.path().join("target");
        fs::write(&target, "kept").expect("space");
        std::os::unix::fs::symlink(&target, folder.path().join(LOG)).expect("space");
        assert_eq!(
            LogFile::new(folder.path()).write_or_describe(b"one\n"),
            None
        );
        assert_eq!(text(folder.path()), "one\n");
        assert_eq!(fs::read_to_string(&target).expect("it stays"), "kept");
        fs::remove_file(folder.path().join(LOG)).expect("it exists");
        fs::create_dir(folder.path().join(LOG)).expect("space");
        let mut log = LogFile::new(folder.path());
        let problem = log.write_or_describe(b"one\n").expect("it is a folder");
        assert!(problem.contains(LOG), "{problem}");
        assert_eq!(log.write_or_describe(b"two\n"), None);
    }
}
