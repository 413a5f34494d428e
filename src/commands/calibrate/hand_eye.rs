//! `fieldrig calibrate hand-eye`: the pose of a camera on a robot, from images of a target or poses
//! of a board.

use super::flags::{ReportFlag, RigFlags};
use super::target_argument;
use super::terminal::Terminal;
use crate::exit::Exit;
use crate::number_args::number_in_range;
use crate::print;
use calibrate::{HandEyeSamples, HandEyeTask, Host, MotionOptions, RobotOptions};
use messages::BadInput;
use std::path::PathBuf;
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
    /// Also estimate the intrinsics, starting from the intrinsics in the file; needs images
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

/// Flags for moving the arm.
#[derive(Debug, clap::Args)]
struct MoveFlags {
    /// With a rig file: move the arm to poses that show the target, until the result is accurate.
    /// The target must be visible at the start. The arm returns to the start at the end. The
    /// command does not avoid obstacles, and does not check for collisions of the arm with itself,
    /// its base or cables
    #[arg(long = "move")]
    is_requested: bool,
    /// With --move: confirm that nobody is within reach of the arm, and that a hand is on the
    /// emergency stop. Not needed with --sim
    #[arg(long, requires = "is_requested")]
    enable_motion: bool,
    /// With --move: maximum number of poses
    #[arg(long, value_name = "N", default_value_t = 20, requires = "is_requested", value_parser = clap::value_parser!(u16).range(10..=200))]
    max_poses: u16,
    /// With --move: end when the standard deviations of the position are at most this, millimeters
    #[arg(long, value_name = "MM", default_value_t = 0.2, requires = "is_requested", value_parser = number_in_range(1e-3..=100.0))]
    goal_mm: f64,
    /// With --move: maximum distance of the flange from its position at the start, millimeters;
    /// tool, camera, target and elbow can reach farther. Default: 300; if the camera is on the
    /// flange, at most half its distance to the target
    #[arg(long, value_name = "MM", requires = "is_requested", value_parser = number_in_range(10.0..=5000.0))]
    max_distance_mm: Option<f64>,
}

/// Reads or takes the samples, calibrates and prints the result. The exit code is 4 if the samples
/// do not determine the result.
pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    let task = args.task()?;
    let host = Terminal::new(Some(&args.rig.page), args.json);
    let (samples, arm) = task.read(&host)?;
    let result = calibrate_and_print(&task, samples, args.json, &host);
    match arm {
        Some(arm) => arm.finish(result),
        None => result,
    }
}

fn calibrate_and_print(
    task: &HandEyeTask,
    samples: HandEyeSamples,
    is_json: bool,
    host: &dyn Host,
) -> anyhow::Result<Exit> {
    let outcome = task.calibrate(samples, host)?;
    // In JSON output, a refusal has the same form as a result, so that programs can evaluate it.
    let document = outcome
        .document()
        .filter(|document| is_json || document.refused.is_none());
    let Some(document) = document else {
        return outcome.finish().map(|()| Exit::Done);
    };
    if is_json {
        print::json(&document)?
    } else {
        print::lines(document.lines())?;
        for warning in &document.warnings {
            log::warn!("{warning}");
        }
    }
    match outcome.finish() {
        // The reason is already part of the JSON output.
        Err(_) if document.refused.is_some() => Ok(Exit::InsufficientData),
        finished => finished.map(|()| Exit::Done),
    }
}

impl Args {
    fn task(&self) -> Result<HandEyeTask, BadInput> {
        // clap requires both or neither.
        let robot = self.urdf.as_ref().zip(self.tip.as_ref());
        Ok(HandEyeTask {
            input: self.input.clone(),
            target: self.target.clone(),
            with_intrinsics: self.with_intrinsics,
            with_joints: self.with_joints,
            robot: robot.map(|(urdf, tip)| RobotOptions {
                urdf: urdf.clone(),
                tip: tip.clone(),
            }),
            motion: self.motion.options(),
            rig: self.rig.options()?,
            report: self.report.options(),
        })
    }
}

impl MoveFlags {
    /// How the arm moves; `None` if it is only read.
    fn options(&self) -> Option<MotionOptions> {
        self.is_requested.then_some(MotionOptions {
            is_confirmed: self.enable_motion,
            max_poses: self.max_poses,
            goal_mm: self.goal_mm,
            max_distance_mm: self.max_distance_mm,
        })
    }
}
