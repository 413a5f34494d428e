//! Parameters of Robstride motors: their table, and the bytes that hold them.
//!
//! Sources: as of the frames, in the module above.

use super::super::{CanError, decode_enum};

/// Counts of `canTimeout` a second.
const TIMEOUT_TICKS_HZ: f64 = 20_000.0;
/// A parameter that this program reads or writes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u16)]
pub enum Parameter {
    /// `run_mode`: 0 obeys motion commands.
    RunMode = 0x7005,
    /// `limit_torque`, N m.
    TorqueLimit = 0x700B,
    /// `limit_cur`, A.
    CurrentLimit = 0x7018,
    /// `mechPos`: the output shaft, rad; read only.
    Position = 0x7019,
    /// `mechVel`: the output shaft, rad/s; read only.
    Velocity = 0x701B,
    /// `VBUS`: supply, V; read only.
    Supply = 0x701C,
    /// `loc_kp`: stiffness of the motor's own position mode.
    PositionGain = 0x701E,
    /// `EPScan_time`: how often the motor reports by itself, 1 is every 10 ms and each more 5 ms longer.
    ReportInterval = 0x7026,
    /// `canTimeout`: how long it obeys its last command, 20 000 a second; 0 is for ever.
    Timeout = 0x7028,
}

impl Parameter {
    const ALL: [Self; 9] = [
        Self::RunMode,
        Self::TorqueLimit,
        Self::CurrentLimit,
        Self::Position,
        Self::Velocity,
        Self::Supply,
        Self::PositionGain,
        Self::ReportInterval,
        Self::Timeout,
    ];

    /// How many bytes of a whole number it holds; `None` where it is a real one.
    fn integer_bytes(self) -> Option<usize> {
        match self {
            Self::RunMode => Some(1),
            Self::ReportInterval => Some(2),
            Self::Timeout => Some(4),
            _ => None,
        }
    }

    /// The parameter of an index.
    pub(super) fn of_index(index: u16) -> Result<Self, CanError> {
        decode_enum("the parameter", index.into(), &Self::ALL, |known| known as u32)
    }

    /// What the last four bytes of a message about it hold.
    pub(super) fn value(self, [a, b, c, d]: [u8; 4]) -> Value {
        match self.integer_bytes() {
            Some(1) => Value::Integer(a.into()),
            Some(2) => Value::Integer(u16::from_le_bytes([a, b]).into()),
            Some(_) => Value::Integer(u32::from_le_bytes([a, b, c, d])),
            None => Value::Float(f32::from_le_bytes([a, b, c, d])),
        }
    }

    /// The last four bytes of a message that sets it.
    pub(super) fn value_bytes(self, value: Value) -> Result<[u8; 4], CanError> {
        match (self.integer_bytes(), value) {
            (Some(n_bytes), Value::Integer(whole)) if n_bytes == 4 || whole < 1 << (8 * n_bytes) => {
                Ok(whole.to_le_bytes())
            }
            (None, Value::Float(real)) if real.is_finite() => Ok(real.to_le_bytes()),
            _ => Err(CanError::Undefined { field: "the value for the parameter", raw: self as u32 }),
        }
    }

    /// A message about it.
    pub(super) fn bytes(self, [a, b, c, d]: [u8; 4]) -> [u8; 8] {
        let [low, high] = (self as u16).to_le_bytes();
        [low, high, 0, 0, a, b, c, d]
    }
}

/// What a parameter holds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Value {
    /// In parameters of codes and ticks.
    Integer(u32),
    /// In parameters of SI values.
    Float(f32),
}

/// The value of [`Parameter::Timeout`] for a time, rounded up so that no motor stops earlier than asked for; 0 never stops it.
#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "within u32 by the check")]
pub fn timeout(timeout_secs: f64) -> Result<Value, CanError> {
    let upper = f64::from(u32::MAX) / TIMEOUT_TICKS_HZ;
    match (0.0..=upper).contains(&timeout_secs) {
        true if timeout_secs == 0.0 => Ok(Value::Integer(0)),
        // Less a hair, so that whole ticks stay what they are; never 0, which would be for ever.
        true => Ok(Value::Integer((timeout_secs * TIMEOUT_TICKS_HZ - 1e-6).ceil().max(1.0) as u32)),
        false => Err(CanError::Range { field: "the timeout in seconds", value: timeout_secs, lower: 0.0, upper }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn timeouts_round_up_to_ticks() {
        for secs in [-1e-3, f64::NAN, f64::INFINITY, 1e9] {
            assert!(matches!(timeout(secs), Err(CanError::Range { .. })), "{secs}");
        }
        for (secs, ticks) in [(0.0, 0), (1e-12, 1), (0.1, 2000), (1.0, 20_000)] {
            assert_eq!(timeout(secs), Ok(Value::Integer(ticks)), "{secs}");
        }
    }
}
