//! A file or folder of this program that another program may remove or rename while it is in use.

use std::fs::File;
use std::io::ErrorKind;
use std::os::fd::AsRawFd;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

/// A file or folder that is kept open, so that its contents remain until this value is dropped.
#[derive(Debug)]
pub struct Kept {
    path: PathBuf,
    file: File,
}

/// Where a kept file or folder is now.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Place {
    /// The file or folder is at its original path.
    Here,
    /// The file or folder is at this other path.
    MovedTo(PathBuf),
    /// Removed, or moved to an unknown place.
    Removed,
}

impl Kept {
    /// Opens a file or folder for reading.
    ///
    /// # Errors
    /// Fails if the file or folder cannot be opened.
    pub fn open(path: &Path) -> std::io::Result<Self> {
        Ok(Self {
            path: path.to_owned(),
            file: File::open(path)?,
        })
    }

    /// The path at which it was opened.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Where it is now.
    pub fn place(&self) -> Place {
        if self.is_at(&self.path) {
            return Place::Here;
        }
        // Only Linux reports the path of an open file. For a removed file, this path ends with "
        // (deleted)" and does not exist.
        let now = std::fs::read_link(self.in_proc());
        let moved = now.ok().filter(|now| self.is_at(now));
        moved.map_or(Place::Removed, Place::MovedTo)
    }

    /// Whether a path leads to this file or folder. Device and inode identify it, because another
    /// program may have put a different file at the path.
    fn is_at(&self, path: &Path) -> bool {
        let Ok(named) = path.metadata() else {
            return false;
        };
        self.file
            .metadata()
            .is_ok_and(|own| (own.dev(), own.ino()) == (named.dev(), named.ino()))
    }

    /// Writes the contents of a removed file to its path again, unless the path is taken.
    ///
    /// # Errors
    /// Fails if the file cannot be written, or if the path is taken.
    pub fn restore(&self) -> std::io::Result<()> {
        // The file is opened again, because another user of `file` may share its position. Systems
        // without /proc, such as macOS, use a duplicate of `file` instead.
        let mut contents = match File::open(self.in_proc()) {
            Err(error) if error.kind() == ErrorKind::NotFound => self.file.try_clone()?,
            opened => opened?,
        };
        crate::create(&self.path, |file| {
            std::io::copy(&mut contents, file).map(drop)
        })
    }

    fn in_proc(&self) -> PathBuf {
        format!("/proc/self/fd/{}", self.file.as_raw_fd()).into()
    }
}

#[cfg(test)]
mod tests {
    use super::{Kept, Place};
    use std::fs;

    #[test]
    fn removed_file_is_restored_with_what_was_written_since() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("scan");
        let mut writer = crate::begin(&path).expect("a new file");
        let kept = Kept::open(&path).expect("it exists");
        assert_eq!(kept.place(), Place::Here);
        fs::remove_file(&path).expect("it exists");
        std::io::Write::write_all(&mut writer, b"written later").expect("space");
        assert_eq!(kept.place(), Place::Removed);
        fs::write(&path, "other").expect("space");
        assert_eq!(kept.place(), Place::Removed, "another file has its name");
        assert!(kept.restore().is_err(), "the other file stays");
        fs::remove_file(&path).expect("it exists");
        kept.restore().expect("space");
        assert_eq!(
            fs::read_to_string(&path).expect("it is there"),
            "written later"
        );
    }

    #[test]
    fn new_name_of_a_folder_is_found() {
        let folder = tempfile::tempdir().expect("a folder");
        let [old, new] = ["old", "new"].map(|name| folder.path().join(name));
        fs::create_dir(&old).expect("space");
        let kept = Kept::open(&old).expect("it exists");
        fs::rename(&old, &new).expect("it exists");
        assert_eq!(
            kept.place(),
            Place::MovedTo(new.canonicalize().expect("it exists"))
        );
        fs::remove_dir(&new).expect("it is empty");
        assert_eq!(kept.place(), Place::Removed);
    }
}
