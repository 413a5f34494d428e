//! Opens arms of Universal Robots.

#[cfg(target_os = "linux")]
use super::real::franka_chain as controller_chain;
use crate::config::Rig;
use anyhow::bail;
use drivers::Arm;
#[cfg(target_os = "linux")]
use drivers::ur::{ArmConfig, UrArm};

/// Opens an arm for reading.
#[cfg(target_os = "linux")]
pub(super) fn arm(rig: &Rig) -> anyhow::Result<Box<dyn Arm>> {
    Ok(Box::new(UrArm::open(&arm_config(rig)?)?))
}

#[cfg(not(target_os = "linux"))]
pub(super) fn arm(_rig: &Rig) -> anyhow::Result<Box<dyn Arm>> {
    bail!("arms of Universal Robots can only be read on Linux")
}

/// Configuration of the arm of a rig. As a Franka arm, it reports poses in the parent link of its
/// first joint.
///
/// # Errors
///
/// If the rig file has no address, or its URDF no such chain.
#[cfg(target_os = "linux")]
pub fn arm_config(rig: &Rig) -> anyhow::Result<ArmConfig> {
    if rig.arm.address.is_empty() {
        bail!(
            "arm.address is missing: set it to the address of the robot's controller, such as \"192.168.1.10\"; the pendant shows it under Settings, System, Network"
        );
    }
    Ok(ArmConfig {
        address: rig.arm.address.clone(),
        joint_names: rig.arm.joints.clone(),
        chain: controller_chain(rig)?,
    })
}
