//! Errors of calibration.

use crate::hand_eye::Refusal;

/// An error of calibration.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A bug: the alignment thread panicked.
    #[error("internal error: the alignment thread ended without a result")]
    AlignmentPanicked,
    /// A residual cannot be computed from the initial parameters.
    #[error(
        "least squares: a residual of block {block_ix} is not defined at the initial parameters; they must be closer to the solution"
    )]
    UndefinedResidual {
        /// Index of the block of residuals.
        block_ix: usize,
    },
    /// There are not more residuals than parameters.
    #[error(
        "least squares: {n_residuals} residuals cannot determine {n_params} parameters; more measurements are needed"
    )]
    TooFewResiduals {
        /// Number of scalar residuals.
        n_residuals: usize,
        /// Number of parameters.
        n_params: usize,
    },
    /// The input of a hand-eye calibration is invalid.
    #[error("hand-eye: {why}")]
    HandEyeInput {
        /// What is wrong, with the value found and the value expected.
        why: String,
    },
    /// The input of a time offset estimation is invalid.
    #[error("time offset: {why}")]
    TimeOffsetInput {
        /// What is wrong, with the value found and the value expected.
        why: String,
    },
    /// The measurements do not determine the result, or a mistake in them explains why they disagree.
    #[error("refused: {0}")]
    Refused(Box<Refusal>),
}
