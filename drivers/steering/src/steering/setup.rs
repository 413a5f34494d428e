//! Configuration of a chain of decisions, with which a record can be replayed alone.

use super::Steering;
use super::state::State;
use crate::arm_chain::{ArmChain, Robot, SteeringConfig};
use crate::base_chain::BaseSteeringConfig;
use crate::body::{Body, Shape};
use crate::error::Error;
use crate::inverse::NearestPosture;
use drivers::motion::{MotionLimits, exact};
use kinematics::Chain;
use kinematics::urdf::Robot as Urdf;
use serde::{Deserialize, Serialize};

/// Configuration, robot and state of a chain of decisions.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Setup {
    /// The arm, if it is steered.
    pub arm: Option<ArmSetup>,
    /// The base, if it is steered.
    pub base: Option<BaseSteeringConfig>,
    state: State,
}

/// Configuration and robot of an arm whose inverse kinematics is [`NearestPosture`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ArmSetup {
    /// Configuration of all links.
    pub config: SteeringConfig,
    /// Robot description.
    pub urdf: String,
    /// Link to which the chain is fixed.
    pub base_link: String,
    /// Link that operators move.
    pub tip_link: String,
    shapes: Vec<Shape>,
    joints: Vec<Joint>,
    free_posture: Option<Vec<f64>>,
}

/// Limits of a joint.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Joint {
    #[serde(with = "exact::array")]
    position: [f64; 2],
    velocity: f64,
    acceleration: f64,
    jerk: f64,
}

impl From<&MotionLimits> for Joint {
    fn from(limits: &MotionLimits) -> Self {
        Self {
            position: limits.position,
            velocity: limits.velocity,
            acceleration: limits.acceleration,
            jerk: limits.jerk,
        }
    }
}

impl From<&Joint> for MotionLimits {
    fn from(joint: &Joint) -> Self {
        Self {
            position: joint.position,
            velocity: joint.velocity,
            acceleration: joint.acceleration,
            jerk: joint.jerk,
        }
    }
}

impl Steering {
    /// The configuration of the chain.
    ///
    /// * `urdf`: the description from which the chain of joints and the shapes were made.
    pub fn setup(&self, urdf: String) -> Setup {
        Setup {
            arm: self.arm.as_ref().map(|arm| ArmSetup::of(arm, urdf)),
            base: self.base.as_ref().map(|base| base.config().clone()),
            state: self.state(),
        }
    }
}

impl ArmSetup {
    fn of(arm: &ArmChain, urdf: String) -> Self {
        Self {
            config: arm.config.clone(),
            urdf,
            base_link: arm.chain.base_link().to_owned(),
            tip_link: arm.chain.tip_link().to_owned(),
            shapes: arm.body.shapes(),
            joints: arm.limits.joints().iter().map(Joint::from).collect(),
            free_posture: arm.free_posture.clone(),
        }
    }

    fn build(&self) -> Result<Steering, Error> {
        let urdf = Urdf::parse(&self.urdf)?;
        let chain = Chain::new(&urdf, &self.base_link, &self.tip_link)?;
        let joints: Vec<MotionLimits> = self.joints.iter().map(MotionLimits::from).collect();
        Steering::new(
            self.config.clone(),
            Robot {
                inverse: Box::new(NearestPosture::new(chain.clone())),
                body: Body::from_shapes(&urdf, &chain, &self.shapes)?,
                chain,
                joints: &joints,
                free_posture: self.free_posture.as_deref(),
            },
        )
    }
}

impl Setup {
    /// The same chain in another state.
    #[must_use]
    pub fn with_state(self, state: State) -> Self {
        Self { state, ..self }
    }

    /// The chain of decisions in the recorded state.
    ///
    /// # Errors
    /// If a part of the setup is invalid, which means that it is damaged.
    pub fn build(&self) -> Result<Steering, Error> {
        let mut steering = match (&self.arm, &self.base) {
            (Some(arm), Some(base)) => arm.build()?.with_base(base.clone())?,
            (Some(arm), None) => arm.build()?,
            (None, Some(base)) => Steering::of_base(base.clone())?,
            (None, None) => return Err(Error::Parts),
        };
        steering.set_state(self.state.clone())?;
        Ok(steering)
    }
}
