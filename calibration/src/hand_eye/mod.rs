//! Hand-eye calibration with a target: pose of a camera on the flange or beside the robot.
//!
//! [`calibrate_hand_eye`] takes robot poses and, for each, the pose of a board in the camera or its
//! corners in the image. Closed-form solutions of sample triples give an initial solution that most
//! samples agree with. It is refined from board poses by generalized least squares, with noise
//! variances estimated by restricted maximum likelihood, or from corners by minimizing the
//! reprojection error, with a small unknown error of each robot pose. The result has an uncertainty
//! and the errors of held-out samples. Input that does not determine the result is refused.

mod arm_plan;
mod closed_form;
mod consensus;
mod corner_fit;
mod error_sources;
mod evaluation;
mod excitation;
mod geometry;
mod guidance;
mod intrinsics_doubt;
mod mistakes;
mod next_poses;
mod planar_pose;
mod pose_fit;
mod propagation;
mod reach;
mod refine;
mod refusal;
mod report;
mod samples;
#[cfg(test)]
pub(crate) mod scene;
mod selection;
mod shutter;
#[cfg(test)]
mod tests;

pub use arm_plan::{ArmPlan, ArmPlanOptions, ArmStep, FirstView, MIN_POSES};
pub use closed_form::ClosedForm;
pub(crate) use closed_form::nearest_rotation;
pub use evaluation::{MAX_FOLDS, Scatter};
pub use excitation::RotationExcitation;
pub use guidance::{HandEyeAdvice, HandEyeGuidance, RECOMMENDED_POSES};
pub use next_poses::{NextPose, NextPoseOptions, suggest_next_poses};
pub use pose_fit::HandEyeNoise;
pub use reach::Reach;
pub use refusal::Refusal;
pub use report::{HandEyeCalibration, JointOffset, SampleReport, SampleStatus};
pub use shutter::{FlangeMotion, corners_at_mid_exposure};

use crate::{BoardPoint, BoardView, Error};
use kinematics::{Chain, Intrinsics, Transform, transform};
use nalgebra::{DMatrix, SymmetricEigen};
use samples::Sorted;

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
    /// Joint values in the order of the chain, radians or meters. Needed for joint offsets only.
    pub joints: Option<Vec<f64>>,
}

/// Input of [`calibrate_hand_eye`].
#[derive(Clone, Debug)]
pub struct HandEyeInput<'a> {
    /// Where the camera is mounted.
    pub setup: Setup,
    /// At least three samples, all with poses or all with corners.
    pub samples: Vec<HandEyeSample>,
    /// Lens parameters. Needed for corners; initial values if they are estimated.
    pub intrinsics: Option<Intrinsics>,
    /// Covariance of the given intrinsics in the order of [`Intrinsics::params`], which enlarges
    /// that of the result. `None`: the intrinsics are taken as exact. Not used if they are
    /// estimated.
    pub intrinsics_covariance: Option<DMatrix<f64>>,
    /// Rotations of the board after which it looks the same, `board_from_equivalent_board`: for
    /// example a half turn about the center of a chessboard whose numbers of inner corners are both
    /// even or both odd. Empty if the orientation is unique.
    pub board_symmetries: &'a [Transform],
    /// The arm, for joint offsets.
    pub chain: Option<&'a Chain>,
    /// What to estimate, and when to refuse.
    pub options: HandEyeOptions,
}

/// Options of [`calibrate_hand_eye`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HandEyeOptions {
    /// Estimates the intrinsics together with the hand-eye transform. Needs corners.
    pub estimate_intrinsics: bool,
    /// Estimates offsets of the joints except the first and the last. Needs corners, joint values
    /// and a chain.
    pub estimate_joint_offsets: bool,
    /// Whether the second poses are those of a board that a camera sees, so that it must be in
    /// front of the camera.
    pub board_is_seen: bool,
    /// Refuses a result with a larger standard deviation of the position along any direction,
    /// meters.
    pub max_sigma_m: f64,
    /// Refuses a result with a larger standard deviation of the rotation around any axis, radians.
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

/// Estimates the pose of the camera on the flange (eye in hand) or in the base (eye to hand), and
/// that of the board.
///
/// # Errors
/// [`Error::Refused`] if the samples do not determine the result or contain a mistake: the message
/// names the reason and the remedy. [`Error::HandEyeInput`] if the input is invalid.
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
    check(input)?;
    let refused = |refusal| Error::Refused(Box::new(refusal));
    // Units first: all other checks compare meters.
    if let Err(refusal) = mistakes::check_magnitudes(&input.samples) {
        return Err(refused(mistakes::unit_mistake(input).unwrap_or(refusal)));
    }
    // Rotations about one axis do not determine the result, however good the images are.
    let robot_poses: Vec<Transform> = input
        .samples
        .iter()
        .map(|sample| sample.base_from_flange)
        .collect();
    excitation::check_rotations(&robot_poses, "flange").map_err(refused)?;

    // Samples without a board and repeated ones are reported, but not used: a repetition would
    // count as an independent measurement.
    let Sorted {
        usable: samples,
        without_board,
        repeated,
    } = samples::samples(input, input.intrinsics.as_ref());
    if samples.len() < MIN_SAMPLES {
        let different = if repeated.is_empty() {
            ""
        } else {
            "different "
        };
        let n = samples.len();
        return Err(refused(too_few(
            n,
            different,
            if n == 1 {
                "has a usable view of the board"
            } else {
                "have a usable view of the board"
            },
        )));
    }
    // Known mistakes are named before anything is estimated: outlier rejection would only report
    // that the samples disagree.
    let consensus = consensus::find(&samples);
    if let Some(refusal) = mistakes::explain(input, &samples, consensus.as_ref()) {
        return Err(refused(refusal));
    }
    let Some(consensus) = consensus else {
        return Err(refused(Refusal::new(
            "no hand-eye transform explains three of the samples",
            "check that each robot pose belongs to its image, and rotate the flange more between the poses",
        )));
    };
    let refined = refine::refine(input, samples, consensus)?;
    // Without the outliers, the remaining rotations may no longer suffice.
    let used: Vec<Transform> = refined
        .used()
        .map(|sample| input.samples[sample.sample_ix].base_from_flange)
        .collect();
    excitation::check_rotations(&used, "flange").map_err(refused)?;
    let calibration = report::report(input, &refined, &without_board, &repeated)?;
    excitation::check_uncertainty(
        &refined.covariance,
        &refined.solution,
        input.options.max_sigma_m,
        input.options.max_sigma_rad,
        input.setup == Setup::EyeInHand,
    )
    .map_err(|refusal| {
        // An uncertain result has a cause. Contradicting intrinsics are the most specific one, then
        // contradicting poses, then too little motion, which the refusal names.
        let doubt = refined.intrinsics_doubt.as_deref();
        if let Some(refusal) =
            mistakes::contradiction(&refined, calibration.scatter.mm).filter(|_| doubt.is_none())
        {
            return refused(refusal);
        }
        refused(with_doubt(
            refusal.with_warnings(&calibration.warnings, doubt),
            doubt,
        ))
    })?;
    Ok(calibration)
}

/// The refusal of an uncertain result. Wrong intrinsics are the more likely reason if the corners
/// contradict them.
fn with_doubt(refusal: Refusal, doubt: Option<&str>) -> Refusal {
    match doubt {
        Some(doubt) => Refusal {
            motion: format!("{doubt}; otherwise, {}", refusal.motion),
            ..refusal
        },
        None => refusal,
    }
}

fn too_few(n: usize, kind: &str, what: &str) -> Refusal {
    let samples = if n == 1 { "sample" } else { "samples" };
    Refusal::new(
        format!(
            "{n} {kind}{samples} {what}; at least {MIN_SAMPLES} are needed, and 12 or more are recommended"
        ),
        "add poses that rotate the flange by at least 20 degrees around different axes",
    )
}

/// An error for invalid input.
fn invalid(why: String) -> Result<(), Error> {
    Err(Error::HandEyeInput { why })
}

/// Rejects invalid values.
fn check(input: &HandEyeInput<'_>) -> Result<(), Error> {
    if input.samples.len() < MIN_SAMPLES {
        let n = input.samples.len();
        return Err(Error::Refused(Box::new(too_few(
            n,
            "",
            if n == 1 { "was given" } else { "were given" },
        ))));
    }
    let is_view = |sample: &HandEyeSample| matches!(sample.board, BoardObservation::View(_));
    let n_views = input
        .samples
        .iter()
        .filter(|sample| is_view(sample))
        .count();
    if n_views != 0 && n_views != input.samples.len() {
        return invalid(format!(
            "{n_views} of {} samples have corners; give corners or poses for all",
            input.samples.len()
        ));
    }
    for sample in &input.samples {
        check_sample(sample)?;
    }
    let options = &input.options;
    let needs_corners = options.estimate_intrinsics || options.estimate_joint_offsets;
    if needs_corners && n_views == 0 {
        return invalid(
            "intrinsics and joint offsets need corners, but the samples have board poses"
                .to_owned(),
        );
    }
    match &input.intrinsics {
        Some(intrinsics) => intrinsics.validate().map_err(|error| Error::HandEyeInput {
            why: error.to_string(),
        })?,
        None if n_views > 0 => {
            return invalid("the samples have corners, but the intrinsics are missing".to_owned());
        }
        None => (),
    }
    if let (Some(intrinsics), Some(covariance)) = (&input.intrinsics, &input.intrinsics_covariance)
    {
        check_covariance(covariance, intrinsics.params().len()).or_else(invalid)?;
    }
    if options.estimate_joint_offsets {
        let Some(chain) = input.chain else {
            return invalid("joint offsets need the chain of the arm (a URDF)".to_owned());
        };
        check_chain(&input.samples, chain)?;
    }
    Ok(())
}

/// Rejects values of a sample that are not finite, and matrices that are no rigid transforms.
fn check_sample(sample: &HandEyeSample) -> Result<(), Error> {
    let is_rigid = |pose: &Transform| {
        transform::is_finite(pose)
            && (pose.rotation.norm() - 1.0).abs() < transform::RIGID_TOLERANCE
    };
    if !is_rigid(&sample.base_from_flange) {
        return invalid(format!(
            "sample {:?}: base_from_flange is not a finite rigid transform",
            sample.name
        ));
    }
    match &sample.board {
        BoardObservation::Pose(pose) if !is_rigid(pose) => {
            return invalid(format!(
                "sample {:?}: camera_from_board is not a finite rigid transform",
                sample.name
            ));
        }
        BoardObservation::View(view) => {
            if let Some(ix) = view.points.iter().position(|point| !is_finite(point)) {
                return invalid(format!(
                    "sample {:?}: corner {ix} is not finite",
                    sample.name
                ));
            }
        }
        BoardObservation::Pose(_) => (),
    }
    Ok(())
}

/// Whether all coordinates of a corner are finite.
fn is_finite(point: &BoardPoint) -> bool {
    point
        .point_in_board
        .iter()
        .chain(&point.pixel)
        .all(|value| value.is_finite())
}

/// Rejects a chain with too few joints for offsets, and joint values that do not belong to it.
fn check_chain(samples: &[HandEyeSample], chain: &Chain) -> Result<(), Error> {
    // The offsets of the first and the last joint are not observable, so one must be left.
    const MIN_JOINTS: usize = 3;
    if chain.n_joints() < MIN_JOINTS {
        return invalid(format!(
            "joint offsets need at least {MIN_JOINTS} joints; the chain has {}",
            chain.n_joints()
        ));
    }
    for sample in samples {
        let joints = sample.joints.as_deref().unwrap_or_default();
        if let Err(error) = chain.forward(joints) {
            return invalid(format!("sample {:?}: {error}", sample.name));
        }
    }
    check_joints(samples, chain)
}

/// Rejects a matrix that is not a covariance of `n` parameters.
fn check_covariance(covariance: &DMatrix<f64>, n: usize) -> Result<(), String> {
    // Relative to the variances. Files with fewer than 6 digits are rejected.
    const ROUNDING: f64 = 1e-6;
    let [rows, columns] = [covariance.nrows(), covariance.ncols()];
    if [rows, columns] != [n, n] {
        return Err(format!(
            "the covariance of the intrinsics is {rows} x {columns}, but there are {n} parameters"
        ));
    }
    if covariance.iter().any(|value| !value.is_finite()) {
        return Err("the covariance of the intrinsics is not finite".to_owned());
    }
    // Focal lengths in pixels and distortion coefficients have variances of different magnitude.
    // In the correlation matrix, one tolerance fits all.
    let scales = covariance
        .diagonal()
        .map(|variance| variance.abs().max(f64::MIN_POSITIVE).sqrt());
    let correlation = DMatrix::from_fn(n, n, |row, column| {
        covariance[(row, column)] / (scales[row] * scales[column])
    });
    let is_symmetric = (&correlation - correlation.transpose()).amax() < ROUNDING;
    let is_positive = SymmetricEigen::new(correlation).eigenvalues.min() > -ROUNDING;
    if is_symmetric && is_positive && covariance.diagonal().min() >= 0.0 {
        Ok(())
    } else {
        Err(
            "the covariance of the intrinsics is not symmetric and positive; copy all its digits"
                .to_owned(),
        )
    }
}

/// Median angle by which the reported flange rotates against the tip of the chain, relative to the
/// first sample, radians. It is zero if the joint values, times `factor`, explain the motion.
fn median_tip_rotation_rad(samples: &[HandEyeSample], chain: &Chain, factor: f64) -> f64 {
    let tip_from_flange = |sample: &HandEyeSample| {
        let joints = sample.joints.iter().flatten();
        let joints: Vec<f64> = joints.map(|value| factor * value).collect();
        Some((chain.forward(&joints).ok()?.inverse() * sample.base_from_flange).rotation)
    };
    let rotations: Vec<_> = samples.iter().filter_map(tip_from_flange).collect();
    let angles: Vec<f64> = rotations
        .iter()
        .map(|rotation| rotation.angle_to(&rotations[0]))
        .collect();
    kinematics::quantile::median(&angles).unwrap_or(0.0)
}

/// Rejects joint values that do not explain the motion of the flange.
fn check_joints(samples: &[HandEyeSample], chain: &Chain) -> Result<(), Error> {
    /// Offsets of the joints move the flange less than this.
    const MAX_ROTATION_RAD: f64 = 0.1;
    let found = median_tip_rotation_rad(samples, chain, 1.0);
    if found < MAX_ROTATION_RAD {
        return Ok(());
    }
    let if_degrees = median_tip_rotation_rad(samples, chain, std::f64::consts::PI / 180.0);
    let hint = if if_degrees < MAX_ROTATION_RAD {
        "they are in degrees, and must be in radians"
    } else {
        "check the order of the joints and the link of the flange"
    };
    let degrees = found.to_degrees();
    Err(Error::HandEyeInput {
        why: format!(
            "the joints and base_from_flange disagree by {degrees:.0} degrees (median); {hint}"
        ),
    })
}
