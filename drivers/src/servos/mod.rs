//! Arms whose joints are servos on a serial bus: Feetech STS and Dynamixel (protocol 2.0).
//!
//! * `config` describes the port, the servos and the arm.
//! * `serial` is a port in raw mode. `packet` has the trait of a packet format, and `bus` sends
//!   instructions and waits for the answers.
//! * `protocol` has the trait of a servo protocol, and [`PROTOCOLS`] lists the protocols. Each is a
//!   folder with its packet format and its control table.
//! * `servo` converts between counts and joint positions. `arm` reads all servos, and never enables
//!   or moves one.
//! * `plan` checks how servos react when this computer stops sending. `movable` is an arm that may
//!   be moved; `motion_loop` is its thread, and `moved_servos` are the servos that it commands.
//! * `find` searches ports for servos.
//! * `emulated` has emulated servos for tests and simulators, behind the feature `emulation`.

mod arm;
mod bus;
mod config;
mod dynamixel;
#[cfg(feature = "emulation")]
pub mod emulated;
mod feetech;
mod find;
mod motion_loop;
mod movable;
mod moved_servos;
mod packet;
mod plan;
mod protocol;
mod serial;
mod servo;
#[cfg(test)]
mod tests;

pub use arm::ServoArm;
pub use bus::{BusCounts, ServoBus};
pub use config::{MovableServoArmConfig, ServoArmConfig, ServoConfig};
pub use dynamixel::DynamixelProtocol;
pub use feetech::FeetechProtocol;
pub use find::{FoundPort, FoundServos, found_ports, servos_on};
pub use movable::MovableServoArm;
pub use packet::{Instruction, PacketFormat, Scan, Status};
pub use protocol::{FoundServo, ServoProtocol};
pub use serial::PortConfig;

/// All servo protocols. Messages list them in this order.
pub static PROTOCOLS: &[&dyn ServoProtocol] = &[&FeetechProtocol, &DynamixelProtocol];
