//! Motion limits of a robot, and the fraction of them that we use.

use super::N_JOINTS;
use super::reference::Reference;
use crate::motion::MotionLimits;
use franka::joint_velocity_limits::JointVelocityLimitsConfig;
use franka::rate_limiting::{self, fer, limit_rate_joint_positions};

/// Fraction of the robot's maximum velocity and acceleration that we use. The rest is a reserve for
/// lost commands: the robot then keeps its acceleration for some milliseconds, and the next
/// setpoints make up for the difference. A larger fraction makes motions faster, and reflexes more
/// likely.
const LIMIT_FRAC: f64 = 0.5;
/// Fraction of the robot's maximum jerk that we use. If a command is lost unnoticed, the robot sees
/// the next command with four times its jerk.
///
/// The factor follows from the differences of positions. With the jerk `j` and the step `T`, the
/// lost command leaves the robot `j T³` behind the trajectory, and the next one brings it back.
/// Over these steps, the position error is `0, 0, -j T³, 0`. Its third difference is `3 j T³`,
/// which is added to the `j T³` of the trajectory. A factor of a quarter thus keeps this jerk
/// within the same fraction as the velocity.
const JERK_LIMIT_FRAC: f64 = 0.25 * LIMIT_FRAC;
/// Distance of targets from the ends of a joint's range. Beyond the end, the robot stops with an
/// error. A joint must therefore stay inside even if it overshoots because of rounding or a missed
/// command at the end of a motion. The margin reduces the range by 0.3 degrees.
const MARGIN_RAD: f64 = 5e-3;
/// Margin subtracted from the velocity near the end of a range, in addition to the robot's own. It
/// covers the tolerance of libfranka's limiter, 0.001 rad/s, and the difference between continuous
/// and sampled velocities.
const SPEED_MARGIN_RAD_S: f64 = 1e-2;
/// Changes by the rate limiter that are smaller than this are rounding errors.
const UNCHANGED_RAD: f64 = 1e-9;

/// Rounding of a quotient of limits.
const FACTOR_ROUNDING: f64 = 1.0 + 1e-9;

/// Limits of one robot.
#[derive(Clone, Debug)]
pub(super) struct RobotLimits {
    position_rad: [[f64; 2]; N_JOINTS],
    acceleration_rad_s2: [f64; N_JOINTS],
    jerk_rad_s3: [f64; N_JOINTS],
    speed: SpeedLimits,
}

/// Velocity limits of the joints.
#[derive(Clone, Debug)]
enum SpeedLimits {
    /// Limits that do not depend on the position.
    Constant([f64; N_JOINTS]),
    /// Limits that are lower towards the ends of the joint ranges.
    PositionDependent(Box<JointVelocityLimitsConfig>),
}

impl RobotLimits {
    /// Limits of a Panda. Source: `rate_limiting.h` of libfranka 0.9.2, `franka_description`.
    pub(super) fn panda() -> Self {
        let (lower, upper) = fer::JOINT_POSITION_LIMITS;
        Self {
            position_rad: std::array::from_fn(|ix| [lower[ix], upper[ix]]),
            acceleration_rad_s2: fer::MAX_JOINT_ACCELERATION,
            jerk_rad_s3: fer::MAX_JOINT_JERK,
            speed: SpeedLimits::Constant(fer::MAX_JOINT_VELOCITY),
        }
    }

    /// Limits of an FR3: position and velocity from the URDF that it serves, acceleration and jerk
    /// from `rate_limiting.h` of libfranka 0.21.2.
    pub(super) fn of_description(urdf: &str) -> Result<Self, String> {
        let speed = JointVelocityLimitsConfig::from_urdf(urdf).map_err(|error| {
            format!("cannot parse the robot description that it serves: {error}")
        })?;
        Ok(Self {
            position_rad: std::array::from_fn(|ix| {
                let joint = &speed[ix];
                [joint.lower_position_limit, joint.upper_position_limit]
            }),
            acceleration_rad_s2: rate_limiting::MAX_JOINT_ACCELERATION,
            jerk_rad_s3: rate_limiting::MAX_JOINT_JERK,
            speed: SpeedLimits::PositionDependent(Box::new(speed)),
        })
    }

    /// Limits for our motions: at most the requested limits, and at most our fraction of the
    /// robot's limits.
    ///
    /// A joint that decelerates with `a` towards its target has the velocity `sqrt(2 a d)` at the
    /// distance `d`. An FR3 allows `sqrt(2 D (d + m)) - o` there, where `m` is the distance from
    /// the target to the end of the range. If `a` is at most `LIMIT_FRAC * D`, this suffices
    /// everywhere if `m` is at least `o² / (2 D (1 - LIMIT_FRAC))`.
    pub(super) fn allowed(&self, requested: &[MotionLimits]) -> Result<Vec<MotionLimits>, String> {
        let n = requested.len();
        if n != N_JOINTS {
            return Err(format!(
                "limits are given for {n} joints, but the arm has {N_JOINTS}"
            ));
        }
        requested
            .iter()
            .enumerate()
            .map(|(ix, requested)| self.allowed_for_joint(ix, requested))
            .collect()
    }

    /// Limits of one joint, see [`RobotLimits::allowed`].
    fn allowed_for_joint(
        &self,
        ix: usize,
        requested: &MotionLimits,
    ) -> Result<MotionLimits, String> {
        let (max_speed, deceleration, offset) = match &self.speed {
            // Without limits that depend on the position, only the fixed margin is needed.
            SpeedLimits::Constant(max_speed) => (max_speed[ix], self.acceleration_rad_s2[ix], 0.0),
            SpeedLimits::PositionDependent(joints) => (
                joints[ix].max_velocity,
                joints[ix].deceleration_limit,
                joints[ix].velocity_offset + SPEED_MARGIN_RAD_S,
            ),
        };
        let margin = MARGIN_RAD + offset.powi(2) / (2.0 * deceleration * (1.0 - LIMIT_FRAC));
        let [lower, upper] = self.position_rad[ix];
        let position = [
            requested.position[0].max(lower + margin),
            requested.position[1].min(upper - margin),
        ];
        // The rig file is probably of another robot. An empty range would also make the clamping of
        // targets panic.
        if position[0] >= position[1] {
            let [min, max] = requested.position;
            return Err(format!(
                "the ranges of joint {} do not overlap: {min} to {max} rad in the rig file, {lower} to {upper} rad in the robot",
                ix + 1
            ));
        }
        Ok(MotionLimits {
            position,
            velocity: requested.velocity.min(LIMIT_FRAC * max_speed),
            // The deceleration of the position-dependent limits may be lower than the maximum
            // acceleration, and the derivation above needs `a <= LIMIT_FRAC * D`.
            acceleration: requested
                .acceleration
                .min(LIMIT_FRAC * deceleration.min(self.acceleration_rad_s2[ix])),
            jerk: requested.jerk.min(JERK_LIMIT_FRAC * self.jerk_rad_s3[ix]),
        })
    }

    /// Checks that braking stays within the limits of the robot. Its jerk may be a quarter of the
    /// robot's, for the reason of [`JERK_LIMIT_FRAC`].
    pub(super) fn check_brake_factor(
        &self,
        limits: &[MotionLimits],
        factor: f64,
    ) -> Result<(), String> {
        for (ix, joint) in limits.iter().enumerate() {
            let max_factor = (self.acceleration_rad_s2[ix] / joint.acceleration)
                .min(0.25 * self.jerk_rad_s3[ix] / joint.jerk);
            if factor > max_factor * FACTOR_ROUNDING {
                return Err(format!(
                    "it cannot brake joint {} with {factor} times the acceleration and jerk of its motions, but with {max_factor:.2} times at most: lower the factor, or the acceleration of motions",
                    ix + 1
                ));
            }
        }
        Ok(())
    }

    /// Limits the rates of a position to be sent, so that the robot does not trigger a reflex.
    /// Returns the position and whether it was changed.
    ///
    /// This is libfranka's rate limiter without its low-pass filter: our setpoints are smooth, and
    /// the filter would only delay them.
    pub(super) fn limited(
        &self,
        requested_rad: [f64; N_JOINTS],
        reference: &Reference,
    ) -> Result<([f64; N_JOINTS], bool), String> {
        let (upper, lower) = match &self.speed {
            SpeedLimits::Constant(max_speed) => (*max_speed, max_speed.map(|max_speed| -max_speed)),
            SpeedLimits::PositionDependent(joints) => {
                let at = &reference.position_rad;
                // A joint beyond the end of its range may stay at rest there.
                (
                    joints.upper_limits(at).map(|max| max.max(0.0)),
                    joints.lower_limits(at).map(|min| min.min(0.0)),
                )
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
        // The limiter computes the position from rates, so rounding changes the position even if
        // nothing was limited. Only larger changes are counted and passed on to the generator.
        let is_same = limited
            .iter()
            .zip(requested_rad)
            .all(|(limited, requested)| (limited - requested).abs() <= UNCHANGED_RAD);
        Ok(if is_same {
            (requested_rad, false)
        } else {
            (limited, true)
        })
    }
}
