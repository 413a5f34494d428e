//! Where real data lie that some tests compare with; elsewhere those tests are skipped with a line.

use std::path::{Path, PathBuf};

/// A folder of the test data: below `FIELDRIG_TEST_DATA`, or beside the project; none where there is none, which is told.
pub(crate) fn folder(name: &str) -> Option<PathBuf> {
    let default_folder = || {
        // The crate's folder is the project's, or in it.
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
