//! Checks the samples and the result. Reports common mistakes in the input (wrong units, inverted
//! transforms, mirrored boards, lists that are off by one), contradictions, and directions that are
//! not observable.

mod rotations;

pub(crate) use rotations::axis_name;
pub use rotations::{HandEyeAdvice, HandEyeGuidance, RECOMMENDED_POSES, RotationExcitation};

use super::geometry;
use super::report::HandEyeCalibration;
use super::samples::{self, Sample, Sorted, used};
use super::solve::{self, ClosedForm, Consensus, Refined, consensus};
use super::{BoardObservation, HandEyeInput, HandEyeSample, MIN_SAMPLES, Refusal, Setup};
use crate::Error;
use crate::least_squares::sigma_of;
use kinematics::Transform;
use nalgebra::{DMatrix, SymmetricEigen, Vector3};

/// Finds an initial solution, and reports mistakes in the samples.
///
/// # Errors
/// Returns [`Error::Refused`] if the samples contain a known mistake, do not determine the result,
/// or disagree.
pub(crate) fn find_consensus(
    input: &HandEyeInput<'_>,
    sorted: &Sorted,
) -> Result<Consensus, Error> {
    let samples = &sorted.usable;
    // Units are checked first, because all other checks compare meters.
    if let Err(refusal) = check_magnitudes(&input.samples) {
        let mistake = scale_mistake(samples, consensus(samples).as_ref());
        return Err(mistake
            .map_or(refusal, |(why, remedy)| Refusal::new(why, remedy))
            .into());
    }
    // Rotations about one axis do not determine the result, however good the images are.
    let given = input.samples.iter().map(|sample| sample.base_from_flange);
    rotations::check_rotations(&given.collect::<Vec<_>>())?;
    // Samples without a board and repeated samples are reported but not used. A repeated sample
    // would count as an independent measurement.
    if samples.len() < MIN_SAMPLES {
        let kind = if sorted.repeated.is_empty() {
            ""
        } else {
            "different "
        };
        let what = [
            "has a usable view of the board",
            "have a usable view of the board",
        ];
        return Err(samples::too_few(samples.len(), kind, what).into());
    }
    // Known mistakes are reported before anything is estimated, because outlier rejection would
    // only report that the samples disagree.
    let found = consensus(samples);
    if let Some(refusal) = explain(input, samples, found.as_ref()) {
        return Err(refusal.into());
    }
    found.ok_or_else(|| {
        Refusal::new(
            NO_SOLUTION,
            "check that each robot pose belongs to its image, and rotate the flange more between the poses",
        )
        .into()
    })
}

/// Checks that the samples that were used determine the result.
///
/// # Errors
/// Returns [`Error::Refused`] with the likely cause of a result that is too uncertain.
pub(crate) fn check_result(
    input: &HandEyeInput<'_>,
    refined: &Refined,
    calibration: &HandEyeCalibration,
) -> Result<(), Error> {
    // Without the outliers, the remaining rotations may no longer suffice.
    let poses =
        used(&refined.samples).map(|sample| input.samples[sample.sample_ix].base_from_flange);
    rotations::check_rotations(&poses.collect::<Vec<_>>())?;
    let Err(refusal) = check_uncertainty(input, refined) else {
        return Ok(());
    };
    // The refusal names the cause of an uncertain result. The most specific cause is tested first:
    // contradicting intrinsics, then contradicting poses, then too little motion.
    let Some(doubt) = refined.intrinsics_doubt.as_deref() else {
        let contradiction = contradiction(refined, calibration.scatter.mm);
        let uncertain = || refusal.with_warnings(&calibration.warnings, None);
        return Err(contradiction.unwrap_or_else(uncertain).into());
    };
    let refusal = refusal.with_warnings(&calibration.warnings, Some(doubt));
    Err(Refusal {
        motion: format!("{doubt}; otherwise, {}", refusal.motion),
        ..refusal
    }
    .into())
}

const NO_SOLUTION: &str = "no hand-eye transform explains three of the samples";

/// In meters, positions of a robot and distances of a board are below this limit. In millimeters,
/// all lengths above 2 cm exceed the limit.
const MAX_POSITION_M: f64 = 20.0;

/// A variant of the input explains the disagreement if it fits better by this factor. With a
/// smaller factor, good input would be rejected if a variant fits slightly better by chance.
const MUCH_BETTER: f64 = 5.0;

/// Checks that the positions can be meters.
///
/// # Errors
/// Fails if most of the positions are too large.
fn check_magnitudes(samples: &[HandEyeSample]) -> Result<(), Refusal> {
    let robot: Vec<f64> = samples
        .iter()
        .map(|sample| sample.base_from_flange.translation.vector.norm())
        .collect();
    let board: Vec<f64> = samples
        .iter()
        .filter_map(|sample| match &sample.board {
            BoardObservation::Pose(pose) => Some(pose.translation.vector.norm()),
            BoardObservation::View(view) => view
                .points
                .iter()
                .map(|point| point.point_in_board.norm())
                .reduce(f64::max),
        })
        .collect();
    // The median is used, because single positions may be wrong for other reasons.
    for (name, values) in [("base_from_flange", robot), ("the board", board)] {
        let median = numbers::quantile::median(&values).unwrap_or(0.0);
        if median > MAX_POSITION_M {
            return Err(Refusal::new(
                format!(
                    "the median norm of the positions of {name} is {median:.1} m, expected at most {MAX_POSITION_M} m; they are probably in millimeters"
                ),
                format!("divide the positions of {name} by 1000"),
            ));
        }
    }
    Ok(())
}

/// A calibrated camera predicts the board within this fraction of its distance.
const GOOD_FRAC: f64 = 0.02;

/// The mistake that explains why the samples disagree. `None` if they agree or no known mistake
/// explains it.
fn explain(
    input: &HandEyeInput<'_>,
    samples: &[Sample],
    found: Option<&Consensus>,
) -> Option<Refusal> {
    let distance_m = geometry::median_distance_m(samples.iter().map(likely_board))?;
    let found_m = found.map_or(f64::INFINITY, Consensus::median_m);
    let residual = if found_m.is_finite() {
        format!(
            "the samples disagree by {:.0} mm (median, board at {:.0} mm)",
            1e3 * found_m,
            1e3 * distance_m
        )
    } else {
        NO_SOLUTION.to_owned()
    };
    // A shift between the lists is tested first, because with shifted lists, all other tests would
    // compare wrong pairs.
    if let Some(refusal) = shift_mistake(input, samples, found_m, distance_m) {
        return Some(refusal);
    }
    // Wrong scales are tested even if the samples agree roughly. With a scale near 1, for example
    // because the board has another size, the samples still agree roughly.
    if let Some((why, remedy)) = scale_mistake(samples, found) {
        return Some(Refusal::new(format!("{residual}, and {why}"), remedy));
    }
    let has_poses = !has_images(samples);
    if found_m <= GOOD_FRAC * distance_m {
        let is_tested = input.options.board_is_seen && has_poses;
        return is_tested.then(|| behind_mistake(samples)).flatten();
    }
    inversion_mistake(input, samples, has_poses, [found_m, distance_m], &residual)
}

/// The most likely pose of the board.
fn likely_board(sample: &Sample) -> &Transform {
    &sample.candidates[0].camera_from_board
}

/// Whether the board poses were computed from corners. An input contains either corners or board
/// poses.
fn has_images(samples: &[Sample]) -> bool {
    samples
        .iter()
        .any(|sample| sample.candidates[0].corners.is_some())
}

/// Explanation of samples that agree on a board behind the camera. There are two possible causes.
/// The camera axes may be different, or both poses of each sample may be inverted. In the second
/// case, the samples agree on the inverse of another transform.
fn behind_mistake(samples: &[Sample]) -> Option<Refusal> {
    let is_behind = |sample: &&Sample| likely_board(sample).translation.z <= 0.0;
    let n_behind = samples.iter().filter(is_behind).count();
    // It is sufficient that most boards are behind the camera, because a few samples may be wrong
    // in another way.
    (5 * n_behind > 4 * samples.len()).then(|| {
        Refusal::new(
            format!(
                "the board is behind the camera in {n_behind} of {} samples: either the camera has the axes of OpenGL (y up, z backward), expected x right, y down, z forward; or the given matrices are board_from_camera",
                samples.len()
            ),
            "negate the second and third row of camera_from_board in the first case; in the second, invert the board poses, and check that the robot poses are base_from_flange",
        )
    })
}

/// Explains the disagreement by inverted robot or board poses, if the samples agree after inverting
/// the robot poses.
///
/// * `[found_m, distance_m]`: median error of the samples without inversion, and the distance of
///   the board.
/// * `residual`: the disagreement, as text.
fn inversion_mistake(
    input: &HandEyeInput<'_>,
    samples: &[Sample],
    has_poses: bool,
    [found_m, distance_m]: [f64; 2],
    residual: &str,
) -> Option<Refusal> {
    // Inverting either transform swaps the unknowns, so the data do not determine which one was
    // inverted.
    let variant: Vec<Sample> = samples
        .iter()
        .map(|sample| Sample {
            a: sample.a.inverse(),
            ..sample.clone()
        })
        .collect();
    let variant_m = consensus(&variant)?.median_m();
    if variant_m * MUCH_BETTER > found_m.min(distance_m) || variant_m > 2.0 * GOOD_FRAC * distance_m
    {
        return None;
    }
    let fits = format!("{residual}; they agree within {:.1} mm if", 1e3 * variant_m);
    let other = match input.setup {
        Setup::EyeInHand => "eye to hand",
        Setup::EyeToHand => "eye in hand",
    };
    let robot = format!(
        "base_from_flange is inverted: the given matrices are flange_from_base, or the setup is {other}"
    );
    let robot_remedy = format!("invert the robot poses, or choose the setup {other}");
    let board = "camera_from_board is inverted: the given matrices are board_from_camera";
    // Only boards in front of the camera are visible. Poses that fieldrig computed from corners
    // cannot be inverted.
    let is_in_front = |sample: &Sample| likely_board(sample).translation.z > 0.0;
    let inverse_is_in_front = |sample: &Sample| likely_board(sample).inverse().translation.z > 0.0;
    let may_be_robot = !has_poses || samples.iter().all(is_in_front);
    let may_be_board = has_poses && samples.iter().all(inverse_is_in_front);
    Some(if !may_be_robot {
        Refusal::new(format!("{fits} {board}"), "invert the board poses")
    } else if may_be_board {
        Refusal::new(
            format!("{fits} {robot}; or if {board}"),
            format!("{robot_remedy}, or invert the board poses"),
        )
    } else {
        Refusal::new(format!("{fits} {robot}"), robot_remedy)
    })
}

/// The refusal of samples that contradict each other. More samples would not help. `scatter_mm` is
/// the scatter of the board.
fn contradiction(refined: &Refined, scatter_mm: f64) -> Option<Refusal> {
    /// Scatter of the board relative to its distance. Detections and robots are far more accurate.
    const MAX_FRAC: f64 = 0.05;
    let boards = used(&refined.samples).map(|sample| &sample.chosen().camera_from_board);
    let distance_m = geometry::median_distance_m(boards)?;
    (scatter_mm > 1e3 * MAX_FRAC * distance_m).then(|| {
        Refusal::new(
            format!(
                "the robot poses and the board poses contradict each other: the board scatters by {scatter_mm:.0} mm (RMS, board at {:.0} mm)",
                1e3 * distance_m
            ),
            "check that each robot pose belongs to its image or board pose (the order of both lists), and that neither board nor camera was moved",
        )
    })
}

/// Explains the disagreement by a shift of one entry between the lists of robot poses and images.
/// This is the case if pairing each image with the robot pose of the next or the previous sample
/// makes the samples agree.
fn shift_mistake(
    input: &HandEyeInput<'_>,
    samples: &[Sample],
    found_m: f64,
    distance_m: f64,
) -> Option<Refusal> {
    /// Better fits cannot be improved by a shift.
    const MIN_FRAC: f64 = 0.002;
    if samples.len() < MIN_SHIFTED_SAMPLES || found_m < MIN_FRAC * distance_m {
        return None;
    }
    let (shift, best_m) = [1, -1]
        .map(|shift| (shift, shifted_median_m(input, samples, shift)))
        .into_iter()
        .min_by(|a, b| a.1.total_cmp(&b.1))?;
    if best_m * MUCH_BETTER > found_m.min(distance_m) {
        return None;
    }
    let (other, missing) = if shift > 0 {
        ("next", "the first image or board pose is missing")
    } else {
        ("previous", "the first robot pose is missing")
    };
    let before = if found_m.is_finite() {
        format!("within {:.1} mm", 1e3 * found_m)
    } else {
        "not at all".to_owned()
    };
    let board = if has_images(samples) {
        "image"
    } else {
        "board pose"
    };
    Some(Refusal::new(
        format!(
            "the robot poses and {board}s are off by one: the samples agree {before} (median), but within {:.1} mm if each {board} is paired with the robot pose of the {other} sample",
            1e3 * best_m
        ),
        format!(
            "check that both lists start with the same sample: {missing}, or one list counts from 1"
        ),
    ))
}

/// With this many samples, a wrong shift does not fit better by chance.
const MIN_SHIFTED_SAMPLES: usize = 6;

/// Median distance of the samples, meters, if each board is paired with the robot pose of the
/// sample `shift` places later. It is infinite if the samples have no solution.
fn shifted_median_m(input: &HandEyeInput<'_>, samples: &[Sample], shift: isize) -> f64 {
    let shifted: Vec<Sample> = samples
        .iter()
        .filter_map(|sample| {
            let other_ix = sample.sample_ix.checked_add_signed(shift)?;
            let other = input.samples.get(other_ix)?;
            Some(Sample {
                a: geometry::a_of(input.setup, &other.base_from_flange),
                ..sample.clone()
            })
        })
        .collect();
    // The sample at one end has no partner.
    if shifted.len() + 1 < MIN_SHIFTED_SAMPLES {
        return f64::INFINITY;
    }
    consensus(&shifted).map_or(f64::INFINITY, |found| found.median_m())
}

/// Explains the disagreement by different units of the robot's and the board's translations, and
/// gives the remedy.
fn scale_mistake(samples: &[Sample], found: Option<&Consensus>) -> Option<(String, String)> {
    /// A scale closer to 1 or to 0 may be noise.
    const MIN_SIGMAS: f64 = 5.0;
    /// Smaller changes are errors of the robot or of the print.
    const MIN_CHANGE: f64 = 0.02;
    /// Factor by which the scale must improve the agreement.
    const BETTER: f64 = 3.0;
    let pairs = samples.iter().enumerate().map(|(ix, sample)| {
        let choice = found.map_or(0, |found| found.choice[ix]);
        (sample.a, sample.candidates[choice].camera_from_board)
    });
    let motions = solve::motions(&pairs.collect::<Vec<_>>());
    let rotation = ClosedForm::ParkMartin.solve(&motions)?.rotation;
    let (scale, sigma) = solve::relative_scale(&motions, rotation)?;
    // Unrelated motions have a scale near 0.
    if scale.is_nan()
        || scale.abs() <= MIN_SIGMAS * sigma
        || (scale - 1.0).abs() < MIN_CHANGE.max(MIN_SIGMAS * sigma)
    {
        return None;
    }
    // The scale must explain the disagreement.
    let mut scaled: Vec<Sample> = samples.to_vec();
    for candidate in scaled.iter_mut().flat_map(|sample| &mut sample.candidates) {
        candidate.camera_from_board.translation.vector *= scale;
    }
    let explained_m = consensus(&scaled)?.median_m() / scale.abs().max(1.0);
    if explained_m * BETTER > found.map_or(f64::INFINITY, Consensus::median_m) {
        return None;
    }
    Some(explain_scale(scale, sigma))
}

/// Explains a scale of the robot's translations relative to the board's translations, and how to
/// correct it.
fn explain_scale(scale: f64, sigma: f64) -> (String, String) {
    /// Names of units, and the number of units per meter.
    const UNITS: [(&str, f64); 3] = [
        ("millimeters", 1000.0),
        ("centimeters", 100.0),
        ("inches", 39.37),
    ];
    let is_near = |value: f64, expected: f64| (value / expected - 1.0).abs() < 0.1;
    let unit_of = |value: f64| UNITS.into_iter().find(|(_, per_m)| is_near(value, *per_m));
    if is_near(scale, -1.0) {
        (
            "the board moves mirrored relative to the robot: the images are flipped, or the target was printed mirrored"
                .to_owned(),
            "turn off mirroring in the camera, or print the target again".to_owned(),
        )
    } else if let Some((unit, per_m)) = unit_of(scale) {
        (
            wrong_unit("the robot", "the board", unit, per_m),
            format!("divide the positions of base_from_flange by {per_m}"),
        )
    } else if let Some((unit, per_m)) = unit_of(1.0 / scale) {
        (
            wrong_unit("the board", "the robot", unit, per_m),
            format!(
                "divide the positions of camera_from_board, or the size of the board, by {per_m}"
            ),
        )
    } else {
        (
            format!(
                "the motions of the robot are {scale:.3} times (+-{sigma:.3}) those of the board"
            ),
            format!("check the size of the squares: it seems to be {scale:.3} times the given one"),
        )
    }
}

/// A sentence about positions of a body whose unit differs from the unit of another body.
fn wrong_unit(body: &str, other: &str, unit: &str, per_m: f64) -> String {
    format!(
        "the positions of {body} are {per_m} times too large relative to those of {other}: they are probably in {unit}"
    )
}

/// Checks the predicted uncertainty of position and rotation along every direction.
///
/// # Errors
/// The error names the direction that is determined worst.
fn check_uncertainty(input: &HandEyeInput<'_>, refined: &Refined) -> Result<(), Refusal> {
    let [max_sigma_m, max_sigma_rad] = [input.options.max_sigma_m, input.options.max_sigma_rad];
    let (sigma_rad, rotation_axis) = worst_direction(&refined.covariance, 0);
    let (sigma_m, direction) = worst_direction(&refined.covariance, 3);
    // The condition is written so that NaN is refused.
    if sigma_m <= max_sigma_m && sigma_rad <= max_sigma_rad {
        return Ok(());
    }
    let (in_camera, what) = if sigma_m > max_sigma_m {
        let what = format!(
            "the position is uncertain by {:.1} mm (at most {:.1} mm) along",
            1e3 * sigma_m,
            1e3 * max_sigma_m
        );
        (direction, what)
    } else {
        let what = format!(
            "the rotation is uncertain by {:.2} degrees (at most {:.2} degrees) around",
            sigma_rad.to_degrees(),
            max_sigma_rad.to_degrees()
        );
        (rotation_axis, what)
    };
    // If the camera is on the flange, the axes of the flange are named, because people move the
    // flange.
    let is_on_flange = input.setup == Setup::EyeInHand;
    let (axis, body) = if is_on_flange {
        (refined.solution.x.rotation * in_camera, "flange")
    } else {
        (in_camera, "camera")
    };
    Err(Refusal {
        why: format!("{what} {}", axis_name(&axis, body)),
        axis: is_on_flange.then(|| axis.into()),
        motion: format!(
            "add poses that rotate {}",
            rotations::rotations_across(&axis, body)
        ),
    })
}

/// Largest standard deviation in any direction of three parameters, starting with parameter
/// `first`, and this direction.
fn worst_direction(covariance: &DMatrix<f64>, first: usize) -> (f64, Vector3<f64>) {
    let eigen = SymmetricEigen::new(covariance.fixed_view::<3, 3>(first, first).into_owned());
    let ix = eigen.eigenvalues.imax();
    (
        sigma_of(eigen.eigenvalues[ix]),
        eigen.eigenvectors.column(ix).into_owned(),
    )
}
