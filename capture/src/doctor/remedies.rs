//! Remedies for devices that cannot be opened, are silent or are slow. They depend on the kind of
//! the device and on its driver.

use crate::config::{ArmDriver, CameraDriver, Rig};
use drivers::device_names;

/// The kind of a device, from its name in messages.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    Camera,
    Arm,
    Base,
    Scanner,
}

fn kind_of(device: &str) -> Kind {
    match device {
        device_names::ARM => Kind::Arm,
        device_names::BASE => Kind::Base,
        _ if device.starts_with("range scanner ") => Kind::Scanner,
        // Keyframes are made from the images of cameras.
        _ => Kind::Camera,
    }
}

/// Remedy for a device that cannot be opened.
pub(super) fn not_opened(device: &str, rig: &Rig) -> &'static str {
    match (kind_of(device), rig.arm.driver) {
        (Kind::Camera, _) if is_realsense(device, rig) => {
            "connect it to a USB 3 port, or correct its serial number: `fieldrig devices` lists the connected cameras"
        }
        (Kind::Camera, _) => {
            "connect it, or correct its device: `fieldrig devices` lists the connected cameras and their modes"
        }
        (Kind::Arm, ArmDriver::None) => {
            "set the parent of the camera to base or world, or add the arm that carries it"
        }
        (Kind::Arm, ArmDriver::Franka) => {
            "check arm.address and the network cable, unlock the joints in Desk and activate FCI"
        }
        (Kind::Arm, ArmDriver::Ur) => {
            "check arm.address and the network cable, and that the controller is on"
        }
        (Kind::Arm, ArmDriver::Can) => {
            "check power and termination of the bus, and the IDs of the motors; the checks of CAN above name wrong settings of the interface"
        }
        (Kind::Arm, ArmDriver::Feetech | ArmDriver::Dynamixel) => {
            "check power and cable of the servos, and arm.serial.device: `fieldrig devices` lists the serial ports and their servos"
        }
        (Kind::Arm | Kind::Base | Kind::Scanner, _) => {
            "if another program listens on this address, stop it, or choose another address for both programs"
        }
    }
}

/// Remedy for an open device that sends nothing. Devices that receive datagrams have other
/// remedies.
pub(super) fn silent(device: &str, rig: &Rig) -> &'static str {
    match (kind_of(device), rig.arm.driver) {
        (Kind::Camera, _) => "check its cable, and whether another program uses it",
        (Kind::Arm, ArmDriver::Franka | ArmDriver::Ur) => {
            "check the network cable and the state of the controller"
        }
        (Kind::Arm, ArmDriver::Can) => "check power and cables of the motors and their bus",
        (Kind::Arm, ArmDriver::Feetech | ArmDriver::Dynamixel) => {
            "check power and cable of the servos"
        }
        _ => "check it and its cable",
    }
}

/// Remedy for a device that sends less than the rig file says.
pub(super) fn slow(device: &str) -> &'static str {
    match kind_of(device) {
        Kind::Camera => "usual causes: low light with automatic exposure, a slow bus, a busy CPU",
        Kind::Arm => {
            "usual causes: a slow bus or network, a controller that is not ready, a busy CPU"
        }
        Kind::Base => "usual causes: a slow sender, a network that loses datagrams, a busy CPU",
        Kind::Scanner => {
            "usual causes: a slower scanner than range.NAME.rate_hz says, a network that loses datagrams, a busy CPU"
        }
    }
}

/// Whether a device is a RealSense camera.
fn is_realsense(device: &str, rig: &Rig) -> bool {
    rig.cameras
        .iter()
        .filter(|camera| camera.driver == CameraDriver::Realsense)
        .any(|camera| device.starts_with(&device_names::camera(&camera.name)))
}
