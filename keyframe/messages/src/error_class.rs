//! Classes of errors, and errors that state their class. The class determines the exit code of a
//! program.

/// Class of an error, from which a program derives its exit code.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ErrorClass {
    /// The arguments, or a file that they name, are invalid.
    BadInput,
    /// The input is valid but not sufficient for a result.
    InsufficientData,
    /// A device, a file operation or the GPU failed.
    Failed,
}

/// The arguments, or a file that they name, are invalid.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct BadInput(pub String);

/// The input is valid but not sufficient for a result.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct InsufficientData(pub String);
