//! A robot's controller as its clients see it, for tests and simulators: commands over TCP, states at 1 kHz and motions over UDP.
//!
//! `robot` is what the controller does, without sockets, `limits` what a motion may do; `message` and `state` are its bytes, `server`
//! moves them. Where the joints
//! truly are, an owner says once a millisecond: a simulator, or a few lines in a test. Written against the same documents as the
//! driver; that both understood them alike is shown by the tests with libfranka itself and with somebody else's server.
//!
//! Joint positions and joint velocities are taken as motions; Cartesian ones and torques are refused, and of the thresholds of
//! collisions those of joint torques are heeded.

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

/// A robot to play.
#[derive(Clone, Debug)]
pub struct RobotConfig {
    /// Where commands are taken: libfranka connects to port 1337 of whatever address; port 0 takes a free one.
    pub address: SocketAddr,
    /// Version of FCI.
    pub version: FciVersion,
    /// From the robot's base to its flange.
    pub chain: Chain,
    /// The end effector that is set in Desk, `F_T_NE`.
    pub flange_from_ee: Transform,
    /// What motions may do.
    pub limits: Limits,
}

/// What the joints do at one instant.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Joints {
    /// Angles, rad.
    pub position_rad: [f64; N_JOINTS],
    /// Their rates, rad/s.
    pub velocity_rad_s: [f64; N_JOINTS],
    /// Torques measured at the links, gravity among them, Nm.
    pub torque_nm: [f64; N_JOINTS],
    /// What of them comes from outside: contacts, Nm.
    pub external_torque_nm: [f64; N_JOINTS],
}

/// Where a client wants the joints to be at one instant; where they were last wanted while no motion runs.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct CommandedJoints {
    /// Angles, rad.
    pub position_rad: [f64; N_JOINTS],
    /// Their rates, rad/s.
    pub velocity_rad_s: [f64; N_JOINTS],
    /// And theirs, rad/s².
    pub acceleration_rad_s2: [f64; N_JOINTS],
    /// Whether a motion runs.
    pub is_moving: bool,
}

/// Who says where the joints are: asked once for each millisecond, in order, with where they are wanted.
pub type JointSimulator = Box<dyn FnMut(Stamp, &CommandedJoints) -> Joints + Send>;
