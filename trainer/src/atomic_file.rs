//! Writes files so that they are either complete or absent.

use crate::Error;
use std::fs::File;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

/// Temporary path of a file that is being written: the path with `.part` appended.
pub fn partial_path(path: &Path) -> PathBuf {
    let mut partial = path.as_os_str().to_owned();
    partial.push(".part");
    partial.into()
}

/// Writes a file under a temporary name, syncs it and renames it. The final name therefore always refers to a complete
/// file: the previous one or the new one. A partial file is removed after an error.
pub fn write(path: &Path, contents: impl FnOnce(&mut File) -> std::io::Result<()>) -> Result<(), Error> {
    let partial = partial_path(path);
    let written = File::create(&partial).and_then(|mut file| {
        contents(&mut file)?;
        file.sync_all()?;
        std::fs::rename(&partial, path)?;
        // The rename is durable only after the folder is synced.
        let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
        match File::open(folder)?.sync_all() {
            // Some network file systems cannot sync folders.
            Err(error) if matches!(error.kind(), ErrorKind::InvalidInput | ErrorKind::Unsupported) => Ok(()),
            synced => synced,
        }
    });
    if written.is_err() {
        let _ = std::fs::remove_file(&partial); // Best effort: a leftover partial file is harmless.
    }
    written.map_err(|source| Error::Write { path: path.to_owned(), source })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Write;

    #[test]
    fn failed_write_keeps_only_the_previous_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("scene.ply");
        write(&path, |file| file.write_all(b"first")).unwrap();
        let failed = write(&path, |file| {
            file.write_all(b"sec")?;
            Err(std::io::ErrorKind::StorageFull.into())
        });
        assert!(matches!(failed, Err(Error::Write { path: named, .. }) if named == path));
        assert_eq!(std::fs::read(&path).unwrap(), b"first");
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
    }
}
