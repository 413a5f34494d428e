//! Universal Robots arms over RTDE, the real-time data exchange of their controllers. The arms are
//! read at the rate of the controller (125 Hz for CB3, 500 Hz for e-Series and later).
//!
//! * `message` splits and encodes packages, `recipe` has the variables and decodes `state`, and
//!   `connection` does the handshake. `timing` maps the clock of the controller to ours and counts
//!   gaps. `words` explains the modes of a robot.
//! * `arm` reads on its own thread and commands nothing. It first compares the flange poses of the
//!   rig file and of the controller (`flange_check`), and reconnects after a loss. `inspection`
//!   makes the same checks without opening the arm.
//! * `movable` is an arm that may be moved. It sends a `program` to the controller, which follows
//!   setpoints in RTDE registers. Commands pass through `mailbox` to `motion_loop`, which runs on
//!   the reading thread and sends the setpoints. `dashboard` asks for remote control and ends
//!   protective stops.
//! * `emulated` is an emulated controller for tests and simulators, behind the feature `emulation`.
//!
//! Sources of the protocol: "Real-Time Data Exchange (RTDE) Guide" at docs.universal-robots.com for
//! packages, variables and types; the values of the modes as in `datatypes.h` of Universal Robots'
//! client library.

mod address;
mod arm;
mod config;
mod connection;
mod dashboard;
#[cfg(feature = "emulation")]
pub mod emulated;
mod flange_check;
mod inspection;
mod mailbox;
mod message;
mod motion_loop;
#[cfg(test)]
mod motion_tests;
mod movable;
mod program;
mod recipe;
mod state;
mod statistics;
#[cfg(test)]
mod tests;
mod timing;
mod words;

pub use address::RTDE_PORT;
pub use arm::UrArm;
pub use config::ArmConfig;
pub use connection::ControllerVersion;
pub use inspection::{FlangePose, Inspection, controller_version, inspect};
pub use movable::MovableUrArm;
pub use statistics::{MotionStatistics, StateStatistics};

/// Number of joints of every arm of Universal Robots.
pub const N_JOINTS: usize = 6;
