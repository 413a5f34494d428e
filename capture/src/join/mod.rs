//! Joins images with joint readings, base poses and calibration to make keyframes.
//!
//! Samples are pushed one by one. The result depends only on their order, so a live lockstep run,
//! its recording and the replay of that recording give bit-identical keyframes.

mod accept;
mod assemble;
mod base_corrections;
mod camera_motion;
mod change;
mod drift;
mod pixels;
mod ranges;
mod rejection;
mod spacing;
mod station_detector;
mod store;
#[cfg(test)]
mod tests;
mod waiting;

pub(crate) use camera_motion::{CameraPose, JointsRejection, Motion};
pub use change::Change;
pub use drift::DriftReport;
pub use rejection::{Counts, Rejection, SampleUse};
pub use store::StoreUse;

use crate::config::{self, BaseDriver, CameraDriver, Need, Parent, Rig};
use crate::notes::Notes;
use crate::robot_masks::{RobotAt, RobotMasks};
use accept::Acceptance;
use anyhow::Context;
use assemble::Undistorter;
use drivers::{Image, Sample, TruthImage};
use keyframe::{Keyframe, KeyframeList, RangePoints, Split};
use kinematics::{HistoryError, JointState, Stamp, Transform};
use ranges::RangeScans;
use spacing::Spacing;
use std::sync::Arc;
use store::KeyframeStore;
use waiting::{Partner, Waiting};

/// Number of keyframes after which a note names the mean share of the image that the robot covers.
const MIN_IMAGES_OF_COVER: u64 = 8;

/// Converts samples to keyframes.
///
/// [`Join::push`] takes samples one by one. [`Join::finish`] ends the stream. The store of
/// keyframes is bounded. Beyond its limits, the most redundant keyframe is evicted.
pub struct Join {
    motion: Motion,
    robot_masks: Option<RobotMasks>,
    notes: Notes,
    cameras: Vec<CameraState>,
    store: KeyframeStore,
    ranges: RangeScans,
    list: Option<KeyframeList>,
    /// The first image that was compared with the list, as an example for an error message.
    first_image: Option<(Arc<str>, Stamp)>,
    counts: Counts,
    /// Whether the warning about joint limits was logged.
    warned_joint_limits: bool,
    max_wait_secs: f64,
    default_depth_m: f64,
    /// The latest stamp of all samples. The join uses no other clock.
    newest: Stamp,
    /// The latest stamp of the keyframes from the resumed run.
    newest_resumed: Option<Stamp>,
    /// Nanoseconds added to the stamps of new keyframes so that they follow earlier ones; `None`
    /// before the first keyframe.
    stamp_offset_nanos: Option<i64>,
}

/// An event that pushing a sample causes.
#[derive(Clone, Debug)]
pub enum JoinEvent {
    /// A new keyframe was added to the store.
    Accepted(Arc<Keyframe>),
    /// A keyframe was evicted from the full store.
    Evicted {
        /// Name of its camera.
        camera: Arc<str>,
        /// Its stamp.
        stamp: Stamp,
    },
    /// A color image with a known pose, whether or not it becomes a keyframe.
    PosedImage(PosedImage),
    /// A range scan with known base poses.
    RangeScan(Arc<RangePoints>),
    /// A color image did not become a keyframe.
    Rejected {
        /// The reason.
        why: Rejection,
    },
}

/// A color image and its camera pose.
#[derive(Clone, Debug)]
pub struct PosedImage {
    /// The image as delivered by the device, not undistorted.
    pub image: Image,
    /// Pose of the camera at mid-exposure, without the correction of a station.
    pub world_from_camera: Transform,
}

/// One camera of the rig.
struct CameraState {
    config: config::Camera,
    color_undistorter: Undistorter,
    depth_undistorter: Option<Undistorter>,
    acceptance: Acceptance,
    waiting: Waiting,
    n_accepted: usize,
    warned_undecodable: bool,
}

/// A color image with all available data for it.
struct ReadyImage {
    image: Image,
    stamp: Stamp,
    camera_pose: CameraPose,
    depth: Option<(Image, CameraPose)>,
    truth: Option<TruthImage>,
    /// The robot to mask, and the time from the image to the depth image, seconds.
    robot: Option<RobotAt>,
    depth_delay_secs: f64,
}

impl Join {
    /// A join for the cameras and the arm of a rig.
    ///
    /// # Errors
    ///
    /// If calibration is missing, the robot description does not match the rig, or the scaled
    /// training images would be too small.
    pub fn new(rig: &Rig) -> anyhow::Result<Self> {
        rig.require(Need::PosedImages)?;
        let join = &rig.join;
        let spacing = Spacing {
            translation_m: join.min_translation_m,
            rotation_rad: join.min_rotation_rad,
        };
        let robot_masks = RobotMasks::new(rig)?;
        if let Some(warning) = robot_masks.as_ref().and_then(RobotMasks::warning) {
            log::warn!("{warning}");
        }
        Ok(Self {
            motion: Motion::new(rig)?,
            robot_masks,
            notes: Notes::default(),
            cameras: rig
                .cameras
                .iter()
                .map(|camera| CameraState::new(camera, rig, spacing))
                .collect::<Result<_, _>>()?,
            store: KeyframeStore::new(join.max_keyframes, join.max_bytes, spacing),
            ranges: RangeScans::new(rig),
            list: None,
            first_image: None,
            counts: Counts::default(),
            warned_joint_limits: false,
            max_wait_secs: join.max_wait_millis * 1e-3,
            default_depth_m: join.default_depth_m,
            newest: Stamp(i64::MIN),
            newest_resumed: None,
            stamp_offset_nanos: None,
        })
    }

    /// Adds notes about masked robots to the notes of a run.
    #[must_use]
    pub fn with_notes(mut self, notes: Notes) -> Self {
        let warning = self.robot_masks.as_ref().and_then(RobotMasks::warning);
        warning.into_iter().for_each(|warning| notes.add(warning));
        self.notes = notes;
        self
    }

    /// Accepts exactly the keyframes of a list, with its splits, without acceptance tests or store
    /// limits.
    #[must_use]
    pub fn taking_only(mut self, list: KeyframeList) -> Self {
        // Nothing may be evicted, so that the spacing of this store has no effect.
        self.store = KeyframeStore::new(
            usize::MAX,
            u64::MAX,
            Spacing {
                translation_m: 1.0,
                rotation_rad: 1.0,
            },
        );
        self.list = Some(list);
        self
    }

    /// Continues a run that already has these keyframes. Returns the camera and stamp of each
    /// keyframe that does not fit into the store.
    ///
    /// Clocks restart when a simulation or the computer restarts. If the stamp of the first new
    /// keyframe is not later than the earlier stamps, all new keyframes get a stamp offset.
    #[must_use]
    pub fn resume_from(mut self, keyframes: &[Arc<Keyframe>]) -> (Self, Vec<(Arc<str>, Stamp)>) {
        let mut evicted = Vec::new();
        for keyframe in keyframes {
            if let Some(camera) = self
                .cameras
                .iter_mut()
                .find(|camera| camera.config.name == keyframe.camera)
            {
                camera
                    .acceptance
                    .accept_resumed(&keyframe.world_from_camera);
                camera.n_accepted += 1;
            }
            evicted.extend(self.store.push(Arc::clone(keyframe)));
        }
        self.newest_resumed = keyframes.iter().map(|keyframe| keyframe.stamp).max();
        (self, evicted)
    }

    /// Converts the stamp of a sample to the clock of the keyframes.
    pub(crate) fn shifted(&self, stamp: Stamp) -> Stamp {
        Stamp(
            stamp
                .0
                .saturating_add(self.stamp_offset_nanos.unwrap_or_default()),
        )
    }

    /// Processes one sample and returns the resulting events.
    pub fn push(&mut self, sample: Sample) -> Vec<JoinEvent> {
        let mut events = Vec::new();
        // All waits are measured by the newest stamp of any device. With wall time, a replay would
        // decide differently from the run that it repeats.
        self.newest = self.newest.max(sample.stamp());
        match sample {
            Sample::Joints(state) => self.push_joints(state),
            Sample::Base(pose) => {
                let is_valid = self.motion.push_base(&pose);
                self.counts.base_poses_rejected += u64::from(!is_valid);
            }
            Sample::Range(scan) => {
                let is_queued = self.ranges.push(scan);
                self.counts.range_scans_rejected += u64::from(!is_queued);
            }
            Sample::BaseTruth(truth) => self.motion.push_base_truth(&truth),
            Sample::Image(image) => self.push_image(image, &mut events),
            Sample::Truth(truth) => {
                if let Some(camera) = self
                    .cameras
                    .iter_mut()
                    .find(|camera| camera.config.name == truth.image.camera)
                {
                    camera.waiting.push_truth(truth);
                }
            }
        }
        // Any sample may complete a waiting image. A joint reading gives it a pose, and a sample of
        // another device may end its wait.
        self.process_ready(false, &mut events);
        events
    }

    /// Ends the stream and decides about the images that are still waiting.
    pub fn finish(&mut self) -> Vec<JoinEvent> {
        let mut events = Vec::new();
        self.process_ready(true, &mut events);
        events
    }

    /// Accepts or rejects all pending images, because the source has restarted. Its stamps continue
    /// to increase, but the robot jumps back, so the motion up to now is not used for later images.
    pub(crate) fn restart(&mut self) -> Vec<JoinEvent> {
        // Images that still wait belong to the motion before the jump, so they are decided first.
        let events = self.finish();
        self.motion.restart();
        self.ranges.restart();
        if let Some(robot_masks) = &mut self.robot_masks {
            robot_masks.restart();
        }
        events
    }

    /// Counts of all samples so far.
    #[must_use]
    pub fn counts(&self) -> &Counts {
        &self.counts
    }

    /// How full the store of keyframes is.
    #[must_use]
    pub fn store_use(&self) -> StoreUse {
        self.store.usage()
    }

    /// The keyframes in the store, in order of acceptance.
    pub fn keyframes(&self) -> impl Iterator<Item = &Arc<Keyframe>> {
        self.store.iter()
    }

    /// The newest scans of range scanners, with points in the world frame, oldest first.
    pub fn range_scans(&self) -> impl Iterator<Item = &Arc<RangePoints>> {
        self.ranges.iter()
    }

    /// The newest correction of the reported base poses, which range scans give.
    pub(crate) fn map_from_reported(&self) -> Transform {
        self.motion.map_from_reported()
    }

    /// What range scans showed about the drift of the base; `None` if they are not used for this.
    #[must_use]
    pub fn drift(&self) -> Option<&DriftReport> {
        self.ranges.drift()
    }

    /// Compares the result with the list of [`Join::taking_only`], as [`KeyframeList::check_found`]
    /// does; `None` without a list or a difference.
    ///
    /// # Errors
    ///
    /// If no keyframe of the list was found.
    pub fn check_list(&self) -> anyhow::Result<Option<String>> {
        let Some(list) = &self.list else {
            return Ok(None);
        };
        let found = self
            .keyframes()
            .map(|keyframe| (&*keyframe.camera, keyframe.stamp));
        Ok(list.check_found(
            found,
            self.first_image
                .as_ref()
                .map(|(camera, stamp)| (&**camera, *stamp)),
        )?)
    }

    /// Adds a joint state. All states with a problem are counted. For each kind of problem, only
    /// the first state is logged.
    fn push_joints(&mut self, state: JointState) {
        // This check includes states that are ignored below. Readings in degrees also imply
        // impossible speeds and are ignored for this reason, but the warning here names the cause.
        if !self.warned_joint_limits
            && let Some(joint_limit_warning) = self.motion.joint_limit_warning(&state)
        {
            log::warn!("{joint_limit_warning}");
            self.warned_joint_limits = true;
        }
        let all_joints = self.robot_masks.is_some().then(|| state.clone());
        match self.motion.push_joints(state) {
            Ok(()) => {
                if let (Some(robot_masks), Some(state)) = (&mut self.robot_masks, all_joints) {
                    robot_masks.push_joints(&state);
                }
            }
            Err(JointsRejection::Invalid) => self.counts.joints_rejected += 1,
            Err(JointsRejection::TooFast(jump)) => {
                if self.counts.joints_too_fast == 0 {
                    log::warn!(
                        "ignored a joint state: {jump}; stop other programs that send joint states, or correct the URDF"
                    );
                }
                self.counts.joints_too_fast += 1;
            }
        }
    }

    fn push_image(&mut self, image: Image, events: &mut Vec<JoinEvent>) {
        self.counts.device_skipped += image.n_skipped;
        if !image.is_depth() {
            self.counts.images += 1;
            self.counts.color_skipped += image.n_skipped;
        }
        let Some(camera) = self
            .cameras
            .iter_mut()
            .find(|camera| camera.config.name == image.camera)
        else {
            // Only color images are counted and rejected. A depth image of an unknown camera
            // belongs to a color image, which is rejected and counted itself.
            if !image.is_depth() {
                self.counts
                    .unknown_cameras
                    .insert(Arc::clone(&image.camera));
                self.reject(&image.camera, image.stamp, Rejection::UnknownCamera, events);
            }
            return;
        };
        if image.is_depth() {
            let stamp = camera.config.mid_exposure(image.stamp);
            camera.waiting.push_depth(stamp, image);
        // Color images keep their device stamp in the queue, because ground truth is found by the
        // device stamp.
        } else if let Some(dropped_image) = camera.waiting.push_color(image) {
            let stamp = camera.config.mid_exposure(dropped_image.stamp);
            self.reject(&dropped_image.camera, stamp, Rejection::QueueFull, events);
        }
    }

    /// Transforms range scans, then decides about every image that is ready, camera by camera,
    /// oldest first.
    fn process_ready(&mut self, at_end: bool, events: &mut Vec<JoinEvent>) {
        let counts_placed =
            self.ranges
                .process_ready(&mut self.motion, self.newest, at_end, self.max_wait_secs);
        self.counts.range_scans += counts_placed.n_placed;
        self.counts.range_scans_rejected += counts_placed.n_rejected;
        events.extend(
            self.ranges
                .newest(counts_placed.n_placed)
                .cloned()
                .map(JoinEvent::RangeScan),
        );
        // Cameras are processed in the order of the rig file. With this fixed order, a replay gives
        // the keyframes in the order of the run.
        for camera_ix in 0..self.cameras.len() {
            while let Some(ready) = self.next_ready(camera_ix, at_end) {
                match ready {
                    Ok(ready) => {
                        let posed_image = PosedImage {
                            image: ready.image.clone(),
                            world_from_camera: ready.camera_pose.world_from_camera,
                        };
                        events.push(JoinEvent::PosedImage(posed_image));
                        self.decide(camera_ix, ready, events);
                    }
                    Err((camera, stamp)) => self.reject(&camera, stamp, Rejection::NoPose, events),
                }
            }
        }
    }

    /// The oldest waiting image of a camera, if all its data have arrived. The error identifies an
    /// image that will never have a pose.
    fn next_ready(
        &mut self,
        camera_ix: usize,
        at_end: bool,
    ) -> Option<Result<ReadyImage, (Arc<str>, Stamp)>> {
        let camera = &mut self.cameras[camera_ix];
        let device_stamp = camera.waiting.oldest()?.stamp;
        let stamp = camera.config.mid_exposure(device_stamp);
        // An image whose depth image or ground truth was lost must not wait forever, because newer
        // images of its camera queue behind it.
        let overdue = at_end || self.newest.secs_since(stamp) > self.max_wait_secs;
        let masks = self.robot_masks.as_ref();
        let masks = masks.filter(|masks| masks.masks(&camera.config.name));
        let robot_at = |masks: &RobotMasks| masks.at(stamp, self.motion.base_at(stamp)?);
        let camera_pose = self.motion.at(&camera.config, stamp);
        // Without the state of the robot, the image would train the robot into the model.
        let posed = camera_pose.and_then(|pose| Ok((pose, masks.map(robot_at).transpose()?)));
        let (camera_pose, robot) = match posed {
            Err(HistoryError::NotYet { .. }) if !overdue => return None,
            Err(error) => (Err(error), None),
            Ok((camera_pose, robot)) => (Ok(camera_pose), robot),
        };
        let mut depth_delay_secs = 0.0;
        let period_secs = 1.0 / camera.config.rate_hz;
        let mut depth = None;
        if camera.config.depth.is_some() && camera_pose.is_ok() {
            // Depth and color of one exposure are at most half a period apart. A depth image
            // further away belongs to a neighboring color image.
            let (depth_stamp, is_final) = camera.waiting.depth_near(stamp, 0.5 * period_secs);
            if !is_final && !overdue {
                return None;
            }
            if let Some(depth_stamp) = depth_stamp {
                depth_delay_secs = depth_stamp.secs_since(stamp);
                // The depth image has its own pose, because the camera moves between the two
                // exposures.
                match self.motion.at(&camera.config, depth_stamp) {
                    Err(HistoryError::NotYet { .. }) if !overdue => return None,
                    Ok(camera_pose) => {
                        depth = camera
                            .waiting
                            .depth_at(depth_stamp)
                            .cloned()
                            .zip(Some(camera_pose))
                    }
                    // A depth image without a pose is useless, but the color image can still be
                    // used.
                    Err(_) => {}
                }
            }
        }
        let truth = match camera.waiting.truth_of(device_stamp) {
            Partner::NotYet if !overdue && camera_pose.is_ok() => return None,
            Partner::Available(truth) => Some(truth.clone()),
            Partner::NotYet | Partner::Never => None,
        };
        // A recording of a simulator may have no ground truth. If it were still expected, every
        // image of such a recording would wait until it is overdue.
        if truth.is_none() && overdue && camera_pose.is_ok() {
            camera.waiting.stop_waiting_for_truth();
        }
        let image = camera.waiting.take_oldest()?;
        // The depth image of this color image may also be the nearest depth image of the next color
        // image, so it is kept for one period.
        camera
            .waiting
            .forget_before(stamp, device_stamp, period_secs);
        match camera_pose {
            Ok(camera_pose) => Some(Ok(ReadyImage {
                image,
                stamp,
                camera_pose,
                depth,
                truth,
                robot,
                depth_delay_secs,
            })),
            Err(_) => Some(Err((image.camera, stamp))),
        }
    }

    fn decide(&mut self, camera_ix: usize, mut ready: ReadyImage, events: &mut Vec<JoinEvent>) {
        let listed = self
            .list
            .as_ref()
            .map(|list| list.split_of(&ready.image.camera, ready.stamp));
        let name = Arc::clone(&ready.image.camera);
        let stamp = ready.stamp;
        self.first_image
            .get_or_insert_with(|| (Arc::clone(&name), stamp));
        let camera = &mut self.cameras[camera_ix];
        let split = match listed {
            Some(None) => return, // The image is not in the list; this does not count as a rejection.
            Some(Some(split)) => split,
            None => Split::of(camera.n_accepted),
        };
        let robot = ready.robot.take();
        let depth_delay_secs = ready.depth_delay_secs;
        let keyframe = match camera.keyframe(ready, split, listed.is_none(), self.default_depth_m) {
            Ok(keyframe) => keyframe,
            Err(why) => return self.reject(&name, stamp, why, events),
        };
        // Only accepted images count for the split. Each camera thus has the same share of test
        // keyframes, regardless of how many of its images are rejected.
        camera.n_accepted += 1;
        self.counts.accepted += 1;
        // A depth camera measures every pixel at the time of the image. Scans are older and sparse,
        // so they are used only if there is no depth camera.
        let depth_from_ranges = if camera.config.depth.is_none() {
            self.ranges.depth_of(&keyframe)
        } else {
            None
        };
        // The stamp offset is chosen once, at the first keyframe of this run. The time differences
        // between the keyframes therefore stay those of the device. One second separates the first
        // keyframe from the last keyframe of the earlier run.
        let stamp_offset_nanos =
            *self
                .stamp_offset_nanos
                .get_or_insert_with(|| match self.newest_resumed {
                    Some(earlier) if stamp <= earlier => {
                        earlier.plus_secs(1.0).0.saturating_sub(stamp.0)
                    }
                    _ => 0,
                });
        let stamp = Stamp(keyframe.stamp.0.saturating_add(stamp_offset_nanos));
        let mut keyframe = Keyframe {
            depth: keyframe.depth.or(depth_from_ranges),
            stamp,
            ..keyframe
        };
        self.counts.without_depth +=
            u64::from(camera.config.depth.is_some() && keyframe.depth.is_none());
        if let Some(robot) = robot {
            self.mask_robot(&mut keyframe, &robot, depth_delay_secs);
        }
        let keyframe = Arc::new(keyframe);
        events.push(JoinEvent::Accepted(Arc::clone(&keyframe)));
        for (camera, stamp) in self.store.push(keyframe) {
            self.counts.evicted += 1;
            events.push(JoinEvent::Evicted { camera, stamp });
        }
    }

    /// Masks the robot in a keyframe, and adds a note as soon as its mean share is known.
    fn mask_robot(&mut self, keyframe: &mut Keyframe, robot: &RobotAt, depth_delay_secs: f64) {
        let masks = self.robot_masks.as_ref();
        let cover = masks.and_then(|masks| masks.apply(keyframe, robot, depth_delay_secs));
        let Some(cover) = cover else { return };
        let n_images = self.counts.add_robot_cover(&keyframe.camera, cover);
        if n_images == MIN_IMAGES_OF_COVER
            && let Some(note) = self.counts.robot_note(&keyframe.camera)
        {
            log::info!("{note}");
            self.notes.add(note);
        }
    }

    fn reject(&mut self, camera: &str, stamp: Stamp, why: Rejection, events: &mut Vec<JoinEvent>) {
        log::debug!(
            "camera {camera:?}: the image at {} ns did not become a keyframe: {why}",
            stamp.0
        );
        self.counts.reject(why);
        events.push(JoinEvent::Rejected { why });
    }
}

impl CameraState {
    fn new(camera: &config::Camera, rig: &Rig, spacing: Spacing) -> anyhow::Result<Self> {
        let named = || format!("camera {:?}", camera.name);
        let is_fixed = match camera.parent {
            Parent::Flange => false,
            Parent::Base => rig.base.driver == BaseDriver::Fixed,
            Parent::World => true,
        };
        if camera.readout_micros.is_none() && !is_fixed {
            log::warn!(
                "camera {:?}: readout_micros is not in the rig file; assuming a global shutter",
                camera.name
            );
        }
        if camera.stamp_to_mid_exposure.is_none() && camera.driver != CameraDriver::Sim {
            log::warn!(
                "camera {:?}: stamp_to_mid_exposure_millis is not in the rig file; assuming 0",
                camera.name
            );
        }
        // Depth is not scaled: it has its own intrinsics, and averages across depth edges would not
        // lie on any surface.
        let depth_undistorter = camera
            .depth
            .as_ref()
            .map(|depth| Undistorter::new(&depth.intrinsics, 1.0))
            .transpose()?;
        Ok(Self {
            config: camera.clone(),
            color_undistorter: Undistorter::new(&camera.intrinsics, rig.train.scale)
                .with_context(named)?,
            depth_undistorter,
            acceptance: Acceptance::new(&rig.join, camera, is_fixed, spacing),
            waiting: Waiting::new(camera.driver == CameraDriver::Sim && rig.sim.truth),
            n_accepted: 0,
            warned_undecodable: false,
        })
    }

    /// Makes a keyframe from an image, or returns the reason for rejecting it. `run_checks` is
    /// false if a list selects the keyframes.
    fn keyframe(
        &mut self,
        ready: ReadyImage,
        split: Split,
        run_checks: bool,
        default_depth_m: f64,
    ) -> Result<Keyframe, Rejection> {
        let pose = &ready.camera_pose.world_from_camera;
        if !kinematics::transform::is_finite(pose) {
            return Err(Rejection::PoseNotFinite);
        }
        if run_checks {
            self.acceptance.check_motion(ready.stamp, pose)?;
        }
        let depth = self.depth_of(&ready);
        if run_checks {
            let depth_m = depth
                .as_ref()
                .and_then(assemble::median_depth_m)
                .unwrap_or(default_depth_m);
            let exposure_secs = ready
                .image
                .exposure_secs
                .or(self.config.exposure_micros.map(|micros| micros * 1e-6));
            self.acceptance.check_speed(
                &ready.camera_pose,
                self.color_undistorter.full(),
                exposure_secs,
                depth_m,
            )?;
        }
        let rgb = assemble::rgb(&ready.image, &self.config.intrinsics)
            .map_err(|e| self.undecodable(&e))?;
        if run_checks {
            self.acceptance
                .check_pixels(&rgb, self.config.intrinsics.size_px)?;
            self.acceptance.accept(ready.stamp, pose);
        }
        let rgba_srgb = self
            .color_undistorter
            .rgba(&rgb)
            .map_err(|e| self.undecodable(&e))?;
        let truth = ready.truth.and_then(|truth| {
            assemble::truth(&truth, &self.config.intrinsics, &self.color_undistorter)
                .map_err(|e| self.undecodable(&e))
                .ok()
        });
        let pinhole = self.color_undistorter.pinhole();
        Ok(Keyframe {
            camera: ready.image.camera,
            stamp: ready.stamp,
            size_px: pinhole.size_px,
            focal_px: pinhole.focal_px,
            principal_px: pinhole.principal_px,
            rgba_srgb,
            depth,
            world_from_camera: ready.camera_pose.world_from_camera,
            twist: ready.camera_pose.twist,
            readout_secs: self.acceptance.readout_secs(),
            joint_twists: ready.camera_pose.joint_twists,
            base: ready.camera_pose.base,
            split,
            truth,
            robot: None,
        })
    }

    /// The depth of an image. If it does not decode, the keyframe is kept without depth.
    fn depth_of(&mut self, ready: &ReadyImage) -> Option<keyframe::DepthMap> {
        let (image, camera_pose) = ready.depth.as_ref()?;
        let map = assemble::depth_map(
            image,
            self.config.depth.as_ref()?,
            self.depth_undistorter.as_ref()?,
            camera_pose,
        );
        map.map_err(|e| self.undecodable(&e)).ok()
    }

    /// Logs only the first decoding error of a camera. All decoding errors are counted.
    fn undecodable(&mut self, error: &anyhow::Error) -> Rejection {
        if !std::mem::replace(&mut self.warned_undecodable, true) {
            log::warn!("{error:#}");
        }
        Rejection::Undecodable
    }
}
