//! Buses, motors and arms as a rig file has them.

use crate::wire::can::frame::BitRates;
use crate::wire::can::{canopen, cia402, odrive, robstride, tmotor};

/// An arm as the rig file has it.
#[derive(Clone, Debug, PartialEq)]
pub struct ArmConfig {
    /// Buses.
    pub buses: Vec<BusConfig>,
    /// A motor a joint, in the order of the readings.
    pub motors: Vec<MotorConfig>,
    /// How often motors that answer questions are asked; less where the bus would be busy for more than 70 % of the time.
    pub rate_hz: f64,
}

/// A bus as the rig file has it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BusConfig {
    /// Name of the interface, `can0` for instance.
    pub interface: String,
    /// Bits a second.
    pub bitrate_hz: u32,
    /// Bits a second of the data of FD frames; `None` on a classic bus.
    pub data_bitrate_hz: Option<u32>,
    /// The kernel cannot restart the adapter (those on a serial line, `slcan`): once it is off the bus it stays off.
    pub accept_no_restart: bool,
}

impl BusConfig {
    /// Both rates.
    pub fn rates(&self) -> BitRates {
        let nominal_hz = f64::from(self.bitrate_hz);
        BitRates { nominal_hz, data_hz: self.data_bitrate_hz.map_or(nominal_hz, f64::from) }
    }
}

/// The protocol of a motor and what names it on its bus.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Family {
    /// Damiao: its number, and the identifier of its answers (register `MST_ID`). What its counts cover is read from it.
    Damiao {
        /// Number of the motor.
        motor: u16,
        /// Identifier of its answers.
        feedback: u16,
    },
    /// Robstride, private protocol.
    Robstride {
        /// Number of the motor.
        motor: u8,
        /// Its model, which says what its counts cover.
        model: robstride::Model,
    },
    /// T-Motor AK in MIT mode, listened to only.
    TMotor {
        /// Number of the motor.
        motor: u8,
        /// Its model, which says what its counts cover.
        model: tmotor::Model,
    },
    /// ODrive CANSimple.
    Odrive {
        /// Number of the axis.
        node: odrive::Node,
    },
    /// CiA 402 drive.
    Cia402 {
        /// Number of the node.
        node: canopen::Node,
        /// What its counts are worth.
        units: cia402::Units,
    },
}

impl Family {
    /// Whether it could not be told from another one on the same bus.
    pub fn conflicts_with(&self, other: &Self) -> bool {
        match (self, other) {
            // It would take the other one's answers for orders.
            (Self::Damiao { motor: a, feedback: b }, Self::Damiao { motor: c, feedback: d }) => {
                a == c || b == d || a == d || b == c
            }
            (Self::Robstride { motor: a, .. }, Self::Robstride { motor: b, .. })
            | (Self::TMotor { motor: a, .. }, Self::TMotor { motor: b, .. }) => a == b,
            (Self::Odrive { node: a }, Self::Odrive { node: b }) => a == b,
            (Self::Cia402 { node: a, .. }, Self::Cia402 { node: b, .. }) => a == b,
            _ => false,
        }
    }
}

/// A motor and its joint: `joint = direction * motor / gear_ratio + offset_rad`, the direction -1 where it is reversed.
#[derive(Clone, Debug, PartialEq)]
pub struct MotorConfig {
    /// The joint that it moves.
    pub joint: String,
    /// Which of the arm's buses it is on.
    pub bus_ix: usize,
    /// Its protocol.
    pub family: Family,
    /// Turns of what it tells in a turn of the joint: 1 where it tells its output shaft, and no gear is behind that.
    pub gear_ratio: f64,
    /// Whether it turns against its joint.
    pub is_reversed: bool,
    /// Angle of the joint where the motor tells 0, rad.
    pub offset_rad: f64,
    /// How it is held where each command carries that, in MIT mode; `None` where it is only read.
    pub gains: Option<Gains>,
}

/// How stiffly a joint is held. The motor in front of a gear gets both divided by the square of the ratio.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Gains {
    /// Torque by how far it is from where it shall be, N m / rad of the joint.
    pub stiffness_nm_rad: f64,
    /// Torque by how much slower it is than it shall be, N m s / rad of the joint.
    pub damping_nm_s_rad: f64,
}
