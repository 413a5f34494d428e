//! Folders of the user for files of this program, by the XDG Base Directory Specification.

use std::path::PathBuf;

/// The user's folder for data of this program. `None` if there is no home folder.
pub(crate) fn data() -> Option<PathBuf> {
    of("XDG_DATA_HOME", ".local/share")
}

/// The user's folder for files that this program can create again.
#[cfg(feature = "sim")]
pub(crate) fn cache() -> Option<PathBuf> {
    of("XDG_CACHE_HOME", ".cache")
}

/// The folder that a variable names, or this one in the home folder.
fn of(variable: &str, in_home: &str) -> Option<PathBuf> {
    let given = std::env::var_os(variable)
        .map(PathBuf::from)
        // The specification says to ignore relative paths.
        .filter(|folder| folder.is_absolute());
    given
        .or_else(|| Some(std::env::home_dir()?.join(in_home)))
        .map(|folder| folder.join("fieldrig"))
}
