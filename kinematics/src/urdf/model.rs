//! Joints of a robot.

use crate::{Error, Transform};
use nalgebra::{Unit, Vector3};

/// One joint between two links.
#[derive(Clone, Debug)]
pub struct Joint {
    /// Name in the URDF.
    pub name: String,
    /// Type of motion.
    pub kind: JointKind,
    /// Parent link.
    pub parent: String,
    /// Child link. Its frame moves with the joint.
    pub child: String,
    /// Pose of the joint's frame in the parent link at joint value 0.
    pub parent_from_joint: Transform,
    /// Direction of motion in the joint's frame. It is not used for fixed joints.
    pub axis: Unit<Vector3<f64>>,
    /// Allowed range.
    pub limits: JointLimits,
    /// The rule by which this joint follows another joint. `None` if it moves independently.
    pub mimic: Option<Mimic>,
    /// The reason why the joint cannot be part of a chain. If there is a problem, only the names
    /// above are valid.
    pub problem: Option<Error>,
}

/// Type of a joint's motion.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum JointKind {
    /// No motion.
    Fixed,
    /// Rotation about the axis, radians (revolute or continuous).
    Revolute,
    /// Translation along the axis, meters (prismatic).
    Prismatic,
    /// A type with more than one degree of freedom, with its name in the URDF, or "invalid".
    Unsupported(&'static str),
}

/// Allowed range of a joint. It is infinite if the URDF sets no limits, or if the limits are zero.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct JointLimits {
    /// Smallest position, radians or meters.
    pub lower: f64,
    /// Largest position, radians or meters.
    pub upper: f64,
    /// Largest speed, radians or meters per second.
    pub velocity: f64,
    /// Largest torque or force, newton meters or newtons.
    pub effort: f64,
    /// False if the URDF states a range that is invalid. `lower` and `upper` are then infinite, and
    /// a program should not move the joint.
    pub is_range_valid: bool,
}

impl JointLimits {
    /// No limits.
    pub const NONE: Self = Self {
        lower: f64::NEG_INFINITY,
        upper: f64::INFINITY,
        velocity: f64::INFINITY,
        effort: f64::INFINITY,
        is_range_valid: true,
    };
}

/// Rule by which a mimic joint follows another: `multiplier * source + offset`.
#[derive(Clone, Debug, PartialEq)]
pub struct Mimic {
    /// Name of the followed joint.
    pub source: String,
    /// Factor on the source's value.
    pub multiplier: f64,
    /// Offset added to the scaled value, radians or meters.
    pub offset: f64,
}
