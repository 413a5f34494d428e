//! Locates the base from tags that its cameras see: estimates base poses from images and adds them
//! to the samples.

use crate::config::{BaseDriver, Camera, Need, Parent, Rig};
use crate::join::{CameraPose, Motion};
use anyhow::bail;
use drivers::tags::{
    LocateError, RollingShutterCamera, StationaryPoseFilter, TagDetections, TagDetector,
    TagPlacement, locate,
};
use drivers::{BasePose, Error, Image, Sample, Source};
use kinematics::{HistoryError, Stamp, Transform, Twist};
use nalgebra::{Matrix6, Vector3, Vector6};
use std::collections::{BTreeMap, VecDeque};

/// Maximum number of detections that wait for joint states. If more detections wait, the arm sends
/// nothing. Other code reports a silent arm.
const MAX_WAITING: usize = 64;
/// Number of images in which no pose fits the tags, before a warning. After this many images, the
/// rig file probably has a wrong pose of one of the tags. A single image may have a wrong
/// detection.
const MIN_MISFIT_IMAGES: u64 = 3;
/// Time without a pose after which a warning gives the reason, seconds.
const WARN_AFTER_SECS: f64 = 5.0;

/// A source that adds base poses to its samples.
pub(super) struct TagBaseSource {
    source: Box<dyn Source>,
    detector: TagDetector,
    /// Whether every image is processed, even if detection is slow.
    is_lockstep: bool,
    cameras: Vec<Camera>,
    tags: BTreeMap<u32, TagPlacement>,
    /// Motion of the arm alone, as if its base were at the world origin.
    arm: Motion,
    pending: VecDeque<TagDetections>,
    ready: VecDeque<Sample>,
    max_sigma: [f64; 2],
    pose_filter: StationaryPoseFilter,
    newest: Option<Stamp>,
    no_pose_since: Option<Stamp>,
    counts: TagCounts,
}

/// Counts of processed images.
#[derive(Clone, Copy, Debug, Default)]
struct TagCounts {
    n_images: u64,
    n_skipped: u64,
    n_poses: u64,
    n_without_tag: u64,
    n_ambiguous: u64,
    n_misfit: u64,
    n_uncertain: u64,
    n_without_joints: u64,
}

/// The rig without cameras that do not move with the base.
fn with_cameras_on_robot(rig: &Rig) -> Rig {
    let mut rig = rig.clone();
    rig.cameras
        .retain(|camera: &Camera| camera.parent != Parent::World);
    rig
}

impl TagBaseSource {
    /// Checks that the cameras of a rig can locate the base.
    pub(super) fn check(rig: &Rig) -> anyhow::Result<()> {
        let on_robot = with_cameras_on_robot(rig);
        if on_robot.cameras.is_empty() {
            bail!(
                "base.driver is tags, but no camera is on the base or the arm: set camera.NAME.parent to base or flange"
            );
        }
        Ok(on_robot.require(Need::PosedImages)?)
    }

    pub(super) fn new(rig: &Rig, source: Box<dyn Source>) -> anyhow::Result<Self> {
        Self::check(rig)?;
        // With the base at the origin, `Motion` returns poses of cameras relative to the base.
        let mut arm = with_cameras_on_robot(rig);
        arm.base.driver = BaseDriver::Fixed;
        arm.base.world_from_base = Transform::identity();
        Ok(Self {
            source,
            detector: TagDetector::start(rig.base.tag_family)?,
            is_lockstep: rig.sim.lockstep,
            cameras: arm.cameras.clone(),
            tags: rig.base.tags.clone(),
            arm: Motion::new(&arm)?,
            pending: VecDeque::new(),
            ready: VecDeque::new(),
            max_sigma: [rig.base.max_sigma_m, rig.base.max_sigma_rad],
            pose_filter: StationaryPoseFilter::default(),
            newest: None,
            no_pose_since: None,
            counts: TagCounts::default(),
        })
    }

    /// Starts detection in an image of a camera on the robot.
    fn detect(&mut self, image: &Image) {
        if image.is_depth() || self.camera(&image.camera).is_none() {
            return;
        }
        self.counts.n_images += 1;
        // In lockstep, the result must not depend on the speed of the detection. In real time,
        // images that arrive during a detection are skipped instead.
        if self.is_lockstep {
            let new_detections = self.detector.detect_blocking(image.clone());
            self.enqueue(new_detections);
        } else if !self.detector.detect(image.clone()) {
            self.counts.n_skipped += 1;
        }
    }

    fn camera(&self, name: &str) -> Option<&Camera> {
        self.cameras.iter().find(|camera| &*camera.name == name)
    }

    fn enqueue(&mut self, new_detections: Vec<Result<TagDetections, Error>>) {
        for detection in new_detections {
            match detection {
                Ok(detection) => self.pending.push_back(detection),
                Err(error) => log::debug!("base: {error}"),
            }
        }
        while self.pending.len() > MAX_WAITING {
            self.pending.pop_front();
            self.counts.n_without_joints += 1;
        }
    }

    /// Computes base poses for the detections with known joint positions.
    fn process_ready(&mut self) {
        while let Some(detection) = self.pending.front() {
            let Some(camera) = self.camera(&detection.camera) else {
                return;
            };
            let stamp = camera.mid_exposure(detection.stamp);
            match self.arm.at(camera, stamp) {
                Ok(camera_pose) => self.locate(stamp, &camera_pose),
                Err(HistoryError::NotYet { .. }) => return,
                Err(_) => self.counts.n_without_joints += 1,
            }
            self.pending.pop_front();
        }
    }

    fn locate(&mut self, stamp: Stamp, camera_pose: &CameraPose) {
        let base_from_camera = &camera_pose.world_from_camera;
        let Some(detection) = self.pending.front() else {
            return;
        };
        let Some(camera) = self.camera(&detection.camera) else {
            return;
        };
        // Tags whose pose is not in the rig file cannot locate the base.
        let known = detection
            .tags
            .iter()
            .filter_map(|tag| Some((self.tags.get(&tag.id)?, tag.corners_px)));
        let rolling_camera = rolling_shutter_camera(camera, camera_pose);
        let estimate = locate(&rolling_camera, &known.collect::<Vec<_>>());
        match estimate {
            Ok(estimate) if self.newest.is_none_or(|newest| stamp > newest) => {
                // world_from_base = world_from_camera * camera_from_base.
                let world_from_base = estimate.world_from_camera * base_from_camera.inverse();
                let covariance = of_base(&estimate.covariance, base_from_camera);
                // An uncertain pose would displace all keyframes near it. Without a pose, only
                // those keyframes are lost.
                if !self.is_certain(&covariance) {
                    self.counts.n_uncertain += 1;
                    return;
                }
                // While the base stands still, the mean over many images is more precise than a
                // single one.
                let world_from_base = self.pose_filter.push(&world_from_base, &covariance);
                self.ready.push_back(Sample::Base(BasePose {
                    stamp,
                    world_from_base,
                }));
                self.newest = Some(stamp);
                self.no_pose_since = None;
                self.counts.n_poses += 1;
            }
            // Another camera already gave a pose with this or a later stamp.
            Ok(_) => {}
            Err(why) => {
                let name = camera.name.clone();
                let visible_ids: Vec<_> = detection
                    .tags
                    .iter()
                    .map(|tag| tag.id.to_string())
                    .collect();
                self.count_miss(stamp, &name, &visible_ids, why);
            }
        }
    }

    /// Whether the covariance is within the limits of the rig file.
    fn is_certain(&self, covariance: &Matrix6<f64>) -> bool {
        // The trace of a block of the covariance is the mean square of the length of that error.
        let sigma = |first: usize| covariance.diagonal().fixed_rows::<3>(first).sum().sqrt();
        sigma(0) <= self.max_sigma[0] && sigma(3) <= self.max_sigma[1]
    }

    /// Counts an image without a pose, and warns after a long time without any.
    fn count_miss(&mut self, stamp: Stamp, camera: &str, visible_ids: &[String], why: LocateError) {
        match why {
            LocateError::NoTag => self.counts.n_without_tag += 1,
            LocateError::Ambiguous => self.counts.n_ambiguous += 1,
            LocateError::LargeReprojectionError { .. } => {
                self.counts.n_misfit += 1;
                if self.counts.n_misfit == MIN_MISFIT_IMAGES {
                    log::warn!(
                        "base: camera {camera:?}: no pose fits the tags in {MIN_MISFIT_IMAGES} images: {why}; earlier \
                         poses from single tags may be wrong, too"
                    );
                }
            }
        }
        // A single image without a tag is normal. Only a long time without any pose prevents
        // keyframes.
        let since = *self
            .no_pose_since
            .get_or_insert(self.newest.unwrap_or(stamp));
        if stamp.secs_since(since) >= WARN_AFTER_SECS {
            let others = match why {
                LocateError::NoTag if !visible_ids.is_empty() => {
                    format!("; visible tags: {}", visible_ids.join(", "))
                }
                _ => String::new(),
            };
            log::warn!(
                "base: no pose for {:.0} s; camera {camera:?}: {why}{others}",
                stamp.secs_since(since)
            );
            // The next warning follows after the same time.
            self.no_pose_since = Some(stamp);
        }
    }
}

/// A camera during the readout of an image.
pub(super) fn rolling_shutter_camera<'a>(
    camera: &'a Camera,
    pose: &CameraPose,
) -> RollingShutterCamera<'a> {
    RollingShutterCamera {
        intrinsics: &camera.intrinsics,
        twist: pose.twist.unwrap_or_else(Twist::zero),
        readout_secs: camera.readout_micros.unwrap_or(0.0) * 1e-6,
    }
}

impl Source for TagBaseSource {
    fn next_sample(&mut self) -> Result<Option<Sample>, Error> {
        // Detections are processed before the next sample is read, because a base pose must precede
        // the images that wait for it.
        let new_detections = self.detector.new_detections();
        self.enqueue(new_detections);
        self.process_ready();
        if let Some(pose) = self.ready.pop_front() {
            return Ok(Some(pose));
        }
        let Some(sample) = self.source.next_sample()? else {
            // The last detections finish after the source has ended.
            let new_detections = self.detector.finish();
            self.enqueue(new_detections);
            self.process_ready();
            return Ok(self.ready.pop_front());
        };
        match &sample {
            // The join receives the same states and counts the rejected ones.
            Sample::Joints(state) => drop(self.arm.push_joints(state.clone())),
            Sample::Image(image) => self.detect(image),
            _ => {}
        }
        Ok(Some(sample))
    }

    fn n_other_samples_dropped(&self) -> u64 {
        self.source.n_other_samples_dropped()
    }
}

impl Drop for TagBaseSource {
    fn drop(&mut self) {
        let TagCounts {
            n_images,
            n_skipped,
            n_poses,
            n_without_tag,
            n_ambiguous,
            n_misfit,
            n_uncertain,
            n_without_joints,
        } = self.counts;
        log::info!(
            "base: {n_poses} poses from tags in {n_images} images ({n_skipped} skipped, {n_without_tag} without a \
             known tag, {n_ambiguous} ambiguous, {n_misfit} without a fitting pose, {n_uncertain} too uncertain, \
             {n_without_joints} without joint states)"
        );
    }
}

/// The covariance of the base pose in base axes, computed from the covariance of the pose of a
/// camera on the base.
fn of_base(of_camera: &Matrix6<f64>, base_from_camera: &Transform) -> Matrix6<f64> {
    let camera_from_base = base_from_camera.inverse();
    // Column `ix` of the adjoint is the twist of the base that unit component `ix` of the camera's
    // twist causes.
    let columns: [Vector6<f64>; 6] = std::array::from_fn(|ix| {
        let unit =
            |first: usize| Vector3::from_fn(|axis, _| f64::from(u8::from(axis + first == ix)));
        let moved = Twist {
            linear_m_s: unit(0),
            angular_rad_s: unit(3),
        }
        .of_attached(&camera_from_base);
        Vector6::from_iterator(moved.linear_m_s.iter().chain(&moved.angular_rad_s).copied())
    });
    let adjoint = Matrix6::from_columns(&columns);
    // Propagation of a covariance C through a linear map A: A C A^T.
    adjoint * of_camera * adjoint.transpose()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn base_position_uncertainty_grows_with_lever_arm() {
        let base_from_camera = Transform::translation(0.0, 0.0, 2.0);
        let of_camera = Matrix6::from_diagonal(&Vector6::new(1e-6, 1e-6, 1e-6, 1e-4, 0.0, 0.0));
        let of_base = of_base(&of_camera, &base_from_camera);
        // A rotation of 10 mrad about x at 2 m moves the base by 20 mm along y.
        assert!((of_base[(1, 1)] - (1e-6 + 4e-4)).abs() < 1e-12, "{of_base}");
        assert!(
            (of_base[(0, 0)] - 1e-6).abs() < 1e-12 && (of_base[(2, 2)] - 1e-6).abs() < 1e-12,
            "{of_base}"
        );
        let rotation_error = kinematics::transform::exp(
            &Twist {
                linear_m_s: Vector3::zeros(),
                angular_rad_s: Vector3::new(1e-2, 0.0, 0.0),
            },
            1.0,
        );
        let moved = base_from_camera * rotation_error * base_from_camera.inverse();
        assert!((moved.translation.y.abs() - 2e-2).abs() < 1e-5, "{moved}");
    }
}
