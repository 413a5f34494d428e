//! What a robot lets a motion do, and how much of that is asked of it.

use super::N_JOINTS;
use super::reference::Reference;
use crate::motion::{JointTarget, MotionLimits};
use franka::joint_velocity_limits::JointVelocityLimitsConfig;
use franka::rate_limiting::{self, fer, limit_rate_joint_positions};

/// Seconds from command to command.
pub(super) const STEP_SECS: f64 = rate_limiting::DELTA_T;
/// Of the robot's largest speed and acceleration so much is asked at most: the rest is for commands that do not arrive.
const LIMIT_FRAC: f64 = 0.5;
/// And of its largest jerk: a command that is missed without being noticed makes the next one look like four times its jerk.
const JERK_LIMIT_FRAC: f64 = 0.25 * LIMIT_FRAC;
/// Targets stay so far inside a joint's range.
const MARGIN_RAD: f64 = 5e-3;
/// Taken off the speed that is left near the end of a range, beside what the robot takes off.
const SPEED_MARGIN_RAD_S: f64 = 1e-2;
/// A command that the limits change by less is as it was: rounding.
const UNCHANGED_RAD: f64 = 1e-9;

/// The limits of one robot.
#[derive(Clone, Debug)]
pub(super) struct RobotLimits {
    position_rad: [[f64; 2]; N_JOINTS],
    acceleration_rad_s2: [f64; N_JOINTS],
    jerk_rad_s3: [f64; N_JOINTS],
    speed: SpeedLimits,
}

/// How fast joints may be.
#[derive(Clone, Debug)]
enum SpeedLimits {
    /// As fast everywhere.
    Constant([f64; N_JOINTS]),
    /// Slower towards the ends of their ranges.
    PositionDependent(Box<JointVelocityLimitsConfig>),
}

impl RobotLimits {
    /// A Panda's. Source: `rate_limiting.h` of libfranka 0.9.2, `franka_description`.
    pub(super) fn panda() -> Self {
        let (lower, upper) = fer::JOINT_POSITION_LIMITS;
        Self {
            position_rad: std::array::from_fn(|ix| [lower[ix], upper[ix]]),
            acceleration_rad_s2: fer::MAX_JOINT_ACCELERATION,
            jerk_rad_s3: fer::MAX_JOINT_JERK,
            speed: SpeedLimits::Constant(fer::MAX_JOINT_VELOCITY),
        }
    }

    /// Of an FR3 by the description that it serves of itself; acceleration and jerk by `rate_limiting.h` of libfranka 0.21.2.
    pub(super) fn of_description(urdf: &str) -> Result<Self, String> {
        let speed = JointVelocityLimitsConfig::from_urdf(urdf)
            .map_err(|error| format!("its description of itself cannot be read: {error}"))?;
        let range = |ix: usize| [speed[ix].lower_position_limit, speed[ix].upper_position_limit];
        Ok(Self {
            position_rad: std::array::from_fn(range),
            acceleration_rad_s2: rate_limiting::MAX_JOINT_ACCELERATION,
            jerk_rad_s3: rate_limiting::MAX_JOINT_JERK,
            speed: SpeedLimits::PositionDependent(Box::new(speed)),
        })
    }

    /// What is asked of the robot at most: no more than wanted, and no more than its share of what the robot can.
    ///
    /// A joint that brakes with `a` for the end of its way is `sqrt(2 a d)` fast where `d` is left. An FR3 allows
    /// `sqrt(2 D (d + m)) - o` there, `m` the way from the target to the end of the range; with `a` no more than `LIMIT_FRAC` of `D`
    /// that is enough everywhere if `m` is at least `o² / (2 D (1 - LIMIT_FRAC))`.
    pub(super) fn allowed(&self, requested: &[MotionLimits]) -> Result<Vec<MotionLimits>, String> {
        let n = requested.len();
        if n != N_JOINTS {
            return Err(format!("the limits are of {n} joints, the arm has {N_JOINTS}"));
        }
        let allowed = |(ix, requested): (usize, &MotionLimits)| {
            let (max_speed, deceleration, offset) = match &self.speed {
                SpeedLimits::Constant(max_speed) => (max_speed[ix], self.acceleration_rad_s2[ix], 0.0),
                SpeedLimits::PositionDependent(joints) => (
                    joints[ix].max_velocity,
                    joints[ix].deceleration_limit,
                    joints[ix].velocity_offset + SPEED_MARGIN_RAD_S,
                ),
            };
            let margin = MARGIN_RAD + offset.powi(2) / (2.0 * deceleration * (1.0 - LIMIT_FRAC));
            let [lower, upper] = self.position_rad[ix];
            let position = [requested.position[0].max(lower + margin), requested.position[1].min(upper - margin)];
            if position[0] >= position[1] {
                let [min, max] = requested.position;
                return Err(format!(
                    "joint {} may be at {min} to {max} rad by the rig file, at {lower} to {upper} rad by the robot",
                    ix + 1
                ));
            }
            Ok(MotionLimits {
                position,
                velocity: requested.velocity.min(LIMIT_FRAC * max_speed),
                acceleration: requested.acceleration.min(LIMIT_FRAC * deceleration.min(self.acceleration_rad_s2[ix])),
                jerk: requested.jerk.min(JERK_LIMIT_FRAC * self.jerk_rad_s3[ix]),
            })
        };
        requested.iter().enumerate().map(allowed).collect()
    }

    /// A position to be sent, held back where the robot would stop for it; the flag tells whether it was.
    ///
    /// This is libfranka's rate limiter. Its low-pass filter is left out: setpoints are smooth, and it would only make them late.
    pub(super) fn limited(
        &self,
        requested_rad: [f64; N_JOINTS],
        reference: &Reference,
    ) -> Result<([f64; N_JOINTS], bool), String> {
        let (upper, lower) = match &self.speed {
            SpeedLimits::Constant(max_speed) => (*max_speed, max_speed.map(|max_speed| -max_speed)),
            SpeedLimits::PositionDependent(joints) => {
                let at = &reference.position_rad;
                // Beyond the end of its range a joint may still stand.
                (joints.upper_limits(at).map(|max| max.max(0.0)), joints.lower_limits(at).map(|min| min.min(0.0)))
            }
        };
        let limited = limit_rate_joint_positions(
            &upper,
            &lower,
            &self.acceleration_rad_s2,
            &self.jerk_rad_s3,
            &requested_rad,
            &reference.position_rad,
            &reference.velocity_rad_s,
            &reference.acceleration_rad_s2,
        );
        let limited = limited.map_err(|error| error.to_string())?;
        let is_same =
            limited.iter().zip(requested_rad).all(|(limited, requested)| (limited - requested).abs() <= UNCHANGED_RAD);
        Ok(if is_same { (requested_rad, false) } else { (limited, true) })
    }
}

/// A target brought into the joints' ranges.
pub(super) fn clamp_to_range(target: &JointTarget, limits: &[MotionLimits]) -> Result<JointTarget, String> {
    let n = target.position.len();
    if n != limits.len() {
        return Err(format!("the target has {n} joints, the arm {}", limits.len()));
    }
    if let Some(ix) = target.position.iter().position(|position| !position.is_finite()) {
        return Err(format!("the target of joint {} is no number: {}", ix + 1, target.position[ix]));
    }
    let joints = target.position.iter().zip(limits);
    Ok(JointTarget {
        position: joints.map(|(position, joint)| position.clamp(joint.position[0], joint.position[1])).collect(),
    })
}
