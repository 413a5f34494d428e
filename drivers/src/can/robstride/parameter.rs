//! Parameters of Robstride motors and the encoding of their values.
//!
//! Sources: see the module `codec`.

use crate::wire::can::{CanError, decode_enum};

/// Ticks of `canTimeout` per second.
const TIMEOUT_TICKS_HZ: f64 = 20_000.0;

/// A parameter that we read or write.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u16)]
pub enum Parameter {
    /// `run_mode`: 0 is motion mode.
    RunMode = 0x7005,
    /// `limit_torque`, N m.
    TorqueLimit = 0x700B,
    /// `limit_cur`, A.
    CurrentLimit = 0x7018,
    /// `mechPos`: position of the output shaft, rad; read only.
    Position = 0x7019,
    /// `mechVel`: velocity of the output shaft, rad/s; read only.
    Velocity = 0x701B,
    /// `VBUS`: supply voltage, V; read only.
    Supply = 0x701C,
    /// `loc_kp`: stiffness of the motor's own position mode.
    PositionGain = 0x701E,
    /// `EPScan_time`: interval of unsolicited reports. A value of 1 is 10 ms. Each further unit
    /// adds 5 ms.
    ReportInterval = 0x7026,
    /// `canTimeout`: time without commands after which the motor stops, 20 000 ticks per second.
    /// With 0, it never stops.
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

    /// Size of an integer value in bytes; `None` for floating-point values.
    fn integer_bytes(self) -> Option<usize> {
        match self {
            Self::RunMode => Some(1),
            Self::ReportInterval => Some(2),
            Self::Timeout => Some(4),
            _ => None,
        }
    }

    /// The parameter with this index.
    pub(super) fn of_index(index: u16) -> Result<Self, CanError> {
        decode_enum("the parameter", index.into(), &Self::ALL, |known| {
            known as u32
        })
    }

    /// Decodes the value in the last four bytes of a message.
    pub(super) fn value(self, [a, b, c, d]: [u8; 4]) -> Value {
        match self.integer_bytes() {
            // The bytes beyond the size of the parameter are undefined.
            Some(1) => Value::Integer(a.into()),
            Some(2) => Value::Integer(u16::from_le_bytes([a, b]).into()),
            Some(_) => Value::Integer(u32::from_le_bytes([a, b, c, d])),
            None => Value::Float(f32::from_le_bytes([a, b, c, d])),
        }
    }

    /// Encodes a value as the last four bytes of a message.
    pub(super) fn value_bytes(self, value: Value) -> Result<[u8; 4], CanError> {
        match (self.integer_bytes(), value) {
            // The motor would truncate a value that does not fit. Parameters of four bytes are not
            // checked, because every value fits and the shift would overflow.
            (Some(n_bytes), Value::Integer(whole))
                if n_bytes == 4 || whole < 1 << (8 * n_bytes) =>
            {
                Ok(whole.to_le_bytes())
            }
            (None, Value::Float(real)) if real.is_finite() => Ok(real.to_le_bytes()),
            _ => Err(CanError::Undefined {
                field: "the value for the parameter",
                raw: self as u32,
            }),
        }
    }

    /// Payload of a message about this parameter.
    pub(super) fn bytes(self, [a, b, c, d]: [u8; 4]) -> [u8; 8] {
        let [low, high] = (self as u16).to_le_bytes();
        [low, high, 0, 0, a, b, c, d]
    }
}

/// Value of a parameter.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Value {
    /// Integer, for codes and ticks.
    Integer(u32),
    /// Floating-point number, for SI values.
    Float(f32),
}

/// Converts a time to a value of [`Parameter::Timeout`], rounded up so that no motor stops too
/// early. A time of 0 disables the timeout.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "within u32 by the check"
)]
pub fn timeout(timeout_secs: f64) -> Result<Value, CanError> {
    let upper = f64::from(u32::MAX) / TIMEOUT_TICKS_HZ;
    if !(0.0..=upper).contains(&timeout_secs) {
        return Err(CanError::Range {
            field: "the timeout in seconds",
            value: timeout_secs,
            lower: 0.0,
            upper,
        });
    }
    if timeout_secs == 0.0 {
        return Ok(Value::Integer(0));
    }
    // Subtract a small amount so that rounding errors do not add a tick. Never return 0, which
    // would disable the timeout.
    let ticks = (timeout_secs * TIMEOUT_TICKS_HZ - 1e-6).ceil().max(1.0) as u32;
    Ok(Value::Integer(ticks))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn timeouts_round_up_to_ticks() {
        for secs in [-1e-3, f64::NAN, f64::INFINITY, 1e9] {
            assert!(
                matches!(timeout(secs), Err(CanError::Range { .. })),
                "{secs}"
            );
        }
        for (secs, ticks) in [(0.0, 0), (1e-12, 1), (0.1, 2000), (1.0, 20_000)] {
            assert_eq!(timeout(secs), Ok(Value::Integer(ticks)), "{secs}");
        }
    }
}
