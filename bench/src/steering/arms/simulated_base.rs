//! A base that follows its velocities without error, and stops when they end.

use super::super::trace::{Recorder, Sample};
use super::{ArmKind, BenchBase, BenchRobot, Moved, Period, RunningArm};
use anyhow::Result;
use capture::config::BaseMotion;
use drivers::Error;
use drivers::base_motion::{BaseDrive, BaseLimits, BaseReport, BaseVelocity, MovableBase};
use drivers::motion::{MotionLimits, Setpoint};
use kinematics::Stamp;

/// Starts the base at rest.
pub(super) fn start() -> Result<BenchRobot> {
    robot_of(ArmKind::Base, Box::<FollowingBase>::default())
}

/// A base with the default limits of rig files, whose commanded velocities are recorded.
pub(super) fn robot_of(kind: ArmKind, base: Box<dyn MovableBase>) -> Result<BenchRobot> {
    let limits = BaseMotion::default().limits();
    let recorder = Recorder::default();
    let recorded = RecordedBase {
        base,
        recorder: recorder.clone(),
    };
    let drive = BaseDrive::start(Box::new(recorded), limits)?;
    Ok(BenchRobot {
        kind,
        moved: Moved::Base(BenchBase {
            port: drive.port().clone(),
            drive: Some(drive),
        }),
        recorder,
        checked_limits: brake_limits(&limits),
        brake_limits: brake_limits(&limits),
        period: Period::Stamps,
        running: Box::new(Nothing),
    })
}

/// The brake limits for each of the three velocities. A base has no limit of jerk.
fn brake_limits(limits: &BaseLimits) -> Vec<MotionLimits> {
    let of = |velocity: f64, acceleration: f64| MotionLimits {
        position: [f64::NEG_INFINITY, f64::INFINITY],
        velocity,
        acceleration,
        jerk: f64::INFINITY,
    };
    vec![
        of(limits.max_forward_m_s, limits.brake_m_s2),
        of(
            limits.max_left_m_s.max(f64::MIN_POSITIVE),
            limits.brake_m_s2,
        ),
        of(limits.max_yaw_rad_s, limits.brake_yaw_rad_s2),
    ]
}

/// Nothing runs but the thread of the base.
struct Nothing;

impl RunningArm for Nothing {}

/// Records the velocities that a base gets.
struct RecordedBase {
    base: Box<dyn MovableBase>,
    recorder: Recorder,
}

/// The motion of a base with a velocity since the last sample.
pub(super) fn setpoint_after(
    last: Option<&Sample>,
    now: Stamp,
    velocity: BaseVelocity,
) -> Setpoint {
    let velocity = velocity.to_array().to_vec();
    let position = match last {
        None => vec![0.0; velocity.len()],
        Some(last) => {
            let secs = now.secs_since(last.at);
            let parts = last.setpoint.position.iter().zip(&velocity);
            parts.map(|(at, velocity)| at + velocity * secs).collect()
        }
    };
    Setpoint {
        position,
        acceleration: vec![0.0; velocity.len()],
        velocity,
    }
}

impl MovableBase for RecordedBase {
    fn drive(&mut self, now: Stamp, velocity: &BaseVelocity) -> Result<(), Error> {
        let setpoint = setpoint_after(self.recorder.newest().as_ref(), now, *velocity);
        self.recorder.push(now, setpoint);
        self.base.drive(now, velocity)
    }

    fn report(&mut self, now: Stamp) -> BaseReport {
        self.base.report(now)
    }
}

/// A base that has the commanded velocity at once.
#[derive(Default)]
struct FollowingBase {
    velocity: BaseVelocity,
}

impl MovableBase for FollowingBase {
    fn drive(&mut self, _now: Stamp, velocity: &BaseVelocity) -> Result<(), Error> {
        self.velocity = *velocity;
        Ok(())
    }

    fn report(&mut self, now: Stamp) -> BaseReport {
        BaseReport {
            reported_at: Some(now),
            velocity: self.velocity,
            is_stop_confirmed: self.velocity == BaseVelocity::ZERO,
            ..BaseReport::default()
        }
    }
}
