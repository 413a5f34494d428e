//! The path of a rig file, for its comments and for commands in messages.

use messages::quoted_for_shell;
use std::path::{Path, PathBuf};

/// Name of a rig file in commands if its path is unknown.
const PLACEHOLDER: &str = "RIG.toml";

/// Path of the rig file from which a rig was read, as the user has given it. It is not part of the
/// rig: two rigs that differ only in this path are equal.
#[derive(Clone, Debug, Default)]
pub struct RigPath(Option<PathBuf>);

impl RigPath {
    pub(super) fn of(path: &Path) -> Self {
        Self(Some(path.to_owned()))
    }

    /// The path. `None` if the rig was not read from a file.
    #[must_use]
    pub fn get(&self) -> Option<&Path> {
        self.0.as_deref()
    }

    /// The path as an argument of a command, quoted for a shell. `RIG.toml` if the rig was not read
    /// from a file.
    #[must_use]
    pub fn argument(&self) -> String {
        self.0.as_ref().map_or_else(
            || PLACEHOLDER.to_owned(),
            |path| quoted_for_shell(&path.to_string_lossy()),
        )
    }
}

impl PartialEq for RigPath {
    fn eq(&self, _other: &Self) -> bool {
        true
    }
}
