//! The interface of a servo protocol: what the code for whole arms needs to know about the servos
//! of one maker.

use super::bus::ServoBus;
use super::packet::{PacketFormat, Status};
use crate::Error;
use crate::motion::OnLoss;
use std::fmt::Debug;
use std::time::Duration;

/// Counts per revolution of the output shaft. It is the same for all supported servos.
pub(super) const COUNTS_PER_TURN: i32 = 4096;

/// Registers that are read together.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Block {
    /// Address of the first register.
    pub address: u16,
    /// Number of bytes.
    pub len: u16,
}

/// Properties of a servo that do not change while it is used.
#[derive(Clone, Debug, PartialEq)]
pub struct ServoInfo {
    /// Model, for messages.
    pub model: String,
    /// Lowest and highest goal position that the servo accepts, counts.
    pub range_counts: [i32; 2],
    /// Counts per second of a velocity of 1.
    pub velocity_unit_counts_s: f64,
    /// Why the servo cannot be moved to positions; `None` if it can.
    pub mode_problem: Option<String>,
}

/// Measured values, in units of the servo.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Feedback {
    /// Position, counts.
    pub position_counts: i32,
    /// Velocity, in [`ServoInfo::velocity_unit_counts_s`].
    pub velocity: i32,
}

/// A servo that was found on a bus.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FoundServo {
    /// Its ID.
    pub id: u8,
    /// Its model.
    pub model: String,
}

/// What the servos of a protocol can do when commands of this computer stop.
#[derive(Clone, Copy, Debug)]
pub struct LossReactions {
    /// Actions that a servo takes without this computer.
    pub by_servo: &'static [OnLoss],
    /// Actions that this computer can only command while it is running.
    pub while_running: &'static [OnLoss],
    /// What a servo does without this computer, as the start of a sentence.
    pub otherwise: &'static str,
}

/// A problem with a servo, or with the port.
#[derive(Debug)]
pub enum ServoError {
    /// The port was disconnected.
    Port(Error),
    /// The servo does not answer as expected.
    Servo(String),
}

impl From<Error> for ServoError {
    fn from(error: Error) -> Self {
        Self::Port(error)
    }
}

/// A protocol of servos on a serial bus.
pub trait ServoProtocol: Debug + Sync {
    /// Name of the driver in rig files.
    fn name(&self) -> &'static str;
    /// Name of the servos, for messages.
    fn title(&self) -> &'static str;
    /// Maximum ID of a servo.
    fn max_id(&self) -> u8;
    /// The packet format.
    fn format(&self) -> &'static dyn PacketFormat;

    /// Searches the bus for servos. Nothing moves.
    ///
    /// # Errors
    /// If the port was disconnected.
    fn find(&self, bus: &mut ServoBus) -> Result<Vec<FoundServo>, Error>;
    /// Reads the properties of a servo.
    ///
    /// # Errors
    /// If the servo does not answer or is not supported.
    fn identify(&self, bus: &mut ServoBus, id: u8) -> Result<ServoInfo, ServoError>;
    /// Whether some servos of this protocol support the fast sync read.
    fn has_fast_reads(&self) -> bool {
        false
    }
    /// Registers that contain the measured values.
    fn feedback_block(&self) -> Block;
    /// The measured values in these registers; `None` if there are too few bytes.
    fn feedback(&self, data: &[u8]) -> Option<Feedback>;
    /// Whether an answer reports a fault.
    fn has_fault(&self, status: &Status) -> bool;
    /// The faults of a servo whose answer reports one, in words.
    ///
    /// # Errors
    /// If the port was disconnected.
    fn faults(&self, bus: &mut ServoBus, status: &Status) -> Result<String, Error>;

    /// What the servos can do when commands stop.
    fn loss_reactions(&self) -> LossReactions;
    /// Sets the largest speed of a servo, and clears an expired watchdog. Does not enable the
    /// servo.
    ///
    /// # Errors
    /// If a value reads back differently.
    fn prepare(
        &self,
        bus: &mut ServoBus,
        id: u8,
        info: &ServoInfo,
        max_counts_s: f64,
    ) -> Result<(), ServoError>;
    /// Address of the goal position.
    fn goal_address(&self) -> u16;
    /// The bytes of a goal position.
    fn goal(&self, counts: i32) -> Vec<u8>;
    /// Address of the register that enables a servo with 1 and disables it with 0.
    fn torque_address(&self) -> u16;
    /// Address of the register that stops the watchdog with 0; `None` if the servos have no
    /// watchdog.
    fn watchdog_address(&self) -> Option<u16> {
        None
    }
    /// Starts the watchdog of an enabled servo, or stops it if `timeout` is `None`.
    ///
    /// # Errors
    /// If the value reads back differently.
    fn set_watchdog(
        &self,
        _bus: &mut ServoBus,
        _id: u8,
        _timeout: Option<Duration>,
    ) -> Result<(), ServoError> {
        Ok(())
    }
    /// Registers that show whether a servo still follows commands.
    fn vitals_block(&self) -> Block;
    /// The reason why a servo no longer follows commands; `None` if it does.
    fn vitals_problem(&self, data: &[u8]) -> Option<String>;
}

impl PartialEq for dyn ServoProtocol {
    fn eq(&self, other: &Self) -> bool {
        self.name() == other.name()
    }
}

/// The names of set bits, separated by commas.
pub(super) fn bit_names(bits: u8, names: &[(u8, &str)]) -> String {
    let named: Vec<_> = names
        .iter()
        .filter(|(bit, _)| bits & (1 << bit) != 0)
        .map(|(_, name)| *name)
        .collect();
    if named.is_empty() {
        format!("fault {bits:#04x}")
    } else {
        named.join(", ")
    }
}

/// Reads registers of a servo that must answer.
pub(super) fn read(
    bus: &mut ServoBus,
    id: u8,
    address: u16,
    len: u16,
) -> Result<Vec<u8>, ServoError> {
    let status = bus.read(id, address, len)?;
    status
        .map(|status| status.data)
        .ok_or_else(|| no_answer(id))
}

/// Writes registers of a servo, and checks that it has accepted the values.
pub(super) fn write(
    bus: &mut ServoBus,
    id: u8,
    address: u16,
    data: &[u8],
) -> Result<(), ServoError> {
    let contents = bus.write(id, address, data)?.ok_or_else(|| no_answer(id))?;
    if contents == data {
        return Ok(());
    }
    Err(ServoError::Servo(format!(
        "the servo with ID {id} did not accept {data:?} for register {address}: it contains {contents:?}"
    )))
}

pub(super) fn no_answer(id: u8) -> ServoError {
    ServoError::Servo(format!(
        "no servo with ID {id} answers: check its ID, its power, its cable, and arm.serial.baud_hz"
    ))
}
