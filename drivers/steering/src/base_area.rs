//! Keeps a base inside a rectangle on the floor.

use crate::base_clearance::stoppable_m_s;
use crate::base_verdict::FloorPose;
use crate::reason::Reason;
use drivers::base_motion::{BaseLimits, BaseVelocity};

/// Distance from the edge at which the base stops, meters: its pose has errors of this size.
const STOP_BEFORE_M: f64 = 0.02;
/// Number of headings that are compared while the base turns.
const N_HEADINGS: u32 = 7;
/// A base is too fast toward an edge if its measured speed is this many times the permitted one,
/// and the noise of odometry above it.
const TOO_FAST: f64 = 1.05;
const NOISE_M_S: f64 = 0.01;

/// A rectangle on the floor, aligned with the axes of the world, meters.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Area {
    /// Smallest x and y.
    pub(crate) lower: [f64; 2],
    /// Largest x and y.
    pub(crate) upper: [f64; 2],
}

impl Area {
    /// The area with these limits: smallest x and y, then largest x and y.
    pub(crate) fn of([x0, y0, x1, y1]: [f64; 4]) -> Self {
        Self {
            lower: [x0, y0],
            upper: [x1, y1],
        }
    }

    /// Whether a place is inside.
    pub(crate) fn contains(&self, x_m: f64, y_m: f64) -> bool {
        let place = [x_m, y_m];
        (0..2).all(|axis| (self.lower[axis]..=self.upper[axis]).contains(&place[axis]))
    }

    /// The velocity with which the base can stop before the edge. If it is slower than `wanted`,
    /// also the factor on the speed, 0 to 1, and the reason. A motion away from an edge is always
    /// permitted.
    ///
    /// * `measured`: the velocity that the base has. If it is too fast toward an edge, the base
    ///   first comes to rest without turning, for every `wanted`.
    /// * `reaction_secs`: time during which the base does not slow down.
    pub(crate) fn permitted(
        &self,
        pose: &FloorPose,
        wanted: BaseVelocity,
        measured: &BaseVelocity,
        limits: &BaseLimits,
        reaction_secs: f64,
    ) -> (BaseVelocity, Option<(f64, Reason)>) {
        let place = [pose.x_m, pose.y_m];
        let wanted_m_s = fastest_toward(&wanted, pose, limits, reaction_secs);
        let measured_m_s = fastest_toward(measured, pose, limits, reaction_secs);
        let mut scale: f64 = 1.0;
        let mut is_too_fast = false;
        for axis in 0..2 {
            let left_m = [
                self.upper[axis] - place[axis],
                place[axis] - self.lower[axis],
            ];
            for (side, left_m) in left_m.into_iter().enumerate() {
                let left_m = left_m - STOP_BEFORE_M;
                let permitted_m_s = stoppable_m_s(left_m, limits.acceleration_m_s2, reaction_secs);
                let wanted_m_s = wanted_m_s[axis][side];
                if measured_m_s[axis][side] > TOO_FAST * permitted_m_s + NOISE_M_S {
                    is_too_fast = true;
                } else if wanted_m_s > permitted_m_s {
                    scale = scale.min(permitted_m_s / wanted_m_s);
                }
            }
        }
        let velocity = BaseVelocity {
            forward_m_s: wanted.forward_m_s * scale,
            left_m_s: wanted.left_m_s * scale,
            yaw_rad_s: wanted.yaw_rad_s,
        };
        let place = [pose.x_m, pose.y_m, 0.0];
        let reason = Reason::AreaEdge { place };
        if is_too_fast {
            return (BaseVelocity::ZERO, Some((0.0, reason)));
        }
        (velocity, (scale < 1.0).then_some((scale, reason)))
    }
}

/// Largest speeds toward both ends of both axes of the world, m/s, until a base with this velocity
/// could stand still. A base that turns changes its direction meanwhile, and slowing down may take
/// all of its acceleration.
fn fastest_toward(
    velocity: &BaseVelocity,
    pose: &FloorPose,
    limits: &BaseLimits,
    reaction_secs: f64,
) -> [[f64; 2]; 2] {
    let stop_secs = reaction_secs + velocity.speed_m_s() / limits.acceleration_m_s2;
    let turn_rad = velocity.yaw_rad_s * stop_secs;
    let mut fastest: [[f64; 2]; 2] = [[0.0; 2]; 2];
    for ix in 0..N_HEADINGS {
        let share = f64::from(ix) / f64::from(N_HEADINGS - 1);
        let (sin, cos) = (pose.yaw_rad + share * turn_rad).sin_cos();
        let in_world = [
            velocity.forward_m_s * cos - velocity.left_m_s * sin,
            velocity.forward_m_s * sin + velocity.left_m_s * cos,
        ];
        for (fastest, speed_m_s) in fastest.iter_mut().zip(in_world) {
            *fastest = [fastest[0].max(speed_m_s), fastest[1].max(-speed_m_s)];
        }
    }
    fastest
}
