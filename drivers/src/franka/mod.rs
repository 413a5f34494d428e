//! Franka arms (Panda, FR3) over FCI, the interface of their controllers: read at 1 kHz, and moved by joint positions.
//!
//! `session` connects, `state` decodes, `arm` reads on a thread of its own and commands nothing, `realtime` asks the kernel to wake
//! it in time, `statistics` tells how well it did. `movable` is the arm for those who may move it: orders lie on `mailbox`, `motion_loop` is
//! the part of the thread that follows them, `reference` knows where the robot wants its joints, `limits` what it lets a motion do,
//! `request` what it is asked for. `emulated` is the other side: a controller for tests and simulators.
//!
//! Motions are written on the crate's structs of the wire, not with its `Robot`: that one waits for answers without bound, keeps the
//! datagrams to itself, so that lost and late ones cannot be counted, and prints.
//!
//! Sizes, numbers and layouts of messages are those of the crate `franka-rs`, which follows libfranka 0.21.2 (FCI 10, FR3) and
//! 0.9.2 (FCI 5, Panda).

mod arm;
pub mod emulated;
mod limits;
mod mailbox;
mod motion_loop;
#[cfg(test)]
mod motion_tests;
mod movable;
mod realtime;
mod reference;
mod request;
mod session;
mod state;
mod statistics;
#[cfg(test)]
mod tests;

#[cfg(any(test, fuzzing))]
pub(crate) use arm::fuzz;
pub use arm::{ArmConfig, FrankaArm};
pub use franka::FciVersion;
pub use movable::MovableFrankaArm;
pub use request::ContactConfig;
pub use statistics::{MotionStatistics, StateStatistics};

/// Joints of every Franka arm.
pub const N_JOINTS: usize = 7;
