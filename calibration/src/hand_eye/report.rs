//! Result of a hand-eye calibration: transforms, uncertainty, and errors per sample.

use super::closed_form::ClosedForm;
use super::error_sources;
use super::evaluation::{self, Scatter};
use super::geometry;
use super::mistakes;
use super::pose_fit::{self, HandEyeNoise, Measurement};
use super::refine::{self, Refined};
use super::samples;
use super::selection;
use super::{HandEyeInput, Setup};
use crate::least_squares::sigma_of;
use crate::{BoardPoint, Error, PointFit};
use kinematics::{Intrinsics, Transform};
use nalgebra::Matrix6;

/// Result of [`super::calibrate_hand_eye`].
#[derive(Clone, Debug)]
pub struct HandEyeCalibration {
    /// Where the camera is mounted.
    pub setup: Setup,
    /// `flange_from_camera` (eye in hand) or `base_from_camera` (eye to hand).
    pub parent_from_camera: Transform,
    /// `base_from_board` (eye in hand) or `flange_from_board` (eye to hand).
    pub parent_from_board: Transform,
    /// Covariance of `parent_from_camera`: position in meters along the camera's x, y and z axes,
    /// then rotation in radians around them. The squared Mahalanobis distance of the error is below
    /// 12.59 with a probability of 95 %.
    pub covariance: Matrix6<f64>,
    /// Standard deviations of the position along the camera's axes, millimeters.
    pub sigma_mm: [f64; 3],
    /// Standard deviations of the rotation around the camera's axes, degrees.
    pub sigma_deg: [f64; 3],
    /// Scatter of the board over the used samples, with the result of all of them.
    pub scatter: Scatter,
    /// The same for held-out samples: each sample is evaluated with a calibration from others.
    /// Leave-one-out, or with more than [`MAX_FOLDS`](super::MAX_FOLDS) samples, cross-validation
    /// with as many folds.
    pub held_out_scatter: Option<Scatter>,
    /// RMS length of the reprojection error of the used corners, pixels. The robot poses are taken
    /// as exact.
    pub rms_px: Option<f64>,
    /// The same for held-out samples.
    pub held_out_rms_px: Option<f64>,
    /// Estimated measurement errors.
    pub noise: HandEyeNoise,
    /// Closed form that gave the initial solution: that with the smallest leave-one-out scatter.
    pub closed_form: ClosedForm,
    /// Intrinsics, if they were estimated, and their standard deviations in the order of
    /// [`Intrinsics::params`].
    pub intrinsics: Option<(Intrinsics, Vec<f64>)>,
    /// Offsets of the joints, if they were estimated, in the order of the chain.
    pub joint_offsets: Vec<JointOffset>,
    /// One entry per sample of the input.
    pub samples: Vec<SampleReport>,
    /// Problems that do not invalidate the result, one sentence each.
    pub warnings: Vec<String>,
    /// Everything that [`super::suggest_next_poses`] needs.
    pub(super) refined: Refined,
}

/// Offset of one joint: the joint is at the reported value plus the offset.
#[derive(Clone, Debug, PartialEq)]
pub struct JointOffset {
    /// Name of the joint.
    pub joint: String,
    /// Offset and its standard deviation, radians or meters. `None` if it is not observable.
    /// Offsets of the first and the last joint are equivalent to motions of the board and the
    /// camera.
    pub estimate: Option<[f64; 2]>,
}

/// Use of a sample.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SampleStatus {
    /// Used.
    Used,
    /// Excluded: it disagrees with the other samples.
    Outlier,
    /// The corners do not determine a pose of the board.
    NoBoard,
    /// Identical to an earlier sample, which counts once.
    Repeated,
}

/// Errors of one sample.
#[derive(Clone, Debug, PartialEq)]
pub struct SampleReport {
    /// Name of the sample.
    pub name: String,
    /// Use.
    pub status: SampleStatus,
    /// Distance between measured and predicted board origin, millimeters. `None` without a board
    /// pose.
    pub position_mm: Option<f64>,
    /// Angle between measured and predicted board, degrees.
    pub rotation_deg: Option<f64>,
    /// Deviation relative to the estimated noise: 1 is typical.
    pub normalized: Option<f64>,
    /// RMS reprojection error, pixels.
    pub rms_px: Option<f64>,
    /// Origin of the board according to this sample minus that of the result, millimeters along the
    /// axes of the base (eye in hand) or the flange (eye to hand).
    pub board_offset_mm: Option<[f64; 3]>,
    /// Corners without outliers, with their reprojection errors. Empty for given poses.
    pub points: Vec<PointFit>,
}

/// Largest standard deviation of a joint offset that counts as observable, radians or meters: 1
/// degree. A larger value would report offsets that the data hardly determine.
const MAX_JOINT_SIGMA: f64 = 0.0175;

/// Evaluates a refined solution.
pub(super) fn report(
    input: &HandEyeInput<'_>,
    refined: &Refined,
    without_board: &[usize],
    repeated: &[usize],
) -> Result<HandEyeCalibration, Error> {
    let measurements = refined.measurements();
    let boards = measurements
        .iter()
        .map(|m| refine::board_in_parent(&refined.solution, m));
    let internal = || Error::HandEyeInput {
        why: "the board poses have no mean rotation".to_owned(),
    };
    let scatter = evaluation::scatter(&boards.collect::<Vec<_>>()).ok_or_else(internal)?;
    let held_out = HeldOut::new(input, refined, &measurements);
    let covariance = position_first(&refined.covariance.fixed_view::<6, 6>(0, 0).into_owned());
    let sigma =
        |first: usize| [0, 1, 2].map(|axis| sigma_of(covariance[(first + axis, first + axis)]));
    let mut samples = sample_reports(input, refined);
    // Every sample has exactly one status.
    debug_assert_eq!(
        refined.samples.len() + without_board.len() + repeated.len(),
        samples.len()
    );
    for ix in repeated {
        samples[*ix].status = SampleStatus::Repeated;
    }
    let rms_all_px = rms_px(input, refined, |_| Some(refined.solution));
    let mut warnings = problems(input, refined, &samples);
    // Contradicting intrinsics are the more precise explanation.
    if refined.intrinsics_doubt.is_none() {
        warnings.extend(error_sources::warning(&refined.noise, scatter, rms_all_px));
    }
    Ok(HandEyeCalibration {
        setup: input.setup,
        parent_from_camera: refined.solution.x,
        parent_from_board: refined.solution.y,
        covariance,
        sigma_mm: sigma(0).map(|sigma_m| 1e3 * sigma_m),
        sigma_deg: sigma(3).map(f64::to_degrees),
        scatter,
        held_out_scatter: held_out.scatter,
        rms_px: rms_all_px,
        held_out_rms_px: held_out.rms_px,
        noise: refined.noise,
        closed_form: refined.closed_form,
        intrinsics: refined
            .intrinsics
            .clone()
            .filter(|_| input.options.estimate_intrinsics)
            .map(|intrinsics| (intrinsics, refined.intrinsics_sigma.clone())),
        joint_offsets: joint_offsets(input, refined),
        warnings,
        samples,
        refined: refined.clone(),
    })
}

/// A covariance with position before rotation.
fn position_first(covariance: &Matrix6<f64>) -> Matrix6<f64> {
    Matrix6::from_fn(|row, column| covariance[((row + 3) % 6, (column + 3) % 6)])
}

/// Errors of held-out samples.
struct HeldOut {
    scatter: Option<Scatter>,
    rms_px: Option<f64>,
}

impl HeldOut {
    fn new(input: &HandEyeInput<'_>, refined: &Refined, measurements: &[Measurement]) -> Self {
        // With corners, the weights were chosen by held-out errors.
        let knows_noise = refined.noise.corner_px.is_some();
        let folds = evaluation::held_out_solutions(
            input.setup,
            measurements,
            refined.solution,
            refined.weighting,
            knows_noise,
        );
        let boards: Option<Vec<Transform>> = folds
            .iter()
            .zip(measurements)
            .map(|(solution, m)| Some(refine::board_in_parent(solution.as_ref()?, m)))
            .collect();
        let scatter = boards
            .filter(|boards| !boards.is_empty())
            .and_then(|boards| evaluation::scatter(&boards));
        let rms_px = scatter.and_then(|_| rms_px(input, refined, |used_ix| folds[used_ix]));
        Self { scatter, rms_px }
    }
}

/// RMS reprojection error of the used samples, with one solution per used sample. `None` for given
/// poses.
fn rms_px(
    input: &HandEyeInput<'_>,
    refined: &Refined,
    solution: impl Fn(usize) -> Option<geometry::Solution>,
) -> Option<f64> {
    let intrinsics = refined.intrinsics.as_ref()?;
    let used = refined
        .samples
        .iter()
        .zip(&refined.choice)
        .zip(&refined.is_inlier)
        .filter(|(_, is_inlier)| **is_inlier);
    let mut squares = 0.0;
    let mut n = 0;
    for (used_ix, ((sample, choice), _)) in used.enumerate() {
        let points = selection::corners(input, sample, *choice);
        squares += evaluation::reprojection_squares(
            &refine::predicted(&solution(used_ix)?, sample),
            &points,
            intrinsics,
        );
        n += points.len();
    }
    (n > 0).then(|| (squares / n as f64).sqrt())
}

/// The errors of all samples, in the order of the input.
fn sample_reports(input: &HandEyeInput<'_>, refined: &Refined) -> Vec<SampleReport> {
    let mut reports: Vec<SampleReport> = input
        .samples
        .iter()
        .map(|sample| SampleReport {
            name: sample.name.clone(),
            status: SampleStatus::NoBoard,
            position_mm: None,
            rotation_deg: None,
            normalized: None,
            rms_px: None,
            board_offset_mm: None,
            points: Vec::new(),
        })
        .collect();
    for (ix, sample) in refined.samples.iter().enumerate() {
        let report = &mut reports[sample.sample_ix];
        let residual = refine::sample_residual(&refined.solution, sample, refined.choice[ix]);
        report.status = if refined.is_inlier[ix] {
            SampleStatus::Used
        } else {
            SampleStatus::Outlier
        };
        report.rotation_deg = Some(residual.fixed_rows::<3>(0).norm().to_degrees());
        report.position_mm = Some(1e3 * residual.fixed_rows::<3>(3).norm());
        // The squared distance has six degrees of freedom.
        report.normalized = Some((refined.squared_distances[ix] / 6.0).sqrt());
        let board =
            sample.a * refined.solution.x * sample.candidates[refined.choice[ix]].camera_from_board;
        report.board_offset_mm =
            Some(((board.translation.vector - refined.solution.y.translation.vector) * 1e3).into());
        let points = selection::corners(input, sample, refined.choice[ix]);
        let pose = refine::predicted(&refined.solution, sample);
        report.rms_px = refined
            .intrinsics
            .as_ref()
            .filter(|_| !points.is_empty())
            .map(|intrinsics| {
                (evaluation::reprojection_squares(&pose, &points, intrinsics) / points.len() as f64)
                    .sqrt()
            });
        if let Some(intrinsics) = &refined.intrinsics {
            report.points = point_fits(&pose, &points, intrinsics);
        }
    }
    reports
}

/// Reprojection errors of corners. Corners that cannot be projected are left out.
fn point_fits(
    camera_from_board: &Transform,
    points: &[BoardPoint],
    intrinsics: &Intrinsics,
) -> Vec<PointFit> {
    points
        .iter()
        .filter_map(|point| {
            let point_in_board = nalgebra::Point3::from(point.point_in_board);
            let [u, v] = intrinsics.project(&(camera_from_board * point_in_board).coords)?;
            Some(PointFit {
                pixel: point.pixel,
                residual_px: [point.pixel[0] - u, point.pixel[1] - v],
            })
        })
        .collect()
}

/// One entry per joint of the chain, if offsets were estimated.
fn joint_offsets(input: &HandEyeInput<'_>, refined: &Refined) -> Vec<JointOffset> {
    let Some(chain) = input.chain.filter(|_| input.options.estimate_joint_offsets) else {
        return Vec::new();
    };
    let last_ix = chain.n_joints().saturating_sub(1);
    let names = chain.joint_names().iter().enumerate();
    names
        .map(|(ix, joint)| {
            let inner = (ix > 0 && ix < last_ix)
                .then(|| refined.joint_offsets.get(ix - 1))
                .flatten();
            let estimate = inner
                .filter(|(_, sigma)| *sigma <= MAX_JOINT_SIGMA)
                .map(|(offset, sigma)| [*offset, *sigma]);
            JointOffset {
                joint: joint.clone(),
                estimate,
            }
        })
        .collect()
}

/// Names of the samples with a status.
fn named(reports: &[SampleReport], status: SampleStatus) -> Vec<&str> {
    reports
        .iter()
        .filter(|report| report.status == status)
        .map(|report| report.name.as_str())
        .collect()
}

/// Problems that do not invalidate the result: those of the lens, of single samples, and of their
/// number.
fn problems(input: &HandEyeInput<'_>, refined: &Refined, reports: &[SampleReport]) -> Vec<String> {
    let mut warnings: Vec<String> = refined.intrinsics_doubt.clone().into_iter().collect();
    let outliers = named(reports, SampleStatus::Outlier);
    if !outliers.is_empty() {
        warnings.push(format!(
            "{} samples disagree with the others and were not used: {}",
            outliers.len(),
            outliers.join(", ")
        ));
    }
    let without = named(reports, SampleStatus::NoBoard);
    if !without.is_empty() {
        warnings.push(format!(
            "{} images do not show enough corners for a pose: {}",
            without.len(),
            without.join(", ")
        ));
    }
    // A mirrored board in single samples is a detection with swapped corners; in most samples, it
    // is the way the board is described.
    let poses: Vec<(usize, Transform)> = refined
        .samples
        .iter()
        .zip(&refined.choice)
        .map(|(sample, choice)| {
            (
                sample.sample_ix,
                sample.candidates[*choice].camera_from_board,
            )
        })
        .collect();
    let mirrored = mistakes::mirrored(&input.samples, &poses);
    if !mirrored.is_empty() {
        warnings.push(format!(
            "{} samples show the board mirrored: {}",
            mirrored.len(),
            mirrored.join(", ")
        ));
    }
    let repeated = named(reports, SampleStatus::Repeated);
    if !repeated.is_empty() {
        let what = if repeated.len() == 1 {
            "sample is"
        } else {
            "samples are"
        };
        warnings.push(format!(
            "{} {what} identical to an earlier one and not used again: {}",
            repeated.len(),
            repeated.join(", ")
        ));
    }
    let n_used = refined
        .is_inlier
        .iter()
        .filter(|is_inlier| **is_inlier)
        .count();
    let n_stops = samples::n_stops(&refined.samples, &refined.is_inlier);
    if n_stops < n_used {
        warnings.push(format!(
            "{n_used} samples were taken at {n_stops} different robot poses: samples at the same pose share its error and count as one"
        ));
    }
    // Twelve unknowns: with three to five poses, one that is wrong hardly contradicts the others.
    if n_stops < 6 {
        warnings
            .push(format!("only {n_stops} robot poses were used: with fewer than 6, wrong samples may go unnoticed"));
    }
    warnings
}

/// Distance of a calibration from the truth in its own uncertainty: 95 % of the results stay below
/// 12.59.
#[cfg(test)]
pub(super) fn squared_error(calibration: &HandEyeCalibration, truth: &Transform) -> f64 {
    let difference = calibration.parent_from_camera.inverse() * truth;
    let rotation = difference.rotation.scaled_axis();
    let translation = difference.translation.vector;
    let error = nalgebra::Vector6::new(
        translation.x,
        translation.y,
        translation.z,
        rotation.x,
        rotation.y,
        rotation.z,
    );
    calibration
        .covariance
        .cholesky()
        .map_or(f64::INFINITY, |factor| error.dot(&factor.solve(&error)))
}

/// Covariance of a residual, for information gains.
pub(super) fn residual_information(
    setup: Setup,
    measurement: &Measurement,
    solution: &geometry::Solution,
    noise: &HandEyeNoise,
) -> Option<(geometry::Matrix6x12, Matrix6<f64>)> {
    let predicted = solution.camera_from_board(&measurement.a);
    // A future measurement is expected to have no residual.
    let jacobian = geometry::residual_jacobian(&predicted, &nalgebra::Vector6::zeros());
    let weight = pose_fit::covariance(setup, measurement, solution, noise)
        .cholesky()?
        .inverse();
    Some((jacobian, weight))
}
