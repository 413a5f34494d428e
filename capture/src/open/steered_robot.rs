//! Opens the devices of a rig with the robot that operators steer: an arm, a base, or both.

use super::steered::{SteeredArm, check_steerable, steered};
use super::steered_base::{SteeredBase, SteeredParts, check_drivable, with_steered_base};
use super::{Devices, Opened};
use crate::config::Rig;

/// The opened parts of a robot that operators steer. At least one of them is there.
#[derive(Debug)]
pub struct SteeredRobot {
    /// The arm.
    pub arm: Option<SteeredArm>,
    /// The base.
    pub base: Option<SteeredBase>,
}

/// Opens the devices of a rig, see [`super::rig`], with all parts of its robot that operators may
/// move. Real arms hold their positions, and real bases stand still.
///
/// # Errors
///
/// For the reasons of [`super::rig`] and [`check_steered`], or if a part cannot be enabled.
pub fn with_steered_robot(rig: Rig, devices: Devices) -> anyhow::Result<(Opened, SteeredRobot)> {
    if SteeredParts::of(&rig, devices).base {
        let (opened, (base, arm)) = with_steered_base(rig, devices)?;
        let base = Some(base);
        return Ok((opened, SteeredRobot { arm, base }));
    }
    let (opened, arm) = steered(rig, devices)?;
    let robot = SteeredRobot {
        arm: Some(arm),
        base: None,
    };
    Ok((opened, robot))
}

/// Checks that operators may steer the robot of a rig, as far as possible without devices.
///
/// # Errors
///
/// If a part of the robot cannot be moved, although it must.
pub fn check_steered(rig: &Rig, devices: Devices) -> anyhow::Result<()> {
    if SteeredParts::of(rig, devices).base {
        check_drivable(rig, devices)
    } else {
        check_steerable(rig, devices)
    }
}
