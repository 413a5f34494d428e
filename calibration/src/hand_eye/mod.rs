//! Hand-eye calibration with a target: pose of a camera on the flange or beside the robot.
//!
//! [`calibrate_hand_eye`] takes robot poses. A sample combines a robot pose with the pose of a
//! board in the camera, or with the corners of the board in the image. Closed-form solutions of
//! three samples each give an initial solution that most samples agree with. This solution is then
//! refined. With board poses, the refinement is a generalized least squares fit whose noise
//! variances are estimated by restricted maximum likelihood. With corners, the refinement minimizes
//! the reprojection error. Each robot pose may have a small unknown error. The result has an
//! uncertainty and the errors of held-out samples. Input that does not determine the result is
//! refused.

mod checks;
mod geometry;
mod plan;
mod report;
mod samples;
mod solve;
#[cfg(test)]
mod tests;

pub use crate::error::Refusal;
pub use checks::{HandEyeAdvice, HandEyeGuidance, RECOMMENDED_POSES, RotationExcitation};
pub use geometry::Scatter;
pub(crate) use geometry::nearest_rotation;
pub use plan::{
    ArmPlan, ArmPlanOptions, ArmStep, FirstView, MIN_POSES, NextPose, NextPoseOptions, Reach,
    suggest_next_poses,
};
pub use report::{HandEyeCalibration, JointOffset, SampleReport, SampleStatus};
pub use samples::{FlangeMotion, corners_at_mid_exposure};
pub use solve::{ClosedForm, HandEyeNoise, MAX_FOLDS};

use crate::{BoardView, Error};
use kinematics::{Chain, Intrinsics, Transform};
use nalgebra::DMatrix;

/// Where the camera and the board are mounted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Setup {
    /// The camera is on the flange, and the board is fixed to the base.
    EyeInHand,
    /// The camera is fixed to the base, and the board is on the flange.
    EyeToHand,
}

/// What the camera measured in one sample.
#[derive(Clone, Debug, PartialEq)]
pub enum BoardObservation {
    /// Pose of the board, `camera_from_board`.
    Pose(Transform),
    /// Corners in the image.
    View(BoardView),
}

/// One robot pose and what the camera measured there.
#[derive(Clone, Debug, PartialEq)]
pub struct HandEyeSample {
    /// File name or number, for messages.
    pub name: String,
    /// Pose that the robot reported.
    pub base_from_flange: Transform,
    /// The board in the camera.
    pub board: BoardObservation,
    /// Joint values in the order of the chain, radians or meters. They are needed only for
    /// estimating joint offsets.
    pub joints: Option<Vec<f64>>,
}

/// Input of [`calibrate_hand_eye`].
#[derive(Clone, Debug)]
pub struct HandEyeInput<'a> {
    /// Where the camera is mounted.
    pub setup: Setup,
    /// At least three samples, all with poses or all with corners.
    pub samples: Vec<HandEyeSample>,
    /// Lens parameters, which are needed for corners. If the lens is estimated, they are the
    /// initial values.
    pub intrinsics: Option<Intrinsics>,
    /// Covariance of the given intrinsics in the order of [`Intrinsics::params`]. It enlarges the
    /// covariance of the result. If it is `None`, the intrinsics are assumed to be exact. The
    /// covariance is not used if the intrinsics are estimated.
    pub intrinsics_covariance: Option<DMatrix<f64>>,
    /// Rotations `board_from_equivalent_board` after which the board looks the same. An example is
    /// a rotation by 180 degrees about the center of a chessboard whose two numbers of inner
    /// corners are both even or both odd. The list is empty if the orientation is unique.
    pub board_symmetries: &'a [Transform],
    /// The arm, for joint offsets.
    pub chain: Option<&'a Chain>,
    /// What to estimate, and when to refuse.
    pub options: HandEyeOptions,
}

/// Options of [`calibrate_hand_eye`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HandEyeOptions {
    /// Estimates the intrinsics together with the hand-eye transform. This needs corners.
    pub estimate_intrinsics: bool,
    /// Estimates offsets of the joints except the first and the last. This needs corners, joint
    /// values and a chain.
    pub estimate_joint_offsets: bool,
    /// Whether the second pose of each sample is the pose of a board that a camera sees. If so, the
    /// board must be in front of the camera.
    pub board_is_seen: bool,
    /// Maximum standard deviation of the position along any direction, meters. A less certain
    /// result is refused.
    pub max_sigma_m: f64,
    /// Maximum standard deviation of the rotation around any axis, radians. A less certain result
    /// is refused.
    pub max_sigma_rad: f64,
}

impl Default for HandEyeOptions {
    fn default() -> Self {
        Self {
            estimate_intrinsics: false,
            estimate_joint_offsets: false,
            board_is_seen: true,
            max_sigma_m: 0.005,
            max_sigma_rad: 0.5_f64.to_radians(),
        }
    }
}

/// Minimum number of samples.
pub const MIN_SAMPLES: usize = 3;

/// Estimates the pose of the camera on the flange (eye in hand) or in the base (eye to hand). Also
/// estimates the pose of the board.
///
/// # Errors
/// Returns [`Error::Refused`] if the samples do not determine the result or contain a mistake. The
/// message names the reason and the remedy. Returns [`Error::HandEyeInput`] if the input is
/// invalid.
///
/// ```
/// use calibration::hand_eye::{BoardObservation, HandEyeInput, HandEyeOptions, HandEyeSample, Setup, calibrate_hand_eye};
/// use kinematics::Transform;
/// use nalgebra::Vector3;
///
/// let flange_from_camera = Transform::new(Vector3::new(0.05, 0.0, 0.06), Vector3::new(0.0, 0.0, 1.5));
/// let base_from_board = Transform::new(Vector3::new(0.5, 0.1, 0.0), Vector3::new(3.0, 0.0, 0.0));
/// let samples = [[0.3, 0.0, 0.0], [0.0, 0.4, 0.0], [-0.2, 0.1, 0.5], [0.3, -0.4, 0.2]].map(|tilt| {
///     let base_from_flange = Transform::new(Vector3::new(0.4, 0.0, 0.5), Vector3::new(3.0, 0.0, 0.0) + Vector3::from(tilt));
///     let camera_from_board = (base_from_flange * flange_from_camera).inverse() * base_from_board;
///     let board = BoardObservation::Pose(camera_from_board);
///     HandEyeSample { name: format!("{tilt:?}"), base_from_flange, board, joints: None }
/// });
/// let calibration = calibrate_hand_eye(&HandEyeInput {
///     setup: Setup::EyeInHand,
///     samples: samples.into(),
///     intrinsics: None,
///     intrinsics_covariance: None,
///     board_symmetries: &[],
///     chain: None,
///     options: HandEyeOptions::default(),
/// })?;
/// let difference = flange_from_camera.inverse() * calibration.parent_from_camera;
/// assert!(difference.translation.vector.norm() < 1e-6);
/// # Ok::<(), calibration::Error>(())
/// ```
pub fn calibrate_hand_eye(input: &HandEyeInput<'_>) -> Result<HandEyeCalibration, Error> {
    let sorted = samples::prepare(input)?;
    let consensus = checks::find_consensus(input, &sorted)?;
    let refined = solve::refine(input, sorted.usable, &consensus)?;
    let calibration = report::report(input, &refined, &sorted.repeated)?;
    checks::check_result(input, &refined, &calibration)?;
    Ok(calibration)
}
