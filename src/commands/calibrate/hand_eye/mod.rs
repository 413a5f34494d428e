//! `fieldrig calibrate hand-eye`: the pose of a camera on a robot, from images of a target or poses
//! of a board.

mod moved;
mod printed;
mod samples_file;
mod source;

use super::guide::Purpose;
use super::outputs::{self, ReportFlag, RigFlags, RigOutput};
use super::scan::ScanOptions;
use super::target::symmetry_warning;
use super::target_argument;
use crate::exit::{self, Exit};
use crate::print;
use anyhow::Context;
use calibration::hand_eye::{
    HandEyeCalibration, HandEyeInput, HandEyeOptions, NextPose, NextPoseOptions,
    calibrate_hand_eye, suggest_next_poses,
};
use kinematics::urdf::Robot;
use kinematics::{Chain, Intrinsics, Lens, Transform};
use messages::{BadInput, InsufficientData};
use moved::{MoveFlags, MovedArm, Request};
use nalgebra::Vector3;
use printed::{Printed, PrintedPose, PrintedSample};
use samples_file::{Samples, SamplesFile};
use session::calibration_report::{HandEyeReport, Unused};
use source::Source;
use std::path::{Path, PathBuf};
use targets::TargetSpec;

/// Format of the samples file.
const SAMPLES_HELP: &str = r#"Samples as JSON:

{"intrinsics": {"focal_px": [fx, fy], "principal_px": [cx, cy], "distortion": [...]},
 "target": "charuco:5x7:34mm:26mm:5X5_100", "setup": "eye-in-hand",
 "samples": [{"base_from_flange": [[4x4]], "image": "0.png"}, ...]}

Instead of an image, a sample may contain the pose of the board, "camera_from_board"; then intrinsics and target are not
needed. With the setup "eye-to-hand", the camera is fixed and the board moves with the flange. Lengths in meters, matrices
row by row, pixel centers at +0.5, image files relative to this file.

From a recording or the devices of a rig file, images are used in which the arm is slow and the target visible."#;

const INPUT_HELP: &str =
    "Samples as JSON, a recording (.mcap), or a rig file (.toml) whose devices are read";

const TARGET_HELP: &str =
    "With a recording or rig file: the target, such as charuco:5x7:34mm:26mm:5X5_100";

/// Flags of `calibrate hand-eye`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    #[arg(value_name = "SAMPLES.json|RECORDING|RIG", help = INPUT_HELP, long_help = SAMPLES_HELP)]
    input: PathBuf,
    #[arg(long, value_name = "SPEC", value_parser = target_argument, help = TARGET_HELP)]
    target: Option<TargetSpec>,
    /// Also estimate the intrinsics, starting from those in the file; needs images
    #[arg(long)]
    with_intrinsics: bool,
    /// Also estimate the offsets of all joints except the first and the last. With samples in JSON:
    /// needs images, "joints" in the samples, --urdf and --tip
    #[arg(long)]
    with_joints: bool,
    /// Robot description of the arm
    #[arg(long, value_name = "FILE.urdf", requires = "tip")]
    urdf: Option<PathBuf>,
    /// Link of the robot description that is the flange
    #[arg(long, value_name = "LINK", requires = "urdf")]
    tip: Option<String>,
    #[command(flatten)]
    motion: MoveFlags,
    #[command(flatten)]
    rig: RigFlags,
    #[command(flatten)]
    report: ReportFlag,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

/// A result and what to do next.
struct Calibrated {
    calibration: HandEyeCalibration,
    next_poses: Vec<NextPose>,
    /// Intrinsics that were given or estimated; `None` without images.
    intrinsics: Option<Intrinsics>,
    /// `parent_from_camera` for the rig file.
    rig_pose: Transform,
}

/// Reads or takes the samples, calibrates and prints the result. Exit code 4 if the samples do not
/// determine it.
pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    let report = args.report.open()?;
    let mut rig = args.rig.open(&args.input)?;
    let (source, arm) = args.source(report.is_some(), rig.as_mut())?;
    let result = calibrate_and_print(args, source, report, rig);
    match arm {
        Some(arm) => arm.finish(result),
        None => result,
    }
}

fn calibrate_and_print(
    args: &Args,
    mut source: Source,
    report: Option<&Path>,
    mut rig: Option<RigOutput>,
) -> anyhow::Result<Exit> {
    // The rig file is checked before the calibration, so that its result can be written.
    if let Some(rig) = &rig {
        rig.expect_setup(source.setup())?;
    }
    let samples = source.samples(args.json)?;
    if let (Some(rig), Some(size_px)) = (&rig, samples.size_px) {
        rig.expect_size(size_px)?;
    }
    let result = args
        .calibrate(&source, &samples)
        .map_err(|error| with_reason(error, &source, &samples));
    // The result is printed even if the report cannot be written.
    let written = match report {
        Some(path) => write_report(path, &args.input, &source, &samples, &result),
        None => Ok(()),
    };
    let mut printed = match &result {
        Ok(calibrated) => Printed {
            next_poses: calibrated
                .next_poses
                .iter()
                .cloned()
                .map(PrintedPose::of)
                .collect(),
            ..printed::printed(&calibrated.calibration)
        },
        // JSON output contains a refusal like a result, for programs that evaluate it.
        Err(error) if exit::of(error) == Exit::InsufficientData && args.json => {
            Printed::refused(source.setup(), format!("{error:#}"))
        }
        Err(_) => {
            outputs::log_failure(written);
            return result.map(|_| Exit::Done);
        }
    };
    printed
        .samples
        .extend(samples.unused.iter().map(PrintedSample::unused));
    printed.warnings.extend(
        samples
            .other_size
            .iter()
            .filter(|size| !size.prevails)
            .map(|size| size.text.clone()),
    );
    if args.json {
        print::json(&printed)?
    } else {
        printed::describe(&printed, result.as_ref().ok().map(|found| &found.rig_pose))?
    }
    let Ok(Calibrated {
        calibration,
        intrinsics,
        ..
    }) = result
    else {
        outputs::log_failure(written);
        return Ok(Exit::InsufficientData);
    };
    if let Some(rig) = &mut rig {
        rig.set_extrinsics(calibration.setup, &calibration.parent_from_camera)?;
        match (&calibration.intrinsics, intrinsics) {
            (Some((estimated, _)), _) => rig.set_intrinsics(estimated, None)?,
            (None, Some(given)) => rig.warn_if_intrinsics_differ(&given)?,
            (None, None) => (),
        }
        // The joints of a samples file need not be those of the rig.
        match source {
            Source::Scan { .. } => rig.add_joint_offsets(&calibration.joint_offsets),
            Source::File(_) if !calibration.joint_offsets.is_empty() => {
                log::warn!(
                    "joint offsets are not written into the rig file; add them to arm.joint_offsets"
                );
            }
            Source::File(_) => (),
        }
        rig.write()?;
    }
    written?;
    Ok(Exit::Done)
}

/// A refusal with the reason why images were not used.
fn with_reason(error: anyhow::Error, source: &Source, samples: &Samples) -> anyhow::Error {
    // Images that cannot be read were reported before.
    let unused: Vec<&Unused> = samples
        .unused
        .iter()
        .filter(|unused| !unused.is_unreadable)
        .collect();
    match unused.first() {
        Some(first) if exit::of(&error) == Exit::InsufficientData => {
            // Unreadable images do not count, because they say nothing about the target.
            let n_all = source.n_samples() - (samples.unused.len() - unused.len());
            let n = unused.len();
            let name = &first.name;
            let reason = &first.reason;
            let text = format!(
                "{error:#}; {n} of {n_all} images do not show the target: {name}: {reason}"
            );
            InsufficientData(text).into()
        }
        _ => error,
    }
}

/// A refusal with a warning about the target.
fn with_symmetry(error: calibration::Error, symmetry: Option<&str>) -> anyhow::Error {
    match symmetry {
        // An ambiguous target is a likely reason for a refusal.
        Some(symmetry) if matches!(error, calibration::Error::Refused(_)) => {
            InsufficientData(format!("{error}; {symmetry}")).into()
        }
        _ => error.into(),
    }
}

fn write_report(
    path: &Path,
    input: &Path,
    source: &Source,
    samples: &Samples,
    result: &anyhow::Result<Calibrated>,
) -> anyhow::Result<()> {
    let calibrated = result.as_ref().ok();
    let found = calibrated
        .into_iter()
        .flat_map(|calibrated| &calibrated.calibration.warnings);
    let warnings = source.warnings().iter().chain(found).cloned().collect();
    let Some(heading) = outputs::heading(input, result, warnings) else {
        return Ok(());
    };
    let calibration = calibrated.map(|calibrated| &calibrated.calibration);
    let rig_line = calibrated
        .map(|calibrated| printed::pose_toml(&calibrated.rig_pose))
        .map(|pose| format!("parent_from_camera = {pose}"));
    let report = HandEyeReport {
        heading: &heading,
        setup: source.setup(),
        samples: &samples.used,
        unused: &samples.unused,
        calibration,
        next_poses: calibrated.map_or(&[], |calibrated| &calibrated.next_poses),
        rig_line: rig_line.as_deref(),
        photos: &samples.photos,
    };
    outputs::write_report(path, &report.html())
}

impl Args {
    /// Reads the samples file or the images of a recording or rig, or moves the arm to take images.
    /// `output` gets the calibration that devices report.
    fn source(
        &self,
        keeps_photos: bool,
        output: Option<&mut RigOutput>,
    ) -> anyhow::Result<(Source, Option<MovedArm>)> {
        let has = |what: &str, flag: &str| BadInput(format!("{flag}: {what}; remove the flag"));
        let (scan, arm) = if self.motion.is_requested {
            let (scan, arm) = self.motion.run(&self.request(keeps_photos)?, output)?;
            (Some(scan), Some(arm))
        } else {
            let options = ScanOptions {
                keeps_photos,
                is_hidden: self.json,
                purpose: Purpose::HandEye,
            };
            (
                self.rig
                    .read(&self.input, self.target.as_ref(), options, output)?,
                None,
            )
        };
        let source = match (scan, &self.target) {
            (Some(_), _) if self.urdf.is_some() => {
                return Err(has("the rig file names the robot description", "--urdf").into());
            }
            (Some(scan), Some(target)) => Source::Scan {
                scan: Box::new(scan),
                target: target.clone(),
            },
            (None, Some(_)) => {
                return Err(has("the samples file contains the target", "--target").into());
            }
            (_, None) if self.with_joints && self.urdf.is_none() => {
                let why = "--with-joints: with samples in JSON, --urdf and --tip are needed, too";
                return Err(BadInput(why.to_owned()).into());
            }
            (_, None) => {
                let file = SamplesFile::read(&self.input)?;
                let unused = file.unused(self.with_joints);
                unused
                    .iter()
                    .for_each(|note| log::info!("{}: {note}", self.input.display()));
                Source::File(file)
            }
        };
        Ok((source, arm))
    }

    /// What `--move` calibrates.
    fn request(&self, keeps_photos: bool) -> anyhow::Result<Request<'_>> {
        let Some(target) = &self.target else {
            let why = "--target is required with --move, for example --target charuco:5x7:34mm:26mm:5X5_100";
            return Err(BadInput(why.to_owned()).into());
        };
        if self.urdf.is_some() {
            let why = "--urdf: the rig file names the robot description; remove the flag";
            return Err(BadInput(why.to_owned()).into());
        }
        Ok(Request {
            input: &self.input,
            target,
            rig: &self.rig,
            options: self.options(),
            keeps_photos,
        })
    }

    fn options(&self) -> HandEyeOptions {
        HandEyeOptions {
            estimate_intrinsics: self.with_intrinsics,
            estimate_joint_offsets: self.with_joints,
            ..HandEyeOptions::default()
        }
    }

    fn calibrate(&self, source: &Source, samples: &Samples) -> anyhow::Result<Calibrated> {
        source.check(samples)?;
        let symmetries: Vec<Transform> = source
            .target()
            .map(TargetSpec::symmetry)
            .unwrap_or_default();
        let chain = self.chain()?;
        let intrinsics = source.intrinsics(samples.size_px)?;
        // If the lens is estimated, too, the given one is only a start.
        let covariance = match &intrinsics {
            Some(intrinsics) if !self.with_intrinsics => {
                source.intrinsics_covariance(intrinsics)?
            }
            _ => None,
        };
        if intrinsics.is_some() && !self.with_intrinsics && covariance.is_none() {
            log::info!(
                "the given intrinsics are taken as exact, because their uncertainty is unknown"
            );
        }
        let intrinsics = if self.with_intrinsics {
            intrinsics.map(with_distortion)
        } else {
            intrinsics
        };
        let mut input = HandEyeInput {
            setup: source.setup(),
            samples: samples.used.clone(),
            intrinsics: intrinsics.clone(),
            intrinsics_covariance: covariance,
            board_symmetries: &symmetries,
            // Only one of them can exist: `--urdf` is refused with a rig.
            chain: chain.as_ref().or(source.chain()),
            options: self.options(),
        };
        let symmetry = source.target().and_then(symmetry_warning);
        let mut calibration = calibrate_hand_eye(&input)
            .map_err(|error| with_symmetry(error, symmetry.as_deref()))?;
        if let Source::Scan { scan, .. } = source
            && scan.is_rolling_shutter()
        {
            // The corners were corrected with the pose in the rig file. Now a better one is known.
            input.samples = scan.samples(Some(&calibration.parent_from_camera)).0;
            calibration = calibrate_hand_eye(&input)?;
        }
        calibration.warnings.extend(symmetry);
        let next_poses = match source.target() {
            Some(target) => suggest_next_poses(&input, &calibration, &next_pose_options(target)),
            None => Vec::new(),
        };
        let rig_pose = source.rig_pose(&calibration.parent_from_camera);
        Ok(Calibrated {
            calibration,
            next_poses,
            intrinsics,
            rig_pose,
        })
    }

    fn chain(&self) -> anyhow::Result<Option<Chain>> {
        let (Some(urdf), Some(tip)) = (&self.urdf, &self.tip) else {
            return Ok(None);
        };
        let of_file = || urdf.display().to_string();
        let robot = Robot::parse(&outputs::read_text(urdf)?).with_context(of_file)?;
        let root = robot.root().with_context(of_file)?.to_owned();
        Ok(Some(Chain::new(&robot, &root, tip).with_context(of_file)?))
    }
}

/// The start of the estimation of a lens. Without distortion, the estimate of a real lens would be
/// wrong by more than its standard deviation.
fn with_distortion(given: Intrinsics) -> Intrinsics {
    match given.lens {
        Lens::Pinhole => Intrinsics {
            lens: Lens::BrownConrady([0.0; 5]),
            ..given
        },
        _ => given,
    }
}

fn next_pose_options(target: &TargetSpec) -> NextPoseOptions<'static> {
    const N_POSES: usize = 3;
    const MAX_TILT_RAD: f64 = 0.7;
    let [low, high] = target.bounds_m();
    NextPoseOptions {
        n_poses: N_POSES,
        center_in_board: Vector3::new(0.5 * (low[0] + high[0]), 0.5 * (low[1] + high[1]), 0.0),
        radius_m: 0.5 * (high[0] - low[0]).hypot(high[1] - low[1]),
        max_tilt_rad: MAX_TILT_RAD,
        reach: None,
        seed: 1,
    }
}
