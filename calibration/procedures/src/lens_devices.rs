//! The devices of a rig that the calibration of a lens needs.
//!
//! The lens of a camera can be calibrated before the rest of the robot is connected: only the
//! camera is opened, also if an arm carries it. A simulated camera is the exception, because one
//! simulation moves the camera, its arm and the target.

use capture::config::{ArmDriver, BaseDriver, Camera, Parent, Rig, SimTarget};
use capture::open::{self, Devices, Opened};
use targets::TargetSpec;

/// Open devices, and the whole rig with the calibration that the camera reports.
pub(crate) struct LensDevices {
    /// The devices. If the arm is not used, it has no driver in the rig of the devices.
    pub(crate) opened: Opened,
    pub(crate) rig: Rig,
}

/// Opens a camera of a rig. If the camera is simulated, opens the whole rig.
///
/// * `target`: shown to a simulated camera if the rig file names no simulated target.
///
/// # Errors
/// Fails if a device cannot be opened.
pub(crate) fn open(
    rig: Rig,
    camera: &str,
    target: &TargetSpec,
    devices: Devices,
) -> anyhow::Result<LensDevices> {
    let part = camera_alone(&rig, camera);
    if devices == Devices::Sim || open::is_any_simulated(&part) {
        return open_simulated(with_target(rig, camera, target), camera, devices);
    }
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

/// Opens all devices of a rig. The arm is used if it carries the camera, because a simulated arm
/// never rests: its speed decides which images are sharp. The pose of the base does not matter.
fn open_simulated(rig: Rig, camera: &str, devices: Devices) -> anyhow::Result<LensDevices> {
    let is_carried = is_carried(&rig, camera);
    let mut opened = open::rig(rig, devices)?;
    let rig = opened.rig.clone();
    opened.rig.base.driver = BaseDriver::Fixed;
    if !is_carried {
        without_arm(&mut opened.rig);
    }
    Ok(LensDevices { opened, rig })
}

/// The rig with a target in its simulated scene. If the rig file has none, a hand moves one in front
/// of the camera, so that the calibration can be tried with any rig file.
fn with_target(mut rig: Rig, camera: &str, target: &TargetSpec) -> Rig {
    if rig.sim.targets.is_empty() {
        log::info!("a simulated hand moves the target in front of camera {camera:?}");
        let target = SimTarget {
            spec: target.to_string(),
            world_from_board: None,
            flange_from_board: None,
            moved_before: Some(camera.to_owned()),
        };
        rig.sim.targets.insert("in_hand".to_owned(), target);
    }
    rig
}

/// The rig with only this camera.
fn camera_alone(rig: &Rig, camera: &str) -> Rig {
    let mut part = rig.clone();
    part.cameras.retain(|other| &*other.name == camera);
    part.scanners.clear();
    without_arm(&mut part);
    part
}

/// Whether an arm carries the camera.
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
    use capture::config::Override;
    use std::path::Path;

    fn rig(overrides: &[Override]) -> Rig {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../rigs/two-cameras.toml");
        Rig::load(&path, overrides).expect("a bundled rig file")
    }

    /// The rig with a real camera on the flange.
    fn rig_with_webcam(arm: &str) -> Rig {
        rig(&[
            Override::new("arm.driver", arm),
            // An address of RFC 5737 that no arm has.
            Override::new("arm.address", "192.0.2.1"),
            Override::new("camera.wrist.driver", "v4l2"),
            Override::new("camera.wrist.device", "no such serial"),
            Override::new("camera.wrist.depth.device", "no such serial"),
            Override::new("camera.wrist.depth.meters_per_count", 0.001),
        ])
    }

    #[test]
    fn a_real_camera_on_an_arm_is_opened_without_the_arm() {
        let target = "charuco:7x5:17mm:13mm:5X5_100".parse().expect("a target");
        for arm in ["franka", "sim"] {
            let rig = rig_with_webcam(arm);
            let part = camera_alone(&rig, "wrist");
            assert_eq!(part.arm.driver, ArmDriver::None);
            assert_eq!(part.cameras.len(), 1);
            assert_eq!(part.cameras[0].parent, Parent::Base);
            assert!(!open::is_any_simulated(&part), "{arm}");
            // The camera is missed, and not the arm.
            let Err(error) = open(rig, "wrist", &target, Devices::Real) else {
                panic!("there is no such camera");
            };
            let error = format!("{error:#}");
            assert!(
                error.contains("wrist") && !error.contains("192.0.2.1"),
                "{error}"
            );
        }
    }

    #[test]
    fn only_a_camera_on_an_arm_is_carried() {
        let mut rig = rig(&[]);
        assert!(is_carried(&rig, "wrist") && !is_carried(&rig, "overview"));
        rig.arm.driver = ArmDriver::None;
        assert!(!is_carried(&rig, "wrist"), "the rig has no arm");
    }
}
