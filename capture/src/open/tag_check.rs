//! Warns about cameras whose calibrated poses contradict the tags that they see.

use crate::config::{BaseDriver, Camera, Rig};
use crate::join::{CameraPose, Motion};
use crate::notes::Notes;
use crate::open::tags::rolling_shutter_camera;
use calibration::{TagCheck, TagObservation};
use drivers::tags::{TagDetections, TagDetector, TagPlacement, locate};
use drivers::{Error, Image, Sample, Source};
use kinematics::{HistoryError, Stamp};
use std::collections::{BTreeMap, VecDeque};

/// Interval between the images of a camera in which tags are searched, seconds. Detection must not
/// slow down a run. Several images must confirm a contradiction, so it is found after a few
/// seconds.
const INTERVAL_SECS: f64 = 0.5;
/// Maximum number of detections that wait for joint states.
const MAX_WAITING: usize = 16;

/// A source that passes on its samples and compares images with the tags of the rig file.
pub(super) struct TagCheckSource {
    source: Box<dyn Source>,
    detector: TagDetector,
    /// Whether every image is processed, even if detection is slow.
    is_lockstep: bool,
    cameras: BTreeMap<String, CheckedCamera>,
    tags: BTreeMap<u32, TagPlacement>,
    robot: Motion,
    pending: VecDeque<TagDetections>,
    notes: Notes,
}

struct CheckedCamera {
    config: Camera,
    check: TagCheck,
    last_image: Option<Stamp>,
}

impl TagCheckSource {
    /// Checks the images of a source. The source is returned unchanged if the rig has no tags, or
    /// if the tags locate its base.
    ///
    /// * `notes`: gets the warnings.
    pub(super) fn check(
        rig: &Rig,
        source: Box<dyn Source>,
        notes: &Notes,
    ) -> anyhow::Result<Box<dyn Source>> {
        // Tags that locate the base cannot check the poses that are computed from it.
        if rig.base.tags.is_empty() || rig.base.driver != BaseDriver::Fixed {
            return Ok(source);
        }
        let cameras = rig
            .cameras
            .iter()
            .map(|camera| (camera.name.to_string(), CheckedCamera::new(camera)))
            .collect();
        Ok(Box::new(Self {
            source,
            detector: TagDetector::start(rig.base.tag_family)?,
            is_lockstep: rig.sim.lockstep,
            cameras,
            tags: rig.base.tags.clone(),
            robot: Motion::new(rig)?,
            pending: VecDeque::new(),
            notes: notes.clone(),
        }))
    }

    /// Starts detection in an image if the last one of its camera is old enough.
    fn detect(&mut self, image: &Image) {
        let Some(camera) = self
            .cameras
            .get_mut(&*image.camera)
            .filter(|_| !image.is_depth())
        else {
            return;
        };
        if camera
            .last_image
            .is_some_and(|last| image.stamp.secs_since(last) < INTERVAL_SECS)
        {
            return;
        }
        if self.is_lockstep {
            camera.last_image = Some(image.stamp);
            let new_detections = self.detector.detect_blocking(image.clone());
            self.enqueue(new_detections);
        // If the detector is busy, the next image of the camera is tried, without waiting for
        // another interval.
        } else if self.detector.detect(image.clone()) {
            camera.last_image = Some(image.stamp);
        }
    }

    fn enqueue(&mut self, new_detections: Vec<Result<TagDetections, Error>>) {
        // Images that do not decode are counted elsewhere.
        self.pending.extend(
            new_detections
                .into_iter()
                .flatten()
                .filter(|detections| !detections.tags.is_empty()),
        );
        while self.pending.len() > MAX_WAITING {
            self.pending.pop_front();
        }
    }

    /// Checks the detections with known joint positions.
    fn process_ready(&mut self) {
        while let Some(detections) = self.pending.front() {
            if let Some(camera) = self.cameras.get_mut(&*detections.camera) {
                let stamp = camera.config.mid_exposure(detections.stamp);
                match self.robot.at(&camera.config, stamp) {
                    Ok(pose) => camera.compare(stamp, &pose, detections, &self.tags, &self.notes),
                    Err(HistoryError::NotYet { .. }) => return,
                    Err(_) => (),
                }
            }
            self.pending.pop_front();
        }
    }
}

impl CheckedCamera {
    fn new(config: &Camera) -> Self {
        Self {
            config: config.clone(),
            check: TagCheck::new(&config.name),
            last_image: None,
        }
    }

    /// Compares the calibrated pose of an image with the pose from its tags.
    fn compare(
        &mut self,
        stamp: Stamp,
        pose: &CameraPose,
        detections: &TagDetections,
        placements: &BTreeMap<u32, TagPlacement>,
        notes: &Notes,
    ) {
        let known: Vec<(u32, &TagPlacement, [[f64; 2]; 4])> = detections
            .tags
            .iter()
            .filter_map(|tag| Some((tag.id, placements.get(&tag.id)?, tag.corners_px)))
            .collect();
        let camera = rolling_shutter_camera(&self.config, pose);
        let corners: Vec<_> = known
            .iter()
            .map(|(_, placement, corners_px)| (*placement, *corners_px))
            .collect();
        // Images in which the pose is ambiguous or no pose fits are not compared.
        let Ok(estimate) = locate(&camera, &corners) else {
            return;
        };
        let observation = TagObservation {
            stamp,
            calibrated: pose.world_from_camera,
            seen: estimate.world_from_camera,
            covariance: estimate.covariance,
            tags: known.iter().map(|(id, ..)| *id).collect(),
        };
        if let Some(contradiction) = self.check.push(observation) {
            log::warn!("{contradiction}");
            notes.add(contradiction.to_string());
        }
    }
}

impl Source for TagCheckSource {
    fn next_sample(&mut self) -> Result<Option<Sample>, Error> {
        let new_detections = self.detector.new_detections();
        self.enqueue(new_detections);
        self.process_ready();
        let sample = self.source.next_sample()?;
        match &sample {
            Some(Sample::Joints(state)) => drop(self.robot.push_joints(state.clone())),
            Some(Sample::Image(image)) => self.detect(image),
            Some(_) => (),
            None => {
                let new_detections = self.detector.finish();
                self.enqueue(new_detections);
                self.process_ready();
            }
        }
        Ok(sample)
    }

    fn n_other_samples_dropped(&self) -> u64 {
        self.source.n_other_samples_dropped()
    }

    fn n_restarts(&self) -> u64 {
        self.source.n_restarts()
    }
}
