//! Passes the data of the devices of a run to the steering of a robot, and to viewers.

use super::scene_clearance::SceneClearance;
use crate::viewers::Viewers;
use capture::InputObserver;
use keyframe::Keyframe;
use std::sync::Arc;
use viz::{LiveImage, RangeScan, RobotState};

/// A part of steering that needs the data of the devices.
pub(super) trait RobotObserver: Send + Sync {
    /// Receives a state of the robot.
    fn observe_robot(&self, state: &RobotState);

    /// Receives a keyframe when it is accepted.
    fn observe_keyframe(&self, _keyframe: &Arc<Keyframe>) {}
}

impl RobotObserver for SceneClearance {
    fn observe_robot(&self, state: &RobotState) {
        Self::observe_robot(self, state); // The function of the map itself.
    }

    fn observe_keyframe(&self, keyframe: &Arc<Keyframe>) {
        Self::observe_keyframe(self, keyframe);
    }
}

/// An observer of a run's input whose robot is steered.
pub(crate) struct SteeringObserver {
    viewers: Viewers,
    robot: Arc<dyn RobotObserver>,
}

impl SteeringObserver {
    pub(super) fn new(viewers: Viewers, robot: Arc<dyn RobotObserver>) -> Self {
        Self { viewers, robot }
    }
}

impl InputObserver for SteeringObserver {
    fn needs_images(&self) -> bool {
        self.viewers.needs_images()
    }

    fn observe(&self, image: LiveImage) {
        self.viewers.observe(image);
    }

    fn needs_robot(&self) -> bool {
        // Steering needs the poses and postures, also if nobody watches.
        true
    }

    fn observe_robot(&self, state: RobotState) {
        self.robot.observe_robot(&state);
        if self.viewers.needs_robot() {
            self.viewers.observe_robot(state);
        }
    }

    fn observe_keyframe(&self, keyframe: &Arc<Keyframe>) {
        self.robot.observe_keyframe(keyframe);
        self.viewers.observe_keyframe(keyframe);
    }

    fn observe_range_scan(&self, scan: RangeScan) {
        self.viewers.observe_range_scan(scan);
    }
}
