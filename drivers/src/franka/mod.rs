//! Franka arms (Panda, FR3) over FCI, the interface of their controllers. The arms are read at 1
//! kHz, and moved by joint positions.
//!
//! * `connection` connects, and `state` decodes. `arm` reads on its own thread and commands
//!   nothing. `realtime` requests real-time scheduling for this thread, and `statistics` measures
//!   delays and losses.
//! * `movable` is an arm that may be moved. Commands pass through `mailbox` to `motion_loop`, which
//!   runs on the reading thread. `reference` tracks the robot's commanded joint positions, `limits`
//!   has the motion limits, and `request` encodes requests. `recent_cycles` keeps the last cycles
//!   to explain a reflex.
//! * `emulated` is an emulated controller for tests and simulators, behind the feature `emulation`.
//!
//! Motions use the wire structs of `franka-rs` instead of its `Robot`. `Robot` waits for answers
//! without a time limit, and prints to the terminal. It does not expose the datagrams, so lost and
//! late datagrams could not be counted.
//!
//! Sizes, numbers and layouts of messages are those of the crate `franka-rs`, which follows
//! libfranka 0.21.2 (FCI 10, FR3) and 0.9.2 (FCI 5, Panda).

mod arm;
mod connection;
#[cfg(feature = "emulation")]
pub mod emulated;
mod limits;
mod mailbox;
mod motion_loop;
#[cfg(test)]
mod motion_tests;
mod movable;
mod realtime;
mod recent_cycles;
mod reference;
mod request;
mod state;
mod statistics;
#[cfg(test)]
mod test_pace;
#[cfg(test)]
mod tests;

#[cfg(any(test, fuzzing))]
pub(crate) use arm::fuzz;
pub use arm::{ArmConfig, FrankaArm};
pub use franka::FciVersion;
pub use movable::MovableFrankaArm;
pub use request::ContactConfig;
pub use statistics::{MotionStatistics, StateStatistics};

/// Number of joints of every Franka arm.
pub const N_JOINTS: usize = 7;
