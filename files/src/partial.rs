//! Removes output files and folders that were not written completely.
//!
//! A [`Partial`] removes what was created after an error or a signal, unless [`Partial::keep`] was called. Unfinished files of
//! [`create`](crate::create) and [`replace`](crate::replace) are removed in the same way.

use parking_lot::{Mutex, MutexGuard};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// The files and folders that this process is writing.
static IN_PROGRESS: Mutex<BTreeSet<PathBuf>> = Mutex::new(BTreeSet::new());

/// Temporary path of a file that is being written: the path with `.part` appended.
pub fn path_of(path: &Path) -> PathBuf {
    let mut partial = path.as_os_str().to_owned();
    partial.push(".part");
    partial.into()
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
            let mut in_progress = IN_PROGRESS.lock();
            remove(path);
            in_progress.remove(path);
        }
    }
}

/// A folder being written; removed on drop unless [`Self::keep`] is called.
#[derive(Debug)]
#[must_use = "dropping it removes its files"]
pub struct Partial(Vec<PathBuf>);

impl Partial {
    /// A folder that will be filled with `entries`. If the folder exists already, only the entries are removed on drop,
    /// except those that exist already.
    pub fn folder(path: &Path, entries: &[&str]) -> Self {
        let paths = match path.exists() {
            true => entries.iter().map(|entry| path.join(entry)).collect(),
            false => vec![path.to_owned()],
        };
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

/// Removes a file, a link or a folder, if it is there.
pub(crate) fn remove(path: &Path) {
    let is_folder = path.symlink_metadata().is_ok_and(|metadata| metadata.is_dir());
    let removed = if is_folder { std::fs::remove_dir_all(path) } else { std::fs::remove_file(path) };
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
    fn partial_folders_are_removed_unless_kept() {
        let folder = tempfile::tempdir().expect("a folder");
        let at = |name: &str| folder.path().join(name);
        for keeps in [false, true] {
            let (new, existing) =
                (Partial::folder(&at("new"), &["images"]), Partial::folder(folder.path(), &["images", "test.txt"]));
            for name in ["other", "test.txt"] {
                std::fs::write(at(name), b"x").expect("disk space");
            }
            std::fs::create_dir_all(at("new/depth")).expect("disk space");
            std::fs::create_dir_all(at("images/a")).expect("disk space");
            if keeps {
                [new, existing].into_iter().for_each(Partial::keep);
            } else {
                drop([new, existing]);
            }
            let exist = ["new", "images", "test.txt"].map(|name| at(name).exists());
            assert_eq!(exist, [keeps; 3]);
            assert!(at("other").exists());
        }
        drop(Partial::folder(&at("new"), &["depth"]));
        assert!(at("new/depth").exists(), "it existed before");
    }
}
