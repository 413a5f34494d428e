//! The pose of a camera on a robot, from images of a target or poses of a board.

mod document;
mod moved;
mod samples_file;
mod source;

pub use document::HandEyeDocument;
pub use moved::{MotionOptions, MovedArm};

use crate::guide::Purpose;
use crate::host::Host;
use crate::outputs::{self, ReportOptions, RigOptions, RigOutput};
use crate::scan::ScanOptions;
use crate::symmetry::symmetry_warning;
use anyhow::Context;
use calibration::hand_eye::{
    HandEyeCalibration, HandEyeInput, HandEyeOptions, NextPose, NextPoseOptions, Setup,
    calibrate_hand_eye, suggest_next_poses,
};
use capture::known_robots::KnownRobot;
use kinematics::urdf::Robot;
use kinematics::{Chain, Intrinsics, Lens, Transform};
use messages::{BadInput, ErrorClass, InsufficientData, Setting};
use moved::Request;
use nalgebra::Vector3;
use report::calibration_report::{HandEyeReport, Unused};
use samples_file::{Samples, SamplesFile};
use source::Source;
use std::path::PathBuf;
use targets::TargetSpec;

/// Input and options of a hand-eye calibration.
#[derive(Clone, Debug)]
pub struct HandEyeTask {
    /// A samples file (JSON), a recording, or a rig file whose devices are read.
    pub input: PathBuf,
    /// The target. This requires a recording or a rig file as input.
    pub target: Option<TargetSpec>,
    /// Whether the intrinsics are also estimated, which requires images.
    pub with_intrinsics: bool,
    /// Whether the offsets of all joints except the first and the last are also estimated.
    pub with_joints: bool,
    /// The arm. This requires a samples file as input.
    pub robot: Option<RobotOptions>,
    /// How the arm moves. With `None`, the arm is only read.
    pub motion: Option<MotionOptions>,
    /// The camera, and the rig file to write.
    pub rig: RigOptions,
    /// The report to write.
    pub report: Option<ReportOptions>,
}

/// The description of an arm.
#[derive(Clone, Debug)]
pub struct RobotOptions {
    /// The robot description.
    pub urdf: PathBuf,
    /// Link of the robot description that is the flange.
    pub tip: String,
}

/// Samples that were read or taken.
pub struct HandEyeSamples {
    source: Source,
    rig: Option<RigOutput>,
}

/// A result and what to do next.
#[derive(Clone, Debug)]
pub struct CalibratedHandEye {
    /// The estimates.
    pub calibration: HandEyeCalibration,
    /// The poses that would reduce the uncertainty most.
    pub next_poses: Vec<NextPose>,
    /// Intrinsics that were given or estimated. `None` without images.
    pub intrinsics: Option<Intrinsics>,
    /// `parent_from_camera` for the rig file.
    pub rig_pose: Transform,
}

/// The outcome of a hand-eye calibration.
pub struct HandEyeOutcome {
    /// The result, or the reason why there is no result.
    pub result: anyhow::Result<CalibratedHandEye>,
    source: Source,
    samples: Samples,
    rig: Option<RigOutput>,
    /// The result of writing the report.
    written: anyhow::Result<()>,
}

impl HandEyeTask {
    /// Reads a samples file, or takes the images from a recording or from the devices of a rig. If
    /// the arm has moved to take the images, the arm is also returned. In that case, the caller
    /// must call [`MovedArm::finish`] with the result of the calibration.
    ///
    /// # Errors
    /// Fails if the input does not fit the options, or if it cannot be read.
    pub fn read(&self, host: &dyn Host) -> anyhow::Result<(HandEyeSamples, Option<MovedArm>)> {
        // The paths are checked first, so that a wrong path does not cost a calibration.
        self.report.as_ref().map_or(Ok(()), ReportOptions::check)?;
        let mut rig = self.rig.open(&self.input)?;
        let (source, arm) = self.source(host, rig.as_mut())?;
        Ok((HandEyeSamples { source, rig }, arm))
    }

    /// Calibrates, and writes the report. If there is no result, the outcome contains the reason.
    ///
    /// # Errors
    /// Fails if the images cannot be read, or if a result would not fit the rig file to write.
    pub fn calibrate(
        &self,
        samples: HandEyeSamples,
        host: &dyn Host,
    ) -> anyhow::Result<HandEyeOutcome> {
        let HandEyeSamples { mut source, rig } = samples;
        // The rig file is checked before the calibration, so that its result can be written.
        if let Some(rig) = &rig {
            rig.expect_setup(source.setup())?;
        }
        let samples = source.samples(host)?;
        if let (Some(rig), Some(size_px)) = (&rig, samples.size_px) {
            rig.expect_size(size_px)?;
        }
        let result = self
            .estimate(&source, &samples)
            .map_err(|error| with_reason(error, &source, &samples));
        // The result is printed even if the report cannot be written.
        let written = match &self.report {
            Some(report) => self.write_report(report, &source, &samples, &result),
            None => Ok(()),
        };
        Ok(HandEyeOutcome {
            result,
            source,
            samples,
            rig,
            written,
        })
    }

    /// `output` gets the calibration that devices report.
    fn source(
        &self,
        host: &dyn Host,
        output: Option<&mut RigOutput>,
    ) -> anyhow::Result<(Source, Option<MovedArm>)> {
        let has =
            |what: &str, setting: Setting| BadInput(format!("{setting}: {what}; remove the flag"));
        let (scan, arm) = if let Some(motion) = &self.motion {
            let (scan, arm) = motion.run(&self.request(host)?, output)?;
            (Some(scan), Some(arm))
        } else {
            let options = ScanOptions {
                host,
                keeps_photos: self.report.is_some(),
                purpose: Purpose::HandEye,
            };
            (
                self.rig
                    .read(&self.input, self.target.as_ref(), options, output)?,
                None,
            )
        };
        let source = match (scan, &self.target) {
            (Some(_), _) if self.robot.is_some() => {
                return Err(has("the rig file names the robot description", Setting::Urdf).into());
            }
            (Some(scan), Some(target)) => Source::Scan {
                scan: Box::new(scan),
                target: target.clone(),
            },
            (None, Some(_)) => {
                return Err(has("the samples file contains the target", Setting::Target).into());
            }
            (_, None) if self.with_joints && self.robot.is_none() => {
                return Err(BadInput(format!(
                    "{}: with samples in JSON, {} and {} are needed, too",
                    Setting::WithJoints,
                    Setting::Urdf,
                    Setting::Tip
                ))
                .into());
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

    /// The request for a calibration with a moving arm.
    fn request<'a>(&'a self, host: &'a dyn Host) -> anyhow::Result<Request<'a>> {
        let Some(target) = &self.target else {
            let setting = Setting::Target;
            return Err(BadInput(format!(
                "{setting} is required with {}, for example {setting} charuco:5x7:34mm:26mm:5X5_100",
                Setting::Move
            ))
            .into());
        };
        if self.robot.is_some() {
            return Err(BadInput(format!(
                "{}: the rig file names the robot description; remove the flag",
                Setting::Urdf
            ))
            .into());
        }
        Ok(Request {
            input: &self.input,
            target,
            rig: &self.rig,
            options: self.options(),
            host,
            keeps_photos: self.report.is_some(),
        })
    }

    fn options(&self) -> HandEyeOptions {
        HandEyeOptions {
            estimate_intrinsics: self.with_intrinsics,
            estimate_joint_offsets: self.with_joints,
            ..HandEyeOptions::default()
        }
    }

    fn estimate(&self, source: &Source, samples: &Samples) -> anyhow::Result<CalibratedHandEye> {
        source.check(samples)?;
        let symmetries: Vec<Transform> = source
            .target()
            .map(TargetSpec::symmetry)
            .unwrap_or_default();
        let chain = self.chain()?;
        let intrinsics = source.intrinsics(samples.size_px)?;
        // If the lens is also estimated, the given lens is only the initial value.
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
            // Only one of the two robot descriptions can exist, because `--urdf` is refused with a
            // rig.
            chain: chain.as_ref().or(source.chain()),
            options: self.options(),
        };
        let symmetry = source.target().and_then(symmetry_warning);
        let mut calibration = calibrate_hand_eye(&input)
            .map_err(|error| with_symmetry(error, symmetry.as_deref()))?;
        if let Source::Scan { scan, .. } = source
            && scan.is_rolling_shutter()
        {
            // The corners were corrected with the pose in the rig file. They are corrected again,
            // because a better pose is now known.
            input.samples = scan.samples(Some(&calibration.parent_from_camera)).0;
            calibration = calibrate_hand_eye(&input)?;
        }
        calibration.warnings.extend(symmetry);
        let next_poses = match source.target() {
            Some(target) => suggest_next_poses(&input, &calibration, &next_pose_options(target)),
            None => Vec::new(),
        };
        let rig_pose = source.rig_pose(&calibration.parent_from_camera);
        Ok(CalibratedHandEye {
            calibration,
            next_poses,
            intrinsics,
            rig_pose,
        })
    }

    fn chain(&self) -> anyhow::Result<Option<Chain>> {
        let Some(RobotOptions { urdf, tip }) = &self.robot else {
            return Ok(None);
        };
        let of_file = || urdf.display().to_string();
        let known_robot = KnownRobot::named_by(&urdf.to_string_lossy())
            .map_err(|unknown| BadInput(unknown.to_string()))?;
        let text = match known_robot {
            Some(known) => known.urdf.to_owned(),
            None => outputs::read_text(urdf)?,
        };
        let robot = Robot::parse(&text).with_context(of_file)?;
        let root = robot.root().with_context(of_file)?.to_owned();
        Ok(Some(Chain::new(&robot, &root, tip).with_context(of_file)?))
    }

    fn write_report(
        &self,
        report: &ReportOptions,
        source: &Source,
        samples: &Samples,
        result: &anyhow::Result<CalibratedHandEye>,
    ) -> anyhow::Result<()> {
        let calibrated = result.as_ref().ok();
        let found = calibrated
            .into_iter()
            .flat_map(|calibrated| &calibrated.calibration.warnings);
        let warnings = source.warnings().iter().chain(found).cloned().collect();
        let Some(heading) = report.heading(&self.input, result, warnings) else {
            return Ok(());
        };
        let calibration = calibrated.map(|calibrated| &calibrated.calibration);
        let rig_line = calibrated
            .map(|calibrated| pose_toml(&calibrated.rig_pose))
            .map(|pose| format!("parent_from_camera = {pose}"));
        let page = HandEyeReport {
            heading: &heading,
            setup: source.setup(),
            samples: &samples.used,
            unused: &samples.unused,
            calibration,
            next_poses: calibrated.map_or(&[], |calibrated| &calibrated.next_poses),
            rig_line: rig_line.as_deref(),
            photos: &samples.photos,
        };
        report.write(&page.html())
    }
}

impl HandEyeOutcome {
    /// Whether the camera is on the flange or fixed.
    fn setup(&self) -> Setup {
        self.source.setup()
    }

    /// Samples whose image cannot be read or does not show the target.
    fn unused(&self) -> &[Unused] {
        &self.samples.unused
    }

    /// A warning if some images show a board of another size than the target.
    fn size_warning(&self) -> Option<&str> {
        self.samples
            .other_size
            .as_ref()
            .filter(|size| !size.prevails)
            .map(|size| size.text.as_str())
    }

    /// Writes the rig file, if it was requested. This is called after the result was printed.
    ///
    /// # Errors
    /// Fails if there is no result, or if the rig file or the report cannot be written.
    pub fn finish(self) -> anyhow::Result<()> {
        let CalibratedHandEye {
            calibration,
            intrinsics,
            ..
        } = match self.result {
            Ok(calibrated) => calibrated,
            Err(error) => {
                outputs::log_failure(self.written);
                return Err(error);
            }
        };
        if let Some(mut rig) = self.rig {
            rig.set_extrinsics(calibration.setup, &calibration.parent_from_camera)?;
            match (&calibration.intrinsics, intrinsics) {
                (Some((estimated, _)), _) => rig.set_intrinsics(estimated, None)?,
                (None, Some(given)) => rig.warn_if_intrinsics_differ(&given)?,
                (None, None) => (),
            }
            // The joints of a samples file need not be the joints of the rig.
            match self.source {
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
        self.written
    }
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
        Some(first) if session::class(&error) == ErrorClass::InsufficientData => {
            // Unreadable images do not count, because they contain no information about the target.
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

/// The value of `parent_from_camera` in a rig file.
fn pose_toml(pose: &Transform) -> String {
    let xyz_m = nine_digits(pose.translation.vector.as_slice());
    let quat_xyzw = nine_digits(pose.rotation.coords.as_slice());
    format!("{{ xyz_m = [{xyz_m}], quat_xyzw = [{quat_xyzw}] }}")
}

/// Numbers for a rig file. Nine digits have a resolution of a nanometer, which is below any
/// calibration error.
fn nine_digits(values: &[f64]) -> String {
    values
        .iter()
        .map(|value| format!("{value:.9}"))
        .collect::<Vec<_>>()
        .join(", ")
}

/// Initial values for estimating a lens. The lens model has distortion, because the estimate of a
/// real lens without distortion would be wrong by more than its standard deviation.
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
