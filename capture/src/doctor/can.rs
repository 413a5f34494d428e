//! Settings of CAN interfaces.

use super::Finding;
use crate::config::Rig;
use drivers::can::{BusConfig, Link, interfaces};
use std::path::Path;

/// Checks the settings of CAN interfaces. Interfaces in the rig file must match it. For the other
/// interfaces, general settings are checked.
pub(super) fn can(rig: Option<&Rig>) -> Vec<Finding> {
    let named = rig.map_or(&[][..], |rig| &rig.arm.buses);
    let others = interfaces(Path::new("/sys"))
        .into_iter()
        .filter(|name| !named.iter().any(|bus| bus.interface == *name));
    let mut findings = Vec::new();
    for (interface, bus) in named
        .iter()
        .map(|bus| (bus.interface.clone(), Some(bus)))
        .chain(others.map(|name| (name, None)))
    {
        let link = match Link::read(&interface) {
            Ok(link) => link,
            Err(error) => {
                findings.push(Finding::fail(
                    "can",
                    error.to_string(),
                    "list the CAN interfaces with fieldrig devices",
                ));
                continue;
            }
        };
        let default_config = BusConfig {
            interface,
            bitrate_hz: link.bitrate_hz.unwrap_or(1_000_000),
            data_bitrate_hz: link.data_bitrate_hz,
            accept_no_restart: false,
        };
        let problems = link.problems(bus.unwrap_or(&default_config));
        if problems.is_empty() {
            findings.push(Finding::ok("can", link.to_string()));
        }
        findings.extend(problems.into_iter().map(|link_problem| {
            let message = format!("{}: {}", link.interface, link_problem.problem);
            match bus {
                Some(_) => Finding::fail("can", message, link_problem.command),
                None => Finding::warn("can", message, link_problem.command),
            }
        }));
    }
    findings
}
