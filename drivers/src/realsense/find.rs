//! Lists connected RealSense cameras and their problems.

use super::Problem;
use super::sdk::{Context, Device};
use realsense_rust::kind::Rs2CameraInfo;

/// A connected camera.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FoundCamera {
    /// Model name.
    pub name: String,
    /// Serial number, which identifies the camera in a rig file.
    pub serial: String,
    /// Firmware version.
    pub firmware: String,
    /// Firmware version that the library recommends, if it reports one.
    pub recommended_firmware: Option<String>,
    /// USB version of the connection, such as `3.2`.
    pub usb: Option<String>,
}

impl FoundCamera {
    pub(super) fn of(device: &Device) -> Self {
        Self {
            name: info(device, Rs2CameraInfo::Name).unwrap_or_else(|| "RealSense".into()),
            serial: info(device, Rs2CameraInfo::SerialNumber).unwrap_or_default(),
            firmware: info(device, Rs2CameraInfo::FirmwareVersion).unwrap_or_default(),
            recommended_firmware: info(device, Rs2CameraInfo::RecommendedFirmwareVersion),
            usb: info(device, Rs2CameraInfo::UsbTypeDescriptor),
        }
    }

    /// Whether the camera is connected by USB 2, on which only few of its modes are available.
    pub fn is_on_usb2(&self) -> bool {
        self.usb
            .as_deref()
            .is_some_and(|usb| usb.starts_with('2') || usb.starts_with('1'))
    }

    /// Whether the firmware of the camera is older than the version that the library recommends.
    pub fn has_old_firmware(&self) -> bool {
        // The versions are compared part by part as numbers. If they were compared as text, 5.9
        // would be newer than 5.16.
        self.recommended_firmware
            .as_deref()
            .is_some_and(|requested| version_numbers(&self.firmware) < version_numbers(requested))
    }

    /// Name and serial number for messages.
    pub(super) fn describe(&self) -> String {
        format!("{} {}", self.name, self.serial)
    }
}

/// A text that a device reports about itself.
fn info(device: &Device, kind: Rs2CameraInfo) -> Option<String> {
    device
        .info
        .info(kind)
        .map(|text| text.to_string_lossy().into_owned())
}

/// The parts of a version, such as 5.16.0.1.
fn version_numbers(version: &str) -> Vec<u32> {
    version
        .split('.')
        .map(|part| part.parse().unwrap_or(0))
        .collect()
}

/// All connected cameras.
pub fn cameras() -> Result<Vec<FoundCamera>, Problem> {
    Ok(Context::new()?
        .devices()?
        .iter()
        .map(FoundCamera::of)
        .collect())
}

/// Finds the camera with a serial number, or the only connected camera if the number is empty.
pub(super) fn camera(context: &Context, serial: &str) -> Result<Device, Problem> {
    let mut devices = context.devices()?;
    let found: Vec<FoundCamera> = devices.iter().map(FoundCamera::of).collect();
    let is_match = |found: &FoundCamera| serial.is_empty() || found.serial == serial;
    let connected = || found.iter().map(FoundCamera::describe).collect();
    match found.iter().filter(|found| is_match(found)).count() {
        0 => Err(Problem::NoDevice {
            serial: serial.to_owned(),
            connected: connected(),
        }),
        1 => Ok(devices.swap_remove(
            found
                .iter()
                .position(is_match)
                .expect("the filter found one match"),
        )),
        _ => Err(Problem::Ambiguous {
            connected: connected(),
        }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn old_firmware_and_usb2_are_detected() {
        let found = |firmware: &str, requested: Option<&str>, usb: Option<&str>| FoundCamera {
            name: "Intel RealSense D435I".into(),
            serial: "123".into(),
            firmware: firmware.into(),
            recommended_firmware: requested.map(str::to_owned),
            usb: usb.map(str::to_owned),
        };
        assert!(found("5.9.15.1", Some("5.16.0.1"), None).has_old_firmware());
        assert!(!found("5.16.0.1", Some("5.16.0.1"), None).has_old_firmware());
        assert!(!found("5.17.0.9", Some("5.16.0.1"), None).has_old_firmware());
        assert!(!found("5.9.15.1", None, None).has_old_firmware());
        assert!(found("", None, Some("2.1")).is_on_usb2());
        assert!(!found("", None, Some("3.2")).is_on_usb2() && !found("", None, None).is_on_usb2());
    }

    #[test]
    fn missing_camera_error_names_it() {
        let context = Context::new().expect("the library starts without a camera");
        let message = camera(&context, "no such serial")
            .expect_err("no camera is connected")
            .to_string();
        assert!(message.contains("no such serial"), "{message}");
    }
}
