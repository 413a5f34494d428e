//! Names and removes output files and folders that were not written completely.
//!
//! After an error or a signal, the writing functions of this crate remove unfinished files and
//! folders. If a program is killed, its leftover files are removed when the same file is written
//! again.

use parking_lot::{Mutex, MutexGuard};
use std::collections::BTreeSet;
use std::ffi::OsStr;
use std::io::{Error, ErrorKind};
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};

/// The files and folders that this process is writing.
static IN_PROGRESS: Mutex<BTreeSet<PathBuf>> = Mutex::new(BTreeSet::new());

/// Start and end of temporary names. No other program uses such names. A file with such a name that
/// is not locked is therefore a leftover of this program and can be removed. A file such as
/// `scene.ply.part` could be an unfinished download.
const PREFIX: &[u8] = b".";
const SUFFIX: &[u8] = b".fieldrig.part";
/// Maximum length of a file name on Linux and macOS.
const MAX_NAME_BYTES: usize = 255;

/// Temporary path of a file or folder that is being written: `.NAME.fieldrig.part` in the same
/// folder.
///
/// The temporary path depends only on the final path. Programs that write the same file at the same
/// time therefore notice each other.
pub fn path_of(path: &Path) -> PathBuf {
    let name = path.file_name().unwrap_or_default().as_bytes();
    // Very long names are truncated. Files whose truncated names are equal cannot be written at the
    // same time.
    let name = &name[..name.len().min(MAX_NAME_BYTES - PREFIX.len() - SUFFIX.len())];
    path.with_file_name(OsStr::from_bytes(&[PREFIX, name, SUFFIX].concat()))
}

/// A path that is removed on drop, and by [`remove_all`].
#[derive(Debug)]
pub(crate) struct Registered(Option<PathBuf>);

impl Registered {
    pub(crate) fn new(path: &Path) -> Self {
        IN_PROGRESS.lock().insert(path.to_owned());
        Self(Some(path.to_owned()))
    }

    /// Keeps what is at the path.
    pub(crate) fn disarm(&mut self) {
        if let Some(path) = self.0.take() {
            IN_PROGRESS.lock().remove(&path);
        }
    }
}

impl Drop for Registered {
    fn drop(&mut self) {
        if let Some(path) = &self.0 {
            // The lock is held while the path is removed. Otherwise, `remove_all` could return
            // before the removal, and the process could exit while the file still exists.
            let mut in_progress = IN_PROGRESS.lock();
            remove(path);
            in_progress.remove(path);
        }
    }
}

/// Prevents the start of new files as long as it exists.
#[must_use = "dropping it allows new files"]
pub struct NoNewFiles {
    _in_progress: MutexGuard<'static, BTreeSet<PathBuf>>,
}

/// Removes all partial files. Call this function before the process exits.
pub fn remove_all() -> NoNewFiles {
    // The lock is passed to the caller. Threads that want to start a file wait for this lock until
    // the process has ended, so no new partial file appears after this call.
    let in_progress = IN_PROGRESS.lock();
    in_progress.iter().for_each(|path| remove(path));
    NoNewFiles {
        _in_progress: in_progress,
    }
}

/// Removes the temporary file or folder that a killed program left at a path of [`path_of`], if
/// there is one. A folder is removed only if each of its entries has one of the paths in
/// `own_paths`, or the temporary path of one of them.
///
/// # Errors
/// Fails if the folder has other entries, or cannot be removed.
pub fn remove_leftover(unfinished: &Path, names: &[&OsStr]) -> std::io::Result<()> {
    if is_folder(unfinished) {
        let own_paths: Vec<PathBuf> = names.iter().map(|name| unfinished.join(name)).collect();
        let mut entries = std::fs::read_dir(unfinished)
            .map_err(|error| cannot_remove(unfinished, &error))?
            .flatten();
        // A user may have stored files in a folder with this name, although such a name is
        // unlikely.
        if entries.any(|entry| !is_one_of(&entry.path(), &own_paths)) {
            return Err(Error::new(
                ErrorKind::AlreadyExists,
                format!(
                    "{} is a folder with other files; remove it, or choose another name",
                    unfinished.display()
                ),
            ));
        }
    }
    remove_any(unfinished).map_err(|error| cannot_remove(unfinished, &error))
}

/// Adds the path to an error.
fn cannot_remove(unfinished: &Path, error: &Error) -> Error {
    Error::new(
        error.kind(),
        format!("cannot remove {}: {error}", unfinished.display()),
    )
}

/// Whether an entry of a folder has one of these paths, or its temporary path.
fn is_one_of(entry: &Path, own_paths: &[PathBuf]) -> bool {
    own_paths
        .iter()
        .any(|own| entry == own || entry == path_of(own))
}

/// Removes a file, a link or a folder if it exists. Logs a warning if the removal fails.
fn remove(path: &Path) {
    if let Err(error) = remove_any(path) {
        log::warn!(
            "cannot remove the incomplete output {}: {error}",
            path.display()
        );
    }
}

fn remove_any(path: &Path) -> std::io::Result<()> {
    let removed = if is_folder(path) {
        std::fs::remove_dir_all(path)
    } else {
        std::fs::remove_file(path)
    };
    match removed {
        // The path no longer exists, because the writer has published or removed it in the
        // meantime.
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(()),
        removed => removed,
    }
}

/// Whether a path is a folder, and not a link to one.
fn is_folder(path: &Path) -> bool {
    path.symlink_metadata()
        .is_ok_and(|metadata| metadata.is_dir())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn temporary_names_are_beside_the_file_and_not_too_long() {
        for (path, unfinished) in [
            ("scene.ply", ".scene.ply.fieldrig.part"),
            ("a/scan", "a/.scan.fieldrig.part"),
            ("a/scan/", "a/.scan.fieldrig.part"),
            ("/scan", "/.scan.fieldrig.part"),
        ] {
            assert_eq!(path_of(Path::new(path)), Path::new(unfinished), "{path}");
        }
        let folder = tempfile::tempdir().expect("a folder");
        for n_bytes in [200, 240, 241, 255] {
            let path = folder.path().join("x".repeat(n_bytes));
            std::fs::write(path_of(&path), "fits").expect("a valid name");
            crate::write(&path, "complete").expect("a valid name");
            assert!(path.exists() && !path_of(&path).exists(), "{n_bytes}");
        }
    }

    #[test]
    fn registered_paths_are_removed_unless_disarmed() {
        let folder = tempfile::tempdir().expect("a folder");
        let at = |name: &str| folder.path().join(name);
        let registered = ["dropped", "kept"].map(|name| {
            std::fs::create_dir_all(at(name).join("depth")).expect("disk space");
            std::fs::write(at(name).join("depth/0.png"), b"x").expect("disk space");
            Registered::new(&at(name))
        });
        let [dropped, mut kept] = registered;
        kept.disarm();
        drop((dropped, kept));
        assert_eq!(
            ["dropped", "kept"].map(|name| at(name).exists()),
            [false, true]
        );
    }
}
