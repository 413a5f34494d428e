//! Samples with all poses of the board that their measurements allow.

use super::planar_pose::{self, BoardPose};
use super::{BoardObservation, HandEyeInput, geometry};
use kinematics::Transform;
use nalgebra::Matrix6;

/// A sample that can be used.
#[derive(Clone, Debug)]
pub(super) struct Sample {
    /// Index in the input.
    pub(super) sample_ix: usize,
    /// See [`geometry::Solution`].
    pub(super) a: Transform,
    /// Poses of the board, the most likely first. Not empty.
    pub(super) candidates: Vec<Candidate>,
}

/// One pose of the board that a measurement allows.
#[derive(Clone, Debug)]
pub(super) struct Candidate {
    pub(super) camera_from_board: Transform,
    /// Equivalent rotation of the board: the corners are at `board_from_equivalent.inverse() * point_in_board`.
    pub(super) board_from_equivalent: Transform,
    /// Accuracy; `None` for a pose that was given.
    pub(super) corners: Option<CornerStatistics>,
}

/// What the corners of one image say about the pose of the board.
#[derive(Clone, Debug)]
pub(super) struct CornerStatistics {
    /// Covariance of the pose for corners with an error of one pixel, in the parameters of [`geometry::residual`].
    pub(super) unit_covariance: Matrix6<f64>,
    /// Sum of squared residuals of the inliers, square pixels.
    pub(super) squares_px2: f64,
    /// Per corner.
    pub(super) is_inlier: Vec<bool>,
}

/// Candidates of all samples, and the indices of the samples without any.
pub(super) fn samples(
    input: &HandEyeInput<'_>,
    intrinsics: Option<&kinematics::Intrinsics>,
) -> (Vec<Sample>, Vec<usize>) {
    let (mut found, mut without) = (Vec::new(), Vec::new());
    for (sample_ix, sample) in input.samples.iter().enumerate() {
        let poses: Vec<Candidate> = match (&sample.board, intrinsics) {
            (BoardObservation::Pose(pose), _) => vec![Candidate {
                camera_from_board: *pose,
                board_from_equivalent: Transform::identity(),
                corners: None,
            }],
            (BoardObservation::View(view), Some(intrinsics)) => {
                likely(planar_pose::board_poses(view, intrinsics)).into_iter().filter_map(of_corners).collect()
            }
            (BoardObservation::View(_), None) => Vec::new(),
        };
        if poses.is_empty() {
            without.push(sample_ix);
            continue;
        }
        let mut candidates = Vec::new();
        for pose in &poses {
            candidates.push(pose.clone());
            candidates.extend(input.board_symmetries.iter().filter(|symmetry| !is_identity(symmetry)).map(
                |symmetry| {
                    let camera_from_board = pose.camera_from_board * symmetry;
                    Candidate { camera_from_board, board_from_equivalent: *symmetry, ..pose.clone() }
                },
            ));
        }
        let a = geometry::a_of(input.setup, &sample.base_from_flange);
        found.push(Sample { sample_ix, a, candidates });
    }
    (found, without)
}

fn is_identity(transform: &Transform) -> bool {
    const SAME: f64 = 1e-9;
    transform.rotation.angle() < SAME && transform.translation.vector.norm() < SAME
}

/// Removes the second solution if the corners exclude it.
fn likely(mut poses: Vec<BoardPose>) -> Vec<BoardPose> {
    /// Ratio of sums of squares; for a board of normal size, a wrong solution exceeds it by orders of magnitude.
    const MAX_RATIO: f64 = 4.0;
    const MIN_PX: f64 = 0.05; // Residuals of an exact simulation do not exclude anything.
    if let [best, second] = poses.as_slice() {
        let floor = best.is_inlier.len() as f64 * MIN_PX * MIN_PX;
        if second.squares_px2 > MAX_RATIO * (best.squares_px2 + floor) || 2 * second.n_inliers() < best.n_inliers() {
            poses.truncate(1);
        }
    }
    poses
}

fn of_corners(pose: BoardPose) -> Option<Candidate> {
    let unit_covariance = pose.information.try_inverse()?;
    Some(Candidate {
        camera_from_board: pose.camera_from_board,
        board_from_equivalent: Transform::identity(),
        corners: Some(CornerStatistics { unit_covariance, squares_px2: pose.squares_px2, is_inlier: pose.is_inlier }),
    })
}
