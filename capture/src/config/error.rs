//! Errors in rig files.

use std::borrow::Cow;
use std::path::PathBuf;

/// The reason why a rig file was rejected. The message names the file, the line and the key.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ConfigError {
    /// A file is missing or unreadable.
    #[error("cannot read {description} {path:?}")]
    Read {
        /// Contents of the file, with an article.
        description: &'static str,
        /// Its path.
        path: PathBuf,
        /// Why it cannot be read.
        source: std::io::Error,
    },
    /// The text is not TOML.
    #[error("{file} line {line}: {message}")]
    Syntax {
        /// Name of the rig file.
        file: String,
        /// Line of the error, from 1.
        line: usize,
        /// What the parser expected.
        message: String,
    },
    /// The key does not exist.
    #[error("{at}: unknown key {key:?}{}", .nearest.as_ref().map(|nearest_key| format!(", did you mean {nearest_key:?}?")).unwrap_or_default())]
    UnknownKey {
        /// Where the key is set.
        at: SourceLocation,
        /// Dotted path of the key.
        key: String,
        /// Dotted path of the most similar key of the same table, if one is similar.
        nearest: Option<String>,
    },
    /// A required key is missing.
    #[error("{file}: the key {key:?} is missing: {meaning}")]
    Missing {
        /// Name of the rig file.
        file: String,
        /// Dotted path of the key.
        key: String,
        /// Meaning of the key, or its allowed values.
        meaning: Cow<'static, str>,
    },
    /// A value is not allowed.
    #[error("{at}: {key} is {got}, allowed: {allowed}")]
    InvalidValue {
        /// Where the value is set.
        at: SourceLocation,
        /// Dotted path of the key.
        key: String,
        /// The value, as TOML.
        got: String,
        /// The allowed values.
        allowed: String,
    },
    /// A camera info file of ROS cannot be used.
    #[error("{at}: {key}: {reason}")]
    CameraInfo {
        /// Where the value is set.
        at: SourceLocation,
        /// Dotted path of the key.
        key: String,
        /// The file, and why it cannot be used.
        reason: String,
    },
    /// The rig file has several problems.
    #[error(
        "{first}{}{}",
        .others.iter().map(|other| format!("\n  also: {other}")).collect::<String>(),
        if *.n_more > 0 { format!("\n  and {n_more} more problems") } else { String::new() }
    )]
    Several {
        /// The problem that is most likely the cause of others.
        first: Box<Self>,
        /// The other listed problems.
        others: Vec<Self>,
        /// Number of further problems, which are not listed.
        n_more: usize,
    },
    /// The robot description does not match the rig file.
    #[error("{file}: {key}: {reason}")]
    Robot {
        /// Name of the rig file.
        file: String,
        /// Dotted path of the key that does not match.
        key: &'static str,
        /// Why it does not match.
        reason: String,
    },
}

impl ConfigError {
    /// The problem that is shown first.
    pub(super) fn first(&self) -> &Self {
        match self {
            Self::Several { first, .. } => first,
            other => other,
        }
    }

    /// Whether the problem is that this key is missing.
    pub(super) fn is_missing(&self, wanted: &str) -> bool {
        matches!(self, Self::Missing { key, .. } if key == wanted)
    }
}

/// Where a value comes from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum SourceLocation {
    /// A line of the rig file.
    Line {
        /// Name of the rig file.
        file: String,
        /// Line, from 1.
        line: usize,
    },
    /// A value from the command line that overrides the key.
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
