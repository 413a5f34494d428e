//! Valid samples, with all poses of the board that their measurements allow.

mod planar_pose;
mod shutter;

pub(crate) use planar_pose::{board_poses, stepped};
pub use shutter::{FlangeMotion, corners_at_mid_exposure};

use super::{BoardObservation, HandEyeInput, HandEyeSample, MIN_SAMPLES, Refusal, geometry};
use crate::{BoardPoint, Error};
use kinematics::{Chain, Intrinsics, Transform, transform};
use nalgebra::{DMatrix, Matrix6, Point3, SymmetricEigen};
use planar_pose::BoardPose;

/// A sample that can be used.
#[derive(Clone, Debug)]
pub(crate) struct Sample {
    /// Index in the input.
    pub(crate) sample_ix: usize,
    /// Index of the stop of the robot. Samples at the same robot pose have the same stop, and share
    /// the error of that pose.
    pub(crate) stop_ix: usize,
    /// See [`geometry::Solution`].
    pub(crate) a: Transform,
    /// Poses of the board, the most likely first. The list is not empty.
    pub(crate) candidates: Vec<Candidate>,
    /// Index of the candidate that fits the solution.
    pub(crate) choice: usize,
    /// Whether the sample agrees with the solution. Samples that do not agree are outliers.
    pub(crate) is_used: bool,
    /// Squared Mahalanobis distance from the solution, six degrees of freedom.
    pub(crate) squared_distance: f64,
}

impl Sample {
    /// The candidate that fits the solution.
    pub(crate) fn chosen(&self) -> &Candidate {
        &self.candidates[self.choice]
    }

    /// Corners in the chosen board frame, without outliers. Empty for a given pose.
    pub(crate) fn corners(&self, input: &HandEyeInput<'_>) -> Vec<BoardPoint> {
        let chosen = self.chosen();
        let (BoardObservation::View(view), Some(corners)) =
            (&input.samples[self.sample_ix].board, &chosen.corners)
        else {
            return Vec::new();
        };
        // All samples must describe the same board, so corners are rotated to the chosen
        // orientation.
        let equivalent_from_board = chosen.board_from_equivalent.inverse();
        view.points
            .iter()
            .zip(&corners.is_inlier)
            .filter(|(_, is_inlier)| **is_inlier)
            .map(|(point, _)| BoardPoint {
                point_in_board: (equivalent_from_board * Point3::from(point.point_in_board)).coords,
                pixel: point.pixel,
            })
            .collect()
    }
}

/// The samples that agree with the solution.
pub(crate) fn used(samples: &[Sample]) -> impl Iterator<Item = &Sample> {
    samples.iter().filter(|sample| sample.is_used)
}

/// Number of different stops of the used samples.
pub(crate) fn n_stops(samples: &[Sample]) -> usize {
    used(samples)
        .map(|sample| sample.stop_ix)
        .collect::<std::collections::BTreeSet<_>>()
        .len()
}

/// One pose of the board that a measurement allows.
#[derive(Clone, Debug)]
pub(crate) struct Candidate {
    pub(crate) camera_from_board: Transform,
    /// Equivalent rotation of the board. The corners are at `board_from_equivalent.inverse() *
    /// point_in_board`.
    board_from_equivalent: Transform,
    /// Accuracy of the corners. `None` for a pose that was given.
    pub(crate) corners: Option<CornerStatistics>,
}

impl Candidate {
    fn new(camera_from_board: Transform, corners: Option<CornerStatistics>) -> Self {
        Self {
            camera_from_board,
            board_from_equivalent: Transform::identity(),
            corners,
        }
    }
}

/// Information of the corners of one image about the pose of the board.
#[derive(Clone, Debug)]
pub(crate) struct CornerStatistics {
    /// Covariance of the pose for corners with an error of one pixel, in the parameters of
    /// [`geometry::residual`].
    pub(crate) unit_covariance: Matrix6<f64>,
    /// Sum of squared residuals of the inliers, square pixels.
    pub(crate) squares_px2: f64,
    /// For each corner, whether its residual fits the residuals of the other corners.
    pub(crate) is_inlier: Vec<bool>,
}

impl CornerStatistics {
    pub(crate) fn n_inliers(&self) -> usize {
        let inliers = self.is_inlier.iter().filter(|is_inlier| **is_inlier);
        inliers.count()
    }
}

/// The samples of an input, by use.
pub(crate) struct Sorted {
    /// Samples with candidates.
    pub(crate) usable: Vec<Sample>,
    /// Indices of samples that are identical to an earlier sample. They contain no further
    /// information.
    pub(crate) repeated: Vec<usize>,
}

/// Candidates of all samples, except repeated samples.
///
/// # Errors
/// Fails if the input is invalid or has too few samples.
pub(crate) fn prepare(input: &HandEyeInput<'_>) -> Result<Sorted, Error> {
    check(input)?;
    Ok(sort(input, input.intrinsics.as_ref()))
}

/// Candidates of all samples of a valid input, except repeated samples.
pub(crate) fn sort(input: &HandEyeInput<'_>, intrinsics: Option<&Intrinsics>) -> Sorted {
    let mut sorted = Sorted {
        usable: Vec::new(),
        repeated: Vec::new(),
    };
    // Robot poses of the stops so far.
    let mut stops: Vec<Transform> = Vec::new();
    for (sample_ix, sample) in input.samples.iter().enumerate() {
        let mut earlier = input.samples[..sample_ix].iter();
        if earlier.any(|earlier| is_same(earlier, sample)) {
            sorted.repeated.push(sample_ix);
            continue;
        }
        let poses = measured_poses(&sample.board, intrinsics);
        if poses.is_empty() {
            continue;
        }
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
            a: geometry::a_of(input.setup, &sample.base_from_flange),
            candidates: with_symmetries(&poses, input.board_symmetries),
            choice: 0,
            is_used: true,
            squared_distance: 0.0,
        });
    }
    sorted
}

/// The poses of the board that one measurement allows, without its symmetries.
fn measured_poses(board: &BoardObservation, intrinsics: Option<&Intrinsics>) -> Vec<Candidate> {
    match (board, intrinsics) {
        (BoardObservation::Pose(pose), _) => vec![Candidate::new(*pose, None)],
        (BoardObservation::View(view), Some(intrinsics)) => likely(board_poses(view, intrinsics))
            .into_iter()
            .map(|pose| Candidate::new(pose.camera_from_board, Some(pose.corners)))
            .collect(),
        (BoardObservation::View(_), None) => Vec::new(),
    }
}

/// Every pose, followed by the poses of the equivalent rotations of the board.
fn with_symmetries(poses: &[Candidate], symmetries: &[Transform]) -> Vec<Candidate> {
    let mut candidates = Vec::new();
    for pose in poses {
        candidates.push(pose.clone());
        // Most lists of symmetries contain the identity, which would give the same candidate twice.
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
    // The limits are above the noise of encoders, and below any motion that adds information.
    const SAME_M: f64 = 5e-4;
    const SAME_RAD: f64 = 1e-3;
    let difference = a.inverse() * b;
    difference.translation.vector.norm() < SAME_M && difference.rotation.angle() < SAME_RAD
}

fn is_identity(transform: &Transform) -> bool {
    const SAME: f64 = 1e-9;
    transform.rotation.angle() < SAME && transform.translation.vector.norm() < SAME
}

/// Removes the second solution if the corners exclude it.
fn likely(mut poses: Vec<BoardPose>) -> Vec<BoardPose> {
    /// Ratio of sums of squares. For a board of normal size, the ratio of a wrong solution is
    /// larger by orders of magnitude.
    const MAX_RATIO: f64 = 4.0;
    // With this minimum, the tiny residuals of an exact simulation do not exclude a solution.
    const MIN_PX: f64 = 0.05;
    if let [best, second] = poses.as_slice() {
        let (best, second) = (&best.corners, &second.corners);
        let floor = best.is_inlier.len() as f64 * MIN_PX * MIN_PX;
        if second.squares_px2 > MAX_RATIO * (best.squares_px2 + floor)
            || 2 * second.n_inliers() < best.n_inliers()
        {
            poses.truncate(1);
        }
    }
    poses
}

/// An error for invalid input.
fn invalid(why: impl Into<String>) -> Error {
    Error::HandEyeInput { why: why.into() }
}

/// Returns an error for invalid input unless a condition is met.
fn require(is_met: bool, why: impl FnOnce() -> String) -> Result<(), Error> {
    if is_met { Ok(()) } else { Err(invalid(why())) }
}

/// The refusal of too few samples.
///
/// * `kind`: empty, or an adjective and a space.
/// * `what`: the property of these samples, as words for one sample and for several samples.
pub(crate) fn too_few(n: usize, kind: &str, [one, several]: [&str; 2]) -> Refusal {
    let (samples, what) = if n == 1 {
        ("sample", one)
    } else {
        ("samples", several)
    };
    Refusal::new(
        format!(
            "{n} {kind}{samples} {what}; at least {MIN_SAMPLES} are needed, and 12 or more are recommended"
        ),
        "add poses that rotate the flange by at least 20 degrees around different axes",
    )
}

/// Rejects invalid values.
fn check(input: &HandEyeInput<'_>) -> Result<(), Error> {
    let n = input.samples.len();
    if n < MIN_SAMPLES {
        return Err(too_few(n, "", ["was given", "were given"]).into());
    }
    let is_view = |sample: &&HandEyeSample| matches!(sample.board, BoardObservation::View(_));
    let n_views = input.samples.iter().filter(is_view).count();
    require(n_views == 0 || n_views == n, || {
        format!("{n_views} of {n} samples have corners; give corners or poses for all")
    })?;
    for sample in &input.samples {
        check_sample(sample)?;
    }
    let options = &input.options;
    let needs_corners = options.estimate_intrinsics || options.estimate_joint_offsets;
    require(!needs_corners || n_views > 0, || {
        "intrinsics and joint offsets need corners, but the samples have board poses".to_owned()
    })?;
    match &input.intrinsics {
        Some(intrinsics) => {
            let validity = intrinsics.validate();
            validity.map_err(|error| invalid(error.to_string()))?;
            if let Some(covariance) = &input.intrinsics_covariance {
                check_covariance(covariance, intrinsics.params().len())?;
            }
        }
        None => require(n_views == 0, || {
            "the samples have corners, but the intrinsics are missing".to_owned()
        })?,
    }
    match input.chain {
        _ if !options.estimate_joint_offsets => Ok(()),
        Some(chain) => check_chain(&input.samples, chain),
        None => Err(invalid("joint offsets need the chain of the arm (a URDF)")),
    }
}

/// Rejects values of a sample that are not finite, and matrices that are no rigid transforms.
fn check_sample(sample: &HandEyeSample) -> Result<(), Error> {
    let name = &sample.name;
    let check_pose = |pose: &Transform, what: &str| {
        let is_rigid = transform::is_finite(pose)
            && (pose.rotation.norm() - 1.0).abs() < transform::RIGID_TOLERANCE;
        require(is_rigid, || {
            format!("sample {name:?}: {what} is not a finite rigid transform")
        })
    };
    check_pose(&sample.base_from_flange, "base_from_flange")?;
    match &sample.board {
        BoardObservation::Pose(pose) => check_pose(pose, "camera_from_board"),
        BoardObservation::View(view) => {
            let infinite_ix = view.points.iter().position(|point| !is_finite(point));
            infinite_ix.map_or(Ok(()), |ix| {
                Err(invalid(format!(
                    "sample {name:?}: corner {ix} is not finite"
                )))
            })
        }
    }
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
    // The offsets of the first and the last joint are not observable, so at least one other joint
    // is needed.
    const MIN_JOINTS: usize = 3;
    let n_joints = chain.n_joints();
    require(n_joints >= MIN_JOINTS, || {
        format!("joint offsets need at least {MIN_JOINTS} joints; the chain has {n_joints}")
    })?;
    for sample in samples {
        let joints = sample.joints.as_deref().unwrap_or_default();
        chain
            .forward(joints)
            .map_err(|error| invalid(format!("sample {:?}: {error}", sample.name)))?;
    }
    check_joints(samples, chain)
}

/// Rejects a matrix that is not a covariance of `n` parameters.
fn check_covariance(covariance: &DMatrix<f64>, n: usize) -> Result<(), Error> {
    // Tolerance relative to the variances. Files with fewer than 6 digits are rejected.
    const ROUNDING: f64 = 1e-6;
    let (rows, columns) = covariance.shape();
    require((rows, columns) == (n, n), || {
        format!(
            "the covariance of the intrinsics is {rows} x {columns}, but there are {n} parameters"
        )
    })?;
    require(covariance.iter().all(|value| value.is_finite()), || {
        "the covariance of the intrinsics is not finite".to_owned()
    })?;
    // Focal lengths in pixels and distortion coefficients have variances of different magnitude. In
    // the correlation matrix, one tolerance is suitable for all of them.
    let scales = covariance
        .diagonal()
        .map(|variance| variance.abs().max(f64::MIN_POSITIVE).sqrt());
    let correlation = DMatrix::from_fn(n, n, |row, column| {
        covariance[(row, column)] / (scales[row] * scales[column])
    });
    let is_symmetric = (&correlation - correlation.transpose()).amax() < ROUNDING;
    let is_positive = SymmetricEigen::new(correlation).eigenvalues.min() > -ROUNDING;
    let is_covariance = is_symmetric && is_positive && covariance.diagonal().min() >= 0.0;
    require(is_covariance, || {
        "the covariance of the intrinsics is not symmetric and positive; copy all its digits"
            .to_owned()
    })
}

/// Median angle by which the reported flange rotates against the tip of the chain, relative to the
/// first sample, radians. It is zero if the joint values multiplied by `factor` explain the motion.
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
    numbers::quantile::median(&angles).unwrap_or(0.0)
}

/// Rejects joint values that do not explain the motion of the flange.
fn check_joints(samples: &[HandEyeSample], chain: &Chain) -> Result<(), Error> {
    /// Offsets of the joints rotate the flange by less than this.
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
    Err(invalid(format!(
        "the joints and base_from_flange disagree by {degrees:.0} degrees (median); {hint}"
    )))
}
