//! Classes of errors, which determine the exit code.

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
