//! Opens arms of Universal Robots.

#[cfg(target_os = "linux")]
use super::arm_config::{controller_chain, motion_config};
use crate::config::{ArmMotion, Rig};
use anyhow::bail;
use drivers::Arm;
use drivers::motion::MovableArm;
#[cfg(target_os = "linux")]
use drivers::ur::{ArmConfig, MovableUrArm, UrArm};

/// Opens an arm for reading.
#[cfg(target_os = "linux")]
pub(super) fn arm(rig: &Rig) -> anyhow::Result<Box<dyn Arm>> {
    Ok(Box::new(UrArm::open(&arm_config(rig)?)?))
}

#[cfg(not(target_os = "linux"))]
pub(super) fn arm(_rig: &Rig) -> anyhow::Result<Box<dyn Arm>> {
    bail!("arms of Universal Robots can only be read on Linux")
}

/// Opens an arm for motion.
#[cfg(target_os = "linux")]
pub(super) fn movable_arm(rig: &Rig, motion: &ArmMotion) -> anyhow::Result<Box<dyn MovableArm>> {
    let config = arm_config(rig)?;
    let arm = MovableUrArm::open(&config, &motion_config(rig, motion)?)?;
    Ok(Box::new(arm))
}

#[cfg(not(target_os = "linux"))]
pub(super) fn movable_arm(_rig: &Rig, _motion: &ArmMotion) -> anyhow::Result<Box<dyn MovableArm>> {
    bail!("arms of Universal Robots can only be moved on Linux")
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

#[cfg(all(test, feature = "sim", target_os = "linux"))]
mod tests {
    use super::*;
    use crate::doctor::{self, Verdict};
    use drivers::motion::{JointTarget, Motion};
    use drivers::ur::RTDE_PORT;
    use drivers::ur::emulated::{CommandedJoints, ControllerConfig, EmulatedController, Joints};
    use kinematics::Chain;
    use std::net::{Ipv4Addr, SocketAddr};
    use std::time::{Duration, Instant};

    const URDF: &str = include_str!("../../../kinematics/tests/data/ur5e-dh.urdf");
    const REST_RAD: [f64; 6] = [0.3, -1.4, 1.6, -1.8, -1.5, 0.4];
    /// It is long because a busy machine may be slow; a successful test does not wait this long.
    const TEST_TIMEOUT: Duration = Duration::from_secs(30);

    fn rig(address: SocketAddr, flange_link: &str) -> Rig {
        let text = format!(
            r#"
            [arm]
            driver = "ur"
            address = "{address}"
            urdf = "ur5e.urdf"
            flange_link = "{flange_link}"
            [arm.motion]
            on_loss = "hold"
            timeout_millis = 1000
            [camera.wrist]
            driver = "v4l2"
            size_px = [640, 480]
            rate_hz = 30
            parent = "flange"
            parent_from_camera = {{ xyz_m = [0.0, 0.0, 0.1], quat_xyzw = [0.0, 0.0, 0.0, 1.0] }}
            intrinsics = {{ focal_px = [600, 600], principal_px = [320.0, 240.0], lens = "brown_conrady", distortion = [0, 0, 0, 0, 0] }}
            "#
        );
        Rig::parse("ur5e.toml", &text, URDF, &[]).expect("a rig file")
    }

    fn controller() -> (EmulatedController, SocketAddr) {
        let [_, _, high, low] = std::process::id().to_be_bytes();
        let address = (Ipv4Addr::new(127, 39, high, low.max(1)), RTDE_PORT).into();
        let chain = Chain::from_urdf(URDF, "base_link_inertia", "tool0").expect("a UR5e");
        let mut is_first = true;
        let joint_simulator = move |_, commanded: &CommandedJoints| Joints {
            position_rad: if std::mem::take(&mut is_first) {
                REST_RAD
            } else {
                commanded.position_rad
            },
            velocity_rad_s: commanded.velocity_rad_s,
            ..Joints::default()
        };
        let config = ControllerConfig::e_series(address, chain);
        // A busy machine may stall the driver, so the controller waits for its setpoints.
        let answer_wait = Duration::from_secs(2);
        let simulator = Box::new(joint_simulator);
        let controller = EmulatedController::start_waiting(config, answer_wait, simulator);
        (controller.expect("a free address"), address)
    }

    #[test]
    fn arm_of_a_rig_file_is_checked_read_and_moved() {
        let (_controller, address) = controller();
        let rig_with = |flange_link| rig(address, flange_link);
        let verdict = |flange_link, check| {
            let findings = doctor::check(Some(&rig_with(flange_link)));
            let finding = findings.into_iter().find(|finding| finding.check == check);
            finding.expect("the check was made").verdict
        };
        for check in ["RTDE", "robot", "flange pose", "motion"] {
            assert_eq!(verdict("tool0", check), Verdict::Ok, "{check}");
        }
        assert_eq!(verdict("gripper", "flange pose"), Verdict::Fail);

        let rig = rig_with("tool0");
        let mut read = arm(&rig).expect("the arm is open");
        let state = read.read(TEST_TIMEOUT).expect("a state");
        assert_eq!(state.position, REST_RAD);
        drop(read);

        let motion = rig.arm.motion.as_ref().expect("the rig file has the table");
        let mut moved = movable_arm(&rig, motion).expect("the arm is open");
        let mut target = REST_RAD.to_vec();
        target[5] += 0.1;
        let command = JointTarget { position: target };
        moved.command(&command).expect("the arm is ready");
        let deadline = Instant::now() + TEST_TIMEOUT;
        while moved.motion() == Motion::Moving {
            assert!(Instant::now() < deadline);
            moved.read(TEST_TIMEOUT).expect("a state");
        }
        assert_eq!(moved.motion(), Motion::Holding);
    }
}
