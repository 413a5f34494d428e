//! Errors of a solution: scatter of the board and cross-validation.

use super::Setup;
use super::geometry::{self, Solution};
use super::pose_fit::{self, HandEyeNoise, Measurement};
use crate::BoardPoint;
use kinematics::{Intrinsics, Transform};

/// How much the poses of the board that the samples imply differ.
///
/// For each sample, `board_i = base_from_flange_i * flange_from_camera * camera_from_board_i` (eye in hand), or
/// `flange_from_base_i * base_from_camera * camera_from_board_i` (eye to hand). The scatter of the position is the RMS
/// distance of the origin of `board_i` from the mean over the samples. The scatter of the rotation is the RMS angle
/// between the rotation of `board_i` and the mean rotation (least squares over rotation matrices).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Scatter {
    /// Position, millimeters.
    pub mm: f64,
    /// Rotation, degrees.
    pub deg: f64,
}

/// Scatter of board poses. `None` without poses.
pub(super) fn scatter(boards: &[Transform]) -> Option<Scatter> {
    let mean = geometry::mean(boards)?;
    let rms = |squares: f64| (squares / boards.len() as f64).sqrt();
    let distances = boards.iter().map(|board| (board.translation.vector - mean.translation.vector).norm_squared());
    let angles = boards.iter().map(|board| board.rotation.angle_to(&mean.rotation).powi(2));
    Some(Scatter { mm: 1e3 * rms(distances.sum()), deg: rms(angles.sum()).to_degrees() })
}

/// Largest number of fits of a cross-validation. With more measurements, several are left out at a time.
pub const MAX_FOLDS: usize = 60;

/// For each measurement, the solution of the others: leave-one-out, or with many measurements cross-validation in
/// [`MAX_FOLDS`] interleaved folds.
///
/// * `knows_noise`: keeps the given noise, which is faster than estimating it without the measurement.
pub(super) fn held_out_solutions(
    setup: Setup,
    measurements: &[Measurement],
    solution: Solution,
    noise: HandEyeNoise,
    knows_noise: bool,
) -> Vec<Option<Solution>> {
    let n_folds = measurements.len().min(MAX_FOLDS);
    let without = |fold: usize| {
        let others = measurements.iter().enumerate().filter(|(ix, _)| ix % n_folds != fold);
        let others: Vec<Measurement> = others.map(|(_, measurement)| measurement.clone()).collect();
        (others.len() >= 3).then_some(())?;
        let fit = if knows_noise { pose_fit::fit_with_known_noise } else { pose_fit::fit };
        Some(fit(setup, &others, solution, noise).ok()?.solution)
    };
    let folds: Vec<Option<Solution>> = (0..n_folds).map(without).collect();
    (0..measurements.len()).map(|ix| folds[ix % n_folds]).collect()
}

/// Sum of squared reprojection errors, square pixels; infinite if a point cannot be projected.
pub(super) fn reprojection_squares(pose: &Transform, points: &[BoardPoint], intrinsics: &Intrinsics) -> f64 {
    points
        .iter()
        .map(|point| match intrinsics.project(&(pose * nalgebra::Point3::from(point.point_in_board)).coords) {
            Some(pixel) => (pixel[0] - point.pixel[0]).powi(2) + (pixel[1] - point.pixel[1]).powi(2),
            None => f64::INFINITY,
        })
        .sum()
}
