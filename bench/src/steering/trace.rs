//! The motion of an arm, with one sample per cycle, and the limits that it must keep.

use drivers::motion::{MotionLimits, Setpoint};
use kinematics::Stamp;
use parking_lot::Mutex;
use serde::Serialize;
use std::sync::Arc;
use std::time::Duration;

/// Rounding of differences between cycles, relative to a limit. A generator sets velocities of up
/// to 1e-8 to zero at the end of a trajectory, which looks like jerk.
const TOLERANCE: f64 = 1.0 + 1e-3;

/// The commanded motion of an arm in one cycle.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Sample {
    /// When the arm got the setpoint.
    pub(super) at: Stamp,
    /// Position, velocity and acceleration of each joint.
    pub(super) setpoint: Setpoint,
}

impl Sample {
    /// Euclidean norm of the joint velocities.
    pub(super) fn speed(&self) -> f64 {
        let velocity = self.setpoint.velocity.iter();
        velocity.map(|joint| joint * joint).sum::<f64>().sqrt()
    }
}

/// Collects the samples of an arm. Clones share them.
#[derive(Clone, Debug, Default)]
pub(super) struct Recorder(Arc<Mutex<Vec<Sample>>>);

impl Recorder {
    /// Adds the setpoint of a cycle.
    pub(super) fn push(&self, at: Stamp, setpoint: Setpoint) {
        self.0.lock().push(Sample { at, setpoint });
    }

    /// Removes and returns all samples but the newest one, so that the next samples continue them
    /// without a gap.
    pub(super) fn take(&self) -> Vec<Sample> {
        let mut samples = self.0.lock();
        let newest = samples.last().cloned().into_iter().collect();
        std::mem::replace(&mut *samples, newest)
    }

    /// The newest sample.
    pub(super) fn newest(&self) -> Option<Sample> {
        self.0.lock().last().cloned()
    }
}

/// Time between two setpoints.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Period {
    /// Always the same. The stamps show when a busy computer generated the setpoints, not when they
    /// are due.
    Constant(Duration),
    /// The difference of their stamps, for which they were computed.
    Stamps,
}

/// Limits of a joint in each cycle.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum LimitKind {
    /// The range.
    Position,
    /// The velocity.
    Velocity,
    /// The acceleration.
    Acceleration,
    /// The jerk.
    Jerk,
}

/// A limit that was exceeded.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Excess {
    /// Which limit.
    pub kind: LimitKind,
    /// Index of the joint.
    pub joint_ix: usize,
    /// The value, in radians or meters and seconds.
    pub value: f64,
    /// The limit in the same unit.
    pub limit: f64,
}

/// The largest excess over any limit, relative to the limit, in differences between neighboring
/// cycles; `None` if every limit is kept.
///
/// * `limits`: of each joint.
/// * `period`: time between two cycles.
pub(super) fn largest_excess(
    samples: &[Sample],
    limits: &[MotionLimits],
    period: Period,
) -> Option<Excess> {
    let mut largest: Option<(f64, Excess)> = None;
    let mut note = |kind, joint_ix, value: f64, limit: f64, ratio: f64| {
        // Written so that NaN counts as an excess.
        let is_kept = ratio <= TOLERANCE;
        if !is_kept && largest.is_none_or(|(most, _)| ratio > most) {
            let excess = Excess {
                kind,
                joint_ix,
                value,
                limit,
            };
            largest = Some((ratio, excess));
        }
    };
    for pair in samples.windows(2) {
        let [before, after] = [&pair[0].setpoint, &pair[1].setpoint];
        let period_secs = match period {
            Period::Constant(period) => period.as_secs_f64(),
            Period::Stamps => pair[1].at.secs_since(pair[0].at),
        };
        for (ix, joint) in limits.iter().enumerate() {
            let position = after.position[ix];
            let [lower, upper] = joint.position;
            for (bound, beyond) in [(lower, lower - position), (upper, position - upper)] {
                // The excess of a range is relative to one radian, because ranges have no natural scale.
                note(LimitKind::Position, ix, position, bound, 1.0 + beyond);
            }
            let rate = |after: &[f64], before: &[f64]| (after[ix] - before[ix]) / period_secs;
            for (kind, value, limit) in [
                (
                    LimitKind::Velocity,
                    rate(&after.position, &before.position),
                    joint.velocity,
                ),
                (
                    LimitKind::Acceleration,
                    rate(&after.velocity, &before.velocity),
                    joint.acceleration,
                ),
                (
                    LimitKind::Jerk,
                    rate(&after.acceleration, &before.acceleration),
                    joint.jerk,
                ),
            ] {
                note(kind, ix, value, limit, value.abs() / limit);
            }
        }
    }
    largest.map(|(_, excess)| excess)
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use drivers::motion::{JointTarget, TrajectoryGenerator};
    use std::time::Duration;

    pub(in super::super) const PERIOD: Duration = Duration::from_millis(1);
    const CONSTANT: Period = Period::Constant(PERIOD);
    const PERIOD_NANOS: i64 = 1_000_000;

    pub(in super::super) fn limits() -> Vec<MotionLimits> {
        let joint = MotionLimits {
            position: [-1.0, 1.0],
            velocity: 0.5,
            acceleration: 2.0,
            jerk: 40.0,
        };
        vec![joint; 2]
    }

    /// The record of an arm that moves at its full velocity and brakes after some cycles.
    pub(in super::super) fn braked_motion(
        n_moving: i64,
        brake_limits: &[MotionLimits],
    ) -> Vec<Sample> {
        let start = [-0.9, 0.2];
        let mut generator = TrajectoryGenerator::new(&limits(), &start, PERIOD).expect("valid");
        let target = JointTarget {
            position: vec![0.9, 0.1],
        };
        generator.set_target(&target).expect("in its range");
        let mut samples = Vec::new();
        let mut step = |generator: &mut TrajectoryGenerator| {
            let setpoint = generator.step().expect("a plan");
            let at = Stamp(samples.len() as i64 * PERIOD_NANOS);
            samples.push(Sample { at, setpoint });
            samples[samples.len() - 1].clone()
        };
        let mut last = None;
        for _ in 0..n_moving {
            last = Some(step(&mut generator));
        }
        let last = last.expect("it moves");
        let mut brake =
            TrajectoryGenerator::new(brake_limits, &last.setpoint.position, PERIOD).expect("valid");
        brake.resume(&last.setpoint).expect("finite");
        brake.stop();
        while !brake.is_at_rest() {
            step(&mut brake);
        }
        for _ in 0..50 {
            step(&mut brake);
        }
        samples
    }

    #[test]
    fn a_motion_within_its_limits_has_no_excess() {
        let samples = braked_motion(1000, &limits());
        assert_eq!(largest_excess(&samples, &limits(), CONSTANT), None);
    }

    #[test]
    fn each_exceeded_limit_is_found_with_its_joint() {
        let samples = braked_motion(1000, &limits());
        let narrower = |kind| {
            let mut limits = limits();
            let joint = &mut limits[0];
            match kind {
                LimitKind::Position => joint.position = [-1.0, -0.8],
                LimitKind::Velocity => joint.velocity = 0.4,
                LimitKind::Acceleration => joint.acceleration = 1.5,
                LimitKind::Jerk => joint.jerk = 20.0,
            }
            limits
        };
        for kind in [
            LimitKind::Position,
            LimitKind::Velocity,
            LimitKind::Acceleration,
            LimitKind::Jerk,
        ] {
            let excess =
                largest_excess(&samples, &narrower(kind), CONSTANT).expect("it is exceeded");
            assert_eq!((excess.kind, excess.joint_ix), (kind, 0), "{excess:?}");
        }
        let mut jump = samples.clone();
        jump[500].setpoint.position[1] = f64::NAN;
        let excess = largest_excess(&jump, &limits(), CONSTANT).expect("not a number");
        assert_eq!(excess.joint_ix, 1, "{excess:?}");
    }

    #[test]
    fn samples_that_are_taken_continue_without_a_gap() {
        let recorder = Recorder::default();
        for nanos in 0..3 {
            recorder.push(Stamp(nanos), Setpoint::at_rest(vec![0.0]));
        }
        assert_eq!(recorder.take().len(), 3);
        recorder.push(Stamp(3), Setpoint::at_rest(vec![0.0]));
        let stamps: Vec<i64> = recorder.take().iter().map(|sample| sample.at.0).collect();
        assert_eq!(stamps, [2, 3]);
        assert_eq!(recorder.newest().map(|sample| sample.at), Some(Stamp(3)));
    }
}
