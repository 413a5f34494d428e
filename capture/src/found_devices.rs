//! Lists connected devices, as reported by the kernel, with the values to use in a rig file.

#[cfg(target_os = "linux")]
mod serial_ports;
mod watch;

pub use watch::{ChangeKind, DeviceChange, DeviceWatch};

#[cfg(target_os = "linux")]
use drivers::v4l2;
use messages::Setting;
use serde::Serialize;
use std::path::Path;

/// Intel's USB vendor ID, used by RealSense cameras.
#[cfg(any(not(feature = "realsense"), test))]
const INTEL_USB_VENDOR: &str = "8086";

/// A device that was found.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct DeviceInfo {
    /// `gpu`, `camera`, `can`, `serial` or `simulation`.
    pub kind: &'static str,
    /// Value for a rig file, or text for display.
    pub address: String,
    /// Name that the device reports.
    pub name: String,
    /// Whether this build can use the device.
    pub usable: bool,
    /// How to use the device, or why it cannot be used.
    pub note: String,
}

impl DeviceInfo {
    /// The device in columns, and how to use it on another line.
    #[must_use]
    pub fn lines(&self) -> [String; 2] {
        let label = if self.usable { "yes" } else { "no " };
        [
            format!(
                "{label}  {:10} {:14} {}",
                self.kind, self.address, self.name
            ),
            format!("     {}", self.note),
        ]
    }

    /// Whether another list has this device, perhaps in another state.
    fn is_same_as(&self, other: &Self) -> bool {
        self.kind == other.kind && self.address == other.address
    }
}

/// The simulation, the cameras, the CAN interfaces and the serial ports that are found.
#[must_use]
pub fn found_devices() -> Vec<DeviceInfo> {
    devices_with(&[])
}

/// Like [`found_devices`], but serial ports in `known` are not searched for servos again.
fn devices_with(known: &[DeviceInfo]) -> Vec<DeviceInfo> {
    #[cfg(not(target_os = "linux"))]
    let _ = known;
    let mut found = vec![simulation()];
    let sys = Path::new("/sys");
    #[cfg(target_os = "linux")]
    found.extend(video_devices(v4l2::cameras()));
    found.extend(realsense_cameras(sys));
    found.extend(can_interfaces(sys));
    #[cfg(target_os = "linux")]
    found.extend(serial_ports::serial_ports(sys, Path::new("/dev"), known));
    found
}

fn simulation() -> DeviceInfo {
    let usable = cfg!(feature = "sim");
    let note = if usable {
        format!(
            "`fieldrig run RIG.toml {}` simulates all devices of a rig",
            Setting::Sim
        )
    } else {
        "built without simulation; run `make deps`, then `cargo build --release --features sim`"
            .to_owned()
    };
    DeviceInfo {
        kind: "simulation",
        address: format!("run {}", Setting::Sim),
        name: "MuJoCo".into(),
        usable,
        note,
    }
}

/// V4L2 capture devices with their image modes.
#[cfg(target_os = "linux")]
fn video_devices(cameras: Vec<Result<v4l2::FoundCamera, v4l2::Problem>>) -> Vec<DeviceInfo> {
    let unavailable = |problem: v4l2::Problem| DeviceInfo {
        kind: "camera",
        address: "unknown".into(),
        name: "V4L2".into(),
        usable: false,
        note: problem.to_string(),
    };
    cameras
        .into_iter()
        .map(|camera| camera.map_or_else(unavailable, describe_camera))
        .collect()
}

#[cfg(target_os = "linux")]
fn describe_camera(camera: v4l2::FoundCamera) -> DeviceInfo {
    let usb = camera
        .usb_mbits
        .map_or(String::new(), |mbits| format!(", USB at {mbits} Mbit/s"));
    let serial = camera
        .serial
        .as_ref()
        .map_or(String::new(), |serial| format!(", serial {serial}"));
    let offers = v4l2::summary(&camera.modes);
    DeviceInfo {
        kind: "camera",
        address: camera.address(),
        usable: !camera.modes.is_empty(),
        note: format!(
            "driver v4l2, {}, at {}{serial}{usb}: {offers}",
            camera.node.display(),
            camera.bus
        ),
        name: camera.name,
    }
}

/// RealSense cameras found by librealsense.
#[cfg(feature = "realsense")]
fn realsense_cameras(_sys: &Path) -> Vec<DeviceInfo> {
    let found = |address, name, usable, note| DeviceInfo {
        kind: "camera",
        address,
        name,
        usable,
        note,
    };
    match drivers::realsense::cameras() {
        Ok(cameras) => cameras
            .into_iter()
            .map(|camera| {
                let usb = camera
                    .usb
                    .as_ref()
                    .map_or(String::new(), |usb| format!(", USB {usb}"));
                let note = format!("driver realsense, firmware {}{usb}", camera.firmware);
                found(camera.serial, camera.name, true, note)
            })
            .collect(),
        Err(problem) => vec![found(
            "unknown".into(),
            "RealSense".into(),
            false,
            problem.to_string(),
        )],
    }
}

/// RealSense cameras on USB, found in sysfs.
#[cfg(any(not(feature = "realsense"), test))]
fn realsense_on_usb(sys: &Path) -> Vec<DeviceInfo> {
    let usb = sys.join("bus/usb/devices");
    children(&usb)
        .into_iter()
        .filter(|device| attribute(&usb.join(device).join("idVendor")).as_deref() == Some(INTEL_USB_VENDOR))
        .filter_map(|device| {
            let name = attribute(&usb.join(&device).join("product")).filter(|name| name.contains("RealSense"))?;
            let note = "to use the driver realsense, build with `cargo build --release --features realsense`".into();
            Some(DeviceInfo { kind: "camera", address: format!("usb {device}"), name, usable: false, note })
        })
        .collect()
}

#[cfg(not(feature = "realsense"))]
pub(crate) fn realsense_cameras(sys: &Path) -> Vec<DeviceInfo> {
    realsense_on_usb(sys)
}

/// CAN interfaces, real and virtual.
fn can_interfaces(sys: &Path) -> Vec<DeviceInfo> {
    drivers::can::interfaces(sys)
        .into_iter()
        .map(|interface| {
            let state = attribute(&sys.join("class/net").join(&interface).join("operstate"))
                .unwrap_or_else(|| "unknown".into());
            let note =
                format!("driver can, [arm.bus.{interface}]; `fieldrig doctor` checks its settings");
            // Other systems have no SocketCAN.
            let usable = cfg!(target_os = "linux");
            DeviceInfo {
                kind: "can",
                address: interface,
                name: format!("CAN interface, {state}"),
                usable,
                note,
            }
        })
        .collect()
}

/// Names in a sysfs folder, sorted; empty if the folder is absent.
fn children(folder: &Path) -> Vec<String> {
    let mut names: Vec<String> = std::fs::read_dir(folder)
        .into_iter()
        .flatten()
        .filter_map(|entry| entry.ok()?.file_name().into_string().ok())
        .collect();
    names.sort_unstable();
    names
}

/// Value of a sysfs attribute, trimmed.
fn attribute(path: &Path) -> Option<String> {
    Some(std::fs::read_to_string(path).ok()?.trim().to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn write(root: &Path, path: &str, text: &str) {
        let path = root.join(path);
        std::fs::create_dir_all(path.parent().expect("inside root")).expect("folder");
        std::fs::write(path, text).expect("file");
    }

    #[test]
    fn sysfs_is_read_by_kind() {
        let sys = tempfile::tempdir().expect("folder");
        write(sys.path(), "class/net/can0/type", "280\n");
        write(sys.path(), "class/net/can0/operstate", "up\n");
        write(sys.path(), "class/net/eth0/type", "1\n");
        write(sys.path(), "bus/usb/devices/2-1/idVendor", "8086\n");
        write(
            sys.path(),
            "bus/usb/devices/2-1/product",
            "Intel(R) RealSense(TM) Depth Camera 435i\n",
        );
        write(sys.path(), "bus/usb/devices/2-2/idVendor", "8086\n");
        write(sys.path(), "bus/usb/devices/2-2/product", "Bluetooth\n");
        let can = can_interfaces(sys.path());
        assert_eq!(can.len(), 1);
        assert_eq!(
            (can[0].address.as_str(), can[0].name.as_str()),
            ("can0", "CAN interface, up")
        );
        let realsense = realsense_on_usb(sys.path());
        assert_eq!(realsense.len(), 1);
        assert_eq!(realsense[0].address, "usb 2-1");
    }

    #[test]
    fn cameras_are_listed_by_stable_path() {
        let camera = v4l2::FoundCamera {
            node: "/dev/video2".into(),
            name: "C920".into(),
            bus: "usb-0000:00:14.0-2".into(),
            serial: Some("A1B2".into()),
            links: vec!["/dev/v4l/by-id/usb-A1B2-index0".into()],
            usb_mbits: Some(480.0),
            modes: Vec::new(),
        };
        let source = std::io::ErrorKind::PermissionDenied.into();
        let unavailable = v4l2::Problem::Open {
            path: "/dev/video4".into(),
            source,
        };
        let found = video_devices(vec![Ok(camera), Err(unavailable)]);
        assert_eq!(found[0].address, "/dev/v4l/by-id/usb-A1B2-index0");
        assert!(
            found[0]
                .note
                .contains("/dev/video2, at usb-0000:00:14.0-2, serial A1B2, USB at 480 Mbit/s")
        );
        assert!(
            !found[0].usable && !found[1].usable,
            "one has no modes, the other cannot be opened"
        );
        assert!(
            found[1].note.contains("usermod -aG video"),
            "{}",
            found[1].note
        );
    }

    #[test]
    fn missing_sysfs_gives_no_devices() {
        let sys = tempfile::tempdir().expect("folder");
        assert_eq!(realsense_on_usb(sys.path()), []);
        assert_eq!(can_interfaces(sys.path()), []);
    }
}
