//! Images of a target from a recording or from the devices of a rig, as input of `calibrate
//! intrinsics` and `calibrate hand-eye`.

use crate::guide::{Guide, Purpose};
use crate::host::{Activity, Host};
use crate::images::{self, DetectedImage, OtherSize};
use crate::lens::covariance_of;
use crate::outputs::{InputKind, RigOptions, RigOutput};
use calibration::BoardView;
use calibration::hand_eye::{
    BoardObservation, FlangeMotion, HandEyeSample, Setup, corners_at_mid_exposure,
};
use capture::config::{ArmDriver, Camera, Need, Override, Parent, Rig};
use capture::open::{self, Devices, Opened};
use capture::{
    ArmDuringImage, CalibrationImage, CalibrationImages, StampClock, calibration_images,
};
use kinematics::{Chain, Intrinsics, Stamp, Transform};
use messages::{BadInput, InsufficientData, Setting};
use nalgebra::DMatrix;
use report::calibration_report::{Photo, Photos, Unused};
use session::{ReadProgress, corrected_rig};
use std::ops::ControlFlow;
use std::path::Path;
use targets::TargetSpec;

/// Time for which devices are read if no flag limits it, seconds. This time is sufficient for about
/// twenty poses of an arm or target that is moved by hand.
const DEFAULT_SECS: f64 = 30.0;
/// Maximum predicted image motion, pixels. The motion is predicted over the readout time, the
/// exposure time and the uncertainty of the stamp. Corners are corrected for the motion during the
/// readout, but the correction is only as accurate as the velocity. A smaller value rejects images
/// of slow motions. A larger value accepts blurred corners.
pub(crate) const MAX_SHIFT_PX: f64 = 3.0;

/// Images of one camera that were searched for a target.
pub(crate) struct Scan {
    rig: Rig,
    camera: Camera,
    setup: Setup,
    /// Pose of the camera on the flange or in the base, from the rig file.
    parent_from_camera: Transform,
    chain: Option<Chain>,
    images: Vec<(DetectedImage, Option<ArmDuringImage>)>,
    /// The images, if they were requested.
    photos: Photos,
    /// Why there are no images.
    pub(crate) no_images: Option<String>,
    /// Damage of the recording.
    pub(crate) warnings: Vec<String>,
    /// Why images were not saved, although this was requested.
    pub(crate) save_error: Option<anyhow::Error>,
}

/// What to do while images are read.
#[derive(Clone, Copy)]
pub(crate) struct ScanOptions<'a> {
    /// Receives the progress and may request a stop.
    pub(crate) host: &'a dyn Host,
    /// Keeps the images for a report.
    pub(crate) keeps_photos: bool,
    /// What is calibrated. Hand-eye calibration needs an arm.
    pub(crate) purpose: Purpose,
}

impl RigOptions {
    /// Reads a recording or the devices of a rig. Returns `None` if the input is neither.
    ///
    /// * `output`: gets the calibration that devices report.
    pub(crate) fn read(
        &self,
        input: &Path,
        target: Option<&TargetSpec>,
        options: ScanOptions<'_>,
        output: Option<&mut RigOutput>,
    ) -> anyhow::Result<Option<Scan>> {
        self.check(input)?;
        let kind = InputKind::of(input);
        // Image files and samples files are read by the caller.
        if kind == InputKind::Files {
            return Ok(None);
        }
        session::expect(input)?;
        let Some(target) = target else {
            let setting = Setting::Target;
            return Err(BadInput(format!(
                "{}: {setting} is required with a recording or rig file, for example {setting} charuco:5x7:34mm:26mm:5X5_100",
                input.display()
            ))
            .into());
        };
        let opened = match kind {
            InputKind::Rig => self.open_devices(input, options.purpose)?,
            InputKind::Recording | InputKind::Files => {
                let rig = self
                    .rig
                    .as_deref()
                    .map(|file| Rig::load(file, &[]))
                    .transpose()?;
                open::recording(input, rig, &[])?
            }
        };
        // This is the rig after its devices were opened. Cameras may have reported calibration that
        // the file lacks.
        let rig = opened.rig.clone();
        if options.purpose == Purpose::HandEye && rig.arm.driver == ArmDriver::None {
            return Err(BadInput(format!(
                "{}: the rig has no arm, which hand-eye calibration needs; without an arm, use `fieldrig calibrate intrinsics`",
                input.display()
            ))
            .into());
        }
        // The calibration that a simulated camera reports is not the calibration of the real
        // camera.
        if let Some(output) = output.filter(|_| kind == InputKind::Rig && !self.sim) {
            output.set_rig(&rig);
        }
        let mut camera = self.camera_of(&rig)?.clone();
        match options.purpose {
            // Advice about the next image needs only an approximate lens.
            Purpose::Lens => camera.intrinsics = open::approximate_intrinsics(&camera),
            Purpose::HandEye => rig.require(Need::Intrinsics(&camera.name))?,
        }
        let (found, detected) = self.images(opened, &camera, target, options)?;
        let warnings = Vec::from_iter(found.damage.clone());
        for warning in &warnings {
            log::warn!("{warning}");
        }
        log::info!("{}", found.summary());
        let no_images = found
            .images
            .is_empty()
            .then(|| no_images(input, &rig, &camera, &found));
        // If devices were read, the target was already detected during reading.
        let detected = detected.unwrap_or_else(|| {
            images::detect_each(&found.images, options.host, |image| {
                images::detect_in_image(image, target)
            })
        });
        let scan = Scan::of_images(rig, camera, found, detected, options)?;
        Ok(Some(Scan {
            no_images,
            warnings,
            ..scan
        }))
    }

    fn open_devices(&self, rig_file: &Path, purpose: Purpose) -> anyhow::Result<Opened> {
        // In lockstep, the result does not depend on the speed of this computer.
        let overrides = if self.sim {
            vec![Override::new("sim.lockstep", true)]
        } else {
            Vec::new()
        };
        let rig = Rig::load(rig_file, &overrides)?;
        let camera = &self.camera_of(&rig)?.name;
        // A missing lens is reported before the devices start. The simulator assumes one.
        if purpose == Purpose::HandEye && !self.sim {
            rig.require_before_opening(Need::Intrinsics(camera))?;
        }
        open::rig(
            rig,
            if self.sim {
                Devices::Sim
            } else {
                Devices::Real
            },
        )
    }

    /// Reads images. If they come from devices, the target is detected at once, so that advice can
    /// be shown.
    fn images(
        &self,
        opened: Opened,
        camera: &Camera,
        target: &TargetSpec,
        options: ScanOptions<'_>,
    ) -> anyhow::Result<(CalibrationImages, Option<Vec<DetectedImage>>)> {
        let host = options.host;
        let activity = Activity::ReadImages;
        let stop = host.stop_requests(activity)?;
        // Only the stamps of recordings are unrelated to this computer's clock.
        let is_live = !matches!(opened.stamp_clock, StampClock::Unrelated);
        let view = is_live
            .then(|| host.open_view(camera, activity))
            .transpose()?;
        let mut guide = view.map(|view| Guide::new(target, camera, options.purpose, view));
        // A recording has an end.
        let limit_secs = if is_live {
            self.seconds.unwrap_or(DEFAULT_SECS)
        } else {
            f64::INFINITY
        };
        let mut first: Option<Stamp> = None;
        let found = calibration_images(opened, &camera.name, MAX_SHIFT_PX, |sample, images| {
            match &mut guide {
                Some(guide) => guide.update(sample, images),
                None => host.on_progress(ReadProgress {
                    noun: "images",
                    n_done: images.len(),
                    n_all: None,
                }),
            }
            // The time is measured by stamps, because a simulation does not run in real time.
            let since_first = sample
                .stamp()
                .secs_since(*first.get_or_insert(sample.stamp()));
            if since_first > limit_secs || stop.requested() {
                ControlFlow::Break(())
            } else {
                ControlFlow::Continue(())
            }
        });
        host.on_progress_end();
        let found = found?;
        let detected = guide.map(|guide| guide.finish(&found.images));
        Ok((found, detected))
    }
}

fn no_images(input: &Path, rig: &Rig, camera: &Camera, found: &CalibrationImages) -> String {
    let input = input.display();
    let name = &camera.name;
    match (found.n_read, found.n_fast) {
        (0, _) => {
            let names: Vec<&str> = rig.cameras.iter().map(|camera| &*camera.name).collect();
            let names = messages::listed(&names, "and");
            format!(
                "{input}: no image of camera {name:?}; the cameras of the rig are {names}: choose one with {}",
                Setting::Camera
            )
        }
        (_, 0) => format!(
            "{input}: camera {name:?}: none of {} images can be decoded and has joint readings at its stamp; check the clocks of arm and camera, and join.max_gap_millis",
            found.n_read
        ),
        (_, n) => format!(
            "{input}: camera {name:?}: the arm moves too fast in {n} images (more than {MAX_SHIFT_PX} px); stop it at each pose"
        ),
    }
}

impl Scan {
    fn of_images(
        rig: Rig,
        camera: Camera,
        found: CalibrationImages,
        detected: Vec<DetectedImage>,
        options: ScanOptions<'_>,
    ) -> anyhow::Result<Self> {
        let mut photos = Photos::new();
        let mut images = Vec::new();
        for (image, detected) in found.images.into_iter().zip(detected) {
            let CalibrationImage {
                size_px, gray, arm, ..
            } = image;
            if options.keeps_photos {
                photos.insert(
                    detected.name.clone(),
                    Photo::Gray {
                        size_px,
                        pixels: gray,
                    },
                );
            }
            images.push((detected, arm));
        }
        Self::new(rig, camera, images, photos)
    }

    /// A scan of images that were searched for the target. If there is an arm, each image comes
    /// with the state of the arm.
    pub(crate) fn new(
        rig: Rig,
        camera: Camera,
        images: Vec<(DetectedImage, Option<ArmDuringImage>)>,
        photos: Photos,
    ) -> anyhow::Result<Self> {
        // In hand-eye calibration, a camera is attached to the flange or to the base. A camera in
        // the world counts as attached to the base, because the base is fixed.
        let base_from_world = rig.base.world_from_base.inverse();
        let (setup, parent_from_camera) = match camera.parent {
            Parent::Flange => (Setup::EyeInHand, camera.parent_from_camera),
            Parent::Base => (Setup::EyeToHand, camera.parent_from_camera),
            Parent::World => (
                Setup::EyeToHand,
                base_from_world * camera.parent_from_camera,
            ),
        };
        // Without an arm, as in the calibration of a lens, no robot description is needed.
        let chain = images
            .iter()
            .any(|(_, arm)| arm.is_some())
            .then(|| open::chain_of(&rig))
            .transpose()?;
        Ok(Self {
            rig,
            camera,
            setup,
            parent_from_camera,
            chain,
            images,
            photos,
            no_images: None,
            warnings: Vec::new(),
            save_error: None,
        })
    }

    pub(crate) fn setup(&self) -> Setup {
        self.setup
    }

    pub(crate) fn chain(&self) -> Option<&Chain> {
        self.chain.as_ref()
    }

    pub(crate) fn intrinsics(&self) -> &Intrinsics {
        &self.camera.intrinsics
    }

    /// Covariance of the intrinsics, if the rig file contains it.
    pub(crate) fn intrinsics_covariance(&self) -> Result<Option<DMatrix<f64>>, BadInput> {
        let Camera {
            name,
            intrinsics,
            intrinsics_covariance,
            ..
        } = &self.camera;
        covariance_of(intrinsics_covariance, intrinsics)
            .map_err(|error| BadInput(format!("camera.{name}.intrinsics_covariance: {error}")))
    }

    /// A board size that differs from the target's, if several images show it.
    pub(crate) fn other_size(&self, target: &TargetSpec) -> Option<OtherSize> {
        images::other_size(self.images.iter().map(|(image, _)| image), target)
    }

    pub(crate) fn n_images(&self) -> usize {
        self.images.len()
    }

    /// Takes the images, if they were requested.
    pub(crate) fn take_photos(&mut self) -> Photos {
        std::mem::take(&mut self.photos)
    }

    /// An error if no image can be used.
    pub(crate) fn check(&self) -> Result<(), InsufficientData> {
        self.no_images
            .clone()
            .map_or(Ok(()), |reason| Err(InsufficientData(reason)))
    }

    /// Converts an estimated pose of the camera to the `parent_from_camera` of the rig file. The
    /// estimated pose is relative to the flange or base. In the rig file, the parent may also be
    /// the world.
    pub(crate) fn rig_pose(&self, parent_from_camera: &Transform) -> Transform {
        corrected_rig::parent_from_camera(&self.rig.base, self.camera.parent, parent_from_camera)
    }

    /// Whether the rows of an image are exposed one after another, so that the corrections of
    /// corners depend on the pose of the camera.
    pub(crate) fn is_rolling_shutter(&self) -> bool {
        self.camera
            .readout_micros
            .is_some_and(|micros| micros > 0.0)
    }

    /// The images, with corners corrected for a rolling shutter.
    pub(crate) fn detected(&mut self) -> Vec<DetectedImage> {
        // The images are moved out of `self`, because the correction needs the rest of `self`.
        let images = std::mem::take(&mut self.images);
        images
            .into_iter()
            .map(|(mut image, arm)| {
                if let (Ok(board), Some(arm)) = (&mut image.board, arm) {
                    board.view = self.at_mid_exposure(&board.view, &arm, &self.parent_from_camera);
                }
                image
            })
            .collect()
    }

    /// Samples for hand-eye calibration. Also returns the images in which no target was found, with
    /// the reasons. `parent_from_camera` is the pose of the camera, if it is known better than in
    /// the rig file.
    pub(crate) fn samples(
        &self,
        parent_from_camera: Option<&Transform>,
    ) -> (Vec<HandEyeSample>, Vec<Unused>) {
        let mut samples = Vec::new();
        let mut unused = Vec::new();
        for (image, arm) in &self.images {
            let name = image.name.clone();
            match (&image.board, arm) {
                (Ok(board), Some(arm)) => {
                    // The correction for a rolling shutter depends on the pose of the camera.
                    let camera_pose = parent_from_camera.unwrap_or(&self.parent_from_camera);
                    let view = self.at_mid_exposure(&board.view, arm, camera_pose);
                    samples.push(HandEyeSample {
                        name,
                        base_from_flange: arm.base_from_flange,
                        board: BoardObservation::View(view),
                        joints: Some(arm.joints.clone()),
                    });
                }
                (Err(reason), _) => unused.push(reason.unused(name)),
                (_, None) => {
                    let reason = "the robot has no arm".to_owned();
                    unused.push(Unused {
                        name,
                        reason,
                        is_unreadable: false,
                    });
                }
            }
        }
        (samples, unused)
    }

    fn at_mid_exposure(
        &self,
        view: &BoardView,
        arm: &ArmDuringImage,
        parent_from_camera: &Transform,
    ) -> BoardView {
        let motion = FlangeMotion {
            setup: self.setup,
            base_from_flange: arm.base_from_flange,
            base_from_flange_at: &|row_frac| arm.base_from_flange_at(row_frac),
            parent_from_camera: *parent_from_camera,
        };
        let points = corners_at_mid_exposure(&self.camera.intrinsics, &view.points, &motion);
        BoardView {
            points,
            ..view.clone()
        }
    }
}
