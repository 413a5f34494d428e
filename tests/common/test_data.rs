//! Location of real data that some tests use. Without the data, these tests are skipped with a message.

use std::path::{Path, PathBuf};

/// A folder of the test data, in `FIELDRIG_TEST_DATA` or next to the project. If the folder is missing, prints a
/// message and returns `None`.
pub(crate) fn folder(name: &str) -> Option<PathBuf> {
    let default_folder = || {
        // The crate's folder is the project folder or a folder in it.
        let crate_folder = Path::new(env!("CARGO_MANIFEST_DIR"));
        let project = crate_folder.ancestors().find(|folder| folder.join("ARCHITECTURE.md").is_file());
        project.unwrap_or(crate_folder).join("../shared/data")
    };
    let folder = std::env::var_os("FIELDRIG_TEST_DATA").map_or_else(default_folder, PathBuf::from).join(name);
    if !folder.is_dir() {
        eprintln!("skipped: no test data at {}", folder.display());
        return None;
    }
    Some(folder)
}
