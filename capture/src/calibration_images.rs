//! Images of one camera for calibration with a target. They come from devices or a recording, and
//! have the pose of the flange.
//!
//! An image is kept if the robot is slow and its pose differs from the poses of all images kept
//! before. If the robot has no arm, images are kept at a fixed interval.

#[cfg(test)]
mod tests;

use crate::config::{ArmDriver, Camera, Rig};
use crate::open::{Opened, approximate_intrinsics, chain_of};
use crate::stamp_clock::StampClock;
use anyhow::bail;
use drivers::{Image, Sample};
use image::{DynamicImage, RgbImage};
use kinematics::{Chain, HistoryError, JointHistory, JointState, Stamp, Transform, transform};
use messages::BadInput;
use std::collections::VecDeque;
use std::ops::ControlFlow;
use std::time::Duration;

/// Maximum number of joint readings kept. At 1 kHz, they cover 20 s.
const MAX_READINGS: usize = 20_000;
/// Maximum number of images that wait for joint readings. If the arm stops reporting, older images
/// are dropped, so that memory stays bounded.
const MAX_WAITING: usize = 64;
/// Maximum number of images kept. Calibration needs tens of images. More images only cost memory
/// and time.
const MAX_IMAGES: usize = 300;
/// Interval between images of a robot without an arm, seconds. With a shorter interval, consecutive
/// images of a target that is held by hand show nearly the same view.
const INTERVAL_SECS: f64 = 0.5;
/// Maximum age of an image that the caller may choose. It is longer than the latency of cameras and
/// shorter than the time in which a person notices that the decision is about an earlier moment.
const MAX_AGE: Duration = Duration::from_millis(250);
/// Assumed standard deviation of image stamps, seconds. The check of the speed uses it. With a
/// larger value, only images of slower motions are kept.
const STAMP_SIGMA_SECS: f64 = 0.002;

/// A gray image.
#[derive(Clone, Debug)]
pub struct CalibrationImage {
    /// Time since the first sample, seconds.
    pub secs: f64,
    /// Width and height, pixels.
    pub size_px: [u32; 2],
    /// Gray values, row by row.
    pub gray: Vec<u8>,
    /// The arm during the exposure; `None` without an arm.
    pub arm: Option<ArmDuringImage>,
}

/// State of the arm while an image is exposed.
#[derive(Clone, Debug)]
pub struct ArmDuringImage {
    /// Pose of the flange at mid-exposure.
    pub base_from_flange: Transform,
    /// Pose of the flange when the first and the last row are exposed.
    pub base_from_flange_at_rows: [Transform; 2],
    /// Joint positions at mid-exposure in the order of the chain, with the offsets of the rig file.
    pub joints: Vec<f64>,
}

impl ArmDuringImage {
    /// Flange pose at the exposure of a row; `row_frac` is 0 for the first row and 1 for the last.
    pub fn base_from_flange_at(&self, row_frac: f64) -> Transform {
        let [first, last] = &self.base_from_flange_at_rows;
        transform::interpolate(first, last, row_frac)
    }
}

/// The images that were kept, and the numbers of images that were not kept, by reason.
#[derive(Debug, Default)]
pub struct CalibrationImages {
    /// The images in the order of their stamps.
    pub images: Vec<CalibrationImage>,
    /// Number of color images of the camera.
    pub n_read: usize,
    /// Number of images during which the arm moved too fast.
    pub n_fast: usize,
    /// Number of images that have no joint readings at their stamp or do not decode.
    pub n_unusable: usize,
    /// Description of the damage, if the recording ends early.
    pub damage: Option<String>,
}

impl CalibrationImages {
    /// Describes how many images are used. For each reason, also says how many images are not used.
    #[must_use]
    pub fn summary(&self) -> String {
        let n_used = self.images.len();
        let n_similar = self
            .n_read
            .saturating_sub(n_used + self.n_fast + self.n_unusable);
        let similar = if n_used < MAX_IMAGES {
            "similar to a used image".to_owned()
        } else {
            format!("similar to a used image or beyond the maximum of {MAX_IMAGES}")
        };
        let unused: Vec<String> = [
            (n_similar, similar.as_str()),
            (self.n_fast, "during a fast motion of the arm"),
            (self.n_unusable, "without joint readings or damaged"),
        ]
        .into_iter()
        .filter(|(n, _)| *n > 0)
        .map(|(n, reason)| format!("{n} {reason}"))
        .collect();
        let used = format!("{n_used} of {} images used", self.n_read);
        if unused.is_empty() {
            used
        } else {
            format!("{used}; not used: {}", unused.join(", "))
        }
    }
}

/// Reads the images of a camera until `on_sample` breaks or the samples end.
///
/// * `max_shift_px`: maximum predicted image motion, for a scene at `join.default_depth_m`. The
///   motion is that during the readout, the exposure and the error of the stamp together. Images
///   with more motion are not kept.
/// * `on_sample`: is called with each sample before the sample is used. It also receives the images
///   that were kept so far.
///
/// # Errors
///
/// If the rig has no such camera, its base moves, or a device fails.
pub fn calibration_images(
    opened: Opened,
    camera: &str,
    max_shift_px: f64,
    on_sample: impl FnMut(&Sample, &[CalibrationImage]) -> ControlFlow<()>,
) -> anyhow::Result<CalibrationImages> {
    read(opened, camera, max_shift_px, on_sample, None)
}

/// Reads the images of a camera until `on_sample` breaks or the samples end, and keeps those that
/// the caller chooses.
///
/// Images during a fast motion of the arm are not offered. If the caller is slower than a real
/// camera, images that have become too old are not offered either, so that a person who moves a
/// target sees what is decided now.
///
/// * `max_shift_px`, `on_sample`: as for [`calibration_images`].
/// * `choose`: is called with each image, and returns whether it is kept.
///
/// # Errors
///
/// As for [`calibration_images`].
pub fn chosen_calibration_images(
    opened: Opened,
    camera: &str,
    max_shift_px: f64,
    on_sample: impl FnMut(&Sample, &[CalibrationImage]) -> ControlFlow<()>,
    choose: &mut dyn FnMut(&CalibrationImage) -> bool,
) -> anyhow::Result<CalibrationImages> {
    read(opened, camera, max_shift_px, on_sample, Some(choose))
}

fn read(
    opened: Opened,
    camera: &str,
    max_shift_px: f64,
    mut on_sample: impl FnMut(&Sample, &[CalibrationImage]) -> ControlFlow<()>,
    choose: Option<&mut dyn FnMut(&CalibrationImage) -> bool>,
) -> anyhow::Result<CalibrationImages> {
    let Opened {
        rig,
        mut source,
        damage,
        stamp_clock,
    } = opened;
    let mut reader = Reader::new(&rig, camera, max_shift_px)?;
    reader.choose = choose.map(|accepts| Choose {
        accepts,
        stamp_clock,
    });
    while let Some(sample) = source.next_sample()? {
        if on_sample(&sample, &reader.found.images).is_break() {
            break;
        }
        reader.push(sample);
    }
    // Images that still wait will never get joint readings.
    reader.found.n_unusable += reader.waiting.len();
    Ok(CalibrationImages {
        damage: damage.get().cloned(),
        ..reader.found
    })
}

/// Gray values of an image, row by row. `None` if it does not decode.
pub(crate) fn gray_of(image: &Image) -> Option<Vec<u8>> {
    let [width, height] = image.size_px;
    let rgb = RgbImage::from_raw(width, height, image.decode_rgb().ok()?)?;
    Some(DynamicImage::from(rgb).into_luma8().into_raw())
}

/// How the caller chooses images.
struct Choose<'a> {
    accepts: &'a mut dyn FnMut(&CalibrationImage) -> bool,
    stamp_clock: StampClock,
}

impl Choose<'_> {
    /// Whether an image is recent. Images of simulations and recordings wait for the caller.
    fn is_current(&self, stamp: Stamp) -> bool {
        let captured = self.stamp_clock.instant_of(stamp);
        captured.is_none_or(|captured| captured.elapsed() <= MAX_AGE)
    }
}

struct Reader<'a> {
    rig: &'a Rig,
    camera: &'a Camera,
    arm: Option<Arm>,
    /// Focal length, approximate if the lens is unknown.
    focal_px: f64,
    max_shift_px: f64,
    first: Option<Stamp>,
    /// Images whose last row is exposed after the newest joint reading.
    waiting: VecDeque<Image>,
    found: CalibrationImages,
    /// `None` if images are kept that differ from all images kept before.
    choose: Option<Choose<'a>>,
}

/// Recent joint positions.
struct Arm {
    chain: Chain,
    /// Index of each chain joint in the readings.
    order: Vec<usize>,
    joints: JointHistory,
}

impl<'a> Reader<'a> {
    fn new(rig: &'a Rig, camera: &str, max_shift_px: f64) -> anyhow::Result<Self> {
        let Some(camera) = rig.cameras.iter().find(|other| &*other.name == camera) else {
            let names: Vec<&str> = rig.cameras.iter().map(|camera| &*camera.name).collect();
            let names = if names.is_empty() {
                "none".to_owned()
            } else {
                names.join(", ")
            };
            return Err(
                BadInput(format!("the rig has no camera {camera:?}; it has {names}")).into(),
            );
        };
        if rig.has_moving_base() {
            bail!(
                "base.driver: the base moves, but calibration with a target needs a fixed base; while the base stands still, use a copy of the rig file with base.driver = \"fixed\""
            );
        }
        let arm = (rig.arm.driver != ArmDriver::None)
            .then(|| Arm::new(rig))
            .transpose()?;
        Ok(Self {
            rig,
            camera,
            arm,
            focal_px: approximate_intrinsics(camera).focal_px[0],
            max_shift_px,
            first: None,
            waiting: VecDeque::new(),
            found: CalibrationImages::default(),
            choose: None,
        })
    }

    fn push(&mut self, sample: Sample) {
        // The time of all images counts from the first sample of any device.
        self.first.get_or_insert(sample.stamp());
        match sample {
            Sample::Joints(state) => {
                if let Some(arm) = &mut self.arm {
                    arm.push(&state, &self.rig.arm.joint_offsets);
                }
            }
            Sample::Image(image) if !image.is_depth() && image.camera == self.camera.name => {
                self.found.n_read += 1;
                if self.waiting.len() == MAX_WAITING {
                    self.waiting.pop_front();
                    self.found.n_unusable += 1;
                }
                self.waiting.push_back(image);
            }
            _ => return,
        }
        // Images are processed in order. While the oldest image waits for readings, later images
        // wait as well.
        while let Some(image) = self.waiting.pop_front() {
            match self.arm_during(&image) {
                Err(HistoryError::NotYet { .. }) => {
                    self.waiting.push_front(image);
                    break;
                }
                Err(_) => self.found.n_unusable += 1,
                Ok(arm) => self.decide(&image, arm),
            }
        }
    }

    fn readout_secs(&self) -> f64 {
        1e-6 * self.camera.readout_micros.unwrap_or(0.0)
    }

    fn arm_during(&self, image: &Image) -> Result<Option<ArmDuringImage>, HistoryError> {
        let Some(arm) = &self.arm else {
            return Ok(None);
        };
        let mid = self.camera.mid_exposure(image.stamp);
        let half_secs = 0.5 * self.readout_secs();
        let [first, middle, last] =
            [-half_secs, 0.0, half_secs].map(|secs| arm.joints.at(mid.plus_secs(secs)));
        let first = first?;
        let middle = middle?;
        let last = last?;
        // Readings have as many joints as the chain.
        let forward = |joints: &JointState| arm.chain.forward(&joints.position).unwrap_or_default();
        Ok(Some(ArmDuringImage {
            base_from_flange: forward(&middle),
            base_from_flange_at_rows: [forward(&first), forward(&last)],
            joints: middle.position,
        }))
    }

    fn decide(&mut self, image: &Image, arm: Option<ArmDuringImage>) {
        let secs = self
            .first
            .map_or(0.0, |first| image.stamp.secs_since(first));
        // Cheap tests come first, so the pose is compared before the image is decoded.
        let is_candidate = match &self.choose {
            Some(choose) => choose.is_current(image.stamp),
            None => self.is_different(secs, arm.as_ref()),
        };
        if self.found.images.len() >= MAX_IMAGES || !is_candidate {
            return;
        }
        if arm
            .as_ref()
            .is_some_and(|arm| self.shift_px(image, arm) > self.max_shift_px)
        {
            self.found.n_fast += 1;
            return;
        }
        let Some(gray) = gray_of(image) else {
            self.found.n_unusable += 1;
            return;
        };
        let image = CalibrationImage {
            secs,
            size_px: image.size_px,
            gray,
            arm,
        };
        let is_kept = match &mut self.choose {
            Some(choose) => (choose.accepts)(&image),
            None => true,
        };
        if is_kept {
            self.found.images.push(image);
        }
    }

    /// Whether the pose differs from the poses of all images kept. Without an arm, returns whether
    /// the last image is old enough.
    fn is_different(&self, secs: f64, arm: Option<&ArmDuringImage>) -> bool {
        let Some(arm) = arm else {
            return self
                .found
                .images
                .last()
                .is_none_or(|last| secs - last.secs >= INTERVAL_SECS);
        };
        // The pose is compared with those of all images, because a robot often returns to a pose.
        !self
            .found
            .images
            .iter()
            .filter_map(|image| image.arm.as_ref())
            .any(|other| self.is_near(other, arm))
    }

    /// Whether two poses of the flange are closer than the minimum spacing of keyframes.
    fn is_near(&self, one: &ArmDuringImage, other: &ArmDuringImage) -> bool {
        let join = &self.rig.join;
        let motion = one.base_from_flange.inverse() * other.base_from_flange;
        motion.translation.vector.norm() < join.min_translation_m
            && motion.rotation.angle() < join.min_rotation_rad
    }

    /// Predicted image motion during the readout, the exposure and the error of the stamp together,
    /// pixels. It is an upper bound.
    fn shift_px(&self, image: &Image, arm: &ArmDuringImage) -> f64 {
        let [first, last] = &arm.base_from_flange_at_rows;
        let readout_secs = self.readout_secs();
        let exposure_secs = image
            .exposure_secs
            .or(self.camera.exposure_micros.map(|micros| 1e-6 * micros));
        let (motion, secs) = match (&self.arm, readout_secs > 0.0) {
            // Without a readout time, the speed is computed from the motion during a short time
            // before the image.
            (Some(history), false) => {
                let earlier = self
                    .camera
                    .mid_exposure(image.stamp)
                    .plus_secs(-STAMP_SIGMA_SECS);
                let joints = history
                    .joints
                    .at(earlier)
                    .map(|joints| joints.position)
                    .unwrap_or_default();
                let before = history
                    .chain
                    .forward(&joints)
                    .unwrap_or(arm.base_from_flange);
                (before.inverse() * arm.base_from_flange, STAMP_SIGMA_SECS)
            }
            _ => (first.inverse() * last, readout_secs),
        };
        // A rotation moves every pixel by about the focal length times its angle. A translation
        // acts like a rotation by the translation divided by the distance. The sum is an upper
        // bound for both.
        let focal_px = self.focal_px;
        let angle = motion.rotation.angle()
            + motion.translation.vector.norm() / self.rig.join.default_depth_m;
        // The speed in pixels per second is multiplied by the time span in which a pixel may have
        // been exposed.
        focal_px * angle / secs * (readout_secs + exposure_secs.unwrap_or(0.0) + STAMP_SIGMA_SECS)
    }
}

impl Arm {
    fn new(rig: &Rig) -> anyhow::Result<Self> {
        let chain = chain_of(rig)?;
        let order = chain.order_in(&rig.arm.joints)?;
        let max_gap = Duration::from_secs_f64(rig.join.max_gap_millis * 1e-3);
        Ok(Self {
            chain,
            order,
            joints: JointHistory::new(max_gap, MAX_READINGS),
        })
    }

    /// Adds a reading in the order of the device. Invalid readings are ignored, and images at their
    /// stamps are not used.
    fn push(&mut self, state: &JointState, offsets: &[f64]) {
        let position = self.order.iter().map(|ix| {
            let offset = offsets.get(*ix).copied().unwrap_or(0.0);
            state.position.get(*ix).map(|reading| reading + offset)
        });
        let velocity = self
            .order
            .iter()
            .map(|ix| state.velocity.get(*ix).copied())
            .collect::<Option<Vec<f64>>>();
        // A reading with too few joints is dropped. Velocities are optional. Without velocities,
        // positions are interpolated linearly.
        if let Some(position) = position.collect::<Option<Vec<f64>>>() {
            let velocity = velocity.unwrap_or_default();
            let _ = self.joints.push(JointState {
                stamp: state.stamp,
                position,
                velocity,
                effort: Vec::new(),
            });
        }
    }
}
