//! Errors of this crate.

use std::path::PathBuf;

/// Reason why a file of a model cannot be read or written, or its contents cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A file cannot be read.
    #[error("cannot read {path:?}")]
    Read {
        /// The file.
        path: PathBuf,
        /// Cause.
        source: std::io::Error,
    },
    /// A file cannot be written.
    #[error("cannot write {path:?}")]
    Write {
        /// The file.
        path: PathBuf,
        /// Cause.
        source: std::io::Error,
    },
    /// A splat file is invalid.
    #[error("cannot parse {path:?}: {reason}")]
    SplatFile {
        /// The file.
        path: PathBuf,
        /// Description of the problem.
        reason: String,
    },
    /// Splats cannot be read.
    #[error("cannot read splats from {}{hint}", path.display())]
    NoSplats {
        /// Folder or file.
        path: PathBuf,
        /// Suggested action, which completes the sentence.
        hint: &'static str,
        /// Cause.
        source: Box<Self>,
    },
    /// Arrays of splats are inconsistent.
    #[error("splats: {0}")]
    SplatArrays(String),
    /// A file is not a checkpoint, or it is incomplete, damaged or of another version.
    #[error("cannot read checkpoint {path:?}: {reason}")]
    Checkpoint {
        /// The file.
        path: PathBuf,
        /// Description of the problem.
        reason: String,
    },
    /// An array of a complete checkpoint is missing or has another size.
    #[error("invalid state in the checkpoint: {reason}")]
    CheckpointState {
        /// Description of the problem.
        reason: String,
    },
    /// The file of the edits of a saved model is invalid.
    #[error("{} is damaged", path.display())]
    EditsFile {
        /// The file.
        path: PathBuf,
        /// Cause.
        source: serde_json::Error,
    },
    /// A model has the maximum number of edits.
    #[error("a model has at most {max_edits} edits; undo one first")]
    TooManyEdits {
        /// The maximum.
        max_edits: usize,
    },
    /// An edit has values that kernels cannot compute with.
    #[error("invalid edit: {reason}")]
    InvalidEdit {
        /// Values found and expected.
        reason: String,
    },
    /// A model has no edit that could be undone.
    #[error("there is nothing to undo")]
    NothingToUndo,
    /// No edit of a model was undone since the last new edit.
    #[error("there is nothing to redo")]
    NothingToRedo,
}
