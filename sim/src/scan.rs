//! The scanning motion: target camera poses over time, and the joint positions that reach them.

use crate::Error;
use crate::cabinet_tour::CabinetTour;
use crate::config::N_JOINTS;
use crate::objects::{TABLE_Z_M, TARGET_XY_M};
use crate::panda::{self, Jacobian, Joints};
use kinematics::Transform;
use nalgebra::{Matrix3, Matrix6, Rotation3, SMatrix, Translation3, UnitQuaternion, Vector3, Vector6};
use std::f64::consts::TAU;

/// The tour around the target area.
///
/// Azimuth, elevation, distance, roll and look-at point oscillate with periods that have no common multiple, so the
/// first seconds cover the whole range coarsely and later ones fill the gaps. Every oscillation goes both ways and
/// its speed changes continuously, so a time offset and a hand-eye error have different effects.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Scan {
    speed: f64,
    is_azimuth_only: bool,
}

/// One oscillating quantity: mean, amplitude, period in seconds at speed 1, phase in turns.
struct Oscillation(f64, f64, f64, f64);

impl Oscillation {
    fn at(&self, secs: f64) -> f64 {
        let Self(mean, amplitude, period_secs, phase) = self;
        mean + amplitude * ((secs / period_secs + phase) * TAU).sin()
    }
}

const AZIMUTH_DEGREES: Oscillation = Oscillation(0.0, 45.0, 11.3, -0.20);
const ELEVATION_DEGREES: Oscillation = Oscillation(40.0, 20.0, 7.1, 0.35);
const DISTANCE_M: Oscillation = Oscillation(0.35, 0.10, 9.2, 0.10);
const ROLL_DEGREES: Oscillation = Oscillation(0.0, 20.0, 8.3, 0.60);
const LOOK_AT_X_M: Oscillation = Oscillation(0.0, 0.03, 6.3, 0.0);
const LOOK_AT_Y_M: Oscillation = Oscillation(0.0, 0.04, 7.7, 0.5);
/// Height of the look-at point above the table, meters.
const LOOK_AT_HEIGHT_M: f64 = 0.06;
/// The motion accelerates from rest within this time, seconds.
const START_SECS: f64 = 0.5;
/// The speed varies by this fraction, with this period in seconds.
const SPEED_OSCILLATION: (f64, f64) = (0.35, 4.9);

impl Scan {
    /// With `is_azimuth_only`, all quantities except the azimuth stay at their means: the camera rotates about one
    /// axis.
    pub(crate) fn new(speed: f64, is_azimuth_only: bool) -> Self {
        Self { speed, is_azimuth_only }
    }

    fn oscillation(&self, oscillation: &Oscillation, at: f64) -> f64 {
        if self.is_azimuth_only { oscillation.0 } else { oscillation.at(at) }
    }

    /// Progress along the tour, in seconds at constant speed; starts at rest.
    fn progress(&self, secs: f64) -> f64 {
        let (share, period_secs) = SPEED_OSCILLATION;
        // The integral of a smooth ramp from 0 to 1.
        let ramp = (secs / START_SECS).clamp(0.0, 1.0);
        let started = START_SECS * (ramp.powi(3) - 0.5 * ramp.powi(4)) + (secs - START_SECS).max(0.0);
        let uniform_secs = started * self.speed;
        uniform_secs + share * period_secs / TAU * (1.0 - (uniform_secs * TAU / period_secs).cos())
    }

    /// Target pose of the camera: x right, y down, z toward the look-at point.
    pub(crate) fn world_from_camera(&self, secs: f64) -> Transform {
        let at = self.progress(secs);
        let azimuth = AZIMUTH_DEGREES.at(at).to_radians();
        let elevation = self.oscillation(&ELEVATION_DEGREES, at).to_radians();
        let [look_at_x_m, look_at_y_m] =
            [&LOOK_AT_X_M, &LOOK_AT_Y_M].map(|oscillation| self.oscillation(oscillation, at));
        let target =
            Vector3::new(TARGET_XY_M[0] + look_at_x_m, TARGET_XY_M[1] + look_at_y_m, TABLE_Z_M + LOOK_AT_HEIGHT_M);
        let back = Vector3::new(-elevation.cos() * azimuth.cos(), -elevation.cos() * azimuth.sin(), elevation.sin());
        let upright = looking_along(&-back);
        let roll =
            UnitQuaternion::from_axis_angle(&Vector3::z_axis(), self.oscillation(&ROLL_DEGREES, at).to_radians());
        Transform::from_parts(Translation3::from(target + back * self.oscillation(&DISTANCE_M, at)), upright * roll)
    }
}

/// Orientation of an upright camera that looks along a direction: x right, y down, z forward.
pub(crate) fn looking_along(forward: &Vector3<f64>) -> UnitQuaternion<f64> {
    let right = forward.cross(&Vector3::z()).normalize();
    let axes = Matrix3::from_columns(&[right, forward.cross(&right), *forward]);
    UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes))
}

/// Tour of an arm's camera.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Tour {
    /// Around the target area on the table.
    Table(Scan),
    /// From two stations, and into the cabinet.
    Cabinet(CabinetTour),
}

impl Tour {
    /// Target pose of the camera in the arm's base frame.
    pub(crate) fn arm_from_camera(&self, secs: f64) -> Transform {
        match self {
            Self::Table(scan) => scan.world_from_camera(secs),
            Self::Cabinet(tour) => tour.arm_from_camera(secs),
        }
    }
}

/// Follows the scan in joint space by damped least squares, within the joint limits.
#[derive(Clone, Debug)]
pub(crate) struct Follower {
    scan: Tour,
    flange_from_camera: Transform,
    position_rad: Joints,
    velocity_rad_s: Joints,
    acceleration_rad_s2: Joints,
}

/// Preferred posture: far from the joint limits, elbow up.
const REST_POSTURE_RAD: [f64; N_JOINTS] = [0.0, -0.3, 0.0, -2.2, 0.0, 2.2, std::f64::consts::FRAC_PI_4];
/// Margin to the joint limits, radians.
const LIMIT_MARGIN_RAD: f64 = 0.05;
/// Fraction of the maximum joint speeds that the scan uses.
const SPEED_LIMIT_FRAC: f64 = 0.5;
/// Damping of the least squares, in meters and radians.
const DAMPING: f64 = 0.03;
/// Rate at which pose errors and posture errors decay, per second.
const POSE_GAIN_HZ: f64 = 8.0;
const REST_POSTURE_GAIN_HZ: f64 = 0.6;
/// The joint velocity follows the desired velocity as a critically damped spring of this frequency, radians per
/// second, which keeps the motion smooth.
const SMOOTHING_RAD_S: f64 = 40.0;
/// A joint may approach its limit by this fraction of the remaining distance per second.
const LIMIT_APPROACH_HZ: f64 = 3.0;
/// Fraction of the arm's maximum accelerations and jerks that the scan uses.
const DYNAMICS_LIMIT_FRAC: f64 = 0.6;

impl Follower {
    /// Starts at rest, at the scan's first pose.
    pub(crate) fn new(scan: Tour, flange_from_camera: Transform) -> Result<Self, Error> {
        const TOLERANCE: f64 = 0.02;
        let mut follower = Self {
            scan,
            flange_from_camera,
            position_rad: Joints::from(REST_POSTURE_RAD),
            velocity_rad_s: Joints::zeros(),
            acceleration_rad_s2: Joints::zeros(),
        };
        let target_pose = scan.arm_from_camera(0.0);
        for _ in 0..3000 {
            let step = follower.desired_velocity(&target_pose, &Vector6::zeros()) * 0.01;
            follower.position_rad = clamp_to_limits(follower.position_rad + step);
        }
        let base_from_camera = panda::base_from_flange(&follower.position_rad) * flange_from_camera;
        if pose_error(&target_pose, &base_from_camera).norm() > TOLERANCE {
            return Err(Error::Unreachable { at_secs: 0.0 });
        }
        follower.clone().warn_if_tour_is_unreachable();
        Ok(follower)
    }

    /// Simulates half a minute of the scan without dynamics. With some camera extrinsics, the arm reaches its limits
    /// and the camera looks away.
    fn warn_if_tour_is_unreachable(mut self) {
        const CHECKED_SECS: f64 = 30.0;
        const STEP_SECS: f64 = 0.005;
        const TOLERANCE_RAD: f64 = 0.35;
        let (mut worst_rad, mut secs) = (0.0_f64, 0.0);
        while secs < CHECKED_SECS {
            secs += STEP_SECS;
            self.advance(secs, STEP_SECS);
            let base_from_camera = panda::base_from_flange(&self.position_rad) * self.flange_from_camera;
            let error = pose_error(&self.scan.arm_from_camera(secs), &base_from_camera);
            worst_rad = worst_rad.max(error.fixed_rows::<3>(3).norm());
        }
        if worst_rad > TOLERANCE_RAD {
            let degrees = worst_rad.to_degrees();
            log::warn!(
                "the arm cannot follow the whole scan with these camera extrinsics: off by up to {degrees:.0} degrees"
            );
        }
    }

    pub(crate) fn position_rad(&self) -> &Joints {
        &self.position_rad
    }

    pub(crate) fn velocity_rad_s(&self) -> &Joints {
        &self.velocity_rad_s
    }

    /// Advances to a time `step_secs` after the previous one.
    pub(crate) fn advance(&mut self, secs: f64, step_secs: f64) {
        let target_pose = self.scan.arm_from_camera(secs);
        let before = self.scan.arm_from_camera(secs - step_secs);
        let target_twist = pose_error(&target_pose, &before) / step_secs;
        let desired_velocity = self.desired_velocity(&target_pose, &target_twist);
        for ix in 0..N_JOINTS {
            let allowed = self.allowed_speed_rad_s(ix);
            let velocity_error = desired_velocity[ix].clamp(allowed[0], allowed[1]) - self.velocity_rad_s[ix];
            let acceleration = self.acceleration_rad_s2[ix];
            let jerk = (velocity_error * SMOOTHING_RAD_S - 2.0 * acceleration) * SMOOTHING_RAD_S;
            let (max_jerk, max_acceleration) = (panda::MAX_JERK_RAD_S3[ix], panda::MAX_ACCELERATION_RAD_S2[ix]);
            let acceleration =
                acceleration + jerk.clamp(-DYNAMICS_LIMIT_FRAC * max_jerk, DYNAMICS_LIMIT_FRAC * max_jerk) * step_secs;
            self.acceleration_rad_s2[ix] =
                acceleration.clamp(-DYNAMICS_LIMIT_FRAC * max_acceleration, DYNAMICS_LIMIT_FRAC * max_acceleration);
        }
        self.velocity_rad_s += self.acceleration_rad_s2 * step_secs;
        self.position_rad = clamp_to_limits(self.position_rad + self.velocity_rad_s * step_secs);
    }

    /// Minimum and maximum joint velocity; decreases toward a limit.
    fn allowed_speed_rad_s(&self, ix: usize) -> [f64; 2] {
        let (position, fastest) = (self.position_rad[ix], SPEED_LIMIT_FRAC * panda::MAX_SPEED_RAD_S[ix]);
        let to_lower = position - panda::LOWER_RAD[ix] - LIMIT_MARGIN_RAD;
        let to_upper = panda::UPPER_RAD[ix] - LIMIT_MARGIN_RAD - position;
        let towards = |distance: f64| (LIMIT_APPROACH_HZ * distance).clamp(0.0, fastest);
        [-towards(to_lower), towards(to_upper)]
    }

    /// Joint velocity that moves the camera to the target pose; the remaining freedom moves the joints to the
    /// preferred posture.
    fn desired_velocity(&self, target_pose: &Transform, target_twist: &Vector6<f64>) -> Joints {
        let (base_from_camera, jacobian) = panda::jacobian(&self.position_rad, &self.flange_from_camera);
        let twist = target_twist + pose_error(target_pose, &base_from_camera) * POSE_GAIN_HZ;
        let rest_posture_velocity = (Joints::from(REST_POSTURE_RAD) - self.position_rad) * REST_POSTURE_GAIN_HZ;
        let inverse = damped_inverse(&jacobian);
        rest_posture_velocity + inverse * (twist - jacobian * rest_posture_velocity)
    }
}

fn damped_inverse(jacobian: &Jacobian) -> SMatrix<f64, N_JOINTS, 6> {
    let square = jacobian * jacobian.transpose() + Matrix6::identity() * DAMPING.powi(2);
    let inverse = square.try_inverse().expect("a damped square is positive definite");
    jacobian.transpose() * inverse
}

/// Translation and rotation from the actual to the target pose, in world axes.
fn pose_error(target_pose: &Transform, actual: &Transform) -> Vector6<f64> {
    let translation_error = target_pose.translation.vector - actual.translation.vector;
    let rotation_error = (target_pose.rotation * actual.rotation.inverse()).scaled_axis();
    Vector6::new(
        translation_error.x,
        translation_error.y,
        translation_error.z,
        rotation_error.x,
        rotation_error.y,
        rotation_error.z,
    )
}

fn clamp_to_limits(position_rad: Joints) -> Joints {
    let clamp = |ix: usize| {
        position_rad[ix].clamp(panda::LOWER_RAD[ix] + LIMIT_MARGIN_RAD, panda::UPPER_RAD[ix] - LIMIT_MARGIN_RAD)
    };
    Joints::from_fn(|ix, _| clamp(ix))
}
