//! Passes the data of the devices of a run to the steering of a robot, and to viewers.

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

    /// Receives a scan of a range scanner.
    fn observe_range_scan(&self, _scan: &RangeScan) {}
}

/// An observer of a run's input whose robot is steered.
pub(crate) struct SteeringObserver {
    viewers: Viewers,
    /// In the order in which they receive a state of the robot.
    parts: Vec<Arc<dyn RobotObserver>>,
}

impl SteeringObserver {
    pub(super) fn new(viewers: Viewers, parts: Vec<Arc<dyn RobotObserver>>) -> Self {
        Self { viewers, parts }
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
        for part in &self.parts {
            part.observe_robot(&state);
        }
        if self.viewers.needs_robot() {
            self.viewers.observe_robot(state);
        }
    }

    fn observe_keyframe(&self, keyframe: &Arc<Keyframe>) {
        for part in &self.parts {
            part.observe_keyframe(keyframe);
        }
        self.viewers.observe_keyframe(keyframe);
    }

    fn observe_range_scan(&self, scan: RangeScan) {
        for part in &self.parts {
            part.observe_range_scan(&scan);
        }
        self.viewers.observe_range_scan(scan);
    }
}
