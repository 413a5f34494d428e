//! The scanning motion of an arm from a URDF. It gives joint positions over time that move the
//! arm's camera along a tour, within the joint limits.

use super::model::TwinModel;
use crate::follower::{
    POSE_GAIN_HZ, REST_POSTURE_GAIN_HZ, SPEED_LIMIT_FRAC, smooth_acceleration, speeds_within,
};
use crate::joints::Joints;
use crate::scan::{Scan, looking_along};
use kinematics::Transform;
use kinematics::inverse::{damped_change, pose_error};
use nalgebra::{UnitQuaternion, Vector3, Vector6};
use std::f64::consts::TAU;
use std::sync::Arc;

/// What the arm does.
#[expect(clippy::large_enum_variant, reason = "there is one per arm")]
#[derive(Clone, Debug)]
pub(crate) enum TwinTour {
    /// Moves a camera around the target area on the table.
    Table(TableTour),
    /// Moves all joints a little about the preferred posture. The value scales the speed.
    Sway(f64),
}

/// A tour around the target area on the table.
#[derive(Clone, Copy, Debug)]
pub(crate) struct TableTour {
    pub(crate) scan: Scan,
    pub(crate) base_from_scene: Transform,
    /// The camera that follows the tour.
    pub(crate) flange_from_camera: Transform,
}

/// Follows a tour in joint space.
#[derive(Clone, Debug)]
pub(crate) struct TwinFollower {
    model: Arc<TwinModel>,
    tour: TwinTour,
    /// Preferred posture.
    posture: Joints,
    position: Joints,
    velocity: Joints,
    acceleration: Joints,
}

/// Margin to the joint limits, as a fraction of the range. The margin keeps the scan away from the
/// limits.
const LIMIT_MARGIN_FRAC: f64 = 0.01;
/// Damping of the least squares, in meters and radians. Near singular postures, it bounds the joint
/// velocities but causes a pose error.
const DAMPING: f64 = 0.03;
/// Weight of errors of the roll about the optical axis, relative to errors of the viewing direction
/// and the position. An arm with fewer than six joints cannot follow all of them, and with this
/// weight, the roll has the largest error.
const ROLL_WEIGHT: f64 = 0.1;
/// Largest acceleration of a joint, as a multiple of its largest speed per second. The next
/// constant is the largest jerk, as a multiple of the largest acceleration per second. Robot arms
/// allow several times higher values.
const ACCELERATION_HZ: f64 = 5.0;
const JERK_HZ: f64 = 60.0;
/// Amplitude of the sway, radians or meters. The amplitude is also limited to this fraction of the
/// range of a joint.
const SWAY_AMPLITUDE: f64 = 0.1;
const SWAY_AMPLITUDE_FRAC: f64 = 0.1;
/// Period of the sway of the first joint, seconds. The next constant is the factor of the period
/// from joint to joint. The factor is not rational, so that no posture is repeated.
const SWAY_PERIOD_SECS: f64 = 8.0;
const SWAY_PERIOD_FACTOR: f64 = 1.171;

impl TwinFollower {
    /// Starts at rest. With a table, the arm starts at the first pose of the tour, or as close to
    /// this pose as possible.
    pub(crate) fn new(model: Arc<TwinModel>, tour: TwinTour, posture: Joints) -> Self {
        let n_joints = posture.len();
        let mut follower = Self {
            model,
            tour,
            position: posture.clone(),
            posture,
            velocity: Joints::zeros(n_joints),
            acceleration: Joints::zeros(n_joints),
        };
        follower.position = follower.clamp_to_limits(follower.position.clone());
        if matches!(follower.tour, TwinTour::Table(_)) {
            // The loop corresponds to 20 s of motion in steps of 10 ms.
            for _ in 0..2000 {
                let step = follower.desired_velocity(0.0, None) * 0.01;
                follower.position = follower.clamp_to_limits(&follower.position + step);
            }
        }
        follower
    }

    pub(crate) fn position(&self) -> &Joints {
        &self.position
    }

    pub(crate) fn velocity(&self) -> &Joints {
        &self.velocity
    }

    pub(crate) fn acceleration(&self) -> &Joints {
        &self.acceleration
    }

    /// Pose of a camera on the flange in the base.
    pub(crate) fn base_from_camera(&self, flange_from_camera: &Transform) -> Transform {
        self.model.base_from_flange(&self.position) * flange_from_camera
    }

    /// Advances to a time that is `step_secs` after the previous time.
    pub(crate) fn advance(&mut self, secs: f64, step_secs: f64) {
        let desired = self.desired_velocity(secs, Some(step_secs));
        for ix in 0..self.position.len() {
            let [slowest, fastest] = self.allowed_speed(ix);
            let velocity_error = desired[ix].clamp(slowest, fastest) - self.velocity[ix];
            let max_acceleration = ACCELERATION_HZ * self.model.ranges()[ix].max_speed;
            self.acceleration[ix] = smooth_acceleration(
                velocity_error,
                self.acceleration[ix],
                [max_acceleration, JERK_HZ * max_acceleration],
                step_secs,
            );
        }
        self.velocity += &self.acceleration * step_secs;
        let before = self.position.clone();
        self.position = self.clamp_to_limits(&self.position + &self.velocity * step_secs);
        // A joint at its limit has stopped, so its velocity is zero. Otherwise, reported velocities
        // would contradict the positions.
        for ix in 0..self.position.len() {
            let velocity = (self.position[ix] - before[ix]) / step_secs;
            if (velocity - self.velocity[ix]).abs() > 1e-9 {
                self.velocity[ix] = velocity;
                self.acceleration[ix] = 0.0;
            }
        }
    }

    fn allowed_speed(&self, ix: usize) -> [f64; 2] {
        let [lower, upper] = self.limits(ix);
        let position = self.position[ix];
        speeds_within(
            position - lower,
            upper - position,
            SPEED_LIMIT_FRAC * self.model.ranges()[ix].max_speed,
        )
    }

    /// The limits of a joint with a margin.
    fn limits(&self, ix: usize) -> [f64; 2] {
        let range = self.model.ranges()[ix];
        let margin = LIMIT_MARGIN_FRAC * (range.upper - range.lower);
        [range.lower + margin, range.upper - margin]
    }

    fn clamp_to_limits(&self, position: Joints) -> Joints {
        Joints::from_fn(position.len(), |ix, _| {
            let [lower, upper] = self.limits(ix);
            position[ix].clamp(lower, upper)
        })
    }

    /// Joint velocity that leads toward the position of the tour at a time. If `step_secs` is
    /// given, the velocity of the tour since the previous step is added. Without this feedforward,
    /// the camera would lag behind.
    fn desired_velocity(&self, secs: f64, step_secs: Option<f64>) -> Joints {
        match &self.tour {
            TwinTour::Table(tour) => self.velocity_along_table(tour, secs, step_secs),
            TwinTour::Sway(speed) => (self.sway(secs * speed) - &self.position) * POSE_GAIN_HZ,
        }
    }

    /// Joint positions of the sway at a time, if the sway has speed 1.
    fn sway(&self, at: f64) -> Joints {
        let mut period_secs = SWAY_PERIOD_SECS;
        Joints::from_fn(self.posture.len(), |ix, _| {
            let [lower, upper] = self.limits(ix);
            let amplitude = SWAY_AMPLITUDE.min(SWAY_AMPLITUDE_FRAC * (upper - lower));
            let offset = amplitude * (at / period_secs * TAU).sin();
            period_secs *= SWAY_PERIOD_FACTOR;
            (self.posture[ix] + offset).clamp(lower, upper)
        })
    }

    /// Joint velocity that moves the camera toward its position on the tour. It also rotates the
    /// camera from its present position toward the look-at point. Null-space motion moves the
    /// joints toward the preferred posture.
    fn velocity_along_table(&self, tour: &TableTour, secs: f64, step_secs: Option<f64>) -> Joints {
        let base_from_camera = self.base_from_camera(&tour.flange_from_camera);
        let goal = goal(tour, secs, &base_from_camera);
        let mut twist = pose_error(&goal, &base_from_camera) * POSE_GAIN_HZ;
        if let Some(step_secs) = step_secs {
            let on_tour = |secs: f64| tour.base_from_scene * tour.scan.world_from_camera(secs);
            twist += pose_error(&on_tour(secs), &on_tour(secs - step_secs)) / step_secs;
        }
        let (jacobian, twist) = self.in_camera_axes(tour, &base_from_camera, &twist);
        let posture_velocity = (&self.posture - &self.position) * REST_POSTURE_GAIN_HZ;
        let moves = jacobian.iter().zip(&posture_velocity);
        let missing = moves.fold(twist, |rest, (column, velocity)| rest - column * *velocity);
        let mut change = Joints::zeros(jacobian.len());
        damped_change(&jacobian, &missing, DAMPING.powi(2), change.as_mut_slice());
        posture_velocity + change
    }

    /// Computes the Jacobian of the camera in camera axes, and converts `twist` from base axes to
    /// camera axes. Both results are weighted. The Jacobian has one column per joint.
    fn in_camera_axes(
        &self,
        tour: &TableTour,
        base_from_camera: &Transform,
        twist: &Vector6<f64>,
    ) -> (Vec<Vector6<f64>>, Vector6<f64>) {
        let flange = self
            .model
            .chain()
            .jacobian(self.position.as_slice())
            .expect("simulated joints are finite, and as many as the chain has");
        // The camera moves with the flange, so its velocity has a part from the lever arm.
        let lever = base_from_camera.translation.vector
            - (base_from_camera * tour.flange_from_camera.inverse())
                .translation
                .vector;
        let to_camera = base_from_camera.rotation.inverse();
        let weighted = |linear: Vector3<f64>, angular: Vector3<f64>| {
            let linear = to_camera * linear;
            let angular = to_camera * angular;
            Vector6::new(
                linear.x,
                linear.y,
                linear.z,
                angular.x,
                angular.y,
                ROLL_WEIGHT * angular.z,
            )
        };
        let columns = flange.column_iter().map(|column| {
            let angular: Vector3<f64> = column.fixed_rows::<3>(3).into();
            let linear: Vector3<f64> = column.fixed_rows::<3>(0).into();
            weighted(linear + angular.cross(&lever), angular)
        });
        let jacobian = columns.collect();
        let linear: Vector3<f64> = twist.fixed_rows::<3>(0).into();
        let angular: Vector3<f64> = twist.fixed_rows::<3>(3).into();
        (jacobian, weighted(linear, angular))
    }
}

/// Pose in the base that the camera should have. Its position is the position of the tour. Its
/// viewing direction leads from the present position of the camera to the look-at point.
fn goal(tour: &TableTour, secs: f64, base_from_camera: &Transform) -> Transform {
    let TableTour {
        scan,
        base_from_scene,
        ..
    } = tour;
    let eye = base_from_scene * scan.world_from_camera(secs);
    let scene_from_base = base_from_scene.inverse();
    let present_eye = scene_from_base * base_from_camera;
    let forward = scan.look_at(secs) - present_eye.translation.vector;
    let rotation = match forward.try_normalize(1e-6) {
        Some(forward) => toward(&forward, scan.roll_rad(secs), &present_eye.rotation),
        None => present_eye.rotation,
    };
    Transform::from_parts(eye.translation, base_from_scene.rotation * rotation)
}

/// Orientation along a direction, with a roll. If the camera looks straight down, no orientation is
/// upright, so the camera keeps its roll.
fn toward(
    forward: &Vector3<f64>,
    roll_rad: f64,
    present: &UnitQuaternion<f64>,
) -> UnitQuaternion<f64> {
    const VERTICAL: f64 = 0.05; // Sine of the angle to the vertical.
    if forward.xy().norm() > VERTICAL {
        return looking_along(forward)
            * UnitQuaternion::from_axis_angle(&Vector3::z_axis(), roll_rad);
    }
    UnitQuaternion::rotation_between(&(present * Vector3::z()), forward)
        .map_or(*present, |rotation| rotation * present)
}
