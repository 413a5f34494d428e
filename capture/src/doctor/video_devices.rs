//! Checks the permission to open video devices, and the presence of the V4L2 cameras of a rig.

use super::Finding;
#[cfg(target_os = "linux")]
use crate::config::{Camera, CameraDriver, MissingKey, Rig};
#[cfg(target_os = "linux")]
use drivers::v4l2;
use std::path::{Path, PathBuf};

/// Checks that the video devices can be opened.
pub(super) fn permissions(dev: &Path) -> Finding {
    let mut nodes: Vec<PathBuf> = std::fs::read_dir(dev)
        .into_iter()
        .flatten()
        .filter_map(|entry| Some(entry.ok()?.path()))
        .filter(|path| {
            path.file_name()
                .is_some_and(|name| name.to_string_lossy().starts_with("video"))
        })
        .collect();
    nodes.sort_unstable();
    let denied: Vec<String> = nodes
        .iter()
        .filter(|node| {
            // The device is opened for reading and writing, as the drivers do. Any other error,
            // such as a busy device, is not a permission problem.
            let opened = std::fs::File::options().read(true).write(true).open(node);
            opened.is_err_and(|error| error.kind() == std::io::ErrorKind::PermissionDenied)
        })
        .map(|node| node.display().to_string())
        .collect();
    if denied.is_empty() {
        return Finding::ok(
            "cameras",
            format!("{} video devices, all accessible", nodes.len()),
        );
    }
    let message = format!("no permission to open {}", denied.join(", "));
    Finding::warn(
        "cameras",
        message,
        "sudo usermod -aG video $USER, then log in again",
    )
}

/// Reports V4L2 cameras of a rig whose device node may belong to another camera after a restart.
#[cfg(target_os = "linux")]
pub(super) fn unstable_nodes(rig: &Rig) -> Vec<Finding> {
    let cameras = rig
        .cameras
        .iter()
        .filter(|camera| camera.driver == CameraDriver::V4l2);
    let unstable = cameras.filter(|camera| camera.device.starts_with("/dev/video"));
    unstable.map(unstable_node).collect()
}

#[cfg(target_os = "linux")]
fn unstable_node(camera: &Camera) -> Finding {
    let message = format!(
        "camera {:?}: {} may become another camera after a restart",
        camera.name, camera.device
    );
    Finding::warn(
        "cameras",
        message,
        "use the stable name that fieldrig devices prints",
    )
}

/// Reports cameras of a rig whose rig file names no device, and V4L2 cameras that are not connected.
#[cfg(target_os = "linux")]
pub(super) fn missing(rig: &Rig) -> Vec<Finding> {
    rig.cameras
        .iter()
        .flat_map(|camera| {
            let unnamed = camera.missing_devices().into_iter().map(unnamed_device);
            unnamed.chain(absent_devices(camera))
        })
        .collect()
}

#[cfg(target_os = "linux")]
fn unnamed_device(missing: MissingKey) -> Finding {
    let message = format!("{} is missing", missing.key);
    Finding::fail("cameras", message, missing.remedy)
}

/// The devices that the rig file names for a V4L2 camera, and that are not connected.
#[cfg(target_os = "linux")]
fn absent_devices(camera: &Camera) -> impl Iterator<Item = Finding> {
    let name = &camera.name;
    let is_v4l2 = camera.driver == CameraDriver::V4l2;
    let depth = camera.depth.as_ref();
    let devices = [
        ("device", Some(&camera.device)),
        ("depth.device", depth.map(|depth| &depth.device)),
    ];
    devices.into_iter().filter_map(move |(key, device)| {
        let device = device.filter(|device| !device.is_empty() && is_v4l2)?;
        let problem = v4l2::check_connected(device).err()?;
        Some(Finding::fail(
            "cameras",
            format!("camera {name:?}: {problem}"),
            format!("connect it, or set camera.{name}.{key} to one that `fieldrig devices` lists"),
        ))
    })
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use super::*;
    use crate::doctor::testing::bundled_rig;

    #[test]
    fn absent_camera_is_reported_by_its_device() {
        let rig = bundled_rig(
            "static-arm.toml",
            &[
                ("camera.wrist.driver", "v4l2"),
                ("camera.wrist.device", "no such serial"),
            ],
        );
        let findings = missing(&rig);
        assert!(
            findings
                .iter()
                .any(|finding| finding.message.contains("\"no such serial\"")),
            "{findings:?}"
        );
    }
    #[test]
    fn camera_without_a_device_is_reported_by_its_key() {
        let rig = bundled_rig("static-arm.toml", &[("camera.wrist.driver", "v4l2")]);
        let findings = missing(&rig);
        assert!(
            findings[0].message == "camera.wrist.device is missing"
                && findings[0]
                    .remedy
                    .as_ref()
                    .is_some_and(|remedy| remedy.contains("`fieldrig devices`")),
            "{findings:?}"
        );
        // An empty name is not the name of a camera.
        assert!(
            findings
                .iter()
                .all(|finding| !finding.message.contains("\"\"")),
            "{findings:?}"
        );
    }
}
