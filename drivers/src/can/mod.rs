//! Arms whose joints are motors on CAN buses: Linux sockets, one thread a bus. Nothing here commands a motor.
//!
//! `link` checks how an interface is set up, `bus` moves frames and counts what is wrong on the wire, `motor` speaks to one motor
//! of any family, `arm` makes joint states of what all of them say. `played` is the other side: motors for tests and simulators.

#[cfg(target_os = "linux")]
mod arm;
#[cfg(target_os = "linux")]
mod bus;
mod config;
mod interfaces;
#[cfg(target_os = "linux")]
mod link;
#[cfg(target_os = "linux")]
mod motor;
pub mod played;

#[cfg(target_os = "linux")]
pub use arm::CanArm;
#[cfg(target_os = "linux")]
pub use bus::{Arrived, Bus, WireErrors};
pub use config::{ArmConfig, BusConfig, Family, Gains, MotorConfig};
pub use interfaces::interfaces;
#[cfg(target_os = "linux")]
pub use link::{Complaint, Link, State};

/// Our number among Robstride hosts, as in the maker's program.
const ROBSTRIDE_HOST: u8 = 0xFD;
