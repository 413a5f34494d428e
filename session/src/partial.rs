//! Removes output files and folders that were not written completely.
//!
//! A [`Partial`] removes its files after an error or a signal, unless [`Partial::keep`] was called.

use parking_lot::{Mutex, MutexGuard};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// The files and folders that this process is writing.
static IN_PROGRESS: Mutex<BTreeSet<PathBuf>> = Mutex::new(BTreeSet::new());

/// Files or folders being written; removed on drop unless [`Self::keep`] is called.
#[derive(Debug)]
#[must_use = "dropping it removes its files"]
pub struct Partial(Vec<PathBuf>);

impl Partial {
    /// A file that will be written, either directly or as a temporary file with the suffix `.part`.
    pub fn file(path: &Path) -> Self {
        Self::register(vec![path.to_owned(), trainer::atomic_file::partial_path(path)])
    }

    /// A folder that will be filled with `entries`. If the folder exists already, only the entries are removed on drop.
    pub fn folder(path: &Path, entries: &[&str]) -> Self {
        if path.exists() {
            return Self::register(entries.iter().map(|entry| path.join(entry)).collect());
        }
        Self::register(vec![path.to_owned()])
    }

    /// Registers files for removal, except those that already exist.
    fn register(paths: Vec<PathBuf>) -> Self {
        let paths: Vec<PathBuf> = paths.into_iter().filter(|path| !path.exists()).collect();
        IN_PROGRESS.lock().extend(paths.iter().cloned());
        Self(paths)
    }

    /// Keeps the files once they are complete.
    pub fn keep(mut self) {
        let paths = std::mem::take(&mut self.0);
        IN_PROGRESS.lock().retain(|path| !paths.contains(path));
    }
}

impl Drop for Partial {
    fn drop(&mut self) {
        let mut in_progress = IN_PROGRESS.lock();
        for path in &self.0 {
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

/// Removes all partial files. To be called before the process exits.
pub fn remove_all() -> NoNewFiles {
    let in_progress = IN_PROGRESS.lock();
    in_progress.iter().for_each(|path| remove(path));
    NoNewFiles { _in_progress: in_progress }
}

fn remove(path: &Path) {
    let removed = if path.is_dir() { std::fs::remove_dir_all(path) } else { std::fs::remove_file(path) };
    match removed {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
            log::warn!("cannot remove the incomplete output {}: {error}", path.display());
        }
        _ => {}
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn partial_files_are_removed_unless_kept() {
        let folder = tempfile::tempdir().expect("a folder");
        let at = |name: &str| folder.path().join(name);
        for keeps in [false, true] {
            let (file, new) = (Partial::file(&at("scene.ply")), Partial::folder(&at("new"), &["images"]));
            let existing = Partial::folder(folder.path(), &["images", "test.txt"]);
            for name in ["scene.ply", "scene.ply.part", "other", "test.txt"] {
                std::fs::write(at(name), b"x").expect("disk space");
            }
            std::fs::create_dir_all(at("new/depth")).expect("disk space");
            std::fs::create_dir_all(at("images/a")).expect("disk space");
            if keeps {
                [file, new, existing].into_iter().for_each(Partial::keep);
            } else {
                drop([file, new, existing]);
            }
            let exist = ["scene.ply", "new", "images", "test.txt"].map(|name| at(name).exists());
            assert_eq!(exist, [keeps; 4]);
            assert!(at("other").exists());
        }
        drop([Partial::file(&at("scene.ply")), Partial::folder(&at("new"), &["depth"])]);
        assert!(at("scene.ply").exists() && at("new/depth").exists(), "they existed before");
    }
}
