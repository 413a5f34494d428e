//! Emulated servos on a pseudo terminal, for tests and simulators. They answer, move to their
//! goals, and hold when their watchdog expires, as the manuals describe.
//!
//! The emulated servos were written from the same manuals as the driver. The tests therefore also
//! compare them with the makers' own client libraries. Only real servos can show whether the
//! manuals are right.

mod instruction;
mod servo;
mod wire;

pub use servo::{EmulatedServo, ServoKind};
pub use wire::{Disturbance, EmulatedServoBus, ServoLine};
