//! The folder of a robot description.

use std::path::{Path, PathBuf};

/// Folder of the robot description of a rig that was read from a file. Mesh files are named relative
/// to it. It is not part of the rig: two rigs that differ only in this folder are equal.
#[derive(Clone, Debug, Default)]
pub struct UrdfFolder(Option<PathBuf>);

impl UrdfFolder {
    /// The absolute folder of the file at `path`.
    pub(super) fn of(path: &Path) -> Self {
        let absolute = std::path::absolute(path).ok();
        Self(absolute.and_then(|path| path.parent().map(Path::to_owned)))
    }

    /// This folder, which must be absolute.
    pub(super) fn at(folder: &Path) -> Self {
        Self(folder.is_absolute().then(|| folder.to_owned()))
    }

    /// The folder; `None` if the rig was not read from a file.
    #[must_use]
    pub fn path(&self) -> Option<&Path> {
        self.0.as_deref()
    }
}

impl PartialEq for UrdfFolder {
    fn eq(&self, _other: &Self) -> bool {
        true
    }
}
