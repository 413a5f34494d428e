//! Location of real data that some tests use. Without the data, these tests are skipped.

use std::path::{Path, PathBuf};

/// A file or folder of the test data, in `FIELDRIG_TEST_DATA` or next to the project. If it is
/// missing, reports the calling test as skipped and returns `None`.
pub fn data_folder(name: &str) -> Option<PathBuf> {
    let next_to_project = || Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data");
    let data = std::env::var_os("FIELDRIG_TEST_DATA").map_or_else(next_to_project, PathBuf::from);
    let path = data.join(name);
    if !path.exists() {
        crate::skip(format_args!(
            "the test data {name:?} are missing (variable FIELDRIG_TEST_DATA)"
        ));
        return None;
    }
    Some(path)
}
