//! Opens the devices of a rig with a base that operators drive, and with the arm on it.

use super::real;
use super::robot_tap::RobotTap;
use super::steered::{SteeredArm, check_steerable, steer};
use super::{Devices, Opened, check_arm, is_any_simulated};
use crate::config::{
    ArmDriver, BaseDriver, BaseMotion, Camera, CameraDriver, Rig, Scanner, ScannerDriver,
};
use crate::stamp_clock::StampClock;
use anyhow::bail;
use drivers::Source;
use drivers::base_motion::{BaseDrive, BasePort};
use drivers::udp::UdpDrivenBase;
use drivers::{BasePose, LiveDevices, clock};
use kinematics::JointState;
use messages::{BadInput, Setting};

/// A base that operators drive. Dropping it lets the base brake.
#[derive(Debug)]
pub struct SteeredBase {
    drive: BaseDrive,
    tap: RobotTap,
    #[cfg(feature = "sim")]
    simulated: Option<sim::SteeredBase>,
}

impl SteeredBase {
    /// A base that stands still until it is driven.
    fn standing(drive: BaseDrive, tap: RobotTap) -> Self {
        Self {
            drive,
            tap,
            #[cfg(feature = "sim")]
            simulated: None,
        }
    }

    /// A base that another program has opened, whose pose nothing reports.
    #[must_use]
    pub fn driven_by(drive: BaseDrive) -> Self {
        Self::standing(drive, RobotTap::default())
    }

    /// Targets and states of the base.
    #[must_use]
    pub fn port(&self) -> &BasePort {
        self.drive.port()
    }

    /// The newest pose that the base or its localization has reported, without the corrections of
    /// stations; `None` if it comes from the images of the run. It does not wait for the input of
    /// the run.
    #[must_use]
    pub fn reported_pose(&self) -> Option<BasePose> {
        #[cfg(feature = "sim")]
        if let Some(base) = &self.simulated {
            let stamp = clock::now();
            return Some(BasePose {
                stamp,
                world_from_base: base.world_from_base(stamp),
            });
        }
        self.tap.pose()
    }

    /// The newest joint state of the arm on the base, without `arm.joint_offsets`; `None` without
    /// an arm. It does not wait for the input of the run.
    #[must_use]
    pub fn reported_joints(&self) -> Option<JointState> {
        self.tap.joints()
    }

    /// Takes the base over, or stops it. A simulated base ends its tour and brakes. A real base has
    /// no tour.
    pub fn begin(&self) {
        #[cfg(feature = "sim")]
        if let Some(base) = &self.simulated {
            base.begin();
        }
    }

    /// How often a part of the robot has touched the scene; `None` if it is not counted, as for
    /// real robots.
    #[must_use]
    pub fn n_contacts(&self) -> Option<u64> {
        #[cfg(feature = "sim")]
        return self.simulated.as_ref()?.n_contacts();
        #[cfg(not(feature = "sim"))]
        None
    }
}

/// The parts of a robot that operators of a run move.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct SteeredParts {
    pub(super) arm: bool,
    pub(super) base: bool,
}

impl SteeredParts {
    /// The parts that a rig permits to move. In simulations, these are all.
    pub(super) fn of(rig: &Rig, devices: Devices) -> Self {
        let has_arm = !rig.arm.joints.is_empty();
        let is_simulated = devices == Devices::Sim || rig.base.driver == BaseDriver::Sim;
        if is_simulated {
            let base = super::base_moves(rig);
            return Self {
                arm: has_arm || !base,
                base,
            };
        }
        let base = rig.has_moving_base();
        let is_arm_permitted = has_arm && rig.arm.motion.is_some();
        Self {
            arm: is_arm_permitted || !base,
            base,
        }
    }
}

/// Opens the devices of a rig, see [`super::rig`], with a base that operators drive, and with its
/// arm if they steer it, too.
///
/// # Errors
///
/// For the reasons of [`super::rig`] and [`check_drivable`], or if the base cannot be driven, or the
/// arm not be enabled.
pub(super) fn with_steered_base(
    rig: Rig,
    devices: Devices,
) -> anyhow::Result<(Opened, (SteeredBase, Option<SteeredArm>))> {
    check_drivable(&rig, devices)?;
    let is_arm_steered = SteeredParts::of(&rig, devices).arm;
    super::open_rig_with(rig, devices, |rig, _| open_devices(rig, is_arm_steered))
}

/// A base, and its arm if it is steered.
type Robot = (SteeredBase, Option<SteeredArm>);

/// Opens the devices of a rig whose settings are checked.
fn open_devices(
    rig: &mut Rig,
    is_arm_steered: bool,
) -> anyhow::Result<(Box<dyn Source>, StampClock, Robot)> {
    let motion = rig.base.motion.clone().unwrap_or_default();
    if rig.base.driver == BaseDriver::Sim {
        let (source, robot) = open_simulated(rig, &motion, is_arm_steered)?;
        return Ok((source, StampClock::Computer, robot));
    }
    let driver = rig.arm.driver;
    if is_arm_steered {
        // It is opened last, as by `steered.rs`.
        rig.arm.driver = ArmDriver::None;
    }
    let opened = real::open(rig, &mut real::end_on_failure);
    rig.arm.driver = driver;
    let (mut devices, _) = opened.map_err(|error| super::with_sim_hint(error, rig))?;
    let tap = RobotTap::default();
    devices.base = devices.base.map(|base| tap.of_base(base));
    devices.arm = devices.arm.map(|arm| tap.of_arm(arm));
    // The base is reached after all devices that only report, so that it is driven only if they
    // work. An arm is enabled last.
    let base = open_real(&motion, tap)?;
    let arm = if is_arm_steered {
        Some(steer(real::movable_arm(rig)?, &mut devices)?)
    } else {
        None
    };
    let source = Box::new(LiveDevices::new(devices)?);
    Ok((source, StampClock::Computer, (base, arm)))
}

fn open_real(motion: &BaseMotion, tap: RobotTap) -> anyhow::Result<SteeredBase> {
    let Some(address) = motion.address else {
        bail!("base.motion.address is missing: this is a bug");
    };
    // The session must differ from the sessions of earlier starts, so it is the time of the start.
    let session = clock::now().0.unsigned_abs();
    let base = UdpDrivenBase::open(address, session)?;
    log::info!("base: driving the controller at {address}");
    if !address.ip().is_loopback() {
        log::warn!(
            "base: any program in the network can drive the controller at {address}, because datagrams are not authenticated"
        );
    }
    let drive = BaseDrive::start(Box::new(base), motion.limits())?;
    Ok(SteeredBase::standing(drive, tap))
}

#[cfg(feature = "sim")]
fn open_simulated(
    rig: &Rig,
    motion: &BaseMotion,
    is_arm_steered: bool,
) -> anyhow::Result<(Box<dyn Source>, Robot)> {
    let limits = is_arm_steered
        .then(|| super::arm_config::simulated_limits(rig))
        .transpose()?;
    let limits = limits.as_ref().map(|motion| sim::SteeredLimits {
        motion,
        brake_factor: super::steered::BRAKE_FACTOR,
    });
    let (source, robot) = super::simulated::with_steered_base(rig, limits)?;
    let base = SteeredBase {
        drive: BaseDrive::start(robot.driven, motion.limits())?,
        tap: RobotTap::default(),
        simulated: Some(robot.base),
    };
    Ok((source, (base, robot.arm.map(SteeredArm::simulated))))
}

#[cfg(not(feature = "sim"))]
fn open_simulated(
    _rig: &Rig,
    _motion: &BaseMotion,
    _is_arm_steered: bool,
) -> anyhow::Result<(Box<dyn Source>, Robot)> {
    bail!(
        "this program was built without the simulator: build it with `cargo build --release --features sim`"
    )
}

/// Why a rig with real and simulated devices is refused.
const MIXED: &str = "the base and all other devices must be real, or all must be simulated, so that \
                     the images show the motion";

/// Why a rig is refused whose arm has no stowed posture.
const STOWED_MISSING: &str = "base.motion.stowed is missing: set it to the positions of the arm's \
                              joints while the base moves";

/// Whether any device of a rig is real.
fn is_any_real(rig: &Rig) -> bool {
    let is_arm_real = !matches!(rig.arm.driver, ArmDriver::Sim | ArmDriver::None);
    let is_real = |camera: &Camera| camera.driver != CameraDriver::Sim;
    let scans = |scanner: &Scanner| scanner.driver != ScannerDriver::Sim;
    is_arm_real || rig.cameras.iter().any(is_real) || rig.scanners.iter().any(scans)
}

/// Checks that operators may drive the base of a rig, as far as possible without devices.
///
/// # Errors
///
/// If the base cannot be driven, its arm cannot be steered although the rig file permits it, the
/// posture in which the arm is stowed is not known, or a simulation waits for the trainer.
pub(super) fn check_drivable(rig: &Rig, devices: Devices) -> anyhow::Result<()> {
    let refusal = |why: &str| Err(BadInput(format!("{}: {why}", Setting::EnableMotion)).into());
    let is_simulated = devices == Devices::Sim || rig.base.driver == BaseDriver::Sim;
    let has_arm = !rig.arm.joints.is_empty() && (is_simulated || rig.arm.driver != ArmDriver::None);
    let stowed = rig.base.motion.as_ref().map(|motion| &motion.stowed);
    let is_stowed_known = !has_arm || stowed.is_some_and(|stowed| !stowed.is_empty());
    if is_simulated {
        if devices == Devices::Real && is_any_real(rig) {
            return refusal(MIXED);
        }
        if !super::base_moves(rig) {
            return refusal("the base of this scene does not move: remove the flag");
        }
        if rig.sim.lockstep {
            return refusal(
                "a simulation that waits for the trainer has no real time in which a base could be \
                 steered: remove sim.lockstep from the rig file, or remove the flag",
            );
        }
        if rig.sim.emulate_arm && has_arm {
            return refusal(
                "an emulated arm on a moving base cannot be steered: remove sim.emulate_arm from the \
                 rig file, or remove the flag",
            );
        }
        if !is_stowed_known {
            return refusal(STOWED_MISSING);
        }
        return check_arm_on_base(rig, devices);
    }
    if is_any_simulated(rig) {
        return refusal(MIXED);
    }
    let Some(motion) = &rig.base.motion else {
        return refusal(
            "the base can only be read: add a table [base.motion] to the rig file, or remove the \
             flag",
        );
    };
    if motion.address.is_none() {
        return refusal(
            "base.motion.address is missing: set it to the address of the controller of the base, \
             such as \"192.168.1.5:7020\"",
        );
    }
    if !is_stowed_known {
        return refusal(STOWED_MISSING);
    }
    check_arm(rig)?;
    check_arm_on_base(rig, devices)
}

/// Checks the arm on a base, if it is steered.
fn check_arm_on_base(rig: &Rig, devices: Devices) -> anyhow::Result<()> {
    if SteeredParts::of(rig, devices).arm {
        check_steerable(rig, devices)?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Override;
    use std::path::Path;

    fn refusal(name: &str, overrides: &[Override], devices: Devices) -> Option<String> {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../rigs");
        let rig = Rig::load(&folder.join(name), overrides).expect("a rig of this repository");
        assert!(SteeredParts::of(&rig, devices).base);
        let error = check_drivable(&rig, devices).err()?;
        Some(format!("{error:#}"))
    }

    #[test]
    fn bases_are_driven_only_if_the_rig_says_how_and_where_the_arm_is_stowed() {
        let real = [
            Override::new("base.driver", "udp"),
            Override::new("arm.driver", "udp"),
            Override::new("camera.wrist.driver", "v4l2"),
        ];
        let with = |more: &[Override]| [&real[..], more].concat();
        let address = Override::new("base.motion.address", "127.0.0.1:7020");
        let stowed = Override::new("base.motion.stowed", vec![0.0; 7]);
        let unknown = Override::new("base.motion.stowed", Vec::<f64>::new());
        for (overrides, expected) in [
            (&real[..1], Some("all must be simulated")),
            (&real[..], Some("base.motion.address is missing")),
            (
                &with(&[address.clone(), unknown]),
                Some("base.motion.stowed is missing"),
            ),
            (&with(&[address, stowed]), None),
        ] {
            let refusal = refusal("mobile-arm.toml", overrides, Devices::Real);
            match expected {
                None => assert_eq!(refusal, None),
                Some(words) => {
                    let refusal = refusal.unwrap_or_default();
                    assert!(refusal.contains(words), "{refusal}");
                }
            }
        }
    }

    #[cfg(feature = "sim")]
    #[test]
    fn simulated_bases_are_driven_in_real_time_and_their_arms_must_be_stowed() {
        assert_eq!(refusal("mobile-base.toml", &[], Devices::Sim), None);
        let lockstep = [Override::new("sim.lockstep", true)];
        let refused = refusal("mobile-base.toml", &lockstep, Devices::Sim).unwrap_or_default();
        assert!(refused.contains("waits for the trainer"), "{refused}");
        assert_eq!(refusal("mobile-arm.toml", &[], Devices::Sim), None);
        let unknown = [Override::new("base.motion.stowed", Vec::<f64>::new())];
        let refused = refusal("mobile-arm.toml", &unknown, Devices::Sim).unwrap_or_default();
        assert!(
            refused.contains("base.motion.stowed is missing"),
            "{refused}"
        );
    }
}
