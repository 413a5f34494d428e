//! Opens a camera together with an arm that can be moved, real or simulated.

#[cfg(feature = "sim")]
use super::arm_config::simulated_limits;
use super::assumed_lens::assume_calibration_of_simulated;
use super::real;
use super::{Devices, check_arm, use_simulated_devices, without_readout_if_ideal};
use crate::config::{ArmDriver, BaseDriver, Camera, CameraDriver, Rig};
use anyhow::bail;
use drivers::motion::MovableArm;

/// A camera and an arm that can be moved.
pub struct Movable {
    /// The rig with all settings resolved. It contains only this camera.
    pub rig: Rig,
    /// The arm. Its positions do not include `arm.joint_offsets`.
    pub arm: Box<dyn MovableArm>,
    /// The camera. It may also deliver depth.
    pub camera: Box<dyn drivers::Camera>,
}

/// Opens a camera of a rig and enables its arm, which holds its position. Simulated devices run as
/// fast as they are read.
///
/// # Errors
///
/// If the rig has no such camera, a device cannot be opened, the arm cannot be moved as configured,
/// or only one of arm and camera is simulated.
pub fn movable(rig: &Rig, devices: Devices, camera: &str) -> anyhow::Result<Movable> {
    let mut rig = rig.clone();
    // Other devices would only take bandwidth, or fail although they are not needed.
    rig.cameras.retain(|other: &Camera| &*other.name == camera);
    rig.scanners.clear();
    let Some(driver) = rig.cameras.first().map(|camera| camera.driver) else {
        bail!("the rig has no camera {camera:?}");
    };
    // The driver is stored, because `use_simulated_devices` overwrites it, and an emulated
    // controller needs the driver of the real arm.
    let arm_driver = rig.arm.driver;
    if devices == Devices::Sim {
        use_simulated_devices(&mut rig);
    } else if (rig.arm.driver == ArmDriver::Sim) != (driver == CameraDriver::Sim) {
        bail!(
            "the arm and camera {camera:?} must both be real or both be simulated, so that the images show the motion"
        );
    }
    if rig.base.driver != BaseDriver::Fixed {
        bail!(
            "base.driver: the base must be fixed; use a copy of the rig file with base.driver = \"fixed\""
        );
    }
    assume_calibration_of_simulated(&mut rig);
    without_readout_if_ideal(&mut rig);
    check_arm(&rig)?;
    if rig.arm.driver == ArmDriver::Sim {
        if rig.sim.emulate_arm && arm_driver != ArmDriver::Sim {
            rig.arm.driver = arm_driver;
            return emulated(rig);
        }
        return simulated(rig);
    }
    // The camera is opened first, so that the arm is enabled only if everything else works. With
    // the driver `none`, the arm is not opened for reading here. It is opened for motion below.
    let driver = std::mem::replace(&mut rig.arm.driver, ArmDriver::None);
    let opened = real::open(&mut rig, &mut real::end_on_failure);
    rig.arm.driver = driver;
    let (opened, _) = opened?;
    let Some(camera) = opened.cameras.into_iter().next() else {
        bail!("camera {camera:?} was not opened");
    };
    let arm = real::movable_arm(&rig)?;
    Ok(Movable { rig, arm, camera })
}

#[cfg(feature = "sim")]
fn simulated(rig: Rig) -> anyhow::Result<Movable> {
    let limits = simulated_limits(&rig)?;
    let sim::CommandedRig { arm, cameras, .. } = super::simulated::commanded(&rig, &limits)?;
    let Some(camera) = cameras.into_iter().next() else {
        bail!("the simulated rig has no camera");
    };
    Ok(Movable { rig, arm, camera })
}

#[cfg(all(feature = "sim", target_os = "linux"))]
fn emulated(mut rig: Rig) -> anyhow::Result<Movable> {
    let (arm, cameras) = super::emulated::open(&mut rig)?;
    let Some(camera) = cameras.into_iter().next() else {
        bail!("the simulated rig has no camera");
    };
    Ok(Movable { rig, arm, camera })
}

#[cfg(not(all(feature = "sim", target_os = "linux")))]
fn emulated(_rig: Rig) -> anyhow::Result<Movable> {
    bail!(
        "sim.emulate_arm needs Linux and a program built with `cargo build --release --features sim`"
    )
}

#[cfg(not(feature = "sim"))]
fn simulated(_rig: Rig) -> anyhow::Result<Movable> {
    bail!(
        "this program was built without the simulator: build it with `cargo build --release --features sim`"
    )
}
