//! The current joint positions and base pose of the robot, for viewers.

use crate::config::{BaseDriver, Rig};
use crate::stamp_clock::StampClock;
use drivers::Sample;
use keyframe::RobotState;
use kinematics::{Stamp, Transform};

/// Follows the readings of the robot. Unlike the join, it returns every reading at once, without
/// interpolation.
#[derive(Clone, Debug)]
pub struct RobotMotion {
    /// Number of joints in a reading, and the offset of each.
    n_joints: usize,
    joint_offsets: Vec<f64>,
    /// `None` before the first pose of a moving base.
    world_from_base: Option<Transform>,
    /// Time of this pose; `None` if the base is fixed.
    base_stamp: Option<Stamp>,
    has_moving_base: bool,
}

impl RobotMotion {
    /// The robot of a rig, without readings.
    #[must_use]
    pub fn new(rig: &Rig) -> Self {
        let has_moving_base = rig.base.driver != BaseDriver::Fixed;
        Self {
            n_joints: rig.arm.joints.len(),
            joint_offsets: rig.arm.joint_offsets.clone(),
            world_from_base: (!has_moving_base).then_some(rig.base.world_from_base),
            base_stamp: None,
            has_moving_base,
        }
    }

    /// Takes a sample. Returns the state of the robot if the sample changes this state and the pose
    /// of the base is known. The stamp of the state is the older one of the stamps of the joint
    /// positions and of the base pose. The base pose does not include the correction of its
    /// station. The joint positions include the joint offsets.
    pub fn push(&mut self, sample: &Sample, clock: &StampClock) -> Option<RobotState> {
        match sample {
            Sample::Joints(state) => {
                let is_valid = state.position.len() == self.n_joints
                    && state.position.iter().all(|q| q.is_finite());
                let offset = |ix: usize| self.joint_offsets.get(ix).copied().unwrap_or_default();
                let positions = state
                    .position
                    .iter()
                    .enumerate()
                    .map(|(ix, position)| position + offset(ix))
                    .collect();
                let world_from_base = self.world_from_base.filter(|_| is_valid)?;
                let stamp = self
                    .base_stamp
                    .map_or(state.stamp, |base_stamp| base_stamp.min(state.stamp));
                Some(RobotState {
                    stamp,
                    captured_at: clock.captured_at(stamp),
                    world_from_base,
                    positions,
                })
            }
            Sample::Base(pose)
                if self.has_moving_base
                    && kinematics::transform::is_finite(&pose.world_from_base) =>
            {
                self.world_from_base = Some(pose.world_from_base);
                self.base_stamp = Some(pose.stamp);
                // If the robot has joints, their readings report the state, because they come more
                // often than base poses.
                (self.n_joints == 0).then(|| RobotState {
                    stamp: pose.stamp,
                    captured_at: clock.captured_at(pose.stamp),
                    world_from_base: pose.world_from_base,
                    positions: Vec::new(),
                })
            }
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::RobotMotion;
    use crate::StampClock;
    use drivers::{BasePose, Sample};
    use keyframe::RobotState;
    use kinematics::{JointState, Stamp, Transform};

    fn joints(position: Vec<f64>) -> Sample {
        joints_at(7, position)
    }

    fn joints_at(stamp: i64, position: Vec<f64>) -> Sample {
        Sample::Joints(JointState {
            stamp: Stamp(stamp),
            position,
            velocity: Vec::new(),
            effort: Vec::new(),
        })
    }

    fn base(x: f64) -> Sample {
        Sample::Base(BasePose {
            stamp: Stamp(9),
            world_from_base: Transform::translation(x, 0.0, 0.0),
        })
    }

    fn push(robot: &mut RobotMotion, sample: &Sample) -> Option<RobotState> {
        robot.push(sample, &StampClock::Unrelated)
    }

    fn motion(n_joints: usize, world_from_base: Option<Transform>) -> RobotMotion {
        RobotMotion {
            n_joints,
            joint_offsets: vec![0.1; n_joints],
            world_from_base,
            base_stamp: None,
            has_moving_base: world_from_base.is_none(),
        }
    }

    #[test]
    fn readings_have_offsets_and_the_latest_base_pose() {
        let mut moving = motion(2, None);
        assert_eq!(
            push(&mut moving, &joints(vec![1.0, 2.0])),
            None,
            "the base is nowhere yet"
        );
        assert_eq!(push(&mut moving, &base(3.0)), None, "the joints follow");
        let reading = push(&mut moving, &joints(vec![1.0, 2.0])).expect("a reading");
        assert_eq!(
            (reading.stamp, reading.world_from_base.translation.x),
            (Stamp(7), 3.0)
        );
        assert_eq!(reading.positions, [1.1, 2.1]);
        let mut fixed = motion(2, Some(Transform::identity()));
        assert_eq!(
            push(&mut fixed, &base(3.0)),
            None,
            "a fixed base does not move"
        );
        assert_eq!(
            push(&mut fixed, &joints(vec![0.0, 0.0]))
                .expect("a reading")
                .world_from_base,
            Transform::identity()
        );
    }

    #[test]
    fn the_older_of_joints_and_base_counts() {
        let mut moving = motion(1, None);
        assert_eq!(push(&mut moving, &base(0.0)), None, "the joints follow");
        assert_eq!(
            push(&mut moving, &joints_at(8, vec![0.0]))
                .expect("a reading")
                .stamp,
            Stamp(8),
            "the base is newer"
        );
        let frozen = push(&mut moving, &joints_at(5_000, vec![0.0])).expect("a reading");
        assert_eq!(frozen.stamp, Stamp(9), "the base has not reported since");
        let mut fixed = motion(1, Some(Transform::identity()));
        assert_eq!(
            push(&mut fixed, &joints_at(5_000, vec![0.0]))
                .expect("a reading")
                .stamp,
            Stamp(5_000)
        );
    }

    #[test]
    fn invalid_readings_are_ignored() {
        let mut fixed = motion(2, Some(Transform::identity()));
        assert_eq!(push(&mut fixed, &joints(vec![1.0])), None);
        assert_eq!(push(&mut fixed, &joints(vec![1.0, f64::NAN])), None);
    }

    #[test]
    fn a_base_without_joints_is_a_robot_too() {
        let mut moving = motion(0, None);
        assert_eq!(
            push(&mut moving, &base(2.0))
                .expect("a reading")
                .world_from_base
                .translation
                .x,
            2.0
        );
    }
}
