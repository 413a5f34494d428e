//! Lists serial ports on USB, and the servos that answer on adapters for servos.

use super::DeviceInfo;
use drivers::servos::{FoundPort, FoundServos, PortConfig, found_ports, servos_on};
use std::path::Path;

const KIND: &str = "serial";

/// The serial ports, with the lines of a rig file for servos that were found. Ports in `known` are
/// copied from there, because a search disturbs a program that uses the port.
pub(super) fn serial_ports(sys: &Path, dev: &Path, known: &[DeviceInfo]) -> Vec<DeviceInfo> {
    let describe_once = |port: FoundPort| {
        let address = port.path.display().to_string();
        let same = known
            .iter()
            .find(|device| device.kind == KIND && device.address == address);
        same.cloned().unwrap_or_else(|| describe(port))
    };
    found_ports(sys, dev)
        .into_iter()
        .map(describe_once)
        .collect()
}

fn describe(port: FoundPort) -> DeviceInfo {
    let node = port.node.display();
    let (usable, note) = match port.adapter {
        // Opening the port of an unknown device could reset it.
        None => (
            true,
            format!("{node}; not searched for servos, as it is no known adapter for servos"),
        ),
        Some(adapter) => {
            let (usable, found) = search(&port.path);
            (usable, format!("{node}, {adapter}: {found}"))
        }
    };
    DeviceInfo {
        kind: KIND,
        address: port.path.display().to_string(),
        name: port.product,
        usable,
        note,
    }
}

/// Searches a port for servos. Returns whether the port can be used, and what was found.
fn search(path: &Path) -> (bool, String) {
    match servos_on(path, PortConfig::MAX_ANSWER_DELAY) {
        Ok(Some(found)) => (true, describe_servos(&found)),
        Ok(None) => (
            true,
            "no servo with an ID from 1 to 12 answers at 1000000 or 57600 baud; check the power of the servos".to_owned(),
        ),
        Err(error) => (false, error.to_string()),
    }
}

fn describe_servos(found: &FoundServos) -> String {
    let servos: Vec<_> = found
        .servos
        .iter()
        .map(|servo| format!("{} ({})", servo.id, servo.model))
        .collect();
    format!(
        "driver {}, arm.serial.baud_hz = {}, servos {}",
        found.driver,
        found.baud_hz,
        servos.join(", ")
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn other_serial_ports_are_listed_but_not_opened() {
        let sys = tempfile::tempdir().expect("a folder");
        std::fs::create_dir_all(sys.path().join("class/tty/ttyUSB0")).expect("a folder");
        let found = serial_ports(sys.path(), Path::new("/dev"), &[]);
        assert_eq!(found.len(), 1);
        assert_eq!(
            (found[0].kind, found[0].address.as_str()),
            ("serial", "/dev/ttyUSB0")
        );
        assert!(found[0].note.contains("not searched"), "{}", found[0].note);
        // A known port keeps what was found before.
        let known = DeviceInfo {
            note: "six servos".to_owned(),
            ..found[0].clone()
        };
        let again = serial_ports(sys.path(), Path::new("/dev"), std::slice::from_ref(&known));
        assert_eq!(again, [known]);
    }
}
