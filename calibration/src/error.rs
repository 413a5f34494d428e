//! Errors of calibration.

/// An error of calibration.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
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
}
