//! Notices devices that are connected or disconnected.
//!
//! The kernel's lists of devices are read again and again. Only if they change, the devices are
//! looked at, because this opens cameras and searches serial ports for servos.

use super::{DeviceInfo, children, devices_with};
use serde::Serialize;
use std::collections::BTreeSet;
use std::fmt::{Display, Formatter};
use std::path::Path;

/// Folders in sysfs whose entries change when a device is connected or disconnected.
const WATCHED: [&str; 4] = [
    "class/video4linux",
    "bus/usb/devices",
    "class/net",
    "class/tty",
];

/// Whether a device appeared or disappeared.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum ChangeKind {
    /// The device was not there before.
    Connected,
    /// The device is no longer there.
    Disconnected,
}

/// A device that appeared or disappeared.
#[derive(Debug, PartialEq, Eq, Serialize)]
pub struct DeviceChange {
    /// What happened to the device.
    pub change: ChangeKind,
    /// The device.
    #[serde(flatten)]
    pub device: DeviceInfo,
}

impl Display for DeviceChange {
    fn fmt(&self, f: &mut Formatter<'_>) -> std::fmt::Result {
        let Self { change, device } = self;
        let change = match change {
            ChangeKind::Connected => "connected",
            ChangeKind::Disconnected => "disconnected",
        };
        write!(
            f,
            "{change:12}  {:10} {:14} {}; {}",
            device.kind, device.address, device.name, device.note
        )
    }
}

/// Compares the connected devices with those of the previous look.
#[derive(Debug)]
pub struct DeviceWatch {
    known: Vec<DeviceInfo>,
    entries: BTreeSet<String>,
    /// Whether the entries changed at the last look. Device files and permissions follow a moment
    /// later, so the devices are listed once the entries stay the same.
    is_settling: bool,
}

impl DeviceWatch {
    /// Lists the connected devices.
    #[must_use]
    pub fn start() -> Self {
        // The entries are read first. A device that is connected in between is then noticed.
        let entries = entries(Path::new("/sys"));
        Self {
            known: devices_with(&[]),
            entries,
            is_settling: false,
        }
    }

    /// The devices of the last look.
    #[must_use]
    pub fn known(&self) -> &[DeviceInfo] {
        &self.known
    }

    /// Looks again. A change is returned by the second call after it, at the earliest. Serial ports
    /// that were there before are not searched again, because another program may use them.
    pub fn look(&mut self) -> Vec<DeviceChange> {
        self.compare(entries(Path::new("/sys")), devices_with)
    }

    fn compare(
        &mut self,
        entries: BTreeSet<String>,
        list: impl FnOnce(&[DeviceInfo]) -> Vec<DeviceInfo>,
    ) -> Vec<DeviceChange> {
        if entries != self.entries {
            self.entries = entries;
            self.is_settling = true;
            return Vec::new();
        }
        if !std::mem::take(&mut self.is_settling) {
            return Vec::new();
        }
        let now = list(&self.known);
        let before = std::mem::replace(&mut self.known, now);
        let gone = missing_in(&before, &self.known, ChangeKind::Disconnected);
        let new = missing_in(&self.known, &before, ChangeKind::Connected);
        gone.chain(new).collect()
    }
}

/// The devices that are not in another list.
fn missing_in<'a>(
    devices: &'a [DeviceInfo],
    others: &'a [DeviceInfo],
    change: ChangeKind,
) -> impl Iterator<Item = DeviceChange> + 'a {
    devices
        .iter()
        .filter(|device| !others.iter().any(|other| device.is_same_as(other)))
        .map(move |device| DeviceChange {
            change,
            device: device.clone(),
        })
}

fn entries(sys: &Path) -> BTreeSet<String> {
    let mut entries = BTreeSet::new();
    for folder in WATCHED {
        let names = children(&sys.join(folder)).into_iter();
        entries.extend(names.map(|name| format!("{folder}/{name}")));
    }
    entries
}

#[cfg(test)]
mod tests {
    use super::*;

    fn device(address: &str, note: &str) -> DeviceInfo {
        DeviceInfo {
            kind: "camera",
            address: address.to_owned(),
            name: "C920".to_owned(),
            usable: true,
            note: note.to_owned(),
        }
    }

    fn set(names: &[&str]) -> BTreeSet<String> {
        names.iter().map(|name| (*name).to_owned()).collect()
    }

    fn watch(known: Vec<DeviceInfo>, entries: &[&str]) -> DeviceWatch {
        DeviceWatch {
            known,
            entries: set(entries),
            is_settling: false,
        }
    }

    #[test]
    fn devices_are_listed_only_after_the_kernel_reported_a_change() {
        let mut watch = watch(Vec::new(), &["video0"]);
        for _ in 0..3 {
            let changes = watch.compare(set(&["video0"]), |_| panic!("nothing changed"));
            assert_eq!(changes, []);
        }
    }

    #[test]
    fn each_device_that_appears_or_disappears_is_reported_once() {
        let mut watch = watch(vec![device("a", ""), device("b", "")], &["1", "2"]);
        // While entries still change, device files may be missing.
        assert_eq!(watch.compare(set(&["1", "3"]), |_| panic!("too early")), []);
        assert_eq!(
            watch.compare(set(&["1", "3", "4"]), |_| panic!("too early")),
            []
        );
        let list = |known: &[DeviceInfo]| {
            assert_eq!(known.len(), 2, "known devices are passed to the list");
            vec![device("a", "another note"), device("c", "")]
        };
        let changes = watch.compare(set(&["1", "3", "4"]), list);
        let of = |change, address: &str| DeviceChange {
            change,
            device: device(address, ""),
        };
        assert_eq!(
            changes,
            [
                of(ChangeKind::Disconnected, "b"),
                of(ChangeKind::Connected, "c")
            ]
        );
        assert_eq!(watch.known().len(), 2);
        let again = watch.compare(set(&["1", "3", "4"]), |_| panic!("nothing changed"));
        assert_eq!(again, []);
    }

    #[test]
    fn entries_of_sysfs_are_noticed() {
        let sys = tempfile::tempdir().expect("a folder");
        let add = |entry: &str| std::fs::create_dir_all(sys.path().join(entry)).expect("a folder");
        assert!(entries(sys.path()).is_empty());
        add("class/video4linux/video0");
        add("class/net/can0");
        add("class/unrelated/thing");
        let found = entries(sys.path());
        assert_eq!(found, set(&["class/video4linux/video0", "class/net/can0"]));
    }

    #[test]
    fn changes_are_serialized_with_the_device() {
        let change = DeviceChange {
            change: ChangeKind::Connected,
            device: device("a", "note"),
        };
        let json = serde_json::to_value(&change).expect("plain data");
        assert_eq!(
            json,
            serde_json::json!({"change": "connected", "kind": "camera", "address": "a", "name": "C920",
                "usable": true, "note": "note"})
        );
    }
}
