//! Effect of errors of other parameters on the hand-eye transform and the board pose.

use super::corner_fit::CornerState;
use super::geometry::N_PARAMS;
use crate::least_squares::Fit;
use nalgebra::DMatrix;

/// Covariance of the solution due to errors of the other shared parameters of a fit: intrinsics,
/// then joint offsets.
///
/// With the others fixed at values that are wrong by `e`, the solution moves by `-A e` with `A` the
/// inverse of its own information times the information that it shares with the others. The
/// covariance of a solution with all parameters free is the sum of this and of the covariance with
/// fixed ones.
///
/// * `covariance`: covariance of the others; that of the fit itself if `None`.
pub(super) fn propagated(
    free: &Fit<CornerState>,
    covariance: Option<&DMatrix<f64>>,
) -> Option<DMatrix<f64>> {
    let n_others = free.information.nrows() - N_PARAMS;
    let own = free
        .information
        .view((0, 0), (N_PARAMS, N_PARAMS))
        .into_owned();
    let shared = free.information.view((0, N_PARAMS), (N_PARAMS, n_others));
    // `A` above. Its sign does not matter, because it enters squared.
    let by_others = own.cholesky()?.solve(&shared.into_owned());
    let of_fit = free
        .covariance
        .view((N_PARAMS, N_PARAMS), (n_others, n_others))
        .into_owned();
    let covariance = covariance.unwrap_or(&of_fit);
    // A covariance of another lens model has another size.
    (covariance.shape() == (n_others, n_others))
        .then(|| &by_others * covariance * by_others.transpose())
}
