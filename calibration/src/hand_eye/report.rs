//! Result of a hand-eye calibration: transforms, uncertainty, and errors per sample.

use super::geometry::{self, Scatter, Solution};
use super::samples::{self, Sample, used};
use super::solve::{self, HandEyeNoise, Refined};
use super::{HandEyeInput, Setup};
use crate::intrinsics::point_fits;
use crate::least_squares::sigma_of;
use crate::{Error, PointFit};
use kinematics::{Intrinsics, Transform};
use nalgebra::{Matrix6, Vector3};

/// Result of [`super::calibrate_hand_eye`].
#[derive(Clone, Debug)]
pub struct HandEyeCalibration {
    /// Where the camera is mounted.
    pub setup: Setup,
    /// `flange_from_camera` (eye in hand) or `base_from_camera` (eye to hand).
    pub parent_from_camera: Transform,
    /// `base_from_board` (eye in hand) or `flange_from_board` (eye to hand).
    pub parent_from_board: Transform,
    /// Covariance of `parent_from_camera`. The parameters are the position in meters along the
    /// camera's x, y and z axes, then the rotation in radians around them. The squared Mahalanobis
    /// distance of the error is below
    /// 12.59 with a probability of 95 %.
    pub covariance: Matrix6<f64>,
    /// Standard deviations of the position along the camera's axes, millimeters.
    pub sigma_mm: [f64; 3],
    /// Standard deviations of the rotation around the camera's axes, degrees.
    pub sigma_deg: [f64; 3],
    /// Scatter of the board over the used samples. It is computed with the result that was
    /// estimated from all used samples.
    pub scatter: Scatter,
    /// Scatter of the board over held-out samples. Each sample is evaluated with a calibration from
    /// other samples. One sample is left out at a time. With more than
    /// [`MAX_FOLDS`](super::MAX_FOLDS) samples, cross-validation with that number of folds is used.
    pub held_out_scatter: Option<Scatter>,
    /// RMS length of the reprojection error of the used corners, pixels. The robot poses are taken
    /// as exact.
    pub rms_px: Option<f64>,
    /// RMS length of the reprojection error of held-out samples, pixels.
    pub held_out_rms_px: Option<f64>,
    /// Estimated measurement errors.
    pub noise: HandEyeNoise,
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

/// Offset of one joint. The joint is at the reported value plus the offset.
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
    /// The sample was excluded because it disagrees with the other samples.
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
    /// Deviation relative to the estimated noise. A value of 1 is typical.
    pub normalized: Option<f64>,
    /// RMS reprojection error, pixels.
    pub rms_px: Option<f64>,
    /// Origin of the board according to this sample minus the origin according to the result,
    /// millimeters. It is along the axes of the base (eye in hand) or the flange (eye to hand).
    pub board_offset_mm: Option<[f64; 3]>,
    /// Corners without outliers, with their reprojection errors. Empty for given poses.
    pub points: Vec<PointFit>,
}

/// A joint offset counts as observable up to this standard deviation, radians or meters. For a
/// rotation, it is 1 degree. With a larger value, offsets that the data hardly determine would be
/// reported.
const MAX_JOINT_SIGMA: f64 = 0.0175;

/// Evaluates a refined solution.
///
/// * `repeated`: indices of the samples that are identical to an earlier sample. They are not used.
pub(super) fn report(
    input: &HandEyeInput<'_>,
    refined: &Refined,
    repeated: &[usize],
) -> Result<HandEyeCalibration, Error> {
    let boards: Vec<Transform> = used(&refined.samples)
        .map(|sample| {
            let solution = &refined.solution;
            solution.board(&sample.a, &sample.chosen().camera_from_board)
        })
        .collect();
    let scatter = geometry::scatter(&boards).ok_or_else(|| Error::HandEyeInput {
        why: "the board poses have no mean rotation".to_owned(),
    })?;
    let (held_out_scatter, held_out_rms_px) = held_out_errors(input, refined);
    let covariance = position_first(&refined.covariance.fixed_view::<6, 6>(0, 0).into_owned());
    let sigma =
        |first: usize| [0, 1, 2].map(|axis| sigma_of(covariance[(first + axis, first + axis)]));
    let mut samples = sample_reports(input, refined);
    for ix in repeated {
        samples[*ix].status = SampleStatus::Repeated;
    }
    let rms_px = rms_px(input, refined, |_| Some(refined.solution));
    let mut warnings = problems(input, refined, &samples);
    // If the intrinsics contradict the corners, the warning about the intrinsics is the more
    // precise explanation.
    if refined.intrinsics_doubt.is_none() {
        warnings.extend(large_errors(&refined.noise, scatter, rms_px));
    }
    let estimated = refined.intrinsics.clone();
    Ok(HandEyeCalibration {
        setup: input.setup,
        parent_from_camera: refined.solution.x,
        parent_from_board: refined.solution.y,
        covariance,
        sigma_mm: sigma(0).map(|sigma_m| 1e3 * sigma_m),
        sigma_deg: sigma(3).map(f64::to_degrees),
        scatter,
        held_out_scatter,
        rms_px,
        held_out_rms_px,
        noise: refined.noise,
        intrinsics: estimated
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

/// Scatter and RMS reprojection error of held-out samples.
fn held_out_errors(input: &HandEyeInput<'_>, refined: &Refined) -> (Option<Scatter>, Option<f64>) {
    let measurements = solve::measurements(&refined.samples);
    // With corners, the weights were selected by their errors on held-out samples.
    let knows_noise = refined.noise.corner_px.is_some();
    let folds = solve::held_out_solutions(
        input.setup,
        &measurements,
        refined.solution,
        refined.weighting,
        knows_noise,
    );
    let boards: Option<Vec<Transform>> = folds
        .iter()
        .zip(&measurements)
        .map(|(solution, m)| Some(solution.as_ref()?.board(&m.a, &m.camera_from_board)))
        .collect();
    let scatter = boards
        .filter(|boards| !boards.is_empty())
        .and_then(|boards| geometry::scatter(&boards));
    let rms_px = scatter.and_then(|_| rms_px(input, refined, |used_ix| folds[used_ix]));
    (scatter, rms_px)
}

/// RMS reprojection error of the used samples, with one solution per used sample. `None` for given
/// poses.
fn rms_px(
    input: &HandEyeInput<'_>,
    refined: &Refined,
    solution: impl Fn(usize) -> Option<Solution>,
) -> Option<f64> {
    let intrinsics = refined.intrinsics.as_ref()?;
    let mut squares = 0.0;
    let mut n = 0;
    for (used_ix, sample) in used(&refined.samples).enumerate() {
        let points = sample.corners(input);
        let predicted = solution(used_ix)?.camera_from_board(&sample.a);
        squares += geometry::reprojection_squares(&predicted, &points, intrinsics);
        n += points.len();
    }
    (n > 0).then(|| (squares / n as f64).sqrt())
}

/// The errors of all samples, in the order of the input.
fn sample_reports(input: &HandEyeInput<'_>, refined: &Refined) -> Vec<SampleReport> {
    let given = input.samples.iter();
    let mut reports: Vec<SampleReport> = given
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
    let solution = &refined.solution;
    for sample in &refined.samples {
        let report = &mut reports[sample.sample_ix];
        let predicted = solution.camera_from_board(&sample.a);
        let measured = &sample.chosen().camera_from_board;
        let residual = geometry::residual(&predicted, measured);
        report.status = if sample.is_used {
            SampleStatus::Used
        } else {
            SampleStatus::Outlier
        };
        report.rotation_deg = Some(residual.fixed_rows::<3>(0).norm().to_degrees());
        report.position_mm = Some(1e3 * residual.fixed_rows::<3>(3).norm());
        // The squared distance has six degrees of freedom.
        report.normalized = Some((sample.squared_distance / 6.0).sqrt());
        let board = solution.board(&sample.a, measured);
        let offset_m = board.translation.vector - solution.y.translation.vector;
        report.board_offset_mm = Some((offset_m * 1e3).into());
        if let Some(intrinsics) = &refined.intrinsics {
            let points = sample.corners(input);
            let squares = geometry::reprojection_squares(&predicted, &points, intrinsics);
            report.rms_px = (!points.is_empty()).then(|| (squares / points.len() as f64).sqrt());
            report.points = point_fits(intrinsics, &predicted, &points);
        }
    }
    reports
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
fn with_status(reports: &[SampleReport], status: SampleStatus) -> Vec<&str> {
    let reports = reports.iter().filter(|report| report.status == status);
    reports.map(|report| report.name.as_str()).collect()
}

/// Problems that do not invalidate the result. They concern the lens, single samples, and the
/// number of samples.
fn problems(input: &HandEyeInput<'_>, refined: &Refined, reports: &[SampleReport]) -> Vec<String> {
    let mut warnings: Vec<String> = refined.intrinsics_doubt.clone().into_iter().collect();
    let repeated = with_status(reports, SampleStatus::Repeated);
    let are = if repeated.len() == 1 {
        "sample is"
    } else {
        "samples are"
    };
    let repeat = format!("{are} identical to an earlier one and not used");
    for (names, problem) in [
        (
            with_status(reports, SampleStatus::Outlier),
            "samples disagree with the others and were not used",
        ),
        (
            with_status(reports, SampleStatus::NoBoard),
            "images do not show enough corners for a pose",
        ),
        (mirrored(input, refined), "samples show the board mirrored"),
        (repeated, repeat.as_str()),
    ] {
        if !names.is_empty() {
            warnings.push(format!("{} {problem}: {}", names.len(), names.join(", ")));
        }
    }
    let n_used = used(&refined.samples).count();
    let n_stops = samples::n_stops(&refined.samples);
    if n_stops < n_used {
        warnings.push(format!(
            "{n_used} samples were taken at {n_stops} different robot poses: samples at the same pose share its error and count as one"
        ));
    }
    // There are twelve unknowns. With three to five poses, a wrong pose hardly contradicts the
    // other poses.
    if n_stops < 6 {
        warnings
            .push(format!("only {n_stops} robot poses were used: with fewer than 6, wrong samples may go unnoticed"));
    }
    warnings
}

/// Names of the samples that show the other side of the board than most samples. The corners of
/// these samples are mirrored. If only a few samples are mirrored, the detection has swapped
/// corners. If most samples show the back of the board, the points of the board are defined that
/// way.
fn mirrored<'a>(input: &'a HandEyeInput<'_>, refined: &Refined) -> Vec<&'a str> {
    // The board's z axis points away from a viewer of the printed side.
    let is_front = |sample: &Sample| {
        let pose = &sample.chosen().camera_from_board;
        (pose.rotation * Vector3::z()).dot(&pose.translation.vector) > 0.0
    };
    let samples = &refined.samples;
    let n_front = samples.iter().filter(|sample| is_front(sample)).count();
    let majority = 2 * n_front >= samples.len();
    samples
        .iter()
        .filter(|sample| is_front(sample) != majority)
        .map(|sample| input.samples[sample.sample_ix].name.as_str())
        .collect()
}

/// The errors of industrial arms, boards and calibrated cameras are below these limits. Lower
/// limits would cause warnings for inexpensive arms, whose larger errors are not mistakes.
const MAX_RMS_PX: f64 = 3.0;
const MAX_SCATTER: Scatter = Scatter { mm: 5.0, deg: 0.5 };
/// Maximum residual of sharp corners after a separate fit of each image, pixels. With a correct
/// lens, the residual is at most a few tenths of a pixel.
const MAX_RESIDUAL_PX: f64 = 0.7;

/// A sentence on the likely cause, if the errors are larger than the errors of usual arms and
/// cameras.
///
/// If each single image fits the board, the lens and the board are right. In that case, the robot
/// poses do not belong to the images.
fn large_errors(noise: &HandEyeNoise, scatter: Scatter, rms_px: Option<f64>) -> Option<String> {
    let has_large_error = rms_px.is_some_and(|rms_px| rms_px > MAX_RMS_PX)
        || scatter.mm > MAX_SCATTER.mm
        || scatter.deg > MAX_SCATTER.deg;
    has_large_error.then_some(())?;
    let reprojection = rms_px.map_or_else(String::new, |rms_px| format!("{rms_px:.1} px, "));
    let errors = format!(
        "the errors are large ({reprojection}{:.1} mm and {:.2} degrees; errors are usually at most {MAX_RMS_PX} px, {} mm and {} degrees)",
        scatter.mm, scatter.deg, MAX_SCATTER.mm, MAX_SCATTER.deg
    );
    // The checks cover everything between a robot pose and its image. The most common mistakes come
    // first.
    let robot = "check that the arm stood still in each image, that each pose belongs to its image (time offset), that the flange or tool frame is the same in all poses, and that the target and the camera did not move";
    Some(match noise.residual_px {
        Some(residual_px) if residual_px > MAX_RESIDUAL_PX => format!(
            "{errors}; even single images differ from the board by {residual_px:.1} px, so the lens or the target is wrong: calibrate the intrinsics, and check that the target is flat and has the given size"
        ),
        Some(residual_px) => format!(
            "{errors}, but single images fit the board within {residual_px:.1} px, so lens and target are right and the robot poses do not match the images: {robot}"
        ),
        None => format!("{errors}; {robot}, and that the intrinsics of the board poses are right"),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cause_of_large_errors_is_named() {
        let noise = |residual_px| HandEyeNoise {
            corner_px: residual_px,
            residual_px,
            rotation_rad: 1e-3,
            translation_m: 1e-3,
        };
        let (small, large) = (Scatter { mm: 1.0, deg: 0.1 }, Scatter { mm: 4.0, deg: 0.8 });
        assert_eq!(large_errors(&noise(Some(0.2)), small, Some(1.0)), None);
        let robot = large_errors(&noise(Some(0.2)), large, Some(9.0)).unwrap();
        assert!(
            robot.contains("9.0 px, 4.0 mm and 0.80 degrees")
                && robot.contains("robot poses do not match"),
            "{robot}"
        );
        let lens = large_errors(&noise(Some(2.0)), small, Some(9.0)).unwrap();
        assert!(lens.contains("the lens or the target is wrong"), "{lens}");
        let poses = large_errors(&noise(None), large, None).unwrap();
        assert!(
            poses.contains("(4.0 mm") && poses.contains("time offset"),
            "{poses}"
        );
    }
}
