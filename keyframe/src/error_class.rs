//! What an error means for the caller.

/// Class of an error, from which a program derives its exit code.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ErrorClass {
    /// The arguments, or a file they name, are invalid.
    BadInput,
    /// The input is valid but not sufficient for a result.
    InsufficientData,
    /// Something failed: a device, a file, the GPU.
    Failed,
}
