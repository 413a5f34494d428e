//! Arms whose joints are motors on CAN buses, over Linux sockets.
//!
//! `link` checks how an interface is set up, `bus` moves frames and counts what is wrong on the wire. `motor` reads one motor of any
//! family, `arm` makes joint states of what all of them say, a thread a bus; nothing in these two commands a motor. `movable_motor` is a motor
//! that may be moved, `watchdog` what it does when this computer falls silent, `movable` an arm of them, with `arm_loop` as its thread.
//! `emulated` is the other side: motors for tests and simulators.

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
#[cfg(target_os = "linux")]
mod watchdog;

#[cfg(target_os = "linux")]
pub use arm::CanArm;
#[cfg(target_os = "linux")]
pub use bus::{Bus, BusEvent, WireErrors};
pub use config::{ArmConfig, BusConfig, Family, Gains, MotorConfig};
pub use interfaces::interfaces;
#[cfg(target_os = "linux")]
pub use link::{Link, LinkProblem, State};
#[cfg(target_os = "linux")]
pub use movable::{MovableArmConfig, MovableCanArm};

/// Our number among Robstride hosts, as in the maker's program.
const ROBSTRIDE_HOST: u8 = 0xFD;
