//! Checks RealSense cameras.

use super::Finding;
use crate::config::{Camera, CameraDriver, Rig};

/// Checks connected RealSense cameras, and whether those of the rig are connected.
#[cfg(feature = "realsense")]
pub(super) fn realsense(rig: Option<&Rig>) -> Vec<Finding> {
    const CHECK: &str = "realsense";
    let found = match drivers::realsense::cameras() {
        Ok(found) => found,
        Err(problem) => {
            return vec![Finding::fail(
                CHECK,
                problem.to_string(),
                "install the udev rules of the RealSense SDK",
            )];
        }
    };
    let mut findings = Vec::new();
    for camera in &found {
        let name = format!("{} {}", camera.name, camera.serial);
        if camera.is_on_usb2() {
            let remedy = "use a USB 3 port and the original cable; turn the plug over";
            findings.push(Finding::warn(
                CHECK,
                format!("{name}: runs at USB 2, which carries few of its modes"),
                remedy,
            ));
        }
        if camera.has_old_firmware() {
            let recommended = camera.recommended_firmware.as_deref().unwrap_or_default();
            let message = format!(
                "{name}: firmware {} is older than the library recommends ({recommended})",
                camera.firmware
            );
            findings.push(Finding::warn(
                CHECK,
                message,
                "update it with rs-fw-update of the RealSense SDK",
            ));
        }
        if !camera.is_on_usb2() && !camera.has_old_firmware() {
            findings.push(Finding::ok(
                CHECK,
                format!("{name}, firmware {}", camera.firmware),
            ));
        }
    }
    for camera in realsense_of(rig) {
        let is_connected = found
            .iter()
            .any(|device| camera.device.is_empty() || device.serial == camera.device);
        if !is_connected {
            findings.push(not_connected(camera));
        }
    }
    findings
}

/// The problem that the camera is not connected. An empty serial number means any camera.
#[cfg(any(feature = "realsense", test))]
fn not_connected(camera: &Camera) -> Finding {
    let serial = if camera.device.is_empty() {
        String::new()
    } else {
        format!("with the serial number {:?} ", camera.device)
    };
    Finding::fail(
        "realsense",
        format!(
            "camera {:?}: no RealSense camera {serial}is connected",
            camera.name
        ),
        "list the connected cameras with fieldrig devices",
    )
}

#[cfg(not(feature = "realsense"))]
pub(super) fn realsense(rig: Option<&Rig>) -> Vec<Finding> {
    let missing = realsense_of(rig).map(|camera| {
        let message = format!("camera {:?}: this program was built without RealSense support", camera.name);
        let remedy = "install the RealSense SDK (librealsense2), then cargo build --release --features realsense";
        Finding::fail("realsense", message, remedy)
    });
    missing.collect()
}

/// RealSense cameras of a rig, without those that play back a file.
fn realsense_of(rig: Option<&Rig>) -> impl Iterator<Item = &Camera> {
    let cameras = rig.map_or(&[][..], |rig| &rig.cameras).iter();
    cameras.filter(|camera| {
        camera.driver == CameraDriver::Realsense && camera.realsense.file.as_os_str().is_empty()
    })
}

/// Checks that the files that replace RealSense cameras exist.
pub(super) fn files(rig: &Rig) -> Vec<Finding> {
    let missing = |camera: &&Camera| {
        let file = &camera.realsense.file;
        camera.driver == CameraDriver::Realsense && !file.as_os_str().is_empty() && !file.is_file()
    };
    rig.cameras
        .iter()
        .filter(missing)
        .map(missing_file)
        .collect()
}

fn missing_file(camera: &Camera) -> Finding {
    let message = format!(
        "camera {:?}: the file {} does not exist",
        camera.name,
        camera.realsense.file.display()
    );
    Finding::fail(
        "realsense",
        message,
        "camera.NAME.realsense.file is relative to the folder of the rig file",
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::doctor::testing::bundled_rig;

    #[test]
    fn missing_serial_number_is_not_part_of_the_message() {
        let message = |device: &str| {
            let overrides = [
                ("camera.wrist.driver", "realsense"),
                ("camera.wrist.device", device),
            ];
            not_connected(&bundled_rig("static-arm.toml", &overrides).cameras[0]).message
        };
        assert_eq!(
            message(""),
            "camera \"wrist\": no RealSense camera is connected"
        );
        assert_eq!(
            message("021"),
            "camera \"wrist\": no RealSense camera with the serial number \"021\" is connected"
        );
    }

    #[test]
    fn missing_files_are_reported() {
        let overrides = [
            ("camera.wrist.driver", "realsense"),
            ("camera.wrist.realsense.file", "nowhere.bag"),
        ];
        let findings = files(&bundled_rig("static-arm.toml", &overrides));
        assert!(
            findings.len() == 1 && findings[0].message.contains("nowhere.bag"),
            "{findings:?}"
        );
    }
}
