//! The scanning motion in joint space. It gives joint positions over time that move the camera
//! along its tour.

use crate::Error;
use crate::cabinet_tour::CabinetTour;
use crate::config::N_JOINTS;
use crate::panda::{self, Joints};
use crate::scan::Scan;
use kinematics::Transform;
use kinematics::inverse::{damped_change, pose_error};
use nalgebra::Vector6;

/// Tour of an arm's camera.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Tour {
    /// Around the target area on the table.
    Table(Scan),
    /// Around the cabinet from two stations, and into it.
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

/// Preferred posture, which is far from the joint limits and has the elbow up.
const REST_POSTURE_RAD: [f64; N_JOINTS] =
    [0.0, -0.3, 0.0, -2.2, 0.0, 2.2, std::f64::consts::FRAC_PI_4];
/// Margin to the joint limits, radians. The controller overshoots its reference slightly, and must
/// not reach the limits.
const LIMIT_MARGIN_RAD: f64 = 0.05;
/// Fraction of the maximum joint speeds that the scan uses. The rest is a reserve for the
/// controller, which corrects errors.
pub(crate) const SPEED_LIMIT_FRAC: f64 = 0.5;
/// Damping of the least squares, in meters and radians. Near singular postures, it bounds the joint
/// velocities but causes a pose error. With a larger value, tracking is less accurate everywhere.
const DAMPING: f64 = 0.03;
/// Rate at which pose errors and posture errors decay, per second. The posture has the lower rate,
/// because it must not disturb the tracking of the pose.
pub(crate) const POSE_GAIN_HZ: f64 = 8.0;
pub(crate) const REST_POSTURE_GAIN_HZ: f64 = 0.6;
/// Frequency of the critically damped spring with which the joint velocity follows the desired
/// velocity, radians per second. The spring keeps the motion smooth.
const SMOOTHING_RAD_S: f64 = 40.0;
/// Maximum speed at which a joint approaches its limit, as a fraction of the remaining distance per
/// second.
const LIMIT_APPROACH_HZ: f64 = 3.0;
/// Largest rotation between camera and tour that is not reported, radians.
const TOUR_TOLERANCE_RAD: f64 = 0.35;
/// Fraction of the arm's maximum accelerations and jerks that the scan uses.
const DYNAMICS_LIMIT_FRAC: f64 = 0.6;

impl Follower {
    /// Starts at rest, at the scan's first pose.
    pub(crate) fn new(scan: Tour, flange_from_camera: Transform) -> Result<Self, Error> {
        // Tolerance of the pose error, as the norm over meters and radians. The first pose must be
        // reached closely, because the scan would otherwise begin with a jump.
        const TOLERANCE: f64 = 0.02;
        let mut follower = Self {
            scan,
            flange_from_camera,
            position_rad: Joints::from(REST_POSTURE_RAD),
            velocity_rad_s: Joints::zeros(),
            acceleration_rad_s2: Joints::zeros(),
        };
        let target_pose = scan.arm_from_camera(0.0);
        // Inverse kinematics uses the same least squares as the scan, so that both find the same
        // posture. The loop corresponds to 30 s of motion in steps of 10 ms.
        for _ in 0..3000 {
            let step = follower.desired_velocity(&target_pose, &Vector6::zeros()) * 0.01;
            follower.position_rad = clamp_to_limits(follower.position_rad + step);
        }
        let base_from_camera = panda::base_from_flange(&follower.position_rad) * flange_from_camera;
        if pose_error(&target_pose, &base_from_camera).norm() > TOLERANCE {
            return Err(Error::Unreachable { at_secs: 0.0 });
        }
        Ok(follower)
    }

    /// Warns if the camera leaves the tour. With some camera extrinsics, this happens because the
    /// arm reaches its joint limits.
    pub(crate) fn warn_if_tour_is_unreachable(&self) {
        let worst_rad = self.clone().worst_rotation_rad();
        if worst_rad > TOUR_TOLERANCE_RAD {
            let degrees = worst_rad.to_degrees();
            log::warn!(
                "the arm cannot follow the whole scan with these camera extrinsics: off by up to {degrees:.0} degrees"
            );
        }
    }

    /// Whether the camera stays on the tour.
    pub(crate) fn can_follow_tour(&self) -> bool {
        self.clone().worst_rotation_rad() <= TOUR_TOLERANCE_RAD
    }

    /// Follows half a minute of the scan without dynamics. Returns the largest rotation of the
    /// camera relative to the tour. This changes the state of the arm, so it is called on a copy.
    fn worst_rotation_rad(mut self) -> f64 {
        const CHECKED_SECS: f64 = 30.0;
        const STEP_SECS: f64 = 0.005;
        let mut worst_rad = 0.0_f64;
        let mut secs = 0.0;
        while secs < CHECKED_SECS {
            secs += STEP_SECS;
            self.advance(secs, STEP_SECS);
            let base_from_camera =
                panda::base_from_flange(&self.position_rad) * self.flange_from_camera;
            let error = pose_error(&self.scan.arm_from_camera(secs), &base_from_camera);
            worst_rad = worst_rad.max(error.fixed_rows::<3>(3).norm());
        }
        worst_rad
    }

    pub(crate) fn position_rad(&self) -> &Joints {
        &self.position_rad
    }

    pub(crate) fn velocity_rad_s(&self) -> &Joints {
        &self.velocity_rad_s
    }

    pub(crate) fn acceleration_rad_s2(&self) -> &Joints {
        &self.acceleration_rad_s2
    }

    /// Advances to a time that is `step_secs` after the previous time.
    pub(crate) fn advance(&mut self, secs: f64, step_secs: f64) {
        let target_pose = self.scan.arm_from_camera(secs);
        let before = self.scan.arm_from_camera(secs - step_secs);
        // The velocity of the target is the feedforward. Without the feedforward, the camera would
        // lag behind the tour by the camera's velocity divided by the gain.
        let target_twist = pose_error(&target_pose, &before) / step_secs;
        let desired_velocity = self.desired_velocity(&target_pose, &target_twist);
        for ix in 0..N_JOINTS {
            let [slowest, fastest] = self.allowed_speed_rad_s(ix);
            let velocity_error =
                desired_velocity[ix].clamp(slowest, fastest) - self.velocity_rad_s[ix];
            self.acceleration_rad_s2[ix] = smooth_acceleration(
                velocity_error,
                self.acceleration_rad_s2[ix],
                [
                    DYNAMICS_LIMIT_FRAC * panda::MAX_ACCELERATION_RAD_S2[ix],
                    DYNAMICS_LIMIT_FRAC * panda::MAX_JERK_RAD_S3[ix],
                ],
                step_secs,
            );
        }
        self.velocity_rad_s += self.acceleration_rad_s2 * step_secs;
        self.position_rad = clamp_to_limits(self.position_rad + self.velocity_rad_s * step_secs);
    }

    /// Minimum and maximum velocity of a joint. Close to a position limit, the velocity toward it
    /// is reduced.
    fn allowed_speed_rad_s(&self, ix: usize) -> [f64; 2] {
        let position = self.position_rad[ix];
        speeds_within(
            position - panda::LOWER_RAD[ix] - LIMIT_MARGIN_RAD,
            panda::UPPER_RAD[ix] - LIMIT_MARGIN_RAD - position,
            SPEED_LIMIT_FRAC * panda::MAX_SPEED_RAD_S[ix],
        )
    }

    /// Joint velocity that moves the camera toward the target pose. Null-space motion moves the
    /// joints toward the preferred posture.
    fn desired_velocity(&self, target_pose: &Transform, target_twist: &Vector6<f64>) -> Joints {
        let (base_from_camera, jacobian) =
            panda::jacobian(&self.position_rad, &self.flange_from_camera);
        let twist = target_twist + pose_error(target_pose, &base_from_camera) * POSE_GAIN_HZ;
        let rest_posture_velocity =
            (Joints::from(REST_POSTURE_RAD) - self.position_rad) * REST_POSTURE_GAIN_HZ;
        // The posture velocity is applied in full, and the least squares correct its effect on the
        // camera. As a result, only its projection to the null space remains.
        let missing = twist - jacobian * rest_posture_velocity;
        let columns: [Vector6<f64>; N_JOINTS] =
            std::array::from_fn(|ix| jacobian.column(ix).into_owned());
        let mut correction = Joints::zeros();
        damped_change(
            &columns,
            &missing,
            DAMPING.powi(2),
            correction.as_mut_slice(),
        );
        rest_posture_velocity + correction
    }
}

/// Acceleration after a step, within the maxima of acceleration and jerk.
///
/// The velocity follows the desired velocity like a critically damped spring of the frequency w =
/// `SMOOTHING_RAD_S`. The jerk is w^2 * error - 2 * w * acceleration.
pub(crate) fn smooth_acceleration(
    velocity_error: f64,
    acceleration: f64,
    [max_acceleration, max_jerk]: [f64; 2],
    step_secs: f64,
) -> f64 {
    let jerk = (velocity_error * SMOOTHING_RAD_S - 2.0 * acceleration) * SMOOTHING_RAD_S;
    let acceleration = acceleration + jerk.clamp(-max_jerk, max_jerk) * step_secs;
    acceleration.clamp(-max_acceleration, max_acceleration)
}

/// Minimum and maximum velocity of a joint at distances to its lower and upper limit.
pub(crate) fn speeds_within(to_lower: f64, to_upper: f64, fastest: f64) -> [f64; 2] {
    let towards = |distance: f64| (LIMIT_APPROACH_HZ * distance).clamp(0.0, fastest);
    [-towards(to_lower), towards(to_upper)]
}

fn clamp_to_limits(position_rad: Joints) -> Joints {
    Joints::from_fn(|ix, _| {
        position_rad[ix].clamp(
            panda::LOWER_RAD[ix] + LIMIT_MARGIN_RAD,
            panda::UPPER_RAD[ix] - LIMIT_MARGIN_RAD,
        )
    })
}
