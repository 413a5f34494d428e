//! Franka arms (Panda, FR3) over FCI, the interface of their controllers: read at 1 kHz, never commanded.
//!
//! `session` connects, `state` decodes, `arm` reads on a thread of its own, `realtime` asks the kernel to wake it in time,
//! `statistics` tells how well it did. `played` is the other side: a controller for tests and simulators.
//!
//! Sizes, numbers and layouts of messages are those of the crate `franka-rs`, which follows libfranka 0.21.2 (FCI 10, FR3) and
//! 0.9.2 (FCI 5, Panda).

mod arm;
pub mod played;
mod realtime;
mod session;
mod state;
mod statistics;
#[cfg(test)]
mod tests;

#[cfg(any(test, fuzzing))]
pub(crate) use arm::hostile;
pub use arm::{ArmConfig, FrankaArm};
pub use franka::FciVersion;
pub use statistics::Statistics;

/// Joints of every Franka arm.
pub const N_JOINTS: usize = 7;
