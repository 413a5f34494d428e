//! Implements `fieldrig calibrate hand-eye --move`, which moves the arm to poses from which the
//! target is visible.

use super::{next_pose_options, with_distortion};
use crate::host::{Activity, CameraView, Host};
use crate::images::{self, DetectedImage};
use crate::outputs::{self, InputKind, RigOptions, RigOutput};
use crate::scan::Scan;
use calibration::BoardView;
use calibration::hand_eye::{
    ArmPlan, ArmPlanOptions, ArmStep, BoardObservation, FirstView, HandEyeInput, HandEyeOptions,
    HandEyeSample, Reach, Setup, calibrate_hand_eye,
};
use capture::config::{ArmDriver, Camera, Need, Parent, Rig};
use capture::open::{self, Devices};
use capture::{ArmCapture, ArmDuringImage, CalibrationImage, HOLDING, Stop};
use drivers::motion::OnLoss;
use kinematics::{Chain, Transform};
use messages::{BadInput, InsufficientData, Setting};
use report::calibration_report::{Photo, Photos};
use std::path::Path;
use targets::{GrayImage, TargetSpec};

/// Largest change of a joint from the start, radians. A user who has checked the surroundings of
/// the arm expects motions near its current posture. Larger changes give more diverse poses, but
/// the elbow and the cables also reach farther.
const MAX_JOINT_CHANGE_RAD: f64 = 1.2;
/// Default of the maximum distance of the flange from its position at the start, meters. If an arm
/// was moved to its target by hand, this much space around it is usually free.
const DEFAULT_DISTANCE_M: f64 = 0.3;
/// Standard deviation of the rotation below which the result counts as accurate, degrees. It
/// corresponds to half a millimeter at a distance of half a meter.
const GOAL_DEG: f64 = 0.05;

/// How an arm moves to calibrate its camera.
#[derive(Clone, Debug)]
pub struct MotionOptions {
    /// Whether the user has confirmed that the arm may move. A simulated arm needs no confirmation.
    pub is_confirmed: bool,
    /// Maximum number of poses.
    pub max_poses: u16,
    /// Goal for the standard deviations of the camera position, millimeters. The motion ends when
    /// the standard deviations are below the goal.
    pub goal_mm: f64,
    /// Maximum distance of the flange from its position at the start, millimeters. The default
    /// (`None`) is 300. If the camera is on the flange, the default is at most half the distance to
    /// the target.
    pub max_distance_mm: Option<f64>,
}

/// An arm after it has moved.
pub struct MovedArm {
    capture: ArmCapture,
    stop: Stop,
    /// Whether the motors hold the arm after this program has ended.
    holds_on_exit: bool,
    /// Why the motion was not completed.
    failure: Option<anyhow::Error>,
}

impl MovedArm {
    /// If the motors would release the arm at the end of the program, holds the arm until Ctrl-C.
    /// Returns the result of the calibration, or the reason why the motion was not completed.
    ///
    /// # Errors
    /// Fails if the calibration or the motion failed, or if the arm has stopped because of a fault.
    pub fn finish<T>(mut self, result: anyhow::Result<T>) -> anyhow::Result<T> {
        let failure = self.failure.take();
        // The arm is held before anything is returned, because the motors of some arms release the
        // arm when this program ends.
        let held = self.hold_after(result.as_ref().err());
        match (held, failure) {
            (Err(error), None) if result.is_ok() => Err(error),
            (held, Some(failure)) => {
                // The log already contains the reason why the motion was not completed.
                outputs::log_failure(held);
                if self.holds_on_exit {
                    outputs::log_failure(result.map(|_| ()));
                }
                Err(failure)
            }
            (held, None) => {
                outputs::log_failure(held);
                result
            }
        }
    }

    /// Holds an arm whose motors would release it, until a signal. Before that, logs the error with
    /// which the program will end.
    ///
    /// # Errors
    /// Fails if the arm has stopped because of a fault.
    fn hold_after(&mut self, error: Option<&anyhow::Error>) -> anyhow::Result<()> {
        if self.holds_on_exit {
            return Ok(());
        }
        if let Some(error) = error {
            log::error!("{error:#}");
        }
        // The next Ctrl-C ends the hold in an orderly way, even if an earlier Ctrl-C has stopped
        // the motion.
        self.stop.rearm("ending; the motors no longer hold the arm");
        log::info!("{HOLDING}");
        self.capture.hold(&self.stop)
    }
}

/// The input and options of a calibration with a moving arm.
pub(super) struct Request<'a> {
    pub(super) input: &'a Path,
    pub(super) target: &'a TargetSpec,
    pub(super) rig: &'a RigOptions,
    pub(super) options: HandEyeOptions,
    pub(super) host: &'a dyn Host,
    pub(super) keeps_photos: bool,
}

impl MotionOptions {
    /// Moves the arm and takes images. `output` gets the calibration that devices report.
    pub(super) fn run(
        &self,
        request: &Request<'_>,
        output: Option<&mut RigOutput>,
    ) -> anyhow::Result<(Scan, MovedArm)> {
        let input = request.input.display();
        let flags = request.rig;
        // Everything that needs no device is checked before the arm is enabled.
        flags.check(request.input)?;
        if InputKind::of(request.input) != InputKind::Rig {
            return Err(BadInput(format!(
                "{} needs a rig file (.toml) as input; {input} is not one",
                Setting::Move
            ))
            .into());
        }
        if flags.seconds.is_some() {
            return Err(BadInput(format!(
                "{} cannot be combined with {}; limit the number of poses with {}",
                Setting::Seconds,
                Setting::Move,
                Setting::MaxPoses
            ))
            .into());
        }
        let given = Rig::load(request.input, &[])?;
        let given_camera = flags.camera_of(&given)?.clone();
        let camera = &given_camera.name;
        if given.arm.driver == ArmDriver::None {
            return Err(BadInput(format!("{}: {input}: the rig has no arm", Setting::Move)).into());
        }
        let is_simulated = flags.sim || given.arm.driver == ArmDriver::Sim;
        if !is_simulated {
            given.require_before_opening(Need::Intrinsics(camera))?;
            // Without the approximate pose of the camera, the planned motion would be arbitrary.
            if given_camera.unknown.parent_from_camera {
                return Err(BadInput(format!(
                    "camera.{camera}.parent_from_camera is missing: {} plans the motion with it; measure it to about 5 degrees and 25 mm, or calibrate without {}",
                    Setting::Move,
                    Setting::Move
                ))
                .into());
            }
            open::motion_of(&given)?;
            open::check_motion(&given)?;
            if !self.is_confirmed {
                return Err(BadInput(format!(
                    "{} moves the arm: add {} to confirm that nobody is within reach of the arm and that a hand is on the emergency stop",
                    Setting::Move,
                    Setting::EnableMotion
                ))
                .into());
            }
        }
        let activity = Activity::MoveArm { is_simulated };
        let stop = request.host.stop_requests(activity)?;
        let devices = if flags.sim {
            Devices::Sim
        } else {
            Devices::Real
        };
        // The page is opened before the arm is connected, because the user must see the planned
        // motion.
        let view = request.host.open_view(&given_camera, activity)?;
        let mut capture = ArmCapture::new(open::movable(&given, devices, camera)?)?;
        let rig = resolved(&given, capture.rig());
        if let Some(output) = output.filter(|_| !is_simulated) {
            output.set_rig(&rig);
        }
        let mut camera = flags.camera_of(&rig)?.clone();
        if request.options.estimate_intrinsics {
            camera.intrinsics = with_distortion(camera.intrinsics);
        }
        let base_or_flange_from_camera = match camera.parent {
            Parent::World => rig.base.world_from_base.inverse() * camera.parent_from_camera,
            Parent::Flange | Parent::Base => camera.parent_from_camera,
        };
        let mut images = Images {
            camera: &camera,
            base_or_flange_from_camera,
            request,
            view,
            found: Vec::new(),
            photos: Photos::new(),
        };
        let failure = self.take_images(&mut capture, &mut images, &stop).err();
        let Images {
            mut view,
            found,
            photos,
            ..
        } = images;
        view.finish();
        drop(view);
        // A simulated arm cannot fall.
        let holds_on_exit = is_simulated
            || given
                .arm
                .motion
                .as_ref()
                .is_some_and(|motion| motion.on_loss == OnLoss::Hold);
        let mut arm = MovedArm {
            capture,
            stop,
            holds_on_exit,
            failure: None,
        };
        match failure {
            // At this point, at most the first motion was tried.
            Some(error) if found.len() < 2 => {
                outputs::log_failure(arm.hold_after(Some(&error)));
                return Err(error);
            }
            Some(error) => {
                log::error!("{error:#}; calibrating with the images so far");
                arm.failure = Some(error);
            }
            None => (),
        }
        match Scan::new(rig, camera, found, photos) {
            Ok(scan) => Ok((scan, arm)),
            Err(error) => {
                outputs::log_failure(arm.hold_after(Some(&error)));
                Err(arm.failure.unwrap_or(error))
            }
        }
    }

    /// Maximum distance of the flange from its position at the start.
    ///
    /// * `distance_m`: distance of the target from the camera at the start.
    fn max_distance_m(&self, setup: Setup, distance_m: Option<f64>) -> f64 {
        match (self.max_distance_mm, setup, distance_m) {
            (Some(mm), ..) => 1e-3 * mm,
            // A camera on the flange must not reach the target.
            (None, Setup::EyeInHand, Some(distance_m)) => DEFAULT_DISTANCE_M.min(0.5 * distance_m),
            (None, ..) => DEFAULT_DISTANCE_M,
        }
    }

    /// Takes images until the plan is finished, then moves the arm back to the start. Ctrl-C stops
    /// the arm where it is.
    fn take_images(
        &self,
        capture: &mut ArmCapture,
        images: &mut Images<'_>,
        stop: &Stop,
    ) -> anyhow::Result<()> {
        // The start is the only pose that is known to be safe, so the arm returns there at the end.
        let start = capture.joints()?;
        let chain = capture.chain().clone();
        let Some(first) = capture.image(stop)? else {
            return Ok(());
        };
        let view = images.add(first)?;
        // The accuracy of joint offsets is not a goal of the plan, so the plan does not end early
        // if they are estimated.
        let goal_mm = if images.request.options.estimate_joint_offsets {
            0.0
        } else {
            self.goal_mm
        };
        let goals = ArmPlanOptions {
            max_poses: self.max_poses.into(),
            goal_mm,
            goal_deg: GOAL_DEG,
        };
        let poses = next_pose_options(images.request.target);
        let first = FirstView {
            setup: images.setup(),
            view: &view,
            intrinsics: &images.camera.intrinsics,
            parent_from_camera: &images.base_or_flange_from_camera,
        };
        let distance_m = first.distance_m(&poses.center_in_board);
        let max_distance_m = self.max_distance_m(first.setup, distance_m);
        let target = distance_m.map_or_else(String::new, |m| format!("target at {m:.2} m; "));
        log::info!("{target}the flange moves at most {max_distance_m:.2} m from its start");
        capture.limit_distance(max_distance_m)?;
        let reach = Reach {
            chain: &chain,
            start: &start,
            max_joint_change: MAX_JOINT_CHANGE_RAD,
            max_distance_m,
        };
        let mut plan = ArmPlan::new(&reach, &poses, &goals, &first);
        let symmetries = images.request.target.symmetry();
        // Each round estimates the result from the images so far and chooses the pose that lowers
        // the uncertainty most. It then moves the arm there and takes an image.
        loop {
            let estimate_input = images.hand_eye_input(&chain, &symmetries);
            let estimate = calibrate_hand_eye(&estimate_input);
            if let Ok(found) = &estimate {
                let largest = |sigmas: [f64; 3]| sigmas.into_iter().fold(0.0, f64::max);
                let mm = largest(found.sigma_mm);
                let deg = largest(found.sigma_deg);
                log::info!("standard deviations so far: {mm:.2} mm, {deg:.3} degrees");
            }
            let current = capture.joints()?;
            let (joints, purpose) = match plan.next(&estimate_input, estimate.as_ref(), &current) {
                ArmStep::Move { joints, purpose } => (joints, purpose),
                ArmStep::Finished(why) => {
                    log::info!("finished: {why}");
                    break;
                }
            };
            let motion = format!("moving to pose {}: {purpose}", images.found.len() + 1);
            images.view.advise(&motion);
            // After Ctrl-C, the arm stays where it came to rest, because nobody expects another
            // motion.
            if !capture.move_to(&joints, stop)? {
                return Ok(());
            }
            let Some(image) = capture.image(stop)? else {
                return Ok(());
            };
            match images.add(image) {
                Ok(_) => plan.seen(),
                // A pose from which the target is not visible only costs time. The plan then avoids
                // poses near it.
                Err(reason) => {
                    log::info!("pose {}: {reason}", images.found.len());
                    plan.unseen();
                }
            }
        }
        images.view.advise("returning to the start");
        capture.move_to(&start, stop)?;
        Ok(())
    }
}

/// The given rig with the opened camera. The calibration of the camera may be stored in the device.
fn resolved(given: &Rig, opened: &Rig) -> Rig {
    let mut rig = given.clone();
    for camera in &mut rig.cameras {
        if let Some(resolved) = opened
            .cameras
            .iter()
            .find(|other| other.name == camera.name)
        {
            // A rig that was simulated with `--sim` keeps its real drivers when it is written.
            let driver = camera.driver;
            *camera = Camera {
                driver,
                ..resolved.clone()
            };
        }
    }
    rig
}

/// The sample of an image in which the target is visible.
fn sample_of((image, arm): &(DetectedImage, Option<ArmDuringImage>)) -> Option<HandEyeSample> {
    let board = image.board.as_ref().ok()?;
    let arm = arm.as_ref()?;
    Some(HandEyeSample {
        name: image.name.clone(),
        base_from_flange: arm.base_from_flange,
        board: BoardObservation::View(board.view.clone()),
        joints: Some(arm.joints.clone()),
    })
}

/// The images so far.
struct Images<'a> {
    camera: &'a Camera,
    base_or_flange_from_camera: Transform,
    request: &'a Request<'a>,
    view: Box<dyn CameraView>,
    found: Vec<(DetectedImage, Option<ArmDuringImage>)>,
    photos: Photos,
}

impl Images<'_> {
    /// Detects the target in an image. Fails if the target is not visible.
    fn add(&mut self, image: CalibrationImage) -> Result<BoardView, InsufficientData> {
        let n = self.found.len() + 1;
        let CalibrationImage {
            size_px, gray, arm, ..
        } = image;
        let name = format!("pose {n}");
        let board = images::detect_in_gray(
            GrayImage {
                size_px,
                pixels: &gray,
            },
            &name,
            self.request.target,
        );
        let found = match &board {
            Ok(board) => {
                log::info!("pose {n}: {} corners", board.view.points.len());
                Ok(board.view.clone())
            }
            Err(reason) if n == 1 => Err(InsufficientData(format!(
                "the target is not visible at the start: {reason}; move the arm so that the camera sees the whole target, then start again"
            ))),
            Err(reason) => Err(InsufficientData(format!(
                "the target is not visible: {reason}"
            ))),
        };
        self.view
            .show_searched(size_px, &gray, board.as_ref().ok().map(|board| &board.view));
        if self.request.keeps_photos {
            self.photos.insert(
                name.clone(),
                Photo::Gray {
                    size_px,
                    pixels: gray,
                },
            );
        }
        self.found.push((DetectedImage { name, board }, arm));
        found
    }

    fn setup(&self) -> Setup {
        if self.camera.parent == Parent::Flange {
            Setup::EyeInHand
        } else {
            Setup::EyeToHand
        }
    }

    /// Input of the calibration so far.
    fn hand_eye_input<'a>(
        &self,
        chain: &'a Chain,
        symmetries: &'a [Transform],
    ) -> HandEyeInput<'a> {
        HandEyeInput {
            setup: self.setup(),
            samples: self.found.iter().filter_map(sample_of).collect(),
            intrinsics: Some(self.camera.intrinsics.clone()),
            intrinsics_covariance: None, // Further poses do not reduce this effect.
            board_symmetries: symmetries,
            chain: Some(chain),
            options: ArmPlan::estimate_options(&self.request.options),
        }
    }
}
