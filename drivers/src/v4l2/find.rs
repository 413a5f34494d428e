//! Lists connected V4L2 devices with names that are stable across reboots.

use super::Problem;
use super::V4l2Format;
use super::device::Device;
use super::format::{self, Mode, Rates, Sizes};
use std::path::{Path, PathBuf};

/// A node of a V4L2 device that delivers images.
#[derive(Clone, Debug, PartialEq)]
pub struct FoundCamera {
    /// Path of the node, such as `/dev/video0`. The number may change.
    pub node: PathBuf,
    /// Model name.
    pub name: String,
    /// Bus address as reported by the kernel, such as `usb-0000:00:14.0-2`.
    pub bus: String,
    /// USB serial number, if it has one.
    pub serial: Option<String>,
    /// Stable udev links. Links by device come first, and then links by port.
    pub links: Vec<PathBuf>,
    /// Speed of the USB connection, megabits per second.
    pub usb_mbits: Option<f64>,
    /// All supported modes.
    pub modes: Vec<Mode>,
}

impl FoundCamera {
    /// Name for the rig file. It is a udev link if there is one. Otherwise, it is the serial
    /// number. If there is no serial number either, it is the bus address.
    pub fn address(&self) -> String {
        let link = self.links.first().map(|link| link.display().to_string());
        link.or_else(|| self.serial.clone())
            .unwrap_or_else(|| self.bus.clone())
    }

    /// USB bandwidth that is available to one camera, bytes per second. `None` if the camera is not
    /// connected over USB.
    pub fn usb_bytes_per_sec(&self) -> Option<f64> {
        self.usb_mbits.map(format::usb_bytes_per_sec)
    }

    /// Descriptions of modes that exceed the USB bandwidth.
    pub fn modes_exceeding_usb(&self) -> Vec<String> {
        self.usb_bytes_per_sec()
            .map_or(Vec::new(), |bytes_per_sec| {
                format::modes_exceeding(&self.modes, bytes_per_sec)
            })
    }
}

/// Attributes of a node in sysfs, available without opening it.
#[derive(Clone, Debug, PartialEq)]
struct Node {
    path: PathBuf,
    /// Folder of its USB device in sysfs, which is shared by all nodes of a camera.
    usb: Option<PathBuf>,
    serial: Option<String>,
    usb_mbits: Option<f64>,
}

/// All nodes that deliver images, and errors for nodes that cannot be opened. Metadata nodes are
/// skipped.
pub fn cameras() -> Vec<Result<FoundCamera, Problem>> {
    let root = Path::new("/");
    nodes(root)
        .into_iter()
        .filter_map(|node| describe(root, node).transpose())
        .collect()
}

fn describe(root: &Path, node: Node) -> Result<Option<FoundCamera>, Problem> {
    let device = Device::open(&node.path).map_err(|error| Problem::Open {
        path: node.path.clone(),
        source: error.into(),
    })?;
    let Some(identity) = device
        .identity()
        .ok()
        .filter(|identity| identity.streams_images)
    else {
        return Ok(None);
    };
    Ok(Some(FoundCamera {
        name: identity.card,
        bus: identity.bus,
        serial: node.serial,
        links: stable_links(root, &node.path),
        usb_mbits: node.usb_mbits,
        modes: modes(&device),
        node: node.path,
    }))
}

/// All modes of a device with supported formats.
pub(super) fn modes(device: &Device) -> Vec<Mode> {
    let mut modes = Vec::new();
    for fourcc in device.fourccs() {
        let Some(format) = V4l2Format::from_fourcc(fourcc) else {
            continue;
        };
        for size in device.sizes(fourcc) {
            let sizes = Sizes::from_kernel(&size);
            let rates = Rates::from_kernel(&device.intervals(fourcc, sizes.max()));
            modes.push(Mode {
                fourcc,
                format,
                sizes,
                rates,
            });
        }
    }
    modes
}

/// Nodes that match `device` of a rig file. `device` is a path, a serial number or a bus address.
/// The nodes of a camera share their serial number and bus address.
pub(super) fn candidates(device: &str) -> Result<Vec<PathBuf>, Problem> {
    if device.starts_with('/') {
        return Ok(vec![PathBuf::from(device)]);
    }
    let is_match =
        |node: &Node| node.serial.as_deref() == Some(device) || has_bus_address(node, device);
    let found = nodes(Path::new("/")).into_iter().filter(is_match).collect();
    paths_of_one_camera(device, found)
}

/// Whether a node has this bus address. This opens the node, unlike a comparison of serial numbers.
fn has_bus_address(node: &Node, address: &str) -> bool {
    Device::open(&node.path)
        .and_then(|open| open.identity())
        .is_ok_and(|identity| identity.bus == address)
}

/// Checks whether a connected device matches `device` of a rig file. Nodes are only opened to read
/// their bus address.
pub fn check_connected(device: &str) -> Result<(), Problem> {
    if candidates(device)?.iter().any(|path| path.exists()) {
        return Ok(());
    }
    Err(Problem::NoDevice {
        device: device.to_owned(),
    })
}

/// Checks that all nodes belong to one camera, and returns their paths. The check is needed because
/// serial numbers are not always unique.
fn paths_of_one_camera(device: &str, found: Vec<Node>) -> Result<Vec<PathBuf>, Problem> {
    let device = device.to_owned();
    // A camera has several nodes, which share a USB device. Two cameras of one model may have the
    // same serial number.
    let is_one = found.windows(2).all(|pair| pair[0].usb == pair[1].usb);
    let paths: Vec<_> = found.into_iter().map(|node| node.path).collect();
    match paths.len() {
        0 => Err(Problem::NoDevice { device }),
        _ if !is_one => Err(Problem::Ambiguous {
            device,
            nodes: paths,
        }),
        _ => Ok(paths),
    }
}

/// All video nodes in sysfs, in the order of their numbers.
fn nodes(root: &Path) -> Vec<Node> {
    let class = root.join("sys/class/video4linux");
    let number = |name: &str| name.strip_prefix("video")?.parse::<u32>().ok();
    let mut names: Vec<(u32, String)> = std::fs::read_dir(&class)
        .into_iter()
        .flatten()
        .filter_map(|entry| entry.ok()?.file_name().into_string().ok())
        .filter_map(|name| Some((number(&name)?, name)))
        .collect();
    // The nodes are sorted by number. If they were sorted as text, video10 would come before
    // video2.
    names.sort_unstable();
    names
        .into_iter()
        .map(|(_, name)| {
            let usb = usb_folder(&class.join(&name).join("device"));
            let attribute = |name| usb.as_ref().and_then(|usb| usb_attribute(usb, name));
            Node {
                path: root.join("dev").join(&name),
                serial: attribute("serial"),
                usb_mbits: attribute("speed").and_then(|speed| speed.parse().ok()),
                usb,
            }
        })
        .collect()
}

/// An attribute of a USB device in sysfs. `None` if it is missing or empty.
fn usb_attribute(usb: &Path, name: &str) -> Option<String> {
    let text = std::fs::read_to_string(usb.join(name)).ok()?;
    Some(text.trim().to_owned()).filter(|text| !text.is_empty())
}

/// Folder of the USB device that an interface belongs to.
fn usb_folder(device: &Path) -> Option<PathBuf> {
    let folder = device.canonicalize().ok()?;
    folder
        .ancestors()
        // A video node belongs to an interface, whose parent is the USB device with its serial
        // number and speed.
        .find(|ancestor| ancestor.join("idVendor").exists())
        .map(Path::to_owned)
}

/// Udev links to a node: by device, then by port.
fn stable_links(root: &Path, node: &Path) -> Vec<PathBuf> {
    let Ok(node) = node.canonicalize() else {
        return Vec::new();
    };
    ["by-id", "by-path"]
        .into_iter()
        .flat_map(|folder| links_to(&node, &root.join("dev/v4l").join(folder)))
        .collect()
}

/// The links in a folder that lead to a node.
fn links_to(node: &Path, folder: &Path) -> Vec<PathBuf> {
    let mut links: Vec<PathBuf> = std::fs::read_dir(folder)
        .into_iter()
        .flatten()
        .filter_map(|entry| Some(entry.ok()?.path()))
        .filter(|link| link.canonicalize().is_ok_and(|meant| meant == *node))
        .collect();
    // The order of a folder is arbitrary, and the first link becomes the name in a rig file.
    links.sort_unstable();
    links
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::symlink;

    #[test]
    fn stable_names_are_read_from_sysfs_and_udev() {
        let root = tempfile::tempdir().expect("a folder");
        let root = root.path();
        let usb = root.join("sys/devices/pci0/usb1/1-2");
        let interface = usb.join("1-2:1.0");
        for folder in [
            &interface,
            &root.join("sys/devices/platform/vivid.0"),
            &root.join("dev/v4l/by-id"),
        ] {
            std::fs::create_dir_all(folder).expect("folder");
        }
        std::fs::create_dir_all(root.join("dev/v4l/by-path")).expect("folder");
        for (name, text) in [
            ("idVendor", "046d\n"),
            ("serial", "A1B2\n"),
            ("speed", "480\n"),
        ] {
            std::fs::write(usb.join(name), text).expect("file");
        }
        for (node, device) in [
            ("video10", &interface),
            ("video9", &root.join("sys/devices/platform/vivid.0")),
        ] {
            let folder = root.join("sys/class/video4linux").join(node);
            std::fs::create_dir_all(&folder).expect("folder");
            symlink(device, folder.join("device")).expect("link");
            std::fs::write(root.join("dev").join(node), "").expect("file");
        }
        std::fs::create_dir_all(root.join("sys/class/video4linux/v4l-subdev0")).expect("folder");
        let node = root.join("dev/video10");
        symlink("../../video10", root.join("dev/v4l/by-path/pci-2")).expect("link");
        symlink("../../video10", root.join("dev/v4l/by-id/usb-A1B2")).expect("link");
        symlink("../../video9", root.join("dev/v4l/by-path/platform")).expect("link");
        let found = nodes(root);
        let expected = [
            Node {
                path: root.join("dev/video9"),
                usb: None,
                serial: None,
                usb_mbits: None,
            },
            Node {
                path: node.clone(),
                usb: Some(usb.canonicalize().expect("the folder exists")),
                serial: Some("A1B2".into()),
                usb_mbits: Some(480.0),
            },
        ];
        assert_eq!(found, expected);
        assert_eq!(
            stable_links(root, &node),
            [
                root.join("dev/v4l/by-id/usb-A1B2"),
                root.join("dev/v4l/by-path/pci-2")
            ]
        );
        let mut camera = FoundCamera {
            node,
            name: "C920".into(),
            bus: "usb-1-2".into(),
            serial: Some("A1B2".into()),
            links: vec!["/dev/v4l/by-id/usb-A1B2".into()],
            usb_mbits: None,
            modes: Vec::new(),
        };
        assert_eq!(camera.address(), "/dev/v4l/by-id/usb-A1B2");
        camera.links.clear();
        assert_eq!(camera.address(), "A1B2");
        camera.serial = None;
        assert_eq!(camera.address(), "usb-1-2");
    }

    #[test]
    fn no_device_found_when_none_connected() {
        let root = tempfile::tempdir().expect("a folder");
        assert_eq!(nodes(root.path()), []);
        let message = candidates("no such serial")
            .expect_err("no camera has this name")
            .to_string();
        assert!(
            message.contains("no such serial") && message.contains("fieldrig devices"),
            "{message}"
        );
        assert_eq!(
            candidates("/dev/video99").expect("paths are returned unchanged"),
            [PathBuf::from("/dev/video99")]
        );
    }
}
