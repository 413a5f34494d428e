//! Configuration of buses, motors and arms.

use super::family::MotorProtocol;
use super::odrive::Endpoints;
use crate::motion::MotionConfig;
use crate::wire::can::frame::BitRates;
use std::sync::Arc;

/// Configuration of an arm from the rig file.
#[derive(Clone, Debug, PartialEq)]
pub struct ArmConfig {
    /// The buses of the arm.
    pub buses: Vec<BusConfig>,
    /// One motor per joint, in the order of the readings.
    pub motors: Vec<MotorConfig>,
    /// Rate at which motors are polled, in Hz. It is reduced if the load of a bus would exceed 70 %.
    pub rate_hz: f64,
}

/// Configuration of an arm that may be moved.
#[derive(Clone, Debug, PartialEq)]
pub struct MovableArmConfig {
    /// Buses and motors. Motors in MIT mode need their gains.
    pub arm: ArmConfig,
    /// Limits of each joint, in the order of the motors, and the fail-safe behavior if this computer stops sending.
    pub motion: MotionConfig,
    /// Endpoint numbers of `ODrive` axes. Without them, the watchdog of the axes cannot be set.
    pub odrive_endpoints: Option<Endpoints>,
}

/// Configuration of a bus from the rig file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BusConfig {
    /// Name of the interface, for instance `can0`.
    pub interface: String,
    /// Bit rate, bit/s.
    pub bitrate_hz: u32,
    /// Bit rate of the data phase of FD frames, bit/s; `None` on a classic bus.
    pub data_bitrate_hz: Option<u32>,
    /// Accept that the kernel cannot restart the adapter, as with serial-line adapters (`slcan`). After a
    /// bus-off, such an adapter stays bus-off.
    pub accept_no_restart: bool,
}

impl BusConfig {
    /// Nominal and data bit rate.
    pub fn rates(&self) -> BitRates {
        let nominal_hz = f64::from(self.bitrate_hz);
        BitRates { nominal_hz, data_hz: self.data_bitrate_hz.map_or(nominal_hz, f64::from) }
    }
}

/// A motor and its joint: `joint = direction * motor / gear_ratio + offset_rad`, where the direction is -1 if the
/// motor is reversed.
#[derive(Clone, Debug)]
pub struct MotorConfig {
    /// Name of the joint that it moves.
    pub joint: String,
    /// Index of its bus in [`ArmConfig::buses`].
    pub bus_ix: usize,
    /// Its protocol, and its address on the bus.
    pub protocol: Arc<dyn MotorProtocol>,
    /// Turns that the motor reports per turn of the joint. It is 1 if the motor reports the angle of its output shaft
    /// and drives the joint directly.
    pub gear_ratio: f64,
    /// Whether it turns in the opposite direction to its joint.
    pub is_reversed: bool,
    /// Joint angle at which the motor reports 0, rad.
    pub offset_rad: f64,
    /// Gains for families whose commands include them (MIT mode); `None` if the motor is only read.
    pub gains: Option<Gains>,
}

// This is not derived, because the derived code would move the trait object (rust-lang/rust#31740).
impl PartialEq for MotorConfig {
    fn eq(&self, other: &Self) -> bool {
        let Self { joint, bus_ix, protocol, gear_ratio, is_reversed, offset_rad, gains } = self;
        protocol.as_ref() == other.protocol.as_ref()
            && (joint, bus_ix, is_reversed) == (&other.joint, &other.bus_ix, &other.is_reversed)
            && (gear_ratio, offset_rad, gains) == (&other.gear_ratio, &other.offset_rad, &other.gains)
    }
}

/// Stiffness and damping of a joint. A motor in front of a gear gets both divided by the square of the gear ratio.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Gains {
    /// Torque per position error, N m / rad of the joint.
    pub stiffness_nm_rad: f64,
    /// Torque per velocity error, N m s / rad of the joint.
    pub damping_nm_s_rad: f64,
}
