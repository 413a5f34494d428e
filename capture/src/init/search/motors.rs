//! Finds motors on the CAN interfaces of this computer.

use crate::init::findings::{Findings, FoundBus, FoundMotor};
use drivers::Error;
use drivers::can::{Bus, BusConfig, Link, SearchTimes, interfaces, motors_on};
use std::path::Path;

/// Bit rate of interfaces that report none.
const DEFAULT_BITRATE_HZ: u32 = 1_000_000;

/// Adds the interfaces that are up, with their motors.
pub(super) fn find(sys: &Path, findings: &mut Findings) {
    for interface in interfaces(sys) {
        match bus(&interface) {
            Ok(Some(bus)) => findings.buses.push(bus),
            Ok(None) => findings.notes.push(format!(
                "the CAN interface {interface} is down, so it was not searched for motors: sudo ip link set {interface} up type can bitrate {DEFAULT_BITRATE_HZ} restart-ms 100"
            )),
            Err(error) => findings.notes.push(error.to_string()),
        }
    }
}

/// An interface with its motors; `None` if it is down.
fn bus(interface: &str) -> Result<Option<FoundBus>, Error> {
    let link = Link::read(interface)?;
    if !link.is_up {
        return Ok(None);
    }
    // The interface is used as it is set up.
    let config = BusConfig {
        interface: interface.to_owned(),
        bitrate_hz: link.bitrate_hz.unwrap_or(DEFAULT_BITRATE_HZ),
        data_bitrate_hz: None,
        accept_no_restart: true,
    };
    let motors = motors_on(&Bus::open(&config)?, SearchTimes::default())?;
    let motors = motors.into_iter().map(|motor| FoundMotor {
        family: motor.family.name(),
        id: motor.settings.id,
        reported: motor.settings.values.into_iter().collect(),
    });
    Ok(Some(FoundBus {
        interface: interface.to_owned(),
        bitrate_hz: link.bitrate_hz,
        restarts: link.restart_millis != Some(0),
        motors: motors.collect(),
    }))
}
