//! Writes files so that they are complete or absent, and locks folders.

use crate::partial::{self, Registered};
use rustix::fs::{CWD, FlockOperation, Mode, OFlags, flock, renameat_with};
use std::fs::File;
use std::io::{Error, ErrorKind, Write};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

/// Replaces a file, or writes a new file. A link with this name is replaced and not followed.
///
/// # Errors
/// Fails if the file cannot be written, or if another program is writing it. After an error, the
/// previous file is kept.
pub fn replace(
    path: &Path,
    contents: impl FnOnce(&mut File) -> std::io::Result<()>,
) -> std::io::Result<()> {
    write_and_publish(path, contents, |unfinished| {
        std::fs::rename(unfinished, path)
    })
}

/// Like [`replace`], but with contents that are already in memory.
///
/// # Errors
/// Fails like [`replace`].
pub fn write(path: &Path, contents: impl AsRef<[u8]>) -> std::io::Result<()> {
    replace(path, |file| file.write_all(contents.as_ref()))
}

/// Starts a file that grows while it is written, such as a log. A file or link with this name is
/// removed first.
///
/// # Errors
/// Fails if the file cannot be created.
pub fn begin(path: &Path) -> std::io::Result<File> {
    match std::fs::remove_file(path) {
        Err(error) if error.kind() != ErrorKind::NotFound => Err(error),
        _ => File::create_new(path),
    }
}

/// Opens a file to append to it, such as a log that is continued. If the file does not exist, it is
/// created. A link with this name is replaced and not followed.
///
/// # Errors
/// Fails if the file cannot be opened, or is not a regular file.
pub fn append(path: &Path) -> std::io::Result<File> {
    let flags = OFlags::RDWR
        | OFlags::APPEND
        | OFlags::CREATE
        | OFlags::NOFOLLOW
        | OFlags::NONBLOCK
        | OFlags::CLOEXEC;
    if path.is_symlink() {
        std::fs::remove_file(path)?;
    }
    let file = open_unlinked(path, flags)?;
    if !file.metadata()?.is_file() {
        return Err(Error::new(ErrorKind::InvalidInput, "it is not a file"));
    }
    Ok(file)
}

/// Writes a new file.
///
/// # Errors
/// Fails if the file cannot be written, if a file or symbolic link with this name exists, or if
/// another program is writing it.
pub fn create(
    path: &Path,
    contents: impl FnOnce(&mut File) -> std::io::Result<()>,
) -> std::io::Result<()> {
    if path.symlink_metadata().is_ok() {
        return Err(exists());
    }
    write_and_publish(path, contents, |unfinished| publish(unfinished, path))
}

/// Calls `write` with a path in a temporary folder, then moves the result to `path`.
///
/// # Errors
/// Returns the errors of `write` and the errors of [`create`].
pub fn create_from<T, E: From<Error>>(
    path: &Path,
    write: impl FnOnce(&Path) -> Result<T, E>,
) -> Result<T, E> {
    if path.symlink_metadata().is_ok() {
        // The name is checked before the work, which may take minutes. `publish` checks it again.
        return Err(exists().into());
    }
    let unfinished = Unfinished::folder(path)?;
    // `write` gets the final name, whose extension selects the format of some exports.
    let inside = unfinished.path.join(path.file_name().unwrap_or_default());
    let written = write(&inside)?;
    publish(&inside, path)?;
    sync_parent(path)?;
    Ok(written)
}

/// Calls `write` with a path in a temporary folder. `write` creates a folder there, which is then
/// moved to `path`. If the folder `path` already exists, the `entries` that `write` created are
/// moved into it in the given order. If the program is killed, it may have moved only the first
/// entries. The last entry should therefore be the entry by which readers recognize the folder.
///
/// # Errors
/// Returns the errors of `write` and the errors of [`create`]. Entries that have already been moved
/// are removed again.
pub fn create_folder<T, E: From<Error>>(
    path: &Path,
    entries: &[&str],
    write: impl FnOnce(&Path) -> Result<T, E>,
) -> Result<T, E> {
    const CONTENTS: &str = "contents";
    if !path.is_dir() {
        return create_from(path, write);
    }
    let contents = path.join(CONTENTS);
    let unfinished = Unfinished::folder(&contents)?;
    let inside = unfinished.path.join(CONTENTS);
    let written = write(&inside)?;
    let mut moved = Vec::new();
    for entry in entries.iter().filter(|entry| inside.join(entry).exists()) {
        publish(&inside.join(entry), &path.join(entry))?;
        // Until all entries are moved, a failure or signal also removes the entries that have
        // already been moved. Otherwise, an incomplete export would look like a complete one.
        moved.push(Registered::new(&path.join(entry)));
    }
    sync_parent(&contents)?;
    moved.iter_mut().for_each(Registered::disarm);
    Ok(written)
}

fn exists() -> Error {
    Error::new(ErrorKind::AlreadyExists, "it exists already")
}

fn write_and_publish(
    path: &Path,
    contents: impl FnOnce(&mut File) -> std::io::Result<()>,
    publish: impl FnOnce(&Path) -> std::io::Result<()>,
) -> std::io::Result<()> {
    let mut unfinished = Unfinished::file(path)?;
    contents(&mut unfinished.file)?;
    // The contents must be on the disk before the file gets its name. Otherwise, the name could
    // lead to an empty file after a power failure.
    unfinished.file.sync_all()?;
    publish(&unfinished.path)?;
    // From here on, the temporary name may belong to another program.
    unfinished.registered.disarm();
    sync_parent(path)
}

/// Renames a file unless the new name exists.
fn publish(from: &Path, to: &Path) -> std::io::Result<()> {
    #[cfg(target_os = "linux")]
    match renameat_with(CWD, from, CWD, to, rustix::fs::RenameFlags::NOREPLACE) {
        // Some file systems do not support this flag.
        Err(rustix::io::Errno::INVAL | rustix::io::Errno::NOSYS) => {}
        Err(rustix::io::Errno::EXIST) => return Err(exists()),
        renamed => return Ok(renamed?),
    }
    if to.symlink_metadata().is_ok() {
        return Err(exists());
    }
    std::fs::rename(from, to)
}

/// A rename is durable only after the folder is synced.
fn sync_parent(path: &Path) -> std::io::Result<()> {
    let folder = path
        .parent()
        .filter(|folder| !folder.as_os_str().is_empty())
        .unwrap_or(Path::new("."));
    match File::open(folder)?.sync_all() {
        // Some network file systems cannot sync folders.
        Err(error)
            if matches!(
                error.kind(),
                ErrorKind::InvalidInput | ErrorKind::Unsupported
            ) =>
        {
            Ok(())
        }
        synced => synced,
    }
}

/// A file or folder with a temporary name, locked by this process. On drop, it is removed if it
/// still exists.
struct Unfinished {
    path: PathBuf,
    /// This field is declared before `file`. Fields drop in order, so the path is removed while it
    /// is still locked.
    registered: Registered,
    /// The file, or the folder opened for the lock.
    file: File,
}

impl Unfinished {
    fn file(path: &Path) -> std::io::Result<Self> {
        Self::new(path, |unfinished| File::create_new(unfinished).map(Some))
    }

    fn folder(path: &Path) -> std::io::Result<Self> {
        Self::new(path, |unfinished| {
            std::fs::create_dir(unfinished)?;
            match File::open(unfinished) {
                Err(error) if error.kind() == ErrorKind::NotFound => Ok(None),
                opened => opened.map(Some),
            }
        })
    }

    /// Makes and locks the temporary file. A leftover file of a program that was killed is removed
    /// first. Until the new file is locked, another program may mistake it for a leftover and
    /// remove it. In this case, `make` returns `None`.
    fn new(
        path: &Path,
        make: impl Fn(&Path) -> std::io::Result<Option<File>>,
    ) -> std::io::Result<Self> {
        // Each attempt fails only if another program acts between two calls of this program. If
        // this happens a hundred times in a row, the other program will not stop.
        const MAX_ATTEMPTS: usize = 100;
        let busy = || Error::new(ErrorKind::ResourceBusy, "another program is writing it");
        let unfinished = partial::path_of(path);
        let name = path.file_name().unwrap_or_default();
        for _ in 0..MAX_ATTEMPTS {
            match make(&unfinished) {
                Ok(None) => {}
                Ok(Some(file)) => {
                    // Between creation and lock, another program may have mistaken the file for a
                    // leftover and removed it. This program then holds the lock of a file without a
                    // name, and the next attempt makes a new file.
                    if try_lock(&file)? && is_at(&file, &unfinished) {
                        let registered = Registered::new(&unfinished);
                        return Ok(Self {
                            path: unfinished,
                            registered,
                            file,
                        });
                    }
                }
                Err(error) if error.kind() == ErrorKind::AlreadyExists => {
                    let flags =
                        OFlags::RDONLY | OFlags::NOFOLLOW | OFlags::NONBLOCK | OFlags::CLOEXEC;
                    match rustix::fs::open(&unfinished, flags, Mode::empty()).map(File::from) {
                        // The lock distinguishes a leftover from a file that is being written. The
                        // kernel releases the lock when its program ends, even if the program was
                        // killed.
                        Ok(leftover) if !try_lock(&leftover)? => return Err(busy()),
                        // Holding the lock keeps other programs from removing a new file at this
                        // path in the meantime.
                        Ok(leftover) if is_at(&leftover, &unfinished) => {
                            partial::remove_leftover(&unfinished, &[name])?;
                        }
                        // The program that made the file has just published or removed it.
                        Ok(_) | Err(rustix::io::Errno::NOENT) => {}
                        // A symbolic link or a socket cannot be opened, and no program is writing
                        // it.
                        Err(_) => partial::remove_leftover(&unfinished, &[name])?,
                    }
                }
                Err(error) => return Err(error),
            }
        }
        Err(busy())
    }
}

/// Takes the lock of an open file. Returns whether the lock was free. Always returns true on a file
/// system without locks.
fn try_lock(file: &File) -> std::io::Result<bool> {
    match flock(file, FlockOperation::NonBlockingLockExclusive) {
        // Refusing to write on such file systems would be worse than the rare case of two writers.
        Ok(()) | Err(rustix::io::Errno::NOTSUP | rustix::io::Errno::NOLCK) => Ok(true),
        Err(rustix::io::Errno::WOULDBLOCK) => Ok(false),
        Err(error) => Err(error.into()),
    }
}

fn is_at(file: &File, path: &Path) -> bool {
    // The file is identified by device and inode, because paths may be renamed.
    let id = |metadata: std::fs::Metadata| (metadata.dev(), metadata.ino());
    file.metadata().is_ok_and(|open| {
        path.symlink_metadata()
            .is_ok_and(|named| id(open) == id(named))
    })
}

/// Takes the lock of a file. The file is created if necessary, and keeps its contents. Returns
/// `None` if another program holds the lock. The lock is released when the file is closed.
///
/// # Errors
/// Fails if the file cannot be created, or is a symbolic link.
pub fn lock(path: &Path) -> std::io::Result<Option<File>> {
    let flags =
        OFlags::RDWR | OFlags::CREATE | OFlags::NOFOLLOW | OFlags::NONBLOCK | OFlags::CLOEXEC;
    let file = open_unlinked(path, flags)?;
    Ok(try_lock(&file)?.then_some(file))
}

/// Opens a file with flags that include `NOFOLLOW`, and names a symbolic link in the error.
fn open_unlinked(path: &Path, flags: OFlags) -> std::io::Result<File> {
    match rustix::fs::open(path, flags, Mode::from_raw_mode(0o666)) {
        Err(rustix::io::Errno::LOOP) => {
            Err(Error::new(ErrorKind::InvalidInput, "it is a symbolic link"))
        }
        opened => Ok(File::from(opened?)),
    }
}

/// Checks that a folder into which files will be written is not a symbolic link. The folder need
/// not exist.
///
/// # Errors
/// Fails if the folder is a symbolic link.
pub fn check_no_link(folder: &Path) -> std::io::Result<()> {
    match std::fs::read_link(folder) {
        Ok(target) => Err(Error::new(
            ErrorKind::InvalidInput,
            format!(
                "{} is a symbolic link to {:?}, and files are not written through symbolic links: replace it with the folder",
                folder.display(),
                target
            ),
        )),
        Err(_) => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::symlink;

    fn text(text: &str) -> impl FnOnce(&mut File) -> std::io::Result<()> {
        move |file| file.write_all(text.as_bytes())
    }

    fn names(folder: &Path) -> Vec<String> {
        let entries = std::fs::read_dir(folder).expect("a folder");
        let mut names: Vec<_> = entries
            .map(|entry| {
                entry
                    .expect("an entry")
                    .file_name()
                    .to_string_lossy()
                    .into_owned()
            })
            .collect();
        names.sort();
        names
    }

    #[test]
    fn failed_write_keeps_only_the_previous_file() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("scene.ply");
        replace(&path, text("first")).expect("written");
        let failed = replace(&path, |file| {
            file.write_all(b"sec")?;
            Err(ErrorKind::StorageFull.into())
        });
        assert_eq!(
            failed.expect_err("the disk is full").kind(),
            ErrorKind::StorageFull
        );
        assert_eq!(
            create(&path, text("second")).expect_err("it exists").kind(),
            ErrorKind::AlreadyExists
        );
        assert_eq!(std::fs::read(&path).expect("kept"), b"first");
        assert_eq!(names(folder.path()), ["scene.ply"]);
    }

    #[test]
    fn links_are_replaced_and_never_followed() {
        let folder = tempfile::tempdir().expect("a folder");
        let at = |name: &str| folder.path().join(name);
        std::fs::write(at("precious"), "precious").expect("written");
        std::fs::create_dir(at("elsewhere")).expect("a folder");
        for (name, target) in [
            ("a", "precious"),
            (".a.fieldrig.part", "precious"),
            (".b.fieldrig.part", "elsewhere"),
            (".lock", "precious"),
        ] {
            symlink(at(target), at(name)).expect("a link");
        }
        replace(&at("a"), text("new")).expect("the links are replaced");
        create_from(&at("b"), |inside| std::fs::write(inside, "new"))
            .expect("the link is replaced");
        symlink(at("precious"), at("log")).expect("a link");
        begin(&at("log"))
            .expect("the link is replaced")
            .write_all(b"new")
            .expect("written");
        assert_eq!(
            ["a", "b", "precious"].map(|name| std::fs::read_to_string(at(name)).expect("text")),
            ["new", "new", "precious"]
        );
        assert!(!at("a").is_symlink() && names(&at("elsewhere")).is_empty());
        assert_eq!(
            lock(&at(".lock")).expect_err("a link").to_string(),
            "it is a symbolic link"
        );
        symlink(at("elsewhere"), at("keyframes")).expect("a link");
        assert!(
            check_no_link(&at("keyframes"))
                .expect_err("a link")
                .to_string()
                .contains("keyframes is a symbolic link to")
        );
        check_no_link(&at("elsewhere")).expect("a folder");
        check_no_link(&at("absent")).expect("not there yet");
    }

    #[test]
    fn one_of_two_writers_wins_and_leftovers_are_replaced() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("scene.ply");
        std::fs::write(partial::path_of(&path), "of a program that was killed").expect("written");
        replace(&path, |file| {
            // The test takes the lock in place of another program. Two locks of one process
            // conflict in the same way as locks of two processes.
            let refused = replace(&path, text("other")).expect_err("it is being written");
            assert_eq!(refused.to_string(), "another program is writing it");
            assert_eq!(
                create(&path, text("other"))
                    .expect_err("it is being written")
                    .kind(),
                ErrorKind::ResourceBusy
            );
            file.write_all(b"first")
        })
        .expect("the first writer wins");
        assert_eq!(std::fs::read(&path).expect("a file"), b"first");
        let other = folder.path().join("b.ply");
        let created = create_from(&other, |inside| -> std::io::Result<u8> {
            std::fs::write(inside, "late")?;
            std::fs::write(&other, "early")?; // By a program without locks.
            Ok(7)
        });
        assert_eq!(
            created.expect_err("it exists").kind(),
            ErrorKind::AlreadyExists
        );
        assert_eq!(std::fs::read(&other).expect("a file"), b"early");
        assert_eq!(names(folder.path()), ["b.ply", "scene.ply"]);
    }

    #[test]
    fn simultaneous_writers_write_or_are_refused() {
        const N_WRITERS: usize = 4;
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("scene.ply");
        let created = folder.path().join("scene.spz");
        let until_written = |write: &dyn Fn() -> std::io::Result<()>| {
            while let Err(error) = write() {
                let is_refused = matches!(
                    error.kind(),
                    ErrorKind::ResourceBusy | ErrorKind::AlreadyExists
                );
                assert!(is_refused, "{error}");
            }
        };
        let write_often = || {
            for _ in 0..200 {
                until_written(&|| replace(&path, text("scene")));
                until_written(&|| create_from(&created, |inside| std::fs::write(inside, "scene")));
                // Only the creator of the file removes it.
                std::fs::remove_file(&created).expect("it was created");
            }
        };
        std::thread::scope(|scope| (0..N_WRITERS).for_each(|_| drop(scope.spawn(write_often))));
        assert_eq!(names(folder.path()), ["scene.ply"]);
    }

    #[test]
    fn only_leftovers_are_removed() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("a.ply");
        let part = partial::path_of(&path);
        std::fs::create_dir(&part).expect("a folder");
        std::fs::write(part.join("notes.txt"), "of the user").expect("written");
        let refused = replace(&path, text("new"))
            .expect_err("the folder may not be removed")
            .to_string();
        assert!(
            refused.contains(".a.ply.fieldrig.part is a folder with other files"),
            "{refused}"
        );
        std::fs::rename(part.join("notes.txt"), part.join("a.ply")).expect("renamed");
        replace(&path, text("new")).expect("the folder is a leftover");
        assert_eq!(names(folder.path()), ["a.ply"]);
    }

    #[test]
    fn files_that_a_user_calls_part_are_kept() {
        let folder = tempfile::tempdir().expect("a folder");
        let at = |name: &str| folder.path().join(name);
        std::fs::write(at("a.part"), "download").expect("written");
        std::fs::create_dir(at("b.part")).expect("a folder");
        std::fs::write(at(".c.part"), "download").expect("written");
        replace(&at("a"), text("new")).expect("written");
        create_from(&at("b"), |inside| std::fs::write(inside, "new")).expect("written");
        create(&at("c"), text("new")).expect("written");
        create_folder(&at("d"), &[], |inside| std::fs::create_dir(inside)).expect("created");
        assert_eq!(
            names(folder.path()),
            [".c.part", "a", "a.part", "b", "b.part", "c", "d"]
        );
        for name in ["a.part", ".c.part"] {
            assert_eq!(std::fs::read_to_string(at(name)).expect("text"), "download");
        }
    }

    /// Writes a folder with the entries `images` and `list`.
    fn dataset(inside: &Path) -> std::io::Result<()> {
        std::fs::create_dir_all(inside.join("images"))?;
        std::fs::write(inside.join("images/0.png"), "new")?;
        std::fs::write(inside.join("list"), "new")
    }

    const ENTRIES: [&str; 3] = ["images", "masks", "list"];

    #[test]
    fn folder_appears_when_it_is_complete() {
        let folder = tempfile::tempdir().expect("a folder");
        let scan = folder.path().join("scan");
        let unfinished = partial::path_of(&scan);
        // What a killed program leaves behind.
        dataset(&unfinished.join("scan")).expect("space");
        create_folder(&scan, &ENTRIES, |inside| {
            dataset(inside)?;
            assert!(!scan.exists() && inside.starts_with(&unfinished));
            let refused = create_folder(&scan, &ENTRIES, dataset).expect_err("it is being written");
            assert_eq!(refused.to_string(), "another program is writing it");
            Ok::<_, Error>(())
        })
        .expect("the leftover is replaced");
        assert_eq!(
            (names(&scan), names(folder.path())),
            (
                vec!["images".to_owned(), "list".to_owned()],
                vec!["scan".to_owned()]
            )
        );
        std::fs::remove_dir_all(&scan).expect("it exists");
        let failed = create_folder(&scan, &ENTRIES, |inside| {
            dataset(inside)?;
            Err::<(), Error>(ErrorKind::StorageFull.into())
        });
        assert_eq!(
            failed.expect_err("the disk is full").kind(),
            ErrorKind::StorageFull
        );
        assert!(
            names(folder.path()).is_empty(),
            "an incomplete folder is removed"
        );
        symlink(folder.path().join("absent"), &scan).expect("a link");
        let refused = create_folder(&scan, &ENTRIES, dataset).expect_err("a link");
        assert_eq!(refused.kind(), ErrorKind::AlreadyExists);
        assert_eq!(names(folder.path()), ["scan"]);
    }

    #[test]
    fn entries_appear_in_an_existing_folder_when_they_are_complete() {
        let folder = tempfile::tempdir().expect("a folder");
        let at = |name: &str| folder.path().join(name);
        std::fs::write(at("contents"), "of the user").expect("written");
        // What a killed program leaves behind.
        dataset(&partial::path_of(&at("contents")).join("contents")).expect("space");
        create_folder(folder.path(), &ENTRIES, |inside| {
            dataset(inside)?;
            assert!(!at("images").exists() && !at("list").exists());
            Ok::<_, Error>(())
        })
        .expect("the leftover is replaced");
        assert_eq!(names(folder.path()), ["contents", "images", "list"]);
        assert_eq!(names(&at("images")), ["0.png"]);
        std::fs::remove_dir_all(at("images")).expect("it exists");
        let refused = create_folder(folder.path(), &ENTRIES, dataset).expect_err("the list exists");
        assert_eq!(refused.kind(), ErrorKind::AlreadyExists);
        assert_eq!(
            names(folder.path()),
            ["contents", "list"],
            "images are removed again"
        );
        assert_eq!(
            std::fs::read_to_string(at("contents")).expect("text"),
            "of the user"
        );
    }

    #[test]
    fn lock_is_exclusive_and_keeps_the_contents() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join(".lock");
        std::fs::write(&path, "kept").expect("written");
        let held = lock(&path).expect("a file").expect("nobody holds it");
        assert!(lock(&path).expect("a file").is_none());
        drop(held);
        assert!(lock(&path).expect("a file").is_some());
        assert_eq!(std::fs::read(&path).expect("a file"), b"kept");
    }
}
