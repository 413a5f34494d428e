//! The newest reports of the devices of a run: the pose of the base, and the posture of the arm.

use super::pose_tracker::PoseTracker;
use crate::steering::observer::RobotObserver;
use crate::steering::time_base::TimeBase;
use kinematics::{JointState, Stamp, Transform};
use nalgebra::Vector3;
use parking_lot::Mutex;
use steering::{FloorPose, SeenPose, SeenPosture};
use viz::RobotState;

/// State of a robot besides the report of its base.
#[derive(Clone, Debug, Default, PartialEq)]
pub(in crate::steering) struct SeenRobot {
    /// Pose of the base link on the floor.
    pub(in crate::steering) pose: Option<SeenPose>,
    /// Posture of the arm; `None` without an arm.
    pub(in crate::steering) posture: Option<SeenPosture>,
}

/// The newest state of a robot.
#[derive(Debug)]
pub(in crate::steering) struct RobotWatch {
    times: TimeBase,
    newest: Mutex<Newest>,
}

#[derive(Debug, Default)]
struct Newest {
    /// As the input of the run delivers it.
    delivered: SeenRobot,
    poses: PoseTracker,
    /// Posture in the report of the arm itself.
    posture: Option<SeenPosture>,
    /// Poses that the input has delivered, for bases whose device reports nothing itself.
    delivered_poses: PoseTracker,
}

impl RobotWatch {
    /// Nothing is known yet.
    pub(in crate::steering) fn new(times: TimeBase) -> Self {
        Self {
            times,
            newest: Mutex::default(),
        }
    }

    /// The clocks of stamps and instants.
    pub(in crate::steering) fn times(&self) -> TimeBase {
        self.times
    }

    /// The newest state. Reports of the devices themselves come first, because the input of the run
    /// waits for a busy trainer.
    pub(in crate::steering) fn seen(&self) -> SeenRobot {
        let newest = self.newest.lock();
        let reported = newest.poses.newest();
        let reported = reported.map(|(at, world_from_base)| seen_pose(at, &world_from_base));
        let posture = newest.posture.as_ref();
        SeenRobot {
            pose: reported.or(newest.delivered.pose),
            posture: posture.or(newest.delivered.posture.as_ref()).cloned(),
        }
    }

    /// Pose of the base in the map at a time; `None` if it is unknown.
    pub(in crate::steering) fn world_from_base(&self, at: Stamp) -> Option<Transform> {
        let newest = self.newest.lock();
        let delivered = || newest.delivered_poses.at(at);
        newest.poses.at(at).or_else(delivered)
    }

    /// The newest correction of the poses that the device of the base reports.
    pub(in crate::steering) fn map_from_odom(&self) -> Option<Transform> {
        self.newest.lock().poses.map_from_odom()
    }

    /// The newest pose of the base in the map, with its time.
    pub(in crate::steering) fn newest_pose(&self) -> Option<(Stamp, Transform)> {
        let newest = self.newest.lock();
        let delivered = || newest.delivered_poses.newest();
        newest.poses.newest().or_else(delivered)
    }

    /// Notes a pose that the base has reported, without the corrections of stations.
    pub(in crate::steering) fn report_pose(&self, at: Stamp, odom_from_base: Transform) {
        self.newest.lock().poses.report(at, odom_from_base);
    }

    /// Notes a joint state that the arm has reported.
    ///
    /// * `offsets`: added to the positions; empty if there are none.
    pub(in crate::steering) fn report_joints(&self, joints: &JointState, offsets: &[f64]) {
        let offset = |ix: usize| offsets.get(ix).copied().unwrap_or(0.0);
        let positions = joints.position.iter().enumerate();
        self.newest.lock().posture = Some(SeenPosture {
            at: joints.stamp,
            position: positions.map(|(ix, q)| q + offset(ix)).collect(),
        });
    }

    fn observe(&self, state: &RobotState) {
        let at = self.times.stamp(state.captured_at);
        let has_arm = !state.positions.is_empty();
        let mut newest = self.newest.lock();
        newest.poses.correct(state.stamp, &state.world_from_base);
        newest
            .delivered_poses
            .report_in_map(state.stamp, state.world_from_base);
        newest.delivered = SeenRobot {
            pose: Some(seen_pose(at, &state.world_from_base)),
            posture: has_arm.then(|| SeenPosture {
                at,
                position: state.positions.clone(),
            }),
        };
    }
}

fn seen_pose(at: Stamp, world_from_base: &Transform) -> SeenPose {
    SeenPose {
        at,
        pose: floor_pose(world_from_base),
        z_m: world_from_base.translation.z,
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

impl RobotObserver for RobotWatch {
    fn observe_robot(&self, state: &RobotState) {
        self.observe(state);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Translation3, UnitQuaternion};
    use std::time::Instant;

    #[test]
    fn reports_of_the_devices_replace_what_the_input_delivers_late() {
        let watch = RobotWatch::new(TimeBase::now());
        let moved = |x_m: f64| Transform::translation(x_m, 0.0, 0.5);
        watch.report_pose(Stamp(1_000_000_000), moved(1.0));
        watch.report_pose(Stamp(2_000_000_000), moved(2.0));
        assert_eq!(watch.seen().pose, None, "the map is not known yet");
        watch.observe(&RobotState {
            stamp: Stamp(1_000_000_000),
            captured_at: Instant::now(),
            world_from_base: Transform::translation(1.0, 0.25, 0.5),
            positions: vec![0.5],
        });
        let pose = watch.seen().pose.expect("a pose");
        assert_eq!((pose.at, pose.z_m), (Stamp(2_000_000_000), 0.5));
        assert_eq!((pose.pose.x_m, pose.pose.y_m), (2.0, 0.25));
        assert_eq!(watch.seen().posture.map(|it| it.position), Some(vec![0.5]));
        let joints = JointState {
            stamp: Stamp(3_000_000_000),
            position: vec![0.75],
            velocity: Vec::new(),
            effort: Vec::new(),
        };
        watch.report_joints(&joints, &[0.25]);
        let posture = watch.seen().posture.expect("a posture");
        assert_eq!((posture.at, posture.position), (joints.stamp, vec![1.0]));
    }

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
