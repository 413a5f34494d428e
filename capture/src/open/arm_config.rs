//! What drivers need to know of the arm of a rig: its chain and the limits of its motion.

#[cfg(target_os = "linux")]
use crate::config::ArmMotion;
use crate::config::Rig;
use anyhow::{Context, bail};
#[cfg(target_os = "linux")]
use drivers::motion::MotionConfig;
use drivers::motion::MotionLimits;
#[cfg(target_os = "linux")]
use std::time::Duration;

/// The chain from the link in which the controller of a Franka arm or of Universal Robots reports
/// poses to its flange.
///
/// # Errors
///
/// If the URDF of the rig has no such chain.
#[cfg(target_os = "linux")]
pub fn controller_chain(rig: &Rig) -> anyhow::Result<kinematics::Chain> {
    let Rig { arm, .. } = rig;
    let robot = kinematics::urdf::Robot::parse(&arm.urdf_text).context("the arm's URDF")?;
    let path = robot
        .path(&arm.base_link, &arm.flange_link)
        .context("the arm's URDF")?;
    // These controllers report poses in the parent link of the arm's first joint, wherever that link is on
    // the base.
    let first = path.iter().find(|joint| arm.joints.contains(&joint.name));
    let arm_base_link = first.map_or(&arm.base_link, |joint| &joint.parent);
    kinematics::Chain::new(&robot, arm_base_link, &arm.flange_link).context("the arm's URDF")
}

/// Motion limits of each joint, in the order of `arm.joints`. The position limits come from the
/// URDF, and the speed limit comes from the rig file.
pub(super) fn motion_limits(
    rig: &Rig,
    acceleration_secs: f64,
    jerk_secs: f64,
) -> anyhow::Result<Vec<MotionLimits>> {
    let Rig { arm, .. } = rig;
    let chain = super::chain_of(rig)?;
    let mut limits = Vec::new();
    for (ix, name) in arm.joints.iter().enumerate() {
        let joint_ix = chain.joint_names().iter().position(|known| known == name);
        let joint = joint_ix
            .map(|joint_ix| chain.limits()[joint_ix])
            .context("a joint of the rig is not in its URDF")?;
        // Invalid limits do not matter for reading. A motion needs valid limits, because they keep
        // the arm away from its mechanical stops.
        if !joint.is_range_valid {
            bail!(
                "arm.motion: the <limit> of joint {name:?} in the URDF is invalid; give finite numbers, lower at most upper"
            );
        }
        let mut joint =
            MotionLimits::new(&joint, arm.max_speed_rad_s, acceleration_secs, jerk_secs);
        // URDF positions are device positions plus the offset.
        let offset = arm.joint_offsets.get(ix).copied().unwrap_or(0.0);
        joint.position = joint.position.map(|bound| bound - offset);
        limits.push(joint);
    }
    Ok(limits)
}

/// Motion limits of each joint of a simulated arm, which does not need the table `[arm.motion]`.
pub(super) fn simulated_limits(rig: &Rig) -> anyhow::Result<Vec<MotionLimits>> {
    /// The defaults of the table.
    const DEFAULT_SECS: [f64; 2] = [0.5, 0.1];
    let motion = rig.arm.motion.as_ref();
    let [acceleration_secs, jerk_secs] = motion.map_or(DEFAULT_SECS, |motion| {
        [motion.acceleration_secs, motion.jerk_secs]
    });
    motion_limits(rig, acceleration_secs, jerk_secs)
}

#[cfg(target_os = "linux")]
pub(super) fn motion_config(rig: &Rig, motion: &ArmMotion) -> anyhow::Result<MotionConfig> {
    let limits = motion_limits(rig, motion.acceleration_secs, motion.jerk_secs)?;
    let timeout = Duration::from_secs_f64(motion.timeout_millis / 1000.0);
    let ArmMotion {
        on_loss,
        accept_no_watchdog,
        ..
    } = *motion;
    Ok(MotionConfig {
        limits,
        on_loss,
        timeout,
        accept_no_watchdog,
    })
}
