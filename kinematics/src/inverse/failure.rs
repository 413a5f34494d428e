//! Why inverse kinematics has no solution.

use super::target::PoseGap;
use crate::Error;

/// The reason why no joint values give the tip the pose of a target.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum Unsolved {
    /// The input is invalid.
    #[error(transparent)]
    Invalid(#[from] Error),
    /// No joint values were found, even if the ranges of the joints are ignored.
    #[error("the pose is out of reach: the arm ends {}", .0.gap)]
    OutOfReach(Nearest),
    /// Joint values were found, but some are beyond their ranges.
    #[error("the pose needs {}; within the ranges, the arm ends {}", list(.joints), .nearest.gap)]
    BeyondLimits {
        /// The closest pose within the ranges.
        nearest: Nearest,
        /// The joints that would leave their ranges.
        joints: Vec<JointBeyond>,
    },
}

impl Unsolved {
    /// The closest configuration that was found within the ranges. `None` if the input is invalid.
    pub fn nearest(&self) -> Option<&Nearest> {
        match self {
            Self::Invalid(_) => None,
            Self::OutOfReach(nearest) | Self::BeyondLimits { nearest, .. } => Some(nearest),
        }
    }
}

/// A configuration whose pose is as close to the target as was found.
#[derive(Clone, Debug, PartialEq)]
pub struct Nearest {
    /// Joint values within the ranges, radians or meters.
    pub joints: Vec<f64>,
    /// Distance of their pose from the target.
    pub gap: PoseGap,
}

/// A joint that would have to leave its range.
#[derive(Clone, Debug, PartialEq)]
pub struct JointBeyond {
    /// Name of the joint.
    pub joint: String,
    /// Value that the pose needs, radians or meters.
    pub value: f64,
    /// The range.
    pub range: [f64; 2],
}

impl std::fmt::Display for PoseGap {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let degrees = self.angle_rad.to_degrees();
        let meters = self.distance_m;
        write!(f, "{meters:.3} m and {degrees:.1} degrees from it")
    }
}

fn list(joints: &[JointBeyond]) -> String {
    let one = |joint: &JointBeyond| {
        let [lower, upper] = joint.range;
        let (name, value) = (&joint.joint, joint.value);
        format!("joint {name:?} at {value:.3} (range {lower:.3} to {upper:.3})")
    };
    joints.iter().map(one).collect::<Vec<_>>().join(", ")
}
