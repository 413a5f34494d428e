//! An emulated controller of Universal Robots for tests and simulators, on real TCP sockets.
//!
//! `variables` has the RTDE variables and their values, and `robot` runs programs (`urscript`).
//! `client` serves one RTDE client, `lines` the clients of the script and dashboard interfaces, and
//! `server` has the sockets and the thread. A callback of the owner, such as a simulator or a test,
//! returns the actual joint states once per cycle.
//!
//! The emulated controller was written from the same documents as the driver. A test with
//! `ur_rtde`, an independent client library, shows that both interpret these documents correctly.

mod client;
mod lines;
mod robot;
mod server;
mod urscript;
mod variables;

pub use server::EmulatedController;

use super::{ControllerVersion, N_JOINTS};
use kinematics::{Chain, Stamp, Transform};
use std::net::SocketAddr;

/// Configuration of an emulated controller.
#[derive(Clone, Debug)]
pub struct ControllerConfig {
    /// Address of RTDE. Clients of other libraries always connect to port 30004. The ports of the
    /// script and dashboard interfaces are 2 and 5 less, so the port cannot be chosen by the
    /// system.
    pub address: SocketAddr,
    /// Version of the software. Major version 3 is a CB3 controller, which sends 125 states per
    /// second instead of 500.
    pub version: [u32; 3],
    /// Chain from the controller's base frame to the flange.
    pub chain: Chain,
    /// The tool that is set in the installation.
    pub flange_from_tool: Transform,
    /// Variables that the controller does not know, as an older one.
    pub unknown_variables: Vec<String>,
    /// Version of RTDE that the controller accepts.
    pub rtde_version: u16,
}

impl ControllerConfig {
    /// A current e-Series controller without a tool.
    pub fn e_series(address: SocketAddr, chain: Chain) -> Self {
        Self {
            address,
            version: [5, 24, 0],
            chain,
            flange_from_tool: Transform::identity(),
            unknown_variables: Vec::new(),
            rtde_version: 2,
        }
    }

    /// Cycles per second.
    pub(super) fn rate_hz(&self) -> f64 {
        let [major, minor, bugfix] = self.version;
        let version = ControllerVersion {
            major,
            minor,
            bugfix,
        };
        version.rate_hz()
    }

    /// A CB3 controller without a tool, which reports neither torques nor the tool.
    pub fn cb3(address: SocketAddr, chain: Chain) -> Self {
        let unknown = ["actual_current_as_torque", "tcp_offset"];
        Self {
            version: [3, 15, 8],
            unknown_variables: unknown.map(str::to_owned).to_vec(),
            ..Self::e_series(address, chain)
        }
    }
}

/// Actual joint states at one instant.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Joints {
    /// Angles, rad.
    pub position_rad: [f64; N_JOINTS],
    /// Velocities, rad/s.
    pub velocity_rad_s: [f64; N_JOINTS],
    /// Torques, Nm.
    pub torque_nm: [f64; N_JOINTS],
}

/// Modes of a robot, with the numbers of RTDE.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Modes {
    /// 7 is running.
    pub robot_mode: i32,
    /// 1 is normal.
    pub safety_mode: i32,
    /// Whether the freedrive button is pressed.
    pub is_teach_button_pressed: bool,
    /// Whether programs from the network are accepted.
    pub is_remote: bool,
    /// Whether the controller refuses to end a protective stop, as in the first seconds.
    pub is_unlock_refused: bool,
}

impl Default for Modes {
    fn default() -> Self {
        Self {
            robot_mode: 7,
            safety_mode: 1,
            is_teach_button_pressed: false,
            is_remote: true,
            is_unlock_refused: false,
        }
    }
}

/// Joint states that the controller commands at one instant. Without a motion, the positions are
/// those of the joints.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct CommandedJoints {
    /// Angles, rad.
    pub position_rad: [f64; N_JOINTS],
    /// Velocities, rad/s.
    pub velocity_rad_s: [f64; N_JOINTS],
    /// Whether a program runs or the joints brake after its end.
    pub is_moving: bool,
}

/// Callback that returns the actual joint states. It is called once per cycle, in order, with the
/// commanded joint states.
pub type JointSimulator = Box<dyn FnMut(Stamp, &CommandedJoints) -> Joints + Send>;
