//! Arms whose joints are motors on CAN buses, over Linux sockets.
//!
//! * `config` describes buses, motors and arms.
//! * `link` checks the configuration of an interface. `bus` transfers frames and counts errors on
//!   the wire, which code above it accesses through the trait of `frame_io`.
//! * `family` has the traits of a motor family, and [`FAMILIES`] lists the families. Each is a
//!   folder with its codec, its settings in rig files, how its motors are read and moved, and their
//!   emulation.
//! * `motor` reads one motor. `arm` combines the readings of all motors into joint states, with one
//!   thread per bus. Neither commands a motor.
//! * `movable_motor` is a motor that may be moved. `plan` checks how motors are configured to react
//!   when this computer stops sending (`watchdog`). `movable` is an arm of such motors; `arm_loop`
//!   is its thread.
//! * `emulated` has emulated motors for tests and simulators, behind the feature `emulation`.

#[cfg(target_os = "linux")]
mod arm;
#[cfg(target_os = "linux")]
mod arm_loop;
#[cfg(target_os = "linux")]
mod bus;
#[cfg(target_os = "linux")]
mod bus_load;
pub mod cia402;
mod config;
pub mod damiao;
#[cfg(feature = "emulation")]
pub mod emulated;
mod family;
mod find;
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
pub mod odrive;
#[cfg(target_os = "linux")]
mod plan;
mod query;
pub mod robstride;
mod settings;
pub mod tmotor;
#[cfg(test)]
#[cfg(target_os = "linux")]
mod transcript_tests;
mod watchdog;

#[cfg(target_os = "linux")]
pub use arm::CanArm;
#[cfg(target_os = "linux")]
pub use bus::Bus;
pub use config::{ArmConfig, BusConfig, FollowingLimits, Gains, MotorConfig, MovableArmConfig};
#[cfg(any(test, fuzzing))]
pub use family::FamilyFuzzing;
pub use family::{
    Health, MotionProtocol, MotorFamily, MotorProtocol, MotorReading, Reports, Traffic,
};
pub use find::{FoundMotor, SearchTimes, motors_on};
pub use frame_io::{BusEvent, FrameIo, WireErrors};
pub use interfaces::interfaces;
#[cfg(target_os = "linux")]
pub use link::{Link, LinkProblem, State};
#[cfg(target_os = "linux")]
pub use movable::MovableCanArm;
pub use query::MotorQuery;
pub use settings::{AllowedValues, MotorKey, MotorSettings, SettingValue};
pub use watchdog::{Watchdog, WatchdogPlan};

/// All motor families. Messages list them in this order.
pub static FAMILIES: &[&dyn MotorFamily] = &[
    &damiao::DamiaoFamily,
    &robstride::RobstrideFamily,
    &tmotor::TMotorFamily,
    &odrive::OdriveFamily,
    &cia402::Cia402Family,
];
