//! Inputs of one cycle of a base, and the decision.

use crate::reason::Limit;
use drivers::base_motion::{BaseOutput, BaseState, BaseTarget};
use drivers::motion::exact;
use kinematics::Stamp;
use serde::{Deserialize, Serialize};

/// A pose on the floor, in the world.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FloorPose {
    /// x of the base link, meters.
    pub x_m: f64,
    /// y of the base link, meters.
    pub y_m: f64,
    /// Direction of its x axis, counterclockwise from the x axis of the world.
    pub yaw_rad: f64,
}

impl FloorPose {
    /// Whether all numbers are finite.
    pub(crate) fn is_finite(&self) -> bool {
        [self.x_m, self.y_m, self.yaw_rad]
            .iter()
            .all(|number| number.is_finite())
    }
}

/// Where the base was at a time.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct SeenPose {
    /// The time.
    #[serde(with = "exact::stamp")]
    pub at: Stamp,
    /// The pose.
    pub pose: FloorPose,
    /// Height of the base link in the world, meters. No decision depends on it: it shows where the
    /// robot was.
    pub z_m: f64,
}

/// Where the joints of the arm on the base were at a time.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SeenPosture {
    /// The time.
    #[serde(with = "exact::stamp")]
    pub at: Stamp,
    /// Radians or meters, in the order of the names in the configuration.
    #[serde(with = "exact::list")]
    pub position: Vec<f64>,
}

/// State of a base and of the arm on it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct BaseSituation {
    /// The newest report of the base.
    pub base: BaseState,
    /// Its pose; `None` if it is not known.
    pub pose: Option<SeenPose>,
    /// Posture of the arm; `None` if it is not known, or there is no arm.
    pub arm: Option<SeenPosture>,
}

/// The decision of one cycle.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct BaseVerdict {
    /// What the base should do.
    pub output: BaseOutput,
    /// The limits that were applied, in the order of the links.
    pub limits: Vec<Limit>,
    /// Whether the base is at the goal of its operator.
    pub has_arrived: bool,
}

impl BaseVerdict {
    /// The target, if the base should move at a velocity.
    pub fn target(&self) -> Option<&BaseTarget> {
        match &self.output {
            BaseOutput::Drive(target) => Some(target),
            BaseOutput::Brake => None,
        }
    }
}
