//! Motion of the robot's base. The base is fixed, moves around a pedestal, or walks from one
//! station to the next.

use crate::config::Scene;
use crate::random::RandomStream;
use kinematics::Transform;
use nalgebra::{Translation3, UnitQuaternion, Vector3};
use std::f64::consts::TAU;

/// Closed-form motion of the base, which can be evaluated at any time.
#[derive(Clone, Copy, Debug)]
pub(crate) enum BaseMotion {
    /// The base is at the world's origin.
    Fixed,
    /// The base is at this pose in the world.
    FixedAt(Transform),
    /// A quadruped walks sideways around the origin, facing mostly inward. The value scales its
    /// speed.
    Lap(f64),
    /// A base on wheels drives the same lap.
    Rolling {
        /// Factor on the speed.
        speed: f64,
        /// Height of the base link above the floor, meters.
        height_m: f64,
    },
    /// The base stands at a far station, then walks to a near station. The value scales its speed.
    Stations(f64),
}

/// Duration of a lap at speed 1, seconds.
const LAP_SECS: f64 = 36.0;
/// Length of a lap, meters: a circle with the mean radius of the lap.
pub(crate) const LAP_M: f64 = TAU * 2.25;
/// Gait frequency at speed 1. A trotting quadruped of this size takes one to two steps per second.
const GAIT_HZ: f64 = 1.7;
/// Amplitudes of the body motion that the gait causes. A quadruped of this size moves its body by
/// millimeters.
const BOUNCE_M: f64 = 0.007;
const ROLL_RAD: f64 = 0.008;
const PITCH_RAD: f64 = 0.006;
/// Height of the body's center above the floor, meters.
pub(crate) const BODY_Z_M: f64 = 0.52;

/// Time at which the base leaves the first station, seconds at speed 1.
const DEPARTURE_SECS: f64 = 14.0;
/// Duration of the walk to the second station, seconds at speed 1.
const WALK_DURATION_SECS: f64 = 5.0;
/// The stations, each as x and y in meters and heading in radians.
const FAR_STATION: [f64; 3] = [0.0, 0.15, -0.06];
const NEAR_STATION: [f64; 3] = [1.15, 0.0, 0.02];

/// Pose of the arm's base on the quadruped's back. In the URDFs, this is the link `top_plate`.
pub(crate) fn base_from_arm() -> Transform {
    Transform::translation(0.12, 0.0, 0.10)
}

/// Smootherstep (Perlin 2002). It is 0 below zero and 1 above one, and has continuous first and
/// second derivatives. Velocity and acceleration are zero at both ends.
pub(crate) fn smooth(share: f64) -> f64 {
    let share = share.clamp(0.0, 1.0);
    share.powi(3) * (10.0 - 15.0 * share + 6.0 * share * share)
}

/// A sine with an offset. The parameters are mean, amplitude, period in seconds, and phase in
/// turns.
pub(crate) fn oscillate([mean, amplitude, period, phase]: [f64; 4], at: f64) -> f64 {
    mean + amplitude * ((at / period + phase) * TAU).sin()
}

impl BaseMotion {
    /// The motion of a scene's base.
    pub(crate) fn of(scene: Scene, speed: f64) -> Self {
        match scene {
            Scene::StaticArm => Self::Fixed,
            Scene::MobileBase => Self::Lap(speed),
            Scene::MobileArm => Self::Stations(speed),
        }
    }

    /// Height of the base link above the floor while the base stands still, meters.
    pub(crate) fn rest_z_m(&self) -> f64 {
        match self {
            Self::Fixed => 0.0,
            Self::FixedAt(world_from_base) => world_from_base.translation.z,
            Self::Lap(_) | Self::Stations(_) => BODY_Z_M,
            Self::Rolling { height_m, .. } => *height_m,
        }
    }

    /// Completed fraction of the walk. The walk is one lap, or leads from the first station to the
    /// last. The fraction is above 1 in later laps.
    pub(crate) fn walked_frac(&self, secs: f64) -> f64 {
        match self {
            Self::Fixed | Self::FixedAt(_) => 0.0,
            Self::Lap(speed) | Self::Rolling { speed, .. } => lap_secs(secs, *speed) / LAP_SECS,
            Self::Stations(speed) => smooth((secs * speed - DEPARTURE_SECS) / WALK_DURATION_SECS),
        }
    }

    /// True pose of the base.
    pub(crate) fn world_from_base(&self, secs: f64) -> Transform {
        match self {
            Self::Fixed => Transform::identity(),
            Self::FixedAt(world_from_base) => *world_from_base,
            Self::Lap(speed) => lap_pose(lap_secs(secs, *speed), secs * speed),
            Self::Rolling { speed, height_m } => {
                let [x, y, yaw] = lap_position(lap_secs(secs, *speed));
                Transform::from_parts(
                    Translation3::new(x, y, *height_m),
                    UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw),
                )
            }
            Self::Stations(_) => {
                let share = self.walked_frac(secs);
                let [x, y, yaw] = std::array::from_fn(|ix| {
                    FAR_STATION[ix] + (NEAR_STATION[ix] - FAR_STATION[ix]) * share
                });
                // The gait fades out before the base stops.
                let gait_amplitude = (4.0 * share * (1.0 - share)).clamp(0.0, 1.0);
                gait(secs, gait_amplitude, [x, y, yaw])
            }
        }
    }

    /// Times at which the base leaves its first station and reaches its last station, seconds. Both
    /// are zero if the base has no stations.
    pub(crate) fn walk_secs(&self) -> [f64; 2] {
        match self {
            Self::Stations(speed) => [
                DEPARTURE_SECS / speed,
                (DEPARTURE_SECS + WALK_DURATION_SECS) / speed,
            ],
            Self::Fixed | Self::FixedAt(_) | Self::Lap(_) | Self::Rolling { .. } => [0.0; 2],
        }
    }

    /// Index of the current station and seconds since arrival at speed 1. `None` while the base
    /// moves. The arm scans only at stations.
    pub(crate) fn station_at(&self, secs: f64) -> Option<(usize, f64)> {
        match self {
            Self::Fixed | Self::FixedAt(_) => Some((0, secs)),
            Self::Lap(_) | Self::Rolling { .. } => None,
            Self::Stations(speed) => {
                let at = secs * speed;
                if at < DEPARTURE_SECS {
                    Some((0, at))
                } else {
                    (at > DEPARTURE_SECS + WALK_DURATION_SECS)
                        .then_some((1, at - DEPARTURE_SECS - WALK_DURATION_SECS))
                }
            }
        }
    }
}

/// Progress along the laps, in seconds at nominal speed. The walk starts at rest. Afterwards, its
/// speed varies by a third.
fn lap_secs(secs: f64, speed: f64) -> f64 {
    const START_SECS: f64 = 1.5;
    const OSCILLATION: (f64, f64) = (0.35, 7.3);
    let at = secs * speed;
    // This is the integral of the smooth ramp 3 r^2 - 2 r^3, scaled so that the walk has speed 1
    // after the start.
    let ramp = (at / START_SECS).clamp(0.0, 1.0);
    let started = START_SECS * (ramp.powi(3) - 0.5 * ramp.powi(4)) + (at - START_SECS).max(0.0);
    // The oscillation starts with zero derivative, so the walk starts smoothly.
    started + OSCILLATION.0 * OSCILLATION.1 / TAU * (1.0 - (started * TAU / OSCILLATION.1).cos())
}

fn lap_pose(at: f64, gait_secs: f64) -> Transform {
    gait(gait_secs, smooth(at / 2.0), lap_position(at))
}

/// Position on the lap, x and y in meters, and heading in radians.
fn lap_position(at: f64) -> [f64; 3] {
    let around = at / LAP_SECS * TAU + std::f64::consts::PI;
    // The periods have no common multiple, so that no lap repeats the views of another lap.
    let radius_m = oscillate([2.25, 0.38, 23.0, 0.1], at);
    // The heading varies between facing the pedestal and facing past it.
    let heading_offset_rad = oscillate([0.25, 0.55, 15.7, 0.0], at);
    [
        radius_m * around.cos(),
        radius_m * around.sin(),
        around + std::f64::consts::PI + heading_offset_rad,
    ]
}

/// Pose of the walking body at a position and heading, with bounce and sway.
fn gait(secs: f64, gait_amplitude: f64, [x, y, yaw]: [f64; 3]) -> Transform {
    let step = secs * GAIT_HZ * TAU;
    // The body bounces and pitches twice per gait cycle, once for each pair of legs, and rolls
    // once.
    let bounce_m = BOUNCE_M * gait_amplitude * (2.0 * step).sin();
    let rotation_vector = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw)
        * UnitQuaternion::from_axis_angle(
            &Vector3::y_axis(),
            PITCH_RAD * gait_amplitude * (2.0 * step + 0.7).sin(),
        )
        * UnitQuaternion::from_axis_angle(
            &Vector3::x_axis(),
            ROLL_RAD * gait_amplitude * step.sin(),
        );
    Transform::from_parts(
        Translation3::new(x, y, BODY_Z_M + bounce_m),
        rotation_vector,
    )
}

/// Drift as in a SLAM system. It is a random walk that advances only while the base walks.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Drift {
    random: RandomStream,
    /// Standard deviations of one step along or about x, y, z.
    step_m: [f64; 3],
    step_rad: [f64; 3],
}

/// Steps of the random walk over the whole walk. With more steps, the drift changes more often and
/// by less each time. The error at the end stays the same.
const N_STEPS: f64 = 64.0;
/// Errors of height, roll and pitch relative to the errors of the other axes. They are smaller,
/// because gravity and the floor constrain them.
const CONSTRAINED_AXIS_FRAC: f64 = 0.3;
/// Identifies the random number stream.
const DRIFT: u64 = 0xd41f;

/// Standard deviations of one step along three axes. The sum of all steps has the root mean square
/// `size`. The weights distribute it over the axes.
fn step_sigmas(size: f64, weights: [f64; 3]) -> [f64; 3] {
    let norm = weights
        .iter()
        .map(|weight| weight * weight)
        .sum::<f64>()
        .sqrt();
    // The variances of independent steps add up.
    weights.map(|weight| size * weight / norm / N_STEPS.sqrt())
}

impl Drift {
    /// `size_m` and `size_rad` are the root mean square errors at the end of the whole walk.
    pub(crate) fn new(seed: u64, size_m: f64, size_rad: f64) -> Self {
        Self {
            random: RandomStream::new(seed, &[DRIFT]),
            step_m: step_sigmas(size_m, [1.0, 1.0, CONSTRAINED_AXIS_FRAC]),
            step_rad: step_sigmas(
                size_rad,
                [CONSTRAINED_AXIS_FRAC, CONSTRAINED_AXIS_FRAC, 1.0],
            ),
        }
    }

    /// Reported pose, given the true pose and the completed fraction of the walk.
    pub(crate) fn reported(&self, world_from_base: &Transform, walked_frac: f64) -> Transform {
        let steps = walked_frac * N_STEPS;
        let mut translation_error = Vector3::zeros();
        let mut rotation_vector = Vector3::zeros();
        let mut step = 0_u64;
        // All steps are summed in each call, so that no state is needed. Even a long run has only a
        // few hundred steps.
        while (step as f64) < steps {
            // The last step is blended in, so that the reported pose does not jump.
            let share = smooth(steps - step as f64);
            let [a, b] =
                // Translation and rotation use separate counters of the same stream.
                [2 * step, 2 * step + 1].map(|counter| self.random.normals(counter).map(f64::from));
            translation_error += Vector3::from_fn(|axis, _| self.step_m[axis] * a[axis]) * share;
            rotation_vector += Vector3::from_fn(|axis, _| self.step_rad[axis] * b[axis]) * share;
            step += 1;
        }
        let rotation = UnitQuaternion::from_scaled_axis(rotation_vector) * world_from_base.rotation;
        Transform::from_parts(
            (world_from_base.translation.vector + translation_error).into(),
            rotation,
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn drift_has_configured_size_and_starts_at_zero() {
        const TOLERANCE: f64 = 0.1; // Four standard errors of a root mean square over this many seeds.
        const N_SEEDS: u64 = 800;
        for (walked_frac, growth) in [(1.0, 1.0_f64), (0.25, 0.5), (4.0, 2.0)] {
            let (mut squares_m, mut squares_rad) = (0.0, 0.0);
            for seed in 0..N_SEEDS {
                let drift = Drift::new(seed, 0.02, 0.0175);
                let truth = BaseMotion::Lap(1.0).world_from_base(17.0);
                let reported = drift.reported(&truth, walked_frac);
                squares_m +=
                    (reported.translation.vector - truth.translation.vector).norm_squared();
                squares_rad += reported.rotation.angle_to(&truth.rotation).powi(2);
                assert_eq!(drift.reported(&truth, 0.0), truth);
            }
            let [rms_m, rms_rad] =
                [squares_m, squares_rad].map(|squares| (squares / N_SEEDS as f64).sqrt());
            assert!(
                (rms_m / (0.02 * growth) - 1.0).abs() < TOLERANCE,
                "{rms_m} m after {walked_frac}"
            );
            assert!(
                (rms_rad / (0.0175 * growth) - 1.0).abs() < TOLERANCE,
                "{rms_rad} rad after {walked_frac}"
            );
        }
    }

    #[test]
    fn base_walks_smoothly_and_rests_at_stations() {
        const STEP_SECS: f64 = 1e-3;
        for (motion, fastest_m_s) in [
            (BaseMotion::Lap(1.0), 0.9),
            (BaseMotion::Stations(1.0), 0.6),
        ] {
            let mut before = motion.world_from_base(0.0);
            let mut speed_before = 0.0;
            for step in 1..60_000 {
                let secs = f64::from(step) * STEP_SECS;
                let pose = motion.world_from_base(secs);
                let speed =
                    (pose.translation.vector - before.translation.vector).norm() / STEP_SECS;
                assert!(speed < fastest_m_s, "{motion:?}: {speed} m/s at {secs} s");
                assert!(
                    (speed - speed_before).abs() / STEP_SECS < 4.0,
                    "{motion:?}: a jerk at {secs} s"
                );
                if motion.station_at(secs).is_some() {
                    assert!(
                        speed < 1e-9,
                        "{motion:?} moves at {secs} s while at a station"
                    );
                }
                (before, speed_before) = (pose, speed);
            }
        }
    }
}
