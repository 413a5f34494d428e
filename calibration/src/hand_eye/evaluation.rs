//! Errors of a solution: scatter of the board and cross-validation.

use super::Setup;
use super::geometry::{self, Solution};
use super::pose_fit::{self, HandEyeNoise, Measurement};
use crate::BoardPoint;
use kinematics::{Intrinsics, Transform};

/// How much the poses of the board that the samples imply differ.
///
/// For each sample, `board_i = base_from_flange_i * flange_from_camera * camera_from_board_i` (eye
/// in hand), or `flange_from_base_i * base_from_camera * camera_from_board_i` (eye to hand). The
/// scatter of the position is the RMS distance of the origin of `board_i` from the mean over the
/// samples. The scatter of the rotation is the RMS angle between the rotation of `board_i` and the
/// mean rotation (least squares over rotation matrices).
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
    let distances = boards
        .iter()
        .map(|board| (board.translation.vector - mean.translation.vector).norm_squared());
    let angles = boards
        .iter()
        .map(|board| board.rotation.angle_to(&mean.rotation).powi(2));
    Some(Scatter {
        mm: 1e3 * rms(distances.sum()),
        deg: rms(angles.sum()).to_degrees(),
    })
}

/// Largest number of fits of a cross-validation. With more measurements, several are left out at a
/// time, because the time would grow with the square of their number. Leaving out one of 60 changes
/// a solution very little already.
pub const MAX_FOLDS: usize = 60;

/// For each measurement, the solution of the others: stops are left out one by one, or with many
/// stops in [`MAX_FOLDS`] interleaved folds.
///
/// * `knows_noise`: keeps the given noise, which is faster than estimating it without the
///   measurement.
pub(super) fn held_out_solutions(
    setup: Setup,
    measurements: &[Measurement],
    solution: Solution,
    noise: HandEyeNoise,
    knows_noise: bool,
) -> Vec<Option<Solution>> {
    // Measurements at one stop share the error of the robot pose, so they are left out together.
    let mut stops: Vec<usize> = measurements
        .iter()
        .map(|measurement| measurement.stop_ix)
        .collect();
    stops.sort_unstable();
    stops.dedup();
    let n_folds = stops.len().min(MAX_FOLDS);
    let fold_of = |measurement: &Measurement| {
        stops.partition_point(|stop| *stop < measurement.stop_ix) % n_folds
    };
    let n_left_out = stops.len().div_ceil(n_folds.max(1));
    // The others must be at three stops at least.
    let is_possible = stops.len() >= n_left_out + 3;
    let fit = if knows_noise {
        pose_fit::fit_with_known_noise
    } else {
        pose_fit::fit
    };
    let folds: Vec<Option<Solution>> = (0..n_folds)
        .map(|fold| {
            is_possible.then_some(())?;
            let others: Vec<Measurement> = measurements
                .iter()
                .filter(|other| fold_of(other) != fold)
                .cloned()
                .collect();
            Some(fit(setup, &others, solution, noise).ok()?.solution)
        })
        .collect();
    measurements
        .iter()
        .map(|measurement| folds[fold_of(measurement)])
        .collect()
}

/// Sum of squared reprojection errors, square pixels; infinite if a point cannot be projected.
pub(super) fn reprojection_squares(
    pose: &Transform,
    points: &[BoardPoint],
    intrinsics: &Intrinsics,
) -> f64 {
    points
        .iter()
        .map(|point| {
            match intrinsics.project(&(pose * nalgebra::Point3::from(point.point_in_board)).coords)
            {
                Some(pixel) => {
                    (pixel[0] - point.pixel[0]).powi(2) + (pixel[1] - point.pixel[1]).powi(2)
                }
                None => f64::INFINITY,
            }
        })
        .sum()
}
