//! Errors of calibration.

/// An error of calibration.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A bug: the alignment thread panicked.
    #[error("internal error: the alignment thread ended without a result")]
    AlignmentPanicked,
}
