//! Samples with all poses of the board that their measurements allow.

use super::planar_pose::{self, BoardPose};
use super::{BoardObservation, HandEyeInput, HandEyeSample, geometry};
use kinematics::Transform;
use nalgebra::Matrix6;

/// A sample that can be used.
#[derive(Clone, Debug)]
pub(super) struct Sample {
    /// Index in the input.
    pub(super) sample_ix: usize,
    /// Index of the stop: samples at the same robot pose share it, and the error of that pose.
    pub(super) stop_ix: usize,
    /// See [`geometry::Solution`].
    pub(super) a: Transform,
    /// Poses of the board, the most likely first. Not empty.
    pub(super) candidates: Vec<Candidate>,
}

/// One pose of the board that a measurement allows.
#[derive(Clone, Debug)]
pub(super) struct Candidate {
    pub(super) camera_from_board: Transform,
    /// Equivalent rotation of the board: the corners are at `board_from_equivalent.inverse() *
    /// point_in_board`.
    pub(super) board_from_equivalent: Transform,
    /// Accuracy; `None` for a pose that was given.
    pub(super) corners: Option<CornerStatistics>,
}

/// What the corners of one image say about the pose of the board.
#[derive(Clone, Debug)]
pub(super) struct CornerStatistics {
    /// Covariance of the pose for corners with an error of one pixel, in the parameters of
    /// [`geometry::residual`].
    pub(super) unit_covariance: Matrix6<f64>,
    /// Sum of squared residuals of the inliers, square pixels.
    pub(super) squares_px2: f64,
    /// Per corner.
    pub(super) is_inlier: Vec<bool>,
}

/// The samples of an input, by use.
pub(super) struct Sorted {
    /// Samples with candidates.
    pub(super) usable: Vec<Sample>,
    /// Indices of samples whose measurement allows no pose of the board.
    pub(super) without_board: Vec<usize>,
    /// Indices of samples that are identical to an earlier one. They contain no further
    /// information.
    pub(super) repeated: Vec<usize>,
}

/// Candidates of all samples that differ from each other.
pub(super) fn samples(
    input: &HandEyeInput<'_>,
    intrinsics: Option<&kinematics::Intrinsics>,
) -> Sorted {
    let mut sorted = Sorted {
        usable: Vec::new(),
        without_board: Vec::new(),
        repeated: Vec::new(),
    };
    // Robot poses of the stops so far.
    let mut stops: Vec<Transform> = Vec::new();
    for (sample_ix, sample) in input.samples.iter().enumerate() {
        if input.samples[..sample_ix]
            .iter()
            .any(|earlier| is_same(earlier, sample))
        {
            sorted.repeated.push(sample_ix);
            continue;
        }
        let poses = measured_poses(&sample.board, intrinsics);
        if poses.is_empty() {
            sorted.without_board.push(sample_ix);
            continue;
        }
        let candidates = with_symmetries(&poses, input.board_symmetries);
        let a = geometry::a_of(input.setup, &sample.base_from_flange);
        let stop_ix = stops
            .iter()
            .position(|stop| is_same_stop(stop, &sample.base_from_flange));
        let stop_ix = stop_ix.unwrap_or_else(|| {
            stops.push(sample.base_from_flange);
            stops.len() - 1
        });
        sorted.usable.push(Sample {
            sample_ix,
            stop_ix,
            a,
            candidates,
        });
    }
    sorted
}

/// The poses of the board that one measurement allows, without its symmetries.
fn measured_poses(
    board: &BoardObservation,
    intrinsics: Option<&kinematics::Intrinsics>,
) -> Vec<Candidate> {
    match (board, intrinsics) {
        (BoardObservation::Pose(pose), _) => vec![Candidate {
            camera_from_board: *pose,
            board_from_equivalent: Transform::identity(),
            corners: None,
        }],
        (BoardObservation::View(view), Some(intrinsics)) => {
            likely(planar_pose::board_poses(view, intrinsics))
                .into_iter()
                .filter_map(of_corners)
                .collect()
        }
        (BoardObservation::View(_), None) => Vec::new(),
    }
}

/// Every pose, followed by those of the equivalent rotations of the board.
fn with_symmetries(poses: &[Candidate], symmetries: &[Transform]) -> Vec<Candidate> {
    let mut candidates = Vec::new();
    for pose in poses {
        candidates.push(pose.clone());
        // The identity is in most lists of symmetries, and would be a second equal candidate.
        let rotations = symmetries.iter().filter(|symmetry| !is_identity(symmetry));
        candidates.extend(rotations.map(|symmetry| Candidate {
            camera_from_board: pose.camera_from_board * symmetry,
            board_from_equivalent: *symmetry,
            ..pose.clone()
        }));
    }
    candidates
}

/// Whether two samples have the same values.
fn is_same(a: &HandEyeSample, b: &HandEyeSample) -> bool {
    let is_same_board = match (&a.board, &b.board) {
        (BoardObservation::Pose(a), BoardObservation::Pose(b)) => a == b,
        (BoardObservation::View(a), BoardObservation::View(b)) => a.points == b.points,
        _ => false,
    };
    is_same_board && a.base_from_flange == b.base_from_flange && a.joints == b.joints
}

/// Whether a robot reports the same pose twice, up to the noise of its encoders.
fn is_same_stop(a: &Transform, b: &Transform) -> bool {
    // Above the noise of encoders, below any motion that adds information.
    const SAME_M: f64 = 5e-4;
    const SAME_RAD: f64 = 1e-3;
    let difference = a.inverse() * b;
    difference.translation.vector.norm() < SAME_M && difference.rotation.angle() < SAME_RAD
}

/// Number of different stops of the samples that are selected.
pub(super) fn n_stops(samples: &[Sample], is_inlier: &[bool]) -> usize {
    let used = samples
        .iter()
        .zip(is_inlier)
        .filter(|(_, is_inlier)| **is_inlier);
    used.map(|(sample, _)| sample.stop_ix)
        .collect::<std::collections::BTreeSet<_>>()
        .len()
}

fn is_identity(transform: &Transform) -> bool {
    const SAME: f64 = 1e-9;
    transform.rotation.angle() < SAME && transform.translation.vector.norm() < SAME
}

/// Removes the second solution if the corners exclude it.
fn likely(mut poses: Vec<BoardPose>) -> Vec<BoardPose> {
    /// Ratio of sums of squares; for a board of normal size, a wrong solution exceeds it by orders
    /// of magnitude.
    const MAX_RATIO: f64 = 4.0;
    // Residuals of an exact simulation do not exclude anything.
    const MIN_PX: f64 = 0.05;
    if let [best, second] = poses.as_slice() {
        let floor = best.is_inlier.len() as f64 * MIN_PX * MIN_PX;
        if second.squares_px2 > MAX_RATIO * (best.squares_px2 + floor)
            || 2 * second.n_inliers() < best.n_inliers()
        {
            poses.truncate(1);
        }
    }
    poses
}

/// The candidate of a pose from corners. `None` if they do not determine all six parameters.
fn of_corners(pose: BoardPose) -> Option<Candidate> {
    let unit_covariance = pose.information.try_inverse()?;
    Some(Candidate {
        camera_from_board: pose.camera_from_board,
        board_from_equivalent: Transform::identity(),
        corners: Some(CornerStatistics {
            unit_covariance,
            squares_px2: pose.squares_px2,
            is_inlier: pose.is_inlier,
        }),
    })
}
