//! Combines the readings of single motors into states of all joints.

use super::motor::Reading;
use kinematics::{JointState, Stamp};

/// Minimum velocity for extrapolation, rad/s. The position of a slower joint is not extrapolated.
///
/// Most motors encode the velocity as an integer that cannot represent 0, so a motor at rest
/// reports the nearest velocity. With 12 bits for -60 to 60 rad/s, this is 0.015 rad/s. If an
/// answer is 0.2 s late, extrapolation would move a joint at rest by 3 mrad.
const MIN_EXTRAPOLATED_RAD_S: f64 = 0.015;

/// A reading of one joint.
#[derive(Debug)]
pub(super) struct JointReading {
    pub(super) joint_ix: usize,
    pub(super) stamp: Stamp,
    pub(super) reading: Reading,
}

/// The newest reading of each joint.
#[derive(Debug)]
pub(super) struct Joints {
    newest: Vec<Option<(Stamp, Reading)>>,
}

impl Joints {
    pub(super) fn new(n: usize) -> Self {
        Self {
            newest: vec![None; n],
        }
    }

    /// Adds a reading. Once every joint has a new reading, returns a state and starts over.
    pub(super) fn take(&mut self, joint_reading: &JointReading) -> Option<JointState> {
        // A second reading of a joint replaces the first, so that a state contains the newest data
        // of fast motors.
        self.newest[joint_reading.joint_ix] = Some((joint_reading.stamp, joint_reading.reading));
        let all = self.newest.iter().copied().collect::<Option<Vec<_>>>()?;
        // Every state consists of new readings only. Otherwise, a silent motor would keep its last
        // position in all later states.
        self.newest.fill(None);
        let stamp = all.iter().map(|(stamp, _)| *stamp).max()?;
        let at = |(stamp_of_reading, reading): &(Stamp, Reading)| {
            position_after(reading, stamp.secs_since(*stamp_of_reading))
        };
        Some(JointState {
            stamp,
            position: all.iter().map(at).collect(),
            velocity: all
                .iter()
                .map(|(_, reading)| reading.velocity_rad_s)
                .collect(),
            // If one motor reports no effort, the list stays empty, because it must have one entry
            // per joint or none.
            effort: all
                .iter()
                .map(|(_, reading)| reading.effort_nm)
                .collect::<Option<_>>()
                .unwrap_or_default(),
        })
    }
}

/// Position some time after a reading, rad.
///
/// Motors answer one after another. At 1 rad/s and with 2 ms between the first and the last answer,
/// a state without extrapolation would be wrong by 2 mrad.
fn position_after(reading: &Reading, secs: f64) -> f64 {
    if reading.velocity_rad_s.abs() < MIN_EXTRAPOLATED_RAD_S {
        reading.position_rad
    } else {
        reading.position_rad + reading.velocity_rad_s * secs
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn joint_reading(joint_ix: usize, millis: i64, position_rad: f64) -> JointReading {
        let reading = Reading {
            position_rad,
            velocity_rad_s: 2.0,
            effort_nm: Some(0.5),
        };
        JointReading {
            joint_ix,
            stamp: Stamp(millis * 1_000_000),
            reading,
        }
    }

    #[test]
    fn state_waits_for_all_joints_and_extrapolates() {
        let mut joints = Joints::new(3);
        assert_eq!(joints.take(&joint_reading(0, 1, 0.0)), None);
        assert_eq!(joints.take(&joint_reading(2, 2, 0.2)), None);
        assert_eq!(
            joints.take(&joint_reading(0, 3, 0.1)),
            None,
            "the newer reading replaces the older"
        );
        let state = joints.take(&joint_reading(1, 5, 0.3)).unwrap();
        assert_eq!(state.stamp, Stamp(5_000_000));
        let expected = [0.1 + 2.0 * 0.002, 0.3, 0.2 + 2.0 * 0.003];
        assert!(
            state
                .position
                .iter()
                .zip(expected)
                .all(|(got, expected)| (got - expected).abs() < 1e-12)
        );
        assert_eq!((state.velocity, state.effort), (vec![2.0; 3], vec![0.5; 3]));
        assert_eq!(
            joints.take(&joint_reading(1, 6, 0.3)),
            None,
            "it starts over"
        );
    }

    #[test]
    fn joints_at_rest_are_not_extrapolated() {
        let mut joints = Joints::new(2);
        let mut early = joint_reading(0, 0, 0.25);
        early.reading.velocity_rad_s = -0.0073; // What a motor with 30 rad/s and 12 bits reports.
        assert_eq!(joints.take(&early), None);
        let state = joints.take(&joint_reading(1, 200, 0.5)).unwrap();
        assert_eq!(state.position, [0.25, 0.5]);
    }
}
