//! `fieldrig calibrate hand-eye`: the pose of a camera on a robot, from images of a target or poses of a board.

use super::lens::LensFile;
use super::scan::{Scan, ScanFlags};
use super::{images, matrix_of, print_matrix, target_argument, transform_of};
use crate::exit::{self, BadArgument, Exit, InsufficientData};
use crate::print;
use anyhow::Context;
use calibration::hand_eye::{
    BoardObservation, HandEyeCalibration, HandEyeInput, HandEyeOptions, HandEyeSample, NextPose, NextPoseOptions,
    SampleStatus, Setup, calibrate_hand_eye, suggest_next_poses,
};
use kinematics::urdf::Robot;
use kinematics::{Chain, transform};
use nalgebra::Vector3;
use serde::{Deserialize, Serialize};
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

const INPUT_HELP: &str = "Samples as JSON, a recording (.mcap), or a rig file (.toml) whose devices are read";

const TARGET_HELP: &str = "With a recording or rig file: the target, such as charuco:5x7:34mm:26mm:5X5_100";

/// Flags of `calibrate hand-eye`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    #[arg(value_name = "SAMPLES.json|RECORDING|RIG", help = INPUT_HELP, long_help = SAMPLES_HELP)]
    samples: PathBuf,
    #[arg(long, value_name = "SPEC", value_parser = target_argument, help = TARGET_HELP)]
    target: Option<TargetSpec>,
    #[command(flatten)]
    scan: ScanFlags,
    /// Also estimate the intrinsics, starting from those in the file; needs images
    #[arg(long)]
    with_intrinsics: bool,
    /// Also estimate the offsets of all joints except the first and the last. With samples in JSON: needs images,
    /// "joints" in the samples, --urdf and --tip
    #[arg(long)]
    with_joints: bool,
    /// Robot description of the arm
    #[arg(long, value_name = "FILE.urdf", requires = "tip")]
    urdf: Option<PathBuf>,
    /// Link of the robot description that is the flange
    #[arg(long, value_name = "LINK", requires = "urdf")]
    tip: Option<String>,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

/// Contents of the samples file.
#[derive(Debug, Deserialize)]
struct SamplesFile {
    #[serde(default)]
    intrinsics: Option<LensFile>,
    #[serde(default)]
    target: Option<String>,
    #[serde(default)]
    setup: Option<String>,
    samples: Vec<SampleEntry>,
}

#[derive(Debug, Deserialize)]
struct SampleEntry {
    base_from_flange: serde_json::Value,
    #[serde(default)]
    camera_from_board: Option<serde_json::Value>,
    #[serde(default)]
    image: Option<PathBuf>,
    #[serde(default)]
    joints: Option<Vec<f64>>,
}

type Matrix = [[f64; 4]; 4];

/// The printed result. Matrices are row by row; standard deviations along and about the axes of the camera.
#[derive(Debug, Default, Serialize)]
struct Printed {
    #[serde(skip_serializing_if = "Option::is_none")]
    flange_from_camera: Option<Option<Matrix>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    base_from_camera: Option<Option<Matrix>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    base_from_board: Option<Option<Matrix>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    flange_from_board: Option<Option<Matrix>>,
    scatter_mm: Option<f64>,
    scatter_deg: Option<f64>,
    held_out_scatter_mm: Option<f64>,
    held_out_scatter_deg: Option<f64>,
    rms_px: Option<f64>,
    held_out_rms_px: Option<f64>,
    sigma_mm: Option<[f64; 3]>,
    sigma_deg: Option<[f64; 3]>,
    /// The estimated intrinsics, if they were requested.
    #[serde(skip_serializing_if = "Option::is_none")]
    intrinsics: Option<LensFile>,
    joint_offsets: Vec<PrintedJoint>,
    samples: Vec<PrintedSample>,
    /// The poses that would lower the uncertainty most.
    next_poses: Vec<PrintedPose>,
    warnings: Vec<String>,
    refused: Option<String>,
}

/// A suggested robot pose.
#[derive(Debug, Serialize)]
struct PrintedPose {
    base_from_flange: Matrix,
    #[serde(skip_serializing_if = "Option::is_none")]
    joints: Option<Vec<f64>>,
    motion: String,
    /// Standard deviations with this pose, relative to those without.
    sigma_frac: f64,
}

#[derive(Debug, Serialize)]
struct PrintedJoint {
    joint: String,
    /// Offset to add to the readings, radians (meters for prismatic joints); null if it cannot be observed.
    offset: Option<f64>,
    sigma: Option<f64>,
}

#[derive(Debug, Default, Serialize)]
struct PrintedSample {
    name: String,
    status: &'static str,
    /// Why the target was not found in its image.
    #[serde(skip_serializing_if = "Option::is_none")]
    reason: Option<String>,
    position_mm: Option<f64>,
    rotation_deg: Option<f64>,
    rms_px: Option<f64>,
}

/// Calibrates and prints the result. Exit code 4 if the samples do not determine it.
pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    let scan = args.scan.read(&args.samples, args.target.as_ref(), args.json)?;
    let file = match (&scan, &args.target) {
        (Some(scan), target) => SamplesFile::of_scan(scan, target.as_ref()),
        (None, Some(_)) => return Err(BadArgument("--target: samples contain their target".into()).into()),
        (None, None) => SamplesFile::read(&args.samples)?,
    };
    let setup = file.setup()?;
    let mut unused = Vec::new();
    let result = args.calibrate(&file, scan.as_ref(), setup, &mut unused);
    let printed = match result {
        Ok(printed) => printed,
        Err(error) if exit::of(&error) == Exit::InsufficientData => {
            let mut reason = format!("{error:#}");
            if let Some(first) = unused.first() {
                let first_reason = first.reason.as_deref().unwrap_or_default();
                let (n, n_all) = (unused.len(), scan.as_ref().map_or(file.samples.len(), Scan::n_images));
                reason =
                    format!("{reason}; {n} of {n_all} images do not show the target: {}: {first_reason}", first.name);
            }
            if !args.json {
                return Err(InsufficientData(reason).into());
            }
            Printed::refused(setup, reason)
        }
        Err(error) => return Err(error),
    };
    let printed = Printed { samples: printed.samples.into_iter().chain(unused).collect(), ..printed };
    let exit = if printed.refused.is_some() { Exit::InsufficientData } else { Exit::Done };
    if args.json {
        print::json(&printed)?
    } else {
        describe(&printed)?
    }
    Ok(exit)
}

impl Args {
    /// Samples whose image does not show the target are added to `unused`.
    fn calibrate(
        &self,
        file: &SamplesFile,
        scan: Option<&Scan>,
        setup: Setup,
        unused: &mut Vec<PrintedSample>,
    ) -> anyhow::Result<Printed> {
        let target = file.target.as_deref().map(target_argument).transpose().map_err(BadArgument)?;
        let samples = match scan {
            Some(scan) => Samples::of_scan(scan, unused),
            None => file.samples(&self.samples, target.as_ref(), self.json, unused)?,
        };
        let symmetries = target.as_ref().map(TargetSpec::symmetry).unwrap_or_default();
        let chain = self.chain()?;
        let intrinsics = match (scan, &file.intrinsics, samples.size_px) {
            (Some(scan), ..) => Some(scan.intrinsics().clone()),
            (None, Some(lens), Some(size_px)) => Some(lens.intrinsics(size_px)?),
            _ => None,
        };
        let mut input = HandEyeInput {
            setup,
            samples: samples.used,
            intrinsics,
            board_symmetries: &symmetries,
            chain: chain.as_ref().or(scan.and_then(Scan::chain)),
            options: HandEyeOptions {
                estimate_intrinsics: self.with_intrinsics,
                estimate_joint_offsets: self.with_joints,
                ..HandEyeOptions::default()
            },
        };
        let mut calibration = calibrate_hand_eye(&input)?;
        if let Some(scan) = scan {
            // The correction for a rolling shutter depends on the pose of the camera.
            input.samples = scan.samples(Some(&calibration.parent_from_camera)).0;
            calibration = calibrate_hand_eye(&input)?;
        }
        let mut printed = printed(&calibration);
        if let Some(target) = &target {
            let next_poses = suggest_next_poses(&input, &calibration, &next_pose_options(target));
            printed.next_poses = next_poses.into_iter().map(PrintedPose::of).collect();
        }
        Ok(printed)
    }

    fn chain(&self) -> anyhow::Result<Option<Chain>> {
        let (Some(urdf), Some(tip)) = (&self.urdf, &self.tip) else { return Ok(None) };
        let of_file = || urdf.display().to_string();
        let text = std::fs::read_to_string(urdf).with_context(|| format!("cannot read {}", of_file()))?;
        let robot = Robot::parse(&text).with_context(of_file)?;
        let root = robot.root().with_context(of_file)?.to_owned();
        Ok(Some(Chain::new(&robot, &root, tip).with_context(of_file)?))
    }
}

impl PrintedPose {
    fn of(next: NextPose) -> Self {
        let NextPose { base_from_flange, joints, motion, sigma_frac } = next;
        Self { base_from_flange: matrix_of(&base_from_flange), joints, motion, sigma_frac }
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

/// Samples of the file that can be used.
struct Samples {
    used: Vec<HandEyeSample>,
    /// Size of the images, if there are any.
    size_px: Option<[u32; 2]>,
}

impl Samples {
    fn of_scan(scan: &Scan, unused: &mut Vec<PrintedSample>) -> Self {
        let (used, without_target) = scan.samples(None);
        unused.extend(without_target.into_iter().map(|(name, reason)| PrintedSample {
            name,
            status: "no-board",
            reason: Some(reason),
            ..PrintedSample::default()
        }));
        Self { used, size_px: Some(scan.intrinsics().size_px) }
    }
}

impl SamplesFile {
    /// The settings of a scan, without samples.
    fn of_scan(scan: &Scan, target: Option<&TargetSpec>) -> Self {
        let setup = match scan.setup() {
            Setup::EyeInHand => "eye-in-hand",
            Setup::EyeToHand => "eye-to-hand",
        };
        Self {
            intrinsics: None,
            target: target.map(TargetSpec::to_string),
            setup: Some(setup.to_owned()),
            samples: Vec::new(),
        }
    }

    fn read(path: &Path) -> anyhow::Result<Self> {
        let text = std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
        let invalid = |error: serde_json::Error| BadArgument(format!("{}: {error}", path.display()));
        let value: serde_json::Value = serde_json::from_str(&text).map_err(invalid)?;
        let Some(object) = value.as_object() else {
            return Err(BadArgument(format!("{}: expected an object with \"samples\"", path.display())).into());
        };
        const KEYS: [&str; 4] = ["intrinsics", "target", "setup", "samples"];
        let unknown: Vec<&str> = object.keys().map(String::as_str).filter(|key| !KEYS.contains(key)).collect();
        if !unknown.is_empty() {
            log::warn!("{}: unknown keys are ignored: {}", path.display(), unknown.join(", "));
        }
        Ok(serde_json::from_value(value).map_err(invalid)?)
    }

    fn setup(&self) -> Result<Setup, BadArgument> {
        match self.setup.as_deref() {
            None | Some("eye-in-hand") => Ok(Setup::EyeInHand),
            Some("eye-to-hand") => Ok(Setup::EyeToHand),
            Some(other) => Err(BadArgument(format!("setup {other:?}, expected \"eye-in-hand\" or \"eye-to-hand\""))),
        }
    }

    fn samples(
        &self,
        path: &Path,
        target: Option<&TargetSpec>,
        is_hidden: bool,
        unused: &mut Vec<PrintedSample>,
    ) -> anyhow::Result<Samples> {
        let with_image = self.samples.iter().filter_map(|sample| sample.image.as_ref());
        let folder = path.parent().unwrap_or(Path::new(""));
        let files: Vec<PathBuf> = with_image.map(|image| folder.join(image)).collect();
        if let Some(missing) = files.iter().find(|file| !file.is_file()) {
            return Err(
                BadArgument(format!("{}: the image {} does not exist", path.display(), missing.display())).into()
            );
        }
        let mut detected = match (files.is_empty(), target) {
            (true, _) => Vec::new(),
            (false, Some(target)) => images::detect(&files, target, is_hidden),
            (false, None) => return Err(BadArgument(format!("{}: images need a \"target\"", path.display())).into()),
        }
        .into_iter();
        if !files.is_empty() && self.intrinsics.is_none() {
            return Err(BadArgument(format!("{}: images need \"intrinsics\"", path.display())).into());
        }
        let mut samples = Samples { used: Vec::new(), size_px: None };
        let mut first_image: Option<(String, [u32; 2])> = None;
        for (ix, entry) in self.samples.iter().enumerate() {
            let number = format!("sample {ix}");
            let transform = |key: &str, value: &serde_json::Value| {
                transform_of(value)
                    .map_err(|reason| BadArgument(format!("{}: {number}: {key}: {reason}", path.display())))
            };
            let base_from_flange = transform("base_from_flange", &entry.base_from_flange)?;
            let (name, board) = match (&entry.camera_from_board, &entry.image) {
                (Some(pose), None) => {
                    let pose = transform("camera_from_board", pose)?;
                    (number.clone(), BoardObservation::Pose(pose))
                }
                (None, Some(_)) => {
                    let image = detected.next().expect("one result per image");
                    match image.board {
                        Ok(board) => {
                            let size_px = board.size_px;
                            let (first, first_px) = first_image.get_or_insert((image.name.clone(), size_px)).clone();
                            if first_px != size_px {
                                let other = image.name;
                                return Err(calibration::Error::MixedImageSizes {
                                    first,
                                    first_px,
                                    other,
                                    other_px: size_px,
                                }
                                .into());
                            }
                            samples.size_px = Some(size_px);
                            (image.name, BoardObservation::View(board.view))
                        }
                        Err(reason) => {
                            let reason = Some(reason);
                            unused.push(PrintedSample {
                                name: image.name,
                                status: "no-board",
                                reason,
                                ..PrintedSample::default()
                            });
                            continue;
                        }
                    }
                }
                _ => {
                    let message = "must contain either \"camera_from_board\" or \"image\"";
                    return Err(BadArgument(format!("{}: {number} {message}", path.display())).into());
                }
            };
            samples.used.push(HandEyeSample { name, base_from_flange, board, joints: entry.joints.clone() });
        }
        if samples.used.is_empty() && !unused.is_empty() {
            return Err(InsufficientData(format!("{}: no image shows the target", path.display())).into());
        }
        Ok(samples)
    }
}

fn printed(calibration: &HandEyeCalibration) -> Printed {
    let camera = Some(matrix_of(&calibration.parent_from_camera));
    let board = Some(matrix_of(&calibration.parent_from_board));
    let of_setup = |setup: Setup, matrix: Option<Matrix>| (calibration.setup == setup).then_some(matrix);
    let held_out = calibration.held_out_scatter;
    Printed {
        flange_from_camera: of_setup(Setup::EyeInHand, camera),
        base_from_camera: of_setup(Setup::EyeToHand, camera),
        base_from_board: of_setup(Setup::EyeInHand, board),
        flange_from_board: of_setup(Setup::EyeToHand, board),
        scatter_mm: Some(calibration.scatter.mm),
        scatter_deg: Some(calibration.scatter.deg),
        held_out_scatter_mm: held_out.map(|scatter| scatter.mm),
        held_out_scatter_deg: held_out.map(|scatter| scatter.deg),
        rms_px: calibration.rms_px,
        held_out_rms_px: calibration.held_out_rms_px,
        sigma_mm: Some(calibration.sigma_mm),
        sigma_deg: Some(calibration.sigma_deg),
        intrinsics: calibration.intrinsics.as_ref().map(|(intrinsics, _)| LensFile::of(intrinsics)),
        joint_offsets: calibration
            .joint_offsets
            .iter()
            .map(|offset| PrintedJoint {
                joint: offset.joint.clone(),
                offset: offset.estimate.map(|[value, _]| value),
                sigma: offset.estimate.map(|[_, sigma]| sigma),
            })
            .collect(),
        samples: calibration
            .samples
            .iter()
            .map(|sample| PrintedSample {
                name: sample.name.clone(),
                reason: None,
                status: match sample.status {
                    SampleStatus::Used => "used",
                    SampleStatus::Outlier => "outlier",
                    SampleStatus::NoBoard => "no-board",
                },
                position_mm: sample.position_mm,
                rotation_deg: sample.rotation_deg,
                rms_px: sample.rms_px,
            })
            .collect(),
        next_poses: Vec::new(),
        warnings: calibration.warnings.clone(),
        refused: None,
    }
}

impl Printed {
    /// Without a result.
    fn refused(setup: Setup, reason: String) -> Self {
        let of_setup = |other: Setup| (setup == other).then_some(None);
        Self {
            flange_from_camera: of_setup(Setup::EyeInHand),
            base_from_board: of_setup(Setup::EyeInHand),
            base_from_camera: of_setup(Setup::EyeToHand),
            flange_from_board: of_setup(Setup::EyeToHand),
            refused: Some(reason),
            ..Self::default()
        }
    }
}

/// The value of `parent_from_camera` in a rig file.
fn pose_toml(matrix: &Matrix) -> anyhow::Result<String> {
    let pose = transform::from_rows(&std::array::from_fn(|ix| matrix[ix / 4][ix % 4]))?;
    let list = |values: &[f64]| values.iter().map(|value| format!("{value:.9}")).collect::<Vec<_>>().join(", ");
    let (xyz_m, quat_xyzw) = (list(pose.translation.vector.as_slice()), list(pose.rotation.coords.as_slice()));
    Ok(format!("{{ xyz_m = [{xyz_m}], quat_xyzw = [{quat_xyzw}] }}"))
}

fn describe(printed: &Printed) -> anyhow::Result<()> {
    let matrices = [
        ("flange_from_camera", printed.flange_from_camera),
        ("base_from_camera", printed.base_from_camera),
        ("base_from_board", printed.base_from_board),
        ("flange_from_board", printed.flange_from_board),
    ];
    for (name, matrix) in matrices {
        let Some(Some(matrix)) = matrix else { continue };
        print::line(format!("{name}, row by row (meters):"))?;
        print_matrix(&matrix)?;
    }
    if let Some(Some(matrix)) = printed.flange_from_camera.or(printed.base_from_camera) {
        print::line(format!("rig file:\nparent_from_camera = {}", pose_toml(&matrix)?))?;
    }
    if let Some(intrinsics) = &printed.intrinsics {
        print::line(format!("intrinsics = {}", intrinsics.to_toml()))?;
    }
    let three = |values: Option<[f64; 3]>, unit: &str| {
        let values = values.unwrap_or_default().map(|value| format!("{value:.3}"));
        format!("{} {unit}", values.join(", "))
    };
    print::line(format!(
        "standard deviations of the camera along and about its x, y and z axes: {}; {}",
        three(printed.sigma_mm, "mm"),
        three(printed.sigma_deg, "degrees")
    ))?;
    if let (Some(mm), Some(deg)) = (printed.scatter_mm, printed.scatter_deg) {
        print::line(format!("scatter of the board over the samples: {mm:.2} mm, {deg:.3} degrees"))?;
    }
    if let (Some(mm), Some(deg)) = (printed.held_out_scatter_mm, printed.held_out_scatter_deg) {
        print::line(format!("the same for samples that were left out: {mm:.2} mm, {deg:.3} degrees"))?;
    }
    if let Some(rms_px) = printed.rms_px {
        print::line(format!("reprojection error: {rms_px:.3} px (RMS)"))?;
    }
    for joint in &printed.joint_offsets {
        print::line(match (joint.offset, joint.sigma) {
            (Some(offset), Some(sigma)) => {
                format!("offset of {}: {offset:.6} +- {sigma:.6} (radians or meters)", joint.joint)
            }
            _ => format!("offset of {}: cannot be observed", joint.joint),
        })?;
    }
    for sample in printed.samples.iter().filter(|sample| sample.status != "used") {
        let reason = sample.reason.as_deref().unwrap_or(sample.status);
        print::line(format!("not used: {}: {reason}", sample.name))?;
    }
    if let Some(next) = printed.next_poses.first() {
        let percent = 100.0 * (1.0 - next.sigma_frac);
        print::line(format!("next pose: {} (lowers the standard deviations by {percent:.0} %)", next.motion))?;
    }
    for warning in &printed.warnings {
        log::warn!("{warning}");
    }
    Ok(())
}
