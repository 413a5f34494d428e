//! Keeps the textures of simulated scenes in the user's cache folder.

use crate::user_folders;
use std::time::UNIX_EPOCH;

/// Keeps textures from now on, unless the user has no folder for them.
pub(crate) fn start() {
    if let Some((folder, version)) = user_folders::cache().zip(program_version()) {
        sim::keep_textures_in(&folder.join("scenes"), &version);
    }
}

/// A text that changes whenever this program is compiled again: its path, size and time. Textures
/// depend on the code and on the compiler.
fn program_version() -> Option<String> {
    let program = std::env::current_exe().ok()?;
    let metadata = program.metadata().ok()?;
    let modified = metadata.modified().ok()?.duration_since(UNIX_EPOCH).ok()?;
    Some(format!(
        "{} {} {}",
        program.display(),
        metadata.len(),
        modified.as_nanos()
    ))
}
