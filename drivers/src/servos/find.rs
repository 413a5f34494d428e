//! Finds serial ports, and servos on them.

use super::PROTOCOLS;
use super::bus::ServoBus;
use super::protocol::FoundServo;
use super::serial::PortConfig;
use crate::Error;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// USB adapters for servos: vendor, product, and name. Only these are searched for servos: opening
/// any other port could reset its device, and bytes could command it.
const ADAPTERS: [(&str, &str, &str); 3] = [
    ("1a86", "55d3", "CH343, for Feetech servos"),
    ("0403", "6014", "FT232H, such as U2D2"),
    ("2f5d", "2202", "OpenRB-150"),
];
/// Baud rates that are searched: that of most arms, and the default of Dynamixel servos.
const SEARCHED_BAUD_HZ: [u32; 2] = [1_000_000, 57_600];

/// A serial port on USB.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FoundPort {
    /// Path for a rig file. It does not change when other devices are connected.
    pub path: PathBuf,
    /// Path of the device, such as `/dev/ttyACM0`.
    pub node: PathBuf,
    /// Name of its product.
    pub product: String,
    /// Name of the adapter if it is one for servos.
    pub adapter: Option<&'static str>,
}

/// Serial ports on USB, in the order of their names.
pub fn found_ports(sys: &Path, dev: &Path) -> Vec<FoundPort> {
    let mut names: Vec<_> = std::fs::read_dir(sys.join("class/tty"))
        .into_iter()
        .flatten()
        .filter_map(|entry| entry.ok()?.file_name().into_string().ok())
        .filter(|name| name.starts_with("ttyACM") || name.starts_with("ttyUSB"))
        .collect();
    names.sort_unstable();
    names
        .into_iter()
        .map(|name| {
            let usb = usb_device(&sys.join("class/tty").join(&name).join("device"));
            let attribute = |key: &str| {
                let text = std::fs::read_to_string(usb.as_ref()?.join(key)).ok()?;
                Some(text.trim().to_owned())
            };
            let [vendor, product] = ["idVendor", "idProduct"].map(attribute);
            let node = dev.join(&name);
            FoundPort {
                path: stable_path(dev, &node).unwrap_or_else(|| node.clone()),
                node,
                product: attribute("product").unwrap_or_else(|| "serial port".to_owned()),
                adapter: ADAPTERS
                    .iter()
                    .find(|(known_vendor, known_product, _)| {
                        vendor.as_deref() == Some(known_vendor)
                            && product.as_deref() == Some(known_product)
                    })
                    .map(|(.., name)| *name),
            }
        })
        .collect()
}

/// The folder of the USB device that contains an interface.
fn usb_device(interface: &Path) -> Option<PathBuf> {
    let interface = std::fs::canonicalize(interface).ok()?;
    interface
        .ancestors()
        .take(4)
        .find(|folder| folder.join("idVendor").exists())
        .map(Path::to_owned)
}

/// The path of a device by its serial number.
fn stable_path(dev: &Path, node: &Path) -> Option<PathBuf> {
    let node = std::fs::canonicalize(node).ok()?;
    let links = std::fs::read_dir(dev.join("serial/by-id")).ok()?;
    let mut links: Vec<_> = links
        .filter_map(|entry| Some(entry.ok()?.path()))
        .filter(|link| std::fs::canonicalize(link).is_ok_and(|target| target == node))
        .collect();
    links.sort_unstable();
    links.into_iter().next()
}

/// Servos that answer on a port, with the name of the driver and the baud rate. All servos have the
/// same protocol and rate.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FoundServos {
    /// Name of the driver in rig files.
    pub driver: &'static str,
    /// Baud rate, bit/s.
    pub baud_hz: u32,
    /// The servos.
    pub servos: Vec<FoundServo>,
}

/// Searches a port for servos with the IDs 1 to 12. Takes about two seconds if there are none and
/// the delay is [`PortConfig::MAX_ANSWER_DELAY`]. Nothing moves.
///
/// * `max_answer_delay`: time that each answer may take.
///
/// # Errors
/// If the port cannot be opened or is in use.
pub fn servos_on(path: &Path, max_answer_delay: Duration) -> Result<Option<FoundServos>, Error> {
    for baud_hz in SEARCHED_BAUD_HZ {
        for protocol in PROTOCOLS {
            let config = PortConfig {
                device: path.to_owned(),
                baud_hz,
                reconnect_for: Duration::ZERO,
                max_answer_delay,
            };
            let mut bus = ServoBus::open(&config, protocol.format())?;
            let servos = protocol.find(&mut bus)?;
            if !servos.is_empty() {
                return Ok(Some(FoundServos {
                    driver: protocol.name(),
                    baud_hz,
                    servos,
                }));
            }
        }
    }
    Ok(None)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn write(path: &Path, text: &str) {
        std::fs::create_dir_all(path.parent().expect("inside a folder")).expect("a folder");
        std::fs::write(path, text).expect("a file");
    }

    #[test]
    fn ports_have_their_stable_path_and_adapter() {
        let root = tempfile::tempdir().expect("a folder");
        let (sys, dev) = (root.path().join("sys"), root.path().join("dev"));
        let usb = sys.join("devices/usb1/1-2");
        for (key, text) in [
            ("idVendor", "1a86\n"),
            ("idProduct", "55d3\n"),
            ("product", "USB Single Serial\n"),
        ] {
            write(&usb.join(key), text);
        }
        write(&usb.join("1-2:1.0/bInterfaceNumber"), "00\n");
        for name in ["ttyACM0", "ttyS0"] {
            let tty = sys.join("class/tty").join(name);
            std::fs::create_dir_all(&tty).expect("a folder");
            std::os::unix::fs::symlink(usb.join("1-2:1.0"), tty.join("device")).expect("a link");
            write(&dev.join(name), "");
        }
        let link = dev.join("serial/by-id/usb-1a86_USB_Single_Serial_5A46-if00");
        std::fs::create_dir_all(link.parent().expect("a folder")).expect("a folder");
        std::os::unix::fs::symlink("../../ttyACM0", &link).expect("a link");
        let expected = FoundPort {
            path: link,
            node: dev.join("ttyACM0"),
            product: "USB Single Serial".to_owned(),
            adapter: Some("CH343, for Feetech servos"),
        };
        assert_eq!(found_ports(&sys, &dev), [expected]);
    }
}
