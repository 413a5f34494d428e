//! The robot that operators of a run steer: its arm or its base.

use super::base::PreparedBase;
use super::{ClearanceFeed, PreparedSteering, SteeringThread};
use crate::viewers::Viewers;
use capture::InputObserver;
use capture::config::Rig;
use capture::open::{SteeredArm, SteeredBase};
use std::path::Path;
use viz::Hub;

/// The opened arm or base that operators steer.
pub(crate) enum SteeredRobot {
    /// An arm on a fixed base.
    Arm(SteeredArm),
    /// A base.
    Base(SteeredBase),
}

/// The steered robot of a run, before its input is read.
pub(crate) enum PreparedRobot {
    Arm(Box<PreparedSteering>),
    Base(Box<PreparedBase>),
}

impl PreparedRobot {
    /// Prepares a robot for its operators.
    ///
    /// # Errors
    ///
    /// If an arm has no shapes, because nothing would then protect it.
    pub(crate) fn new(robot: SteeredRobot, rig: &Rig) -> anyhow::Result<Self> {
        Ok(match robot {
            SteeredRobot::Arm(arm) => Self::Arm(Box::new(PreparedSteering::new(arm, rig)?)),
            SteeredRobot::Base(base) => Self::Base(Box::new(PreparedBase::new(base, rig))),
        })
    }

    /// An observer of the run's input, which also passes everything on to viewers.
    pub(crate) fn observer(&self, viewers: Viewers) -> Box<dyn InputObserver> {
        match self {
            Self::Arm(arm) => Box::new(arm.observer(viewers)),
            Self::Base(base) => base.observer(viewers),
        }
    }

    /// Passes depth that the live model draws to the map of free space of an arm.
    pub(crate) fn clearance_feed(&self) -> Option<ClearanceFeed> {
        match self {
            Self::Arm(arm) => Some(arm.clearance_feed()),
            Self::Base(_) => None,
        }
    }

    /// Lets clients of the hub steer the robot.
    ///
    /// * `log_folder`: where all decisions are logged, if they are.
    ///
    /// # Errors
    ///
    /// If the robot reports nothing, its limits are not valid, or no thread can be started.
    pub(crate) fn start(
        self,
        hub: &Hub,
        log_folder: Option<&Path>,
    ) -> anyhow::Result<SteeringThread> {
        match self {
            Self::Arm(arm) => arm.start(hub, log_folder),
            Self::Base(base) => base.start(hub, log_folder),
        }
    }
}
