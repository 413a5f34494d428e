//! Keeps a base inside a rectangle on the floor.

use crate::base_verdict::FloorPose;
use crate::reason::Reason;
use drivers::base_motion::{BaseLimits, BaseVelocity};

/// Time from a decision until the base obeys, seconds: the age of its pose, the way of the command,
/// and the reaction of its controller. The base covers this time's distance before it slows down.
const REACTION_SECS: f64 = 0.25;
/// A base is too fast toward an edge if its measured speed is this many times the permitted one, and
/// the noise of odometry above it.
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
    /// The area of its four numbers: smallest x and y, then largest x and y.
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

    /// Factor on a velocity, 0 to 1, with which the base can stop before the edge, and the reason if
    /// it is less than 1. A motion away from an edge is always permitted.
    ///
    /// * `measured`: the velocity that the base has. If it is too fast toward an edge, in whatever
    ///   direction it should move next, it first comes to rest.
    pub(crate) fn speed(
        &self,
        pose: &FloorPose,
        wanted: &BaseVelocity,
        measured: &BaseVelocity,
        limits: &BaseLimits,
    ) -> (f64, Option<Reason>) {
        let place = [pose.x_m, pose.y_m];
        let wanted = in_world(wanted, pose);
        let measured = in_world(measured, pose);
        let mut scale: f64 = 1.0;
        for axis in 0..2 {
            // Speed and distance toward both edges of this axis.
            for (side, left_m) in [
                (1.0, self.upper[axis] - place[axis]),
                (-1.0, place[axis] - self.lower[axis]),
            ] {
                let permitted_m_s = stoppable_m_s(left_m, limits.acceleration_m_s2);
                let wanted_m_s = side * wanted[axis];
                let measured_m_s = side * measured[axis];
                if measured_m_s > TOO_FAST * permitted_m_s + NOISE_M_S {
                    scale = 0.0;
                } else if wanted_m_s > permitted_m_s {
                    scale = scale.min(permitted_m_s / wanted_m_s);
                }
            }
        }
        let reason = (scale < 1.0).then_some(Reason::AreaEdge {
            place: [pose.x_m, pose.y_m, 0.0],
        });
        (scale, reason)
    }
}

/// x and y of a velocity over the floor, in the world, m/s.
fn in_world(velocity: &BaseVelocity, pose: &FloorPose) -> [f64; 2] {
    let (sin, cos) = pose.yaw_rad.sin_cos();
    [
        velocity.forward_m_s * cos - velocity.left_m_s * sin,
        velocity.forward_m_s * sin + velocity.left_m_s * cos,
    ]
}

/// Largest speed that still permits a stop within a distance, after the reaction time: the positive
/// solution of `distance = reaction * speed + speed^2 / (2 * deceleration)`.
fn stoppable_m_s(distance_m: f64, deceleration_m_s2: f64) -> f64 {
    if distance_m <= 0.0 {
        return 0.0;
    }
    let reaction = deceleration_m_s2 * REACTION_SECS;
    (reaction * reaction + 2.0 * deceleration_m_s2 * distance_m).sqrt() - reaction
}
