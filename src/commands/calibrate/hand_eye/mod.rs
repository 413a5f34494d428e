//! `fieldrig calibrate hand-eye`: the pose of a camera on a robot, from images of a target or poses of a board.

mod printed;
mod samples_file;

use super::outputs::{self, ReportFlag, RigFlags};
use crate::exit::{self, Exit, InsufficientData};
use crate::print;
use anyhow::Context;
use calibration::hand_eye::{
    HandEyeCalibration, HandEyeInput, HandEyeOptions, NextPose, NextPoseOptions, calibrate_hand_eye, suggest_next_poses,
};
use kinematics::urdf::Robot;
use kinematics::{Chain, Transform};
use nalgebra::Vector3;
use printed::{Printed, PrintedPose, PrintedSample};
use samples_file::{Samples, SamplesFile};
use session::calibration_report::HandEyeReport;
use std::path::{Path, PathBuf};
use targets::TargetSpec;

/// Format of the samples file.
const SAMPLES_HELP: &str = r#"Samples as JSON:

{"intrinsics": {"focal_px": [fx, fy], "principal_px": [cx, cy], "distortion": [...]},
 "target": "charuco:5x7:34mm:26mm:5X5_100", "setup": "eye-in-hand",
 "samples": [{"base_from_flange": [[4x4]], "image": "0.png"}, ...]}

Instead of an image, a sample may contain the pose of the board, "camera_from_board"; then intrinsics and target are not
needed. With the setup "eye-to-hand", the camera is fixed and the board moves with the flange. Lengths in meters, matrices
row by row, pixel centers at +0.5, image files relative to this file."#;

/// Flags of `calibrate hand-eye`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    #[arg(value_name = "SAMPLES.json", help = "Samples as JSON", long_help = SAMPLES_HELP)]
    samples: PathBuf,
    /// Also estimate the intrinsics, starting from those in the file; needs images
    #[arg(long)]
    with_intrinsics: bool,
    /// Also estimate the offsets of all joints except the first and the last; needs images, "joints" in the samples,
    /// --urdf and --tip
    #[arg(long, requires_all = ["urdf", "tip"])]
    with_joints: bool,
    /// Robot description of the arm
    #[arg(long, value_name = "FILE.urdf", requires = "tip")]
    urdf: Option<PathBuf>,
    /// Link of the robot description that is the flange
    #[arg(long, value_name = "LINK", requires = "urdf")]
    tip: Option<String>,
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
    intrinsics: Option<kinematics::Intrinsics>,
}

/// Calibrates and prints the result. Exit code 4 if the samples do not determine it.
pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    let report = args.report.open()?;
    let mut rig = args.rig.open()?;
    let file = SamplesFile::read(&args.samples)?;
    if let Some(rig) = &rig {
        rig.expect_setup(file.setup)?;
    }
    let samples = file.detect(args.json)?;
    if let (Some(rig), Some(size_px)) = (&rig, samples.size_px) {
        rig.expect_size(size_px)?;
    }
    let result = args.calibrate(&file, &samples).map_err(|error| with_reason(error, &file, &samples));
    if let Some(path) = report {
        write_report(path, &args.samples, &file, &samples, &result)?;
    }
    let mut printed = match &result {
        Ok(calibrated) => Printed {
            next_poses: calibrated.next_poses.iter().cloned().map(PrintedPose::of).collect(),
            ..printed::printed(&calibrated.calibration)
        },
        Err(error) if exit::of(error) == Exit::InsufficientData && args.json => {
            Printed::refused(file.setup, format!("{error:#}"))
        }
        Err(_) => return result.map(|_| Exit::Done),
    };
    printed.samples.extend(samples.unused.iter().map(PrintedSample::unused));
    if args.json {
        print::json(&printed)?
    } else {
        printed::describe(&printed)?
    }
    let Ok(Calibrated { calibration, intrinsics, .. }) = result else { return Ok(Exit::InsufficientData) };
    if let Some(rig) = &mut rig {
        rig.set_extrinsics(calibration.setup, &calibration.parent_from_camera)?;
        match (&calibration.intrinsics, intrinsics) {
            (Some((estimated, _)), _) => rig.set_intrinsics(estimated)?,
            (None, Some(given)) => rig.warn_if_intrinsics_differ(&given)?,
            (None, None) => (),
        }
        rig.write()?;
    }
    Ok(Exit::Done)
}

/// A refusal with the reason why images were not used.
fn with_reason(error: anyhow::Error, file: &SamplesFile, samples: &Samples) -> anyhow::Error {
    match samples.unused.first() {
        Some(first) if exit::of(&error) == Exit::InsufficientData => {
            let (n, n_all) = (samples.unused.len(), file.len());
            let (name, reason) = (&first.name, &first.reason);
            let text = format!("{error:#}; {n} of {n_all} images do not show the target: {name}: {reason}");
            InsufficientData(text).into()
        }
        _ => error,
    }
}

fn write_report(
    path: &Path,
    input: &Path,
    file: &SamplesFile,
    samples: &Samples,
    result: &anyhow::Result<Calibrated>,
) -> anyhow::Result<()> {
    let calibrated = result.as_ref().ok();
    let warnings = calibrated.map_or(Vec::new(), |calibrated| calibrated.calibration.warnings.clone());
    let Some(heading) = outputs::heading(input, result, warnings) else { return Ok(()) };
    let calibration = calibrated.map(|calibrated| &calibrated.calibration);
    let rig_line = calibration
        .map(|calibration| printed::pose_toml(&calibration.parent_from_camera))
        .map(|pose| format!("parent_from_camera = {pose}"));
    let report = HandEyeReport {
        heading: &heading,
        setup: file.setup,
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
    fn calibrate(&self, file: &SamplesFile, samples: &Samples) -> anyhow::Result<Calibrated> {
        file.check_detected(samples)?;
        let symmetries: Vec<Transform> = file.target.as_ref().map(TargetSpec::symmetry).unwrap_or_default();
        let chain = self.chain()?;
        let intrinsics = match (&file.intrinsics, samples.size_px) {
            (Some(lens), Some(size_px)) => Some(lens.intrinsics(size_px)?),
            _ => None,
        };
        let input = HandEyeInput {
            setup: file.setup,
            samples: samples.used.clone(),
            intrinsics: intrinsics.clone(),
            board_symmetries: &symmetries,
            chain: chain.as_ref(),
            options: HandEyeOptions {
                estimate_intrinsics: self.with_intrinsics,
                estimate_joint_offsets: self.with_joints,
                ..HandEyeOptions::default()
            },
        };
        let calibration = calibrate_hand_eye(&input)?;
        let next_poses = match &file.target {
            Some(target) => suggest_next_poses(&input, &calibration, &next_pose_options(target)),
            None => Vec::new(),
        };
        Ok(Calibrated { calibration, next_poses, intrinsics })
    }

    fn chain(&self) -> anyhow::Result<Option<Chain>> {
        let (Some(urdf), Some(tip)) = (&self.urdf, &self.tip) else { return Ok(None) };
        let of_file = || urdf.display().to_string();
        let robot = Robot::parse(&outputs::read_text(urdf)?).with_context(of_file)?;
        let root = robot.root().with_context(of_file)?.to_owned();
        Ok(Some(Chain::new(&robot, &root, tip).with_context(of_file)?))
    }
}

fn next_pose_options(target: &TargetSpec) -> NextPoseOptions {
    const N_POSES: usize = 3;
    const MAX_TILT_RAD: f64 = 0.7;
    let [low, high] = target.bounds_m();
    NextPoseOptions {
        n_poses: N_POSES,
        center_in_board: Vector3::new(0.5 * (low[0] + high[0]), 0.5 * (low[1] + high[1]), 0.0),
        radius_m: 0.5 * (high[0] - low[0]).hypot(high[1] - low[1]),
        max_tilt_rad: MAX_TILT_RAD,
    }
}
