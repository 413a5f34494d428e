//! Whether the corners contradict the given intrinsics.

use super::corner_fit::CornerState;
use super::geometry::{N_PARAMS, Solution};
use super::propagation::propagated;
use super::selection::{Free, Selection, corner_fit};
use crate::least_squares::Fit;
use kinematics::Intrinsics;
use messages::Setting;
use nalgebra::{DMatrix, DVector};

/// The corners contradict the given intrinsics.
pub(super) struct IntrinsicsDoubt {
    free: Solution,
    by_intrinsics: DMatrix<f64>,
    pub(super) warning: String,
}

impl IntrinsicsDoubt {
    /// `None` if free intrinsics do not fit significantly better, or differ by no more than the
    /// uncertainty of the given ones explains.
    ///
    /// * `free`: fit with free intrinsics.
    pub(super) fn new(
        selection: Selection<'_>,
        intrinsics: &Intrinsics,
        free: &Fit<CornerState>,
        covariance: Option<&DMatrix<f64>>,
    ) -> Option<Self> {
        let fixed = corner_fit(
            selection,
            intrinsics,
            &[],
            Free {
                intrinsics: false,
                joints: false,
            },
        )
        .ok()?;
        // Twice the decrease of the cost has as many degrees of freedom as there are intrinsics.
        // Residuals of real images are not independent, so their variance scales it, and the limit
        // is generous.
        let n_params = intrinsics.params().len() as f64;
        let decrease = 2.0 * (fixed.cost - free.cost) / free.variance.max(1.0);
        let limit = n_params + 6.0 * (2.0 * n_params).sqrt();
        (decrease > limit).then_some(())?;
        // The given intrinsics have an uncertainty of their own. A change within it contradicts
        // nothing, and the uncertainty is propagated to the result anyway.
        if covariance.is_some_and(|given| {
            squared_change(intrinsics, free, given).is_some_and(|square| square < limit)
        }) {
            return None;
        }
        let change = fixed.state.solution.x.inverse() * free.state.solution.x;
        let warning = format!(
            "the corners contradict the given intrinsics: with free intrinsics, {}, and the camera moves by {:.1} mm and {:.2} degrees, which is included in the uncertainty; calibrate the intrinsics with calibrate intrinsics, or estimate them together with the pose ({})",
            change_of_intrinsics(intrinsics, &free.state.intrinsics),
            1e3 * change.translation.vector.norm(),
            change.rotation.angle().to_degrees(),
            Setting::WithIntrinsics
        );
        Some(Self {
            free: free.state.solution,
            by_intrinsics: propagated(free, None)?,
            warning,
        })
    }

    /// Covariance to add to that of a solution with the given intrinsics: the effect of the
    /// uncertainty of free intrinsics, and the square of the difference.
    pub(super) fn covariance(&self, solution: &Solution) -> DMatrix<f64> {
        let mut shift = DVector::zeros(N_PARAMS);
        for (first, from, to) in [(0, solution.x, self.free.x), (6, solution.y, self.free.y)] {
            let change = from.inverse() * to;
            shift
                .fixed_rows_mut::<3>(first)
                .copy_from(&change.rotation.scaled_axis());
            shift
                .fixed_rows_mut::<3>(first + 3)
                .copy_from(&change.translation.vector);
        }
        &self.by_intrinsics + &shift * shift.transpose()
    }
}

/// Squared change of the intrinsics relative to the uncertainty of both, given and free ones.
/// `None` if neither is uncertain.
fn squared_change(
    given: &Intrinsics,
    free: &Fit<CornerState>,
    covariance: &DMatrix<f64>,
) -> Option<f64> {
    let params = given.params();
    let changes = free
        .state
        .intrinsics
        .params()
        .into_iter()
        .zip(&params)
        .map(|(free, given)| free - given);
    let change = DVector::from_iterator(params.len(), changes);
    let n = params.len();
    let of_free = free.covariance.view((N_PARAMS, N_PARAMS), (n, n));
    let total = covariance + of_free;
    Some(change.dot(&total.cholesky()?.solve(&change)))
}

/// The changes of focal length and principal point, the larger one first.
fn change_of_intrinsics(given: &Intrinsics, free: &Intrinsics) -> String {
    let largest = |a: [f64; 2], b: [f64; 2]| f64::max((a[0] - b[0]).abs(), (a[1] - b[1]).abs());
    let [x, y] = [0, 1].map(|axis| free.principal_px[axis] - given.principal_px[axis]);
    let focal = format!(
        "the focal length changes from {:.1} to {:.1} px",
        given.focal_px[0], free.focal_px[0]
    );
    let principal = format!(
        "the principal point moves by ({x:.1}, {y:.1}) px from ({:.1}, {:.1})",
        given.principal_px[0], given.principal_px[1]
    );
    if largest(given.principal_px, free.principal_px) > largest(given.focal_px, free.focal_px) {
        format!("{principal}, {focal}")
    } else {
        format!("{focal}, {principal}")
    }
}
