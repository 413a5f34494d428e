//! Franka arms (Panda, FR3) over FCI, the interface of their controllers: read at 1 kHz, and moved by joint positions.
//!
//! `session` connects, `state` decodes, `arm` reads on a thread of its own and commands nothing, `realtime` asks the kernel to wake
//! it in time, `statistics` tells how well it did. `movable` is the arm for those who may move it: orders lie on `desk`, `mover` is
//! the part of the thread that follows them, `reference` knows where the robot wants its joints, `limits` what it lets a motion do,
//! `request` what it is asked for. `played` is the other side: a controller for tests and simulators.
//!
//! Motions are written on the crate's structs of the wire, not with its `Robot`: that one waits for answers without bound, keeps the
//! datagrams to itself, so that lost and late ones cannot be counted, and prints.
//!
//! Sizes, numbers and layouts of messages are those of the crate `franka-rs`, which follows libfranka 0.21.2 (FCI 10, FR3) and
//! 0.9.2 (FCI 5, Panda).

mod arm;
mod desk;
mod limits;
mod movable;
mod mover;
#[cfg(test)]
mod moving_tests;
pub mod played;
mod realtime;
mod reference;
mod request;
mod session;
mod state;
mod statistics;
#[cfg(test)]
mod tests;

#[cfg(any(test, fuzzing))]
pub(crate) use arm::hostile;
pub use arm::{ArmConfig, FrankaArm};
pub use franka::FciVersion;
pub use movable::MovableFrankaArm;
pub use request::ContactConfig;
pub use statistics::{MotionStatistics, Statistics};

/// Joints of every Franka arm.
pub const N_JOINTS: usize = 7;
