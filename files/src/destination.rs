//! Checks early whether an output can be written, so that a wrong path does not cost the work
//! before.

use rustix::fs::{Access, access};
use rustix::io::Errno;
use std::fmt;
use std::path::{Path, PathBuf};

/// Why nothing can be written into a folder. Its text names the folder and the remedy.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Unwritable {
    folder: PathBuf,
    reason: Reason,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Reason {
    Missing,
    NotAFolder,
    ReadOnly,
}

impl fmt::Display for Unwritable {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let folder = self.folder.display();
        match self.reason {
            Reason::Missing => write!(
                f,
                "the folder {folder} does not exist; create it, or choose another"
            ),
            Reason::NotAFolder => write!(f, "{folder} is not a folder; choose a folder"),
            Reason::ReadOnly => write!(
                f,
                "this user may not write into the folder {folder}; choose another, or change its permissions"
            ),
        }
    }
}

impl std::error::Error for Unwritable {}

/// Checks that the folder of a new file exists and accepts files. The disk may still be full.
///
/// # Errors
/// If the folder does not exist, is no folder, or may not be changed by this user.
pub fn check_file(path: &Path) -> Result<(), Unwritable> {
    let folder = path.parent().unwrap_or(path);
    if !shown(folder).exists() {
        return Err(Unwritable {
            folder: folder.to_owned(),
            reason: Reason::Missing,
        });
    }
    check_entries_of(folder)
}

/// Checks that files can be written into a folder, which is created with its parents if it does not
/// exist.
///
/// # Errors
/// If the folder, or the nearest parent that exists, is no folder or may not be changed by this
/// user.
pub fn check_folder(path: &Path) -> Result<(), Unwritable> {
    let existing = path.ancestors().find(|folder| shown(folder).exists());
    check_entries_of(existing.unwrap_or(path))
}

fn check_entries_of(folder: &Path) -> Result<(), Unwritable> {
    let folder = shown(folder);
    let reason = match access(folder, Access::WRITE_OK | Access::EXEC_OK) {
        _ if !folder.is_dir() => Reason::NotAFolder,
        Err(Errno::ACCESS | Errno::ROFS | Errno::PERM) => Reason::ReadOnly,
        // The write itself reports other problems.
        _ => return Ok(()),
    };
    Err(Unwritable {
        // The current folder has no distinctive name.
        folder: std::path::absolute(folder).unwrap_or_else(|_| folder.to_owned()),
        reason,
    })
}

/// The empty parent of a relative path is the current folder.
fn shown(folder: &Path) -> &Path {
    if folder.as_os_str().is_empty() {
        Path::new(".")
    } else {
        folder
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn missing_folders_are_named_and_existing_ones_accepted() {
        let folder = tempfile::tempdir().expect("a folder");
        let inside = |name: &str| folder.path().join(name);
        assert_eq!(check_file(&inside("rig.toml")), Ok(()));
        assert_eq!(check_file(Path::new("rig.toml")), Ok(()));
        let missing = check_file(&inside("absent/rig.toml")).expect_err("no folder");
        let text = missing.to_string();
        assert!(text.contains("absent does not exist; create it"), "{text}");
        // A folder is created with its parents.
        assert_eq!(check_folder(&inside("absent/run")), Ok(()));
        assert_eq!(check_folder(Path::new("absent/run")), Ok(()));
    }

    #[test]
    fn files_are_no_folders() {
        let folder = tempfile::tempdir().expect("a folder");
        let file = folder.path().join("notes.txt");
        std::fs::write(&file, "").expect("written");
        for problem in [
            check_file(&file.join("rig.toml")),
            check_folder(&file.join("run")),
        ] {
            let text = problem.expect_err("a file").to_string();
            assert!(text.contains("notes.txt is not a folder"), "{text}");
        }
    }
}
