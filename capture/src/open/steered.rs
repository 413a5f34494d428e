//! Opens the devices of a rig with an arm that operators steer.

use super::arm_config::simulated_limits;
use super::real;
use super::{Devices, Opened, check_arm, is_any_simulated};
use crate::config::{ArmDriver, Rig};
use crate::stamp_clock::StampClock;
use anyhow::bail;
use drivers::motion::{MovableArm, SteeringPort};
use drivers::{LiveDevices, Source};
use kinematics::Chain;
use messages::{BadInput, Setting};

/// Acceleration and jerk of braking, as a factor of those of motions. Drivers keep motions far
/// below what the robot can do, and an arm that must stop may use more of it.
pub(super) const BRAKE_FACTOR: f64 = 2.0;

/// An arm that operators steer. Clones refer to the same arm.
#[derive(Clone, Debug)]
pub struct SteeredArm {
    port: SteeringPort,
    #[cfg(feature = "sim")]
    simulated: Option<sim::SteeredArm>,
}

impl SteeredArm {
    /// An arm that holds its position until it is steered.
    #[must_use]
    pub fn holding(port: SteeringPort) -> Self {
        Self {
            port,
            #[cfg(feature = "sim")]
            simulated: None,
        }
    }

    /// A simulated arm that is on its tour until [`Self::begin`].
    #[cfg(feature = "sim")]
    pub(super) fn simulated(arm: sim::SteeredArm) -> Self {
        Self {
            port: arm.port().clone(),
            simulated: Some(arm),
        }
    }

    /// Targets and states of the arm. Positions are in the order of the arm's joint names, without
    /// `arm.joint_offsets`.
    #[must_use]
    pub fn port(&self) -> &SteeringPort {
        &self.port
    }

    /// Takes the arm over, or stops it. A simulated arm brakes and ends its tour; a real arm holds
    /// its position anyway.
    pub fn begin(&self) {
        #[cfg(feature = "sim")]
        if let Some(arm) = &self.simulated {
            arm.begin();
        }
    }

    /// How often a part of the robot has touched the scene; `None` if it is not counted, as for real
    /// arms.
    #[must_use]
    pub fn n_contacts(&self) -> Option<u64> {
        #[cfg(feature = "sim")]
        return self.simulated.as_ref()?.n_contacts();
        #[cfg(not(feature = "sim"))]
        None
    }
}

/// Opens the devices of a rig, see [`super::rig`], with its arm enabled for motion. A real arm
/// holds its position.
///
/// # Errors
///
/// For the reasons of [`super::rig`] and [`check_steerable`], or if the arm cannot be enabled.
pub(super) fn steered(rig: Rig, devices: Devices) -> anyhow::Result<(Opened, SteeredArm)> {
    check_steerable(&rig, devices)?;
    super::open_rig_with(rig, devices, open_devices)
}

/// Opens the devices of a rig whose settings are checked.
///
/// * `arm_driver`: driver of the arm in the rig file, which a simulation has replaced.
fn open_devices(
    rig: &mut Rig,
    arm_driver: ArmDriver,
) -> anyhow::Result<(Box<dyn Source>, StampClock, SteeredArm)> {
    let (devices, arm) = match rig.arm.driver {
        ArmDriver::Sim if rig.sim.emulate_arm && arm_driver != ArmDriver::Sim => {
            rig.arm.driver = arm_driver;
            open_emulated(rig)?
        }
        ArmDriver::Sim => {
            let (source, arm) = open_simulated(rig)?;
            return Ok((source, StampClock::Computer, arm));
        }
        _ => open_real(rig).map_err(|error| super::with_sim_hint(error, rig))?,
    };
    let source = Box::new(LiveDevices::new(devices)?);
    Ok((source, StampClock::Computer, arm))
}

fn open_real(rig: &mut Rig) -> anyhow::Result<(drivers::Devices, SteeredArm)> {
    // The arm is opened last, so that it is enabled only if everything else works. With the driver
    // `none`, it is not opened for reading.
    let driver = std::mem::replace(&mut rig.arm.driver, ArmDriver::None);
    let opened = real::open(rig, &mut real::end_on_failure);
    rig.arm.driver = driver;
    let (mut devices, _) = opened?;
    let arm = steer(real::movable_arm(rig)?, &mut devices)?;
    Ok((devices, arm))
}

/// Switches an arm to steering, and adds it to the devices that are read.
pub(super) fn steer(
    mut arm: Box<dyn MovableArm>,
    devices: &mut drivers::Devices,
) -> anyhow::Result<SteeredArm> {
    let port = arm.steering_port(BRAKE_FACTOR)?;
    devices.arm = Some(arm);
    Ok(SteeredArm::holding(port))
}

#[cfg(feature = "sim")]
fn open_simulated(rig: &Rig) -> anyhow::Result<(Box<dyn Source>, SteeredArm)> {
    let motion = simulated_limits(rig)?;
    let limits = sim::SteeredLimits {
        motion: &motion,
        brake_factor: BRAKE_FACTOR,
    };
    let (source, arm) = super::simulated::steered(rig, limits)?;
    Ok((source, SteeredArm::simulated(arm)))
}

#[cfg(not(feature = "sim"))]
fn open_simulated(_rig: &Rig) -> anyhow::Result<(Box<dyn Source>, SteeredArm)> {
    bail!(
        "this program was built without the simulator: build it with `cargo build --release --features sim`"
    )
}

#[cfg(all(feature = "sim", target_os = "linux"))]
fn open_emulated(rig: &mut Rig) -> anyhow::Result<(drivers::Devices, SteeredArm)> {
    let (arm, cameras) = super::emulated::open(rig)?;
    let mut devices = drivers::Devices {
        cameras,
        ..drivers::Devices::default()
    };
    let arm = steer(arm, &mut devices)?;
    Ok((devices, arm))
}

#[cfg(not(all(feature = "sim", target_os = "linux")))]
fn open_emulated(_rig: &mut Rig) -> anyhow::Result<(drivers::Devices, SteeredArm)> {
    bail!(
        "sim.emulate_arm needs Linux and a program built with `cargo build --release --features sim`"
    )
}

/// Checks that operators may steer the arm of a rig, as far as possible without devices.
///
/// # Errors
///
/// If the rig has no arm, its arm cannot be moved, it has joints beside those that move the flange,
/// or a simulation waits for the trainer.
pub(super) fn check_steerable(rig: &Rig, devices: Devices) -> anyhow::Result<()> {
    let is_simulated = devices == Devices::Sim || rig.arm.driver == ArmDriver::Sim;
    if rig.arm.joints.is_empty() || (rig.arm.driver == ArmDriver::None && !is_simulated) {
        bail!(BadInput(format!(
            "{}: the rig file has no arm that could move: remove the flag",
            Setting::EnableMotion
        )));
    }
    check_joints(rig)?;
    if rig.sim.lockstep && is_simulated {
        bail!(BadInput(format!(
            "{}: a simulation that waits for the trainer has no real time in which an arm could be steered: remove {}, \
             or sim.lockstep from the rig file",
            Setting::EnableMotion,
            Setting::Lockstep
        )));
    }
    if is_simulated {
        return simulated_limits(rig).map(drop);
    }
    if is_any_simulated(rig) {
        bail!(BadInput(format!(
            "{}: the arm and all cameras must be real, or all must be simulated, so that the images show the motion",
            Setting::EnableMotion
        )));
    }
    real::motion_of(rig)?;
    real::check_motion(rig)?;
    check_arm(rig)
}

/// Checks that the arm has exactly the joints that move its flange: targets contain no others.
fn check_joints(rig: &Rig) -> anyhow::Result<()> {
    let arm = &rig.arm;
    let chain = Chain::from_urdf(&arm.urdf_text, &arm.base_link, &arm.flange_link)?;
    chain.order_in(&arm.joints)?;
    let is_other = |joint: &&String| !chain.joint_names().contains(*joint);
    let others: Vec<&str> = arm
        .joints
        .iter()
        .filter(is_other)
        .map(String::as_str)
        .collect();
    if others.is_empty() {
        return Ok(());
    }
    bail!(BadInput(format!(
        "{}: arm.joints contains {}, but only joints between {:?} and {:?} can be steered yet: \
         remove the others from arm.joints, set arm.flange_link to a link behind them, or remove \
         the flag",
        Setting::EnableMotion,
        others.join(", "),
        arm.base_link,
        arm.flange_link
    )))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Override;
    use std::path::Path;

    fn refusal(name: &str, overrides: &[Override], devices: Devices) -> Option<String> {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../rigs");
        let rig = Rig::load(&folder.join(name), overrides).expect("a rig of this repository");
        let error = check_steerable(&rig, devices).err()?;
        Some(format!("{error:#}"))
    }

    #[test]
    fn arms_are_steered_only_if_the_rig_allows_it() {
        assert_eq!(refusal("static-arm.toml", &[], Devices::Sim), None);
        assert_eq!(
            refusal("static-arm.toml", &[], Devices::Real),
            None,
            "its driver is sim"
        );
        let real = [
            Override::new("arm.driver", "franka"),
            Override::new("arm.address", "127.0.0.1:1"),
            Override::new("camera.wrist.driver", "v4l2"),
        ];
        let allowed = [&real[..], &[Override::new("arm.motion.on_loss", "hold")]].concat();
        let lockstep = [Override::new("sim.lockstep", true)];
        for (name, overrides, devices, expected) in [
            (
                "static-arm.toml",
                &lockstep[..],
                Devices::Sim,
                Some("waits for the trainer"),
            ),
            (
                "static-arm.toml",
                &real[..],
                Devices::Real,
                Some("no table [arm.motion]"),
            ),
            ("static-arm.toml", &allowed[..], Devices::Real, None),
            ("static-arm.toml", &real[..], Devices::Sim, None),
            (
                "static-arm.toml",
                &real[..2],
                Devices::Real,
                Some("all must be simulated"),
            ),
        ] {
            let refusal = refusal(name, overrides, devices);
            match expected {
                None => assert_eq!(refusal, None, "{name}"),
                Some(words) => {
                    let refusal = refusal.unwrap_or_default();
                    assert!(refusal.contains(words), "{name}: {refusal}");
                }
            }
        }
    }

    #[test]
    fn arms_with_joints_beside_their_chain_are_refused_before_devices_are_opened() {
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../rigs/static-arm.toml");
        let mut rig = Rig::load(&file, &[]).expect("a rig of this repository");
        rig.arm.joints.push("gripper".to_owned());
        let devices = Devices::Sim;
        let refusal = check_steerable(&rig, devices).expect_err("a joint too many");
        let refusal = format!("{refusal:#}");
        assert!(
            refusal.contains("arm.joints contains gripper") && refusal.contains("remove"),
            "{refusal}"
        );
        // Opening makes the same check first.
        let opened = steered(rig, devices)
            .err()
            .map(|error| format!("{error:#}"));
        assert_eq!(opened, Some(refusal));
    }

    #[test]
    fn rigs_without_arms_have_no_arm_to_steer() {
        let no_arm = refusal("mobile-base.toml", &[], Devices::Sim).unwrap_or_default();
        assert!(no_arm.contains("no arm"), "{no_arm}");
    }
}
