//! Searches this computer and the addresses of controllers for devices. Nothing moves, no setting is
//! changed, and no network is scanned.

mod cameras;
#[cfg(target_os = "linux")]
mod controllers;
#[cfg(target_os = "linux")]
mod motors;
#[cfg(target_os = "linux")]
mod servos;

use super::findings::{ControllerKind, Findings, FoundController};
use std::path::PathBuf;

/// Where to search, besides the devices of this computer.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct SearchPlan {
    /// Address of a Franka controller. `None`: the address that Franka recommends, if it answers at
    /// once, and no other address is given.
    pub franka: Option<String>,
    /// Address of a controller of Universal Robots. `None`: the address in the documentation of
    /// their ROS driver, if it answers at once.
    pub ur: Option<String>,
    /// Serial port that is searched for servos. `None`: the ports of known adapters. Opening the
    /// port of another device may reset this device.
    pub serial: Option<PathBuf>,
}

/// Searches for devices. Takes some seconds: each CAN bus is observed for about a second, and each
/// port without servos is searched for two.
#[must_use]
pub fn search(plan: &SearchPlan) -> Findings {
    let mut findings = Findings::default();
    cameras::find(&mut findings);
    find_arms(plan, &mut findings);
    findings
}

/// The controller of an arm at an address that the user has given, whether or not it answers.
#[must_use]
pub fn controller_at(kind: ControllerKind, address: &str) -> FoundController {
    #[cfg(target_os = "linux")]
    return controllers::controller_at(kind, address);
    #[cfg(not(target_os = "linux"))]
    FoundController {
        kind,
        address: address.to_owned(),
        problem: Some("this build cannot ask it".to_owned()),
        robot: None,
    }
}

#[cfg(target_os = "linux")]
fn find_arms(plan: &SearchPlan, findings: &mut Findings) {
    let sys = std::path::Path::new("/sys");
    motors::find(sys, findings);
    servos::find(sys, plan.serial.as_deref(), findings);
    controllers::find(plan, findings);
}

/// The drivers of arms need Linux.
#[cfg(not(target_os = "linux"))]
fn find_arms(_plan: &SearchPlan, _findings: &mut Findings) {}
