//! Finds servos on serial ports.

use crate::init::findings::{Findings, FoundServos};
use drivers::servos::{PortConfig, found_ports, servos_on};
use std::path::{Path, PathBuf};

/// Adds the servos on a port, or on the ports of known adapters.
pub(super) fn find(sys: &Path, port: Option<&Path>, findings: &mut Findings) {
    let ports: Vec<PathBuf> = match port {
        Some(port) => vec![port.to_owned()],
        None => found_ports(sys, Path::new("/dev"))
            .into_iter()
            .filter(|port| port.adapter.is_some())
            .map(|port| port.path)
            .collect(),
    };
    for port in ports {
        let device = port.display().to_string();
        match servos_on(&port, PortConfig::MAX_ANSWER_DELAY) {
            Ok(Some(found)) => {
                let mut ids: Vec<u8> = found.servos.iter().map(|servo| servo.id).collect();
                ids.sort_unstable();
                findings.servos.push(FoundServos {
                    device,
                    driver: found.driver,
                    baud_hz: found.baud_hz,
                    ids,
                });
            }
            Ok(None) => findings.notes.push(format!(
                "no servo with an ID from 1 to 12 answers on {device}; check the power of the servos"
            )),
            Err(error) => findings.notes.push(error.to_string()),
        }
    }
}
