//! Images of a target from a recording or from the devices of a rig, as input of `calibrate intrinsics` and `calibrate
//! hand-eye`.

use super::images::{self, DetectedImage};
use crate::exit::{BadArgument, InsufficientData};
use crate::{print, signals};
use calibration::BoardView;
use calibration::hand_eye::{BoardObservation, FlangeMotion, HandEyeSample, Setup, corners_at_mid_exposure};
use capture::config::{Camera, Override, Parent, Rig};
use capture::open::{self, Devices, Opened};
use capture::{ArmDuringImage, CalibrationImages, calibration_images};
use drivers::Sample;
use kinematics::{Chain, Intrinsics, Stamp, Transform};
use std::path::Path;
use targets::{GrayImage, TargetSpec};

/// Time for which devices are read if no flag limits it, seconds.
const DEFAULT_SECS: f64 = 30.0;
/// Images that move further during the exposure of all rows are not used, pixels.
const MAX_SHIFT_PX: f64 = 3.0;

/// Flags for recordings and rigs.
#[derive(Debug, clap::Args)]
pub(super) struct ScanFlags {
    /// With a recording or rig file: the camera to calibrate [default: the only one]
    #[arg(long, value_name = "NAME")]
    camera: Option<String>,
    /// With a rig file: simulate all devices
    #[arg(long)]
    sim: bool,
    /// With a rig file: read the devices for S seconds [default: 30]
    #[arg(long, value_name = "S", value_parser = super::super::number_in_range(1.0..=3600.0))]
    seconds: Option<f64>,
}

/// Images of one camera in which a target was searched.
pub(super) struct Scan {
    setup: Setup,
    camera: Camera,
    /// Pose of the camera on the flange or in the base, from the rig file.
    parent_from_camera: Transform,
    chain: Option<Chain>,
    images: Vec<(DetectedImage, Option<ArmDuringImage>)>,
}

impl ScanFlags {
    /// Reads a recording, or the devices of a rig. `None` if the input is neither.
    pub(super) fn read(
        &self,
        input: &Path,
        target: Option<&TargetSpec>,
        is_hidden: bool,
    ) -> anyhow::Result<Option<Scan>> {
        let is_rig = super::scene::is_rig_file(input);
        if !is_rig && (self.sim || self.seconds.is_some()) {
            return Err(BadArgument("--sim and --seconds need a rig file (.toml) as input".into()).into());
        }
        let is_recording = session::run_folder::is_recording(input);
        if !is_rig && !is_recording {
            return match self.camera {
                Some(_) => Err(BadArgument("--camera needs a recording or rig file as input".into()).into()),
                None => Ok(None),
            };
        }
        session::expect(input)?;
        let Some(target) = target else {
            let example = "such as charuco:5x7:34mm:26mm:5X5_100";
            return Err(BadArgument(format!("{}: --target is missing, {example}", input.display())).into());
        };
        let opened = if is_recording { open::recording(input, None, &[])? } else { self.open_devices(input)? };
        let rig = opened.rig.clone();
        let camera = self.camera_of(&rig)?.clone();
        let found = self.images(opened, &camera.name, is_hidden)?;
        if let Some(damage) = &found.damage {
            log::warn!("{damage}");
        }
        log::info!(
            "{} of {} images used: the others show the same pose, the arm moves too fast in {}, and {} have no robot pose",
            found.images.len(),
            found.n_read,
            found.n_fast,
            found.n_unusable
        );
        if found.images.is_empty() {
            return Err(InsufficientData(no_images(input, &camera, &found)).into());
        }
        Ok(Some(Scan::detect(&rig, camera, found, target, is_hidden)?))
    }

    fn open_devices(&self, rig_file: &Path) -> anyhow::Result<Opened> {
        let overrides = if self.sim { vec![Override::new("sim.lockstep", true)] } else { Vec::new() };
        let rig = Rig::load(rig_file, &overrides)?;
        Ok(open::rig(rig, if self.sim { Devices::Sim } else { Devices::Real })?)
    }

    fn camera_of<'a>(&self, rig: &'a Rig) -> Result<&'a Camera, BadArgument> {
        let names: Vec<&str> = rig.cameras.iter().map(|camera| &*camera.name).collect();
        let names = names.join(", ");
        match (&self.camera, &rig.cameras[..]) {
            (Some(name), cameras) => cameras
                .iter()
                .find(|camera| *camera.name == **name)
                .ok_or_else(|| BadArgument(format!("--camera {name}: the rig has {names}"))),
            (None, [only]) => Ok(only),
            (None, _) => Err(BadArgument(format!("the rig has several cameras; choose one with --camera: {names}"))),
        }
    }

    fn images(&self, opened: Opened, camera: &str, is_hidden: bool) -> anyhow::Result<CalibrationImages> {
        let bar = print::bar(None, "{spinner} {pos} images", is_hidden);
        let stop = signals::stop_on_signals_logging("calibrating with the images so far; Ctrl-C again exits at once")?;
        let is_live = !matches!(opened.stamp_clock, capture::StampClock::Unrelated);
        let limit_secs = if is_live { self.seconds.unwrap_or(DEFAULT_SECS) } else { f64::INFINITY };
        let mut first: Option<Stamp> = None;
        let is_end = |sample: &Sample| {
            let since_first = sample.stamp().secs_since(*first.get_or_insert(sample.stamp()));
            since_first > limit_secs || stop.requested()
        };
        let found = calibration_images(opened, camera, MAX_SHIFT_PX, is_end, &|n| bar.set_position(n as u64));
        bar.finish_and_clear();
        Ok(found?)
    }
}

fn no_images(input: &Path, camera: &Camera, found: &CalibrationImages) -> String {
    let (input, name) = (input.display(), &camera.name);
    match (found.n_read, found.n_fast) {
        (0, _) => format!("{input}: no image of camera {name:?}"),
        (_, 0) => format!("{input}: camera {name:?}: no joint readings at the stamps of {} images", found.n_read),
        (_, n) => format!(
            "{input}: camera {name:?}: the arm moves too fast in {n} images (more than {MAX_SHIFT_PX} px); stop it at each pose"
        ),
    }
}

impl Scan {
    fn detect(
        rig: &Rig,
        camera: Camera,
        found: CalibrationImages,
        target: &TargetSpec,
        is_hidden: bool,
    ) -> anyhow::Result<Self> {
        let detected = images::detect_each(&found.images, is_hidden, |image| {
            let name = format!("image at {:.3} s", image.secs);
            let gray = GrayImage { size_px: image.size_px, pixels: &image.gray };
            let board = images::detect_in_gray(gray, &name, target).map_err(|error| format!("{error:#}"));
            DetectedImage { name, board }
        });
        let base_from_world = rig.base.world_from_base.inverse();
        let (setup, parent_from_camera) = match camera.parent {
            Parent::Flange => (Setup::EyeInHand, camera.parent_from_camera),
            Parent::Base => (Setup::EyeToHand, camera.parent_from_camera),
            Parent::World => (Setup::EyeToHand, base_from_world * camera.parent_from_camera),
        };
        let arms: Vec<_> = found.images.into_iter().map(|image| image.arm).collect();
        let chain = arms.iter().any(Option::is_some).then(|| open::chain_of(rig)).transpose()?;
        Ok(Self { setup, camera, parent_from_camera, chain, images: detected.into_iter().zip(arms).collect() })
    }

    pub(super) fn setup(&self) -> Setup {
        self.setup
    }

    pub(super) fn chain(&self) -> Option<&Chain> {
        self.chain.as_ref()
    }

    pub(super) fn intrinsics(&self) -> &Intrinsics {
        &self.camera.intrinsics
    }

    pub(super) fn n_images(&self) -> usize {
        self.images.len()
    }

    /// The images, with corners corrected for a rolling shutter.
    pub(super) fn detected(&self) -> Vec<DetectedImage> {
        let corrected = |(image, arm): &(DetectedImage, Option<ArmDuringImage>)| {
            let mut image = image.clone();
            if let (Ok(board), Some(arm)) = (&mut image.board, arm) {
                board.view = self.at_mid_exposure(&board.view, arm, &self.parent_from_camera);
            }
            image
        };
        self.images.iter().map(corrected).collect()
    }

    /// Samples for hand-eye calibration, and the images without target with the reasons. `parent_from_camera`: pose of
    /// the camera, if it is known better than in the rig file.
    pub(super) fn samples(
        &self,
        parent_from_camera: Option<&Transform>,
    ) -> (Vec<HandEyeSample>, Vec<(String, String)>) {
        let (mut samples, mut unused) = (Vec::new(), Vec::new());
        for (image, arm) in &self.images {
            let name = image.name.clone();
            match (&image.board, arm) {
                (Ok(board), Some(arm)) => {
                    let camera_pose = parent_from_camera.unwrap_or(&self.parent_from_camera);
                    let view = self.at_mid_exposure(&board.view, arm, camera_pose);
                    samples.push(HandEyeSample {
                        name,
                        base_from_flange: arm.base_from_flange,
                        board: BoardObservation::View(view),
                        joints: Some(arm.joints.clone()),
                    });
                }
                (Err(reason), _) => unused.push((name, reason.clone())),
                (_, None) => unused.push((name, "the robot has no arm".to_owned())),
            }
        }
        (samples, unused)
    }

    fn at_mid_exposure(&self, view: &BoardView, arm: &ArmDuringImage, parent_from_camera: &Transform) -> BoardView {
        let motion = FlangeMotion {
            setup: self.setup,
            base_from_flange: arm.base_from_flange,
            base_from_flange_at: &|row_frac| arm.base_from_flange_at(row_frac),
            parent_from_camera: *parent_from_camera,
        };
        let points = corners_at_mid_exposure(&self.camera.intrinsics, &view.points, &motion);
        BoardView { points, ..view.clone() }
    }
}
