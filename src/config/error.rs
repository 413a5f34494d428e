//! Errors in rig files.

use std::borrow::Cow;
use std::path::PathBuf;

/// Why a rig file was rejected. The message names the file, the line and the key.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub(crate) enum ConfigError {
    /// A file is missing or unreadable.
    #[error("cannot read {description} {path:?}")]
    Read { description: &'static str, path: PathBuf, source: std::io::Error },
    /// The text is not TOML.
    #[error("{file} line {line}: {message}")]
    Syntax { file: String, line: usize, message: String },
    /// The key does not exist.
    #[error("{at}: unknown key {key:?}{}", .nearest.as_ref().map(|nearest_key| format!(", did you mean {nearest_key:?}?")).unwrap_or_default())]
    UnknownKey { at: SourceLocation, key: String, nearest: Option<String> },
    /// A required key.
    #[error("{file}: the key {key:?} is missing: {meaning}")]
    Missing { file: String, key: String, meaning: Cow<'static, str> },
    /// A value outside the allowed ones.
    #[error("{at}: {key} is {got}, allowed: {allowed}")]
    InvalidValue { at: SourceLocation, key: String, got: String, allowed: String },
    /// The robot description does not match the rig file.
    #[error("{file}: {key}: {reason}")]
    Robot { file: String, key: &'static str, reason: String },
}

/// Where a value comes from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum SourceLocation {
    /// A line of the rig file, from 1.
    Line { file: String, line: usize },
    /// A flag that overrides the key.
    Flag,
}

impl std::fmt::Display for SourceLocation {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Line { file, line } => write!(f, "{file} line {line}"),
            Self::Flag => f.write_str("command line"),
        }
    }
}
