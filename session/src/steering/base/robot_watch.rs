//! What the devices of a run report about a robot: the pose of its base, and the posture of its arm.

use crate::steering::time_base::TimeBase;
use crate::viewers::Viewers;
use capture::InputObserver;
use keyframe::Keyframe;
use kinematics::Transform;
use nalgebra::Vector3;
use parking_lot::Mutex;
use std::sync::Arc;
use steering::{FloorPose, SeenPose, SeenPosture};
use viz::{LiveImage, RangeScan, RobotState};

/// What is known about a robot besides the report of its base.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct SeenRobot {
    /// Pose of the base link on the floor.
    pub(super) pose: Option<SeenPose>,
    /// Posture of the arm; `None` without an arm.
    pub(super) posture: Option<SeenPosture>,
}

/// The newest state of a robot.
#[derive(Debug)]
pub(super) struct RobotWatch {
    times: TimeBase,
    seen: Mutex<SeenRobot>,
}

impl RobotWatch {
    /// Nothing is known yet.
    pub(super) fn new(times: TimeBase) -> Self {
        Self {
            times,
            seen: Mutex::default(),
        }
    }

    /// The clocks of stamps and instants.
    pub(super) fn times(&self) -> TimeBase {
        self.times
    }

    /// The newest state.
    pub(super) fn seen(&self) -> SeenRobot {
        self.seen.lock().clone()
    }

    fn observe(&self, state: &RobotState) {
        let at = self.times.stamp(state.captured_at);
        let has_arm = !state.positions.is_empty();
        *self.seen.lock() = SeenRobot {
            pose: Some(SeenPose {
                at,
                pose: floor_pose(&state.world_from_base),
            }),
            posture: has_arm.then(|| SeenPosture {
                at,
                position: state.positions.clone(),
            }),
        };
    }
}

/// Place and heading of a base on the floor. A walking base tilts by a few degrees, which does not
/// matter for its heading.
pub(super) fn floor_pose(world_from_base: &Transform) -> FloorPose {
    let forward = world_from_base.rotation * Vector3::x();
    FloorPose {
        x_m: world_from_base.translation.x,
        y_m: world_from_base.translation.y,
        yaw_rad: forward.y.atan2(forward.x),
    }
}

/// An observer of a run's input whose base is steered.
pub(super) struct WatchingObserver {
    viewers: Viewers,
    watch: Arc<RobotWatch>,
}

impl WatchingObserver {
    pub(super) fn new(viewers: Viewers, watch: Arc<RobotWatch>) -> Self {
        Self { viewers, watch }
    }
}

impl InputObserver for WatchingObserver {
    fn needs_images(&self) -> bool {
        self.viewers.needs_images()
    }

    fn observe(&self, image: LiveImage) {
        self.viewers.observe(image);
    }

    fn needs_robot(&self) -> bool {
        // The pose of the base is needed, also if nobody watches.
        true
    }

    fn observe_robot(&self, state: RobotState) {
        self.watch.observe(&state);
        if self.viewers.needs_robot() {
            self.viewers.observe_robot(state);
        }
    }

    fn observe_keyframe(&self, keyframe: &Arc<Keyframe>) {
        self.viewers.observe_keyframe(keyframe);
    }

    fn observe_range_scan(&self, scan: RangeScan) {
        self.viewers.observe_range_scan(scan);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use kinematics::Stamp;
    use nalgebra::{Translation3, UnitQuaternion};
    use std::time::Instant;

    #[test]
    fn the_heading_is_that_of_the_x_axis_also_while_the_base_tilts() {
        let heading = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), 2.5);
        let tilt = UnitQuaternion::from_euler_angles(0.05, -0.03, 0.0);
        let watch = RobotWatch::new(TimeBase::now());
        assert_eq!(watch.seen(), SeenRobot::default());
        watch.observe(&RobotState {
            stamp: Stamp(0),
            captured_at: Instant::now(),
            world_from_base: Transform::from_parts(
                Translation3::new(1.0, -2.0, 0.5),
                heading * tilt,
            ),
            positions: Vec::new(),
        });
        let seen = watch.seen();
        let pose = seen.pose.expect("a pose").pose;
        assert_eq!((pose.x_m, pose.y_m), (1.0, -2.0));
        assert!((pose.yaw_rad - 2.5).abs() < 1e-3, "{pose:?}");
        assert_eq!(seen.posture, None, "there is no arm");
    }
}
