//! Passes what the devices of a run deliver to the map of free space, and to viewers.

use super::scene_clearance::SceneClearance;
use crate::viewers::Viewers;
use capture::InputObserver;
use keyframe::Keyframe;
use std::sync::Arc;
use viz::{LiveImage, RangeScan, RobotState};

/// An observer of a run's input whose arm is steered.
pub(crate) struct SteeringObserver {
    viewers: Viewers,
    scene: Arc<SceneClearance>,
}

impl SteeringObserver {
    pub(super) fn new(viewers: Viewers, scene: Arc<SceneClearance>) -> Self {
        Self { viewers, scene }
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
        // The posture at the time of each keyframe is needed, also if nobody watches.
        true
    }

    fn observe_robot(&self, state: RobotState) {
        self.scene.observe_robot(&state);
        if self.viewers.needs_robot() {
            self.viewers.observe_robot(state);
        }
    }

    fn observe_keyframe(&self, keyframe: &Arc<Keyframe>) {
        self.scene.observe_keyframe(keyframe);
    }

    fn observe_range_scan(&self, scan: RangeScan) {
        self.viewers.observe_range_scan(scan);
    }
}
