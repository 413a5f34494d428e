//! Checks the paths of outputs before devices are opened and work begins.

use files::destination::{self, Unwritable};
use messages::{BadInput, Setting};
use std::path::Path;

/// Checks that a file can be written where a setting wants it.
///
/// # Errors
/// If its folder does not exist, or may not be changed by this user.
pub fn check_output_file(setting: Setting, path: &Path) -> Result<(), BadInput> {
    destination::check_file(path).map_err(|problem| refused(setting, path, &problem))
}

/// Checks that files can be written into the folder of a setting, which may not exist yet.
///
/// # Errors
/// If the folder, or the nearest parent that exists, may not be changed by this user.
pub fn check_output_folder(setting: Setting, path: &Path) -> Result<(), BadInput> {
    destination::check_folder(path).map_err(|problem| refused(setting, path, &problem))
}

fn refused(setting: Setting, path: &Path, problem: &Unwritable) -> BadInput {
    BadInput(format!("{setting} {}: {problem}", path.display()))
}
