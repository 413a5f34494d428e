//! Arms whose joints are motors on CAN buses, over Linux sockets.
//!
//! * `config` describes buses, motors and arms.
//! * `link` checks the configuration of an interface. `bus` transfers frames and counts errors on the wire, which code
//!   above it accesses through the trait of `frame_io`.
//! * `motor` reads one motor of any family. `arm` combines the readings of all motors into joint states, with one
//!   thread per bus. Neither commands a motor.
//! * `movable_motor` is a motor that may be moved. `watchdog` configures what it does when this computer stops
//!   sending. `movable` is an arm of such motors; `arm_loop` is its thread.
//! * `emulated` has emulated motors for tests and simulators.

#[cfg(target_os = "linux")]
mod arm;
#[cfg(target_os = "linux")]
mod arm_loop;
#[cfg(target_os = "linux")]
mod bus;
#[cfg(target_os = "linux")]
mod bus_load;
mod config;
pub mod emulated;
mod frame_io;
#[cfg(all(target_os = "linux", any(test, fuzzing)))]
pub(crate) mod fuzz;
mod interfaces;
#[cfg(target_os = "linux")]
mod joints;
#[cfg(target_os = "linux")]
mod link;
#[cfg(target_os = "linux")]
mod motor;
#[cfg(target_os = "linux")]
mod movable;
#[cfg(target_os = "linux")]
mod movable_motor;
#[cfg(target_os = "linux")]
mod query;
#[cfg(all(target_os = "linux", test))]
mod transcript_tests;
#[cfg(target_os = "linux")]
mod watchdog;

#[cfg(target_os = "linux")]
pub use arm::CanArm;
#[cfg(target_os = "linux")]
pub use bus::Bus;
pub use config::{ArmConfig, BusConfig, Family, Gains, MotorConfig, MovableArmConfig};
pub use frame_io::{BusEvent, FrameIo, WireErrors};
pub use interfaces::interfaces;
#[cfg(target_os = "linux")]
pub use link::{Link, LinkProblem, State};
#[cfg(target_os = "linux")]
pub use movable::MovableCanArm;

/// Our host ID on Robstride buses. The manufacturer's program uses the same ID.
const ROBSTRIDE_HOST: u8 = 0xFD;
