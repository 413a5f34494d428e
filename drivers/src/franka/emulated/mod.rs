//! An emulated robot controller for tests and simulators: commands over TCP, states at 1 kHz and
//! motions over UDP.
//!
//! `robot` implements the controller without sockets. `limits` checks motions. `model` has the
//! robot description. `message` and `state` encode and decode. `server` has the sockets. A callback
//! of the owner, such as a simulator or a test, returns the actual joint states once per
//! millisecond.
//!
//! The emulated controller was written from the same documents as the driver. Tests with libfranka
//! and with an independent server show that both interpret these documents correctly.
//!
//! It accepts joint position and joint velocity motions, and rejects Cartesian and torque motions.
//! It evaluates only the collision thresholds of joint torques.

mod limits;
mod message;
mod model;
mod robot;
mod server;
mod state;

pub use limits::Limits;
pub use server::EmulatedRobot;
#[cfg(any(test, fuzzing))]
pub(crate) use server::fuzz;

use super::N_JOINTS;
use franka::FciVersion;
use kinematics::{Chain, Stamp, Transform};
use std::net::SocketAddr;

/// Configuration of an emulated robot.
#[derive(Clone, Debug)]
pub struct RobotConfig {
    /// Address to listen on. libfranka always connects to port 1337; port 0 chooses a free one.
    pub address: SocketAddr,
    /// FCI version.
    pub version: FciVersion,
    /// Chain from the robot's base to its flange.
    pub chain: Chain,
    /// The end effector set in Desk, `F_T_NE`.
    pub flange_from_tool: Transform,
    /// Limits for motions.
    pub limits: Limits,
}

/// Measured joint states at one instant.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Joints {
    /// Angles, rad.
    pub position_rad: [f64; N_JOINTS],
    /// Velocities, rad/s.
    pub velocity_rad_s: [f64; N_JOINTS],
    /// Torques measured at the links, including gravity, Nm.
    pub torque_nm: [f64; N_JOINTS],
    /// External torques (contacts) that are included in `torque_nm`, Nm.
    pub external_torque_nm: [f64; N_JOINTS],
}

/// Commanded joint states at one instant. While no motion is active, they keep the last values.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct CommandedJoints {
    /// Angles, rad.
    pub position_rad: [f64; N_JOINTS],
    /// Velocities, rad/s.
    pub velocity_rad_s: [f64; N_JOINTS],
    /// Accelerations, rad/s².
    pub acceleration_rad_s2: [f64; N_JOINTS],
    /// Whether a motion is active.
    pub is_moving: bool,
}

/// Callback that returns the actual joint states. It is called once per millisecond, in order, with
/// the commanded joint states.
pub type JointSimulator = Box<dyn FnMut(Stamp, &CommandedJoints) -> Joints + Send>;
