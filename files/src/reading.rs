//! Opens files for reading.

use crate::Budget;
use std::fs::{File, OpenOptions};
use std::io::{Error, ErrorKind, Read};
use std::os::unix::fs::{FileTypeExt, OpenOptionsExt};
use std::path::Path;

/// Opens a regular file for reading.
///
/// # Errors
/// Fails if the file cannot be opened, or if it is a folder, a pipe, a socket or a device.
pub fn open(path: &Path) -> std::io::Result<File> {
    // Opening a pipe waits for its writer, and opening a device may start the device. The type is
    // therefore also checked before opening.
    check_type(&std::fs::metadata(path)?.file_type())?;
    // Another program may replace the file between this check and the opening. With `NONBLOCK`, a
    // pipe that replaces it is opened at once, and the second check refuses it.
    let flags = rustix::fs::OFlags::NONBLOCK.bits().cast_signed();
    let file = OpenOptions::new()
        .read(true)
        .custom_flags(flags)
        .open(path)?;
    check_type(&file.metadata()?.file_type())?;
    Ok(file)
}

fn check_type(kind: &std::fs::FileType) -> std::io::Result<()> {
    if kind.is_file() {
        return Ok(());
    }
    if kind.is_dir() {
        return Err(Error::new(ErrorKind::IsADirectory, "it is a folder"));
    }
    let what = if kind.is_fifo() {
        "a pipe"
    } else if kind.is_socket() {
        "a socket"
    } else {
        "a device"
    };
    Err(Error::new(
        ErrorKind::InvalidInput,
        format!("it is {what}; expected a file"),
    ))
}

/// Reads a regular file within a budget.
///
/// # Errors
/// Fails if the file cannot be opened or read, is not a regular file, or is larger than the budget.
pub fn read(path: &Path, budget: Budget) -> std::io::Result<Vec<u8>> {
    let file = open(path)?;
    let n_bytes = file.metadata()?.len();
    budget.check_bytes(n_bytes)?;
    let mut bytes = Vec::new();
    // Memory is reserved before reading. A file that does not fit into memory is then an error
    // instead of an abort.
    bytes.try_reserve_exact(usize::try_from(n_bytes).unwrap_or(usize::MAX))?;
    // The file may grow, and files in /proc have no size.
    file.take(budget.max_bytes.saturating_add(1))
        .read_to_end(&mut bytes)?;
    budget.check_bytes(bytes.len() as u64)?;
    Ok(bytes)
}

/// Reads a text in UTF-8 within [`Budget::TEXT`], without its byte order mark.
///
/// # Errors
/// Fails like [`read`], and also if the file is not UTF-8.
pub fn read_text(path: &Path) -> std::io::Result<String> {
    let bytes = read(path, Budget::TEXT)?;
    // Windows editors offer UTF-16 under the name "Unicode". Its byte order mark shows that a text
    // is in UTF-16.
    let is_utf_16 = [[0xFF, 0xFE], [0xFE, 0xFF]]
        .iter()
        .any(|mark| bytes.starts_with(mark));
    let mut text = String::from_utf8(bytes).map_err(|_| {
        let found = if is_utf_16 {
            "it is UTF-16 text; save it as UTF-8"
        } else {
            "it is not UTF-8 text"
        };
        Error::new(ErrorKind::InvalidData, found)
    })?;
    // The parsers of TOML, JSON and lists would treat the byte order mark as a part of the first
    // word.
    if text.starts_with('\u{FEFF}') {
        text.drain(..'\u{FEFF}'.len_utf8());
    }
    Ok(text)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::symlink;
    use std::process::Command;

    #[test]
    fn only_regular_files_up_to_the_limit_are_read() {
        let folder = tempfile::tempdir().expect("a folder");
        let at = |name: &str| folder.path().join(name);
        let of_bytes = |max_bytes| Budget {
            max_bytes,
            ..Budget::TEXT
        };
        std::fs::write(at("text"), "twelve bytes").expect("written");
        symlink(at("text"), at("link")).expect("a link");
        assert_eq!(
            read(&at("link"), of_bytes(12)).expect("a link to a file"),
            b"twelve bytes"
        );
        assert_eq!(read_text(&at("text")).expect("text"), "twelve bytes");
        assert_eq!(
            read(&at("text"), of_bytes(11))
                .expect_err("too large")
                .kind(),
            ErrorKind::FileTooLarge
        );
        std::fs::write(at("latin"), [b'a', 0xE4]).expect("written");
        assert_eq!(
            read_text(&at("latin")).expect_err("not UTF-8").to_string(),
            "it is not UTF-8 text"
        );
        std::fs::write(at("marked"), "\u{FEFF}text").expect("written");
        assert_eq!(read_text(&at("marked")).expect("text"), "text");
        std::fs::write(at("wide"), [0xFF, 0xFE, b'a', 0]).expect("written");
        assert_eq!(
            read_text(&at("wide")).expect_err("UTF-16").to_string(),
            "it is UTF-16 text; save it as UTF-8"
        );
        assert_eq!(
            read(&at("absent"), of_bytes(1)).expect_err("absent").kind(),
            ErrorKind::NotFound
        );
        assert_eq!(
            read(folder.path(), of_bytes(1))
                .expect_err("a folder")
                .to_string(),
            "it is a folder"
        );
        let made = Command::new("mkfifo")
            .arg(at("pipe"))
            .status()
            .expect("mkfifo is part of every system");
        assert!(made.success());
        symlink("/dev/zero", at("zero")).expect("a link");
        for (name, what) in [("pipe", "it is a pipe"), ("zero", "it is a device")] {
            let error = read(&at(name), Budget::PLAIN)
                .expect_err("not a file")
                .to_string();
            assert!(error.starts_with(what), "{error}");
        }
        assert!(
            read(Path::new("/proc/self/status"), Budget::TEXT)
                .expect("a file without a size")
                .len()
                > 100
        );
    }
}
