//! What clients need to know about an arm before they steer it.

use serde::Serialize;

/// The arm of a [`SteeringServer`](crate::SteeringServer).
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct ArmDescription {
    /// Link of the URDF in whose frame all poses are.
    pub base_link: String,
    /// Link of the URDF that the operator moves.
    pub tip_link: String,
    /// The joints, in the order of all lists of joint values.
    pub joints: Vec<SteeredJoint>,
    /// Silence of a device after which the arm brakes.
    pub expiry_secs: f64,
    /// Silence of a client after which its lease ends.
    pub lease_secs: f64,
    /// Round trip from which on a page should show goals before the arm moves, instead of moving the
    /// arm with the hand.
    pub servo_round_trip_millis: f64,
    /// The base, if it is steered. Without a steered arm, there are no joints.
    pub base: Option<BaseDescription>,
}

/// What clients need to know about a base before they drive it.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct BaseDescription {
    /// Largest speed forward and backward, m/s.
    pub max_forward_m_s: f64,
    /// Largest speed to the sides, m/s; 0 if the base cannot move sideways.
    pub max_left_m_s: f64,
    /// Largest yaw rate, rad/s.
    pub max_yaw_rad_s: f64,
    /// Rectangle on the floor that the base stays in: smallest x and y, then largest x and y, in the
    /// world, meters.
    pub area_m: Option<[f64; 4]>,
    /// What keeps the base away from obstacles.
    pub avoidance: BaseAvoidance,
    /// Joint values of the arm while the base moves, in the order of the joints; `None` without an
    /// arm.
    pub stowed: Option<Vec<f64>>,
}

/// What keeps a base away from obstacles.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum BaseAvoidance {
    /// Nothing but its operator.
    #[default]
    Nothing,
    /// It stops before surfaces that were seen, and enters space that was never seen.
    SeenSurfaces,
    /// It stops before everything that is not known to be free.
    UnknownSpace,
}

/// A joint that an operator moves.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct SteeredJoint {
    /// Name in the URDF.
    pub name: String,
    /// Lowest position, radians or meters; `None` if the joint turns without end.
    pub lower: Option<f64>,
    /// Highest position, radians or meters; `None` if the joint turns without end.
    pub upper: Option<f64>,
    /// Whether positions are meters.
    pub is_prismatic: bool,
    /// Greatest speed while an operator moves the arm, radians or meters per second.
    pub velocity: f64,
}
