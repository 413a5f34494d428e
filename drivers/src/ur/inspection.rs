//! A look at a controller without opening the arm, to diagnose problems.

use super::address::ControllerAddress;
use super::arm::{fault, first_state};
use super::config::ArmConfig;
use super::connection::{Connection, ControllerVersion, version_at};
use super::flange_check::check_flange;
use super::{dashboard, words};
use crate::{Error, FlangeDifference};

/// What a controller reports.
#[derive(Clone, Debug, PartialEq)]
pub struct Inspection {
    /// Version of its software.
    pub version: ControllerVersion,
    /// Modes of the robot in words.
    pub mode: String,
    /// The reason why the robot accepts no motion, and the remedy; `None` if it is ready.
    pub blocking_reason: Option<String>,
    /// Whether it accepts programs from the network. `None` if this is unknown, because it does not
    /// distinguish local and remote control, or its dashboard server is disabled.
    pub is_in_remote_control: Option<bool>,
    /// Comparison of the flange pose of the rig file with that of the controller.
    pub flange: FlangePose,
}

/// Comparison of two flange poses.
#[derive(Clone, Debug, PartialEq)]
pub enum FlangePose {
    /// The poses agree within 2 mm and 0.5 degrees.
    Same(FlangeDifference),
    /// The poses differ, and the description may still be right. The text has both poses and the
    /// likely cause.
    Doubtful(String),
    /// The rig file describes another robot or another link.
    Different(String),
}

/// Connects, reads one state, and disconnects. Other clients of the controller are not disturbed.
///
/// # Errors
/// If the controller cannot be reached, or its joints have no power.
pub fn inspect(config: &ArmConfig) -> Result<Inspection, Error> {
    let failed = |reason| fault(&config.address, reason);
    let mut connection = Connection::open(&config.address, false).map_err(failed)?;
    let state = first_state(&mut connection).map_err(failed)?;
    let controller = ControllerAddress::parse(&config.address).map_err(failed)?;
    Ok(Inspection {
        version: connection.version,
        mode: words::describe(&state),
        blocking_reason: words::blocking_reason(&state),
        is_in_remote_control: dashboard::is_in_remote_control(&controller).unwrap_or(None),
        flange: match check_flange(config, &state) {
            Ok(check) => check
                .doubt
                .map_or(FlangePose::Same(check.difference), FlangePose::Doubtful),
            Err(reason) => FlangePose::Different(reason),
        },
    })
}

/// Connects, agrees on the protocol, asks for the version, and disconnects. Only a controller of
/// Universal Robots answers, whether or not its joints have power. Takes seconds if something else
/// listens at the address.
///
/// # Errors
/// If nothing answers as such a controller does.
pub fn controller_version(address: &str) -> Result<ControllerVersion, Error> {
    version_at(address).map_err(|reason| fault(address, reason))
}
