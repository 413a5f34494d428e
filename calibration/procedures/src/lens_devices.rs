//! The devices of a rig that the calibration of a lens needs.
//!
//! Only the camera is opened, so its lens can be calibrated before the rest of the robot is
//! connected. If an arm carries the camera, the arm is opened, too, because images during fast
//! motions of the arm are not used.

use capture::config::{ArmDriver, BaseDriver, Camera, Parent, Rig};
use capture::open::{self, Devices, Opened};

/// Open devices, and the whole rig with the calibration that the camera reports.
pub(crate) struct LensDevices {
    /// The devices. If the arm is not used, it has no driver in the rig of the devices.
    pub(crate) opened: Opened,
    pub(crate) rig: Rig,
}

/// Opens a camera of a rig, and the arm if it carries the camera.
///
/// # Errors
/// Fails if a device cannot be opened.
pub(crate) fn open(rig: Rig, camera: &str, devices: Devices) -> anyhow::Result<LensDevices> {
    let is_carried = is_carried(&rig, camera);
    // One simulation moves all devices.
    let is_simulated = devices == Devices::Sim || open::is_any_simulated(&rig);
    if is_carried || is_simulated {
        let mut opened = open::rig(rig, devices)?;
        let rig = opened.rig.clone();
        if !is_carried {
            without_arm(&mut opened.rig);
        }
        return Ok(LensDevices { opened, rig });
    }
    let mut part = rig.clone();
    part.cameras.retain(|other| &*other.name == camera);
    part.scanners.clear();
    without_arm(&mut part);
    let opened = open::rig(part, devices)?;
    let mut rig = rig;
    for known in &mut rig.cameras {
        let reported = opened
            .rig
            .cameras
            .iter()
            .find(|other| other.name == known.name);
        if let Some(reported) = reported {
            // Everything is copied from the reported camera except the parent, because
            // `without_arm` may have changed the parent.
            *known = Camera {
                parent: known.parent,
                ..reported.clone()
            };
        }
    }
    Ok(LensDevices { opened, rig })
}

/// Whether an arm that is read carries the camera.
fn is_carried(rig: &Rig, camera: &str) -> bool {
    let is_on_flange = rig
        .cameras
        .iter()
        .any(|other| &*other.name == camera && other.parent == Parent::Flange);
    is_on_flange && rig.arm.driver != ArmDriver::None
}

/// Removes the arm and the motion of the base from the rig.
fn without_arm(rig: &mut Rig) {
    rig.arm.driver = ArmDriver::None;
    rig.base.driver = BaseDriver::Fixed;
    for camera in &mut rig.cameras {
        if camera.parent == Parent::Flange {
            camera.parent = Parent::Base;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    fn rig() -> Rig {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../rigs/two-cameras.toml");
        Rig::load(&path, &[]).expect("a bundled rig file")
    }

    #[test]
    fn only_a_camera_on_an_arm_needs_the_arm() {
        let mut rig = rig();
        let name = rig.cameras[0].name.to_string();
        rig.cameras[0].parent = Parent::Flange;
        assert!(is_carried(&rig, &name));
        rig.arm.driver = ArmDriver::None;
        assert!(!is_carried(&rig, &name), "the arm is not read");
        rig.arm.driver = ArmDriver::Udp;
        rig.cameras[0].parent = Parent::World;
        assert!(!is_carried(&rig, &name));
    }
}
