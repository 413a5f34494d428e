//! An emulated Damiao motor.

use super::Damiao;
use super::codec::{self, MIT_MODE, Register, Status};
use crate::can::emulated::{Actuation, CELSIUS, EmulatedDrive, EmulatedProtocol, State};
use crate::wire::can::{CanError, Frame, Id, mit};
use std::time::Duration;

/// Faults, numbered as in the feedback.
const COMMUNICATION_LOST: u32 = Status::LostCommunication as u32;
const OVERLOAD: u32 = Status::Overload as u32;

#[derive(Debug)]
pub(super) struct EmulatedDamiao(pub(super) Damiao);

impl EmulatedProtocol for EmulatedDamiao {
    fn take(&mut self, frame: &Frame, drive: &mut EmulatedDrive) -> Result<Vec<Frame>, CanError> {
        let Damiao { motor, feedback } = self.0;
        let answer_id = Id::standard(feedback.into())?;
        let Ok(bytes) = <[u8; 8]>::try_from(frame.data()) else {
            return Ok(Vec::new());
        };
        // All motors share the ID of register messages, and the payload names the motor.
        if frame.id() == Id::standard(0x7FF)? {
            return self.access_register(bytes, drive);
        }
        if frame.id() != Id::standard(motor.into())? {
            return Ok(Vec::new());
        }
        // State commands and MIT commands have the same ID. Seven bytes of FF are a command with
        // all values near their upper limits, which no controller sends.
        match bytes {
            [
                0xFF,
                0xFF,
                0xFF,
                0xFF,
                0xFF,
                0xFF,
                0xFF,
                state_command @ 0xFB..=0xFE,
            ] => match state_command {
                0xFB => drive.faults = 0,
                // A fault must be cleared before the motor can be enabled.
                0xFC if drive.faults == 0 => drive.switch_on(),
                0xFD => drive.actuation = Actuation::Free,
                _ => {}
            },
            command if register_value(drive, Register::ControlMode as u8) == Some(MIT_MODE) => {
                drive.obey(mit::decode(&command, &drive.limits));
            }
            _ => {}
        }
        Ok(vec![self.feedback(answer_id, drive)?])
    }

    fn timeout(&self, drive: &EmulatedDrive) -> Option<Duration> {
        let ticks = register_value(drive, Register::Timeout as u8).filter(|ticks| *ticks > 0)?;
        Some(Duration::from_secs_f64(codec::timeout_secs(ticks)))
    }

    fn time_out(&mut self, drive: &mut EmulatedDrive) {
        // A motor that was disabled already has nothing to report.
        if drive.state() == State::Enabled {
            drive.faults = COMMUNICATION_LOST;
        }
        drive.actuation = Actuation::Free;
    }

    fn fail(&mut self, drive: &mut EmulatedDrive) {
        drive.faults = OVERLOAD;
    }
}

impl EmulatedDamiao {
    /// Executes a register message, and returns the answer. There is no answer if the message is
    /// for another motor.
    fn access_register(
        &self,
        [low, high, code, register, a, b, c, d]: [u8; 8],
        drive: &mut EmulatedDrive,
    ) -> Result<Vec<Frame>, CanError> {
        let Damiao { motor, feedback } = self.0;
        let answer_id = Id::standard(feedback.into())?;
        if u16::from_le_bytes([low, high]) != motor {
            return Ok(Vec::new());
        }
        let reply = |value: u32, code: u8| {
            let [a, b, c, d] = value.to_le_bytes();
            Frame::classic(answer_id, &[low, high, code, register, a, b, c, d])
        };
        match code {
            0x33 if register == Register::FeedbackId as u8 => {
                Ok(vec![reply(feedback.into(), code)?])
            }
            0x33 => register_value(drive, register)
                .map(|value| reply(value, code))
                .into_iter()
                .collect(),
            0x55 => {
                drive.set(
                    register.into(),
                    u32::from_le_bytes([a, b, c, d]),
                    register == Register::Timeout as u8,
                );
                // The answer repeats the message even if the write is ignored, so a driver must
                // read the register back.
                Ok(vec![reply(u32::from_le_bytes([a, b, c, d]), code)?])
            }
            0xCC => Ok(vec![self.feedback(answer_id, drive)?]),
            _ => Ok(Vec::new()),
        }
    }
    fn feedback(&self, answer_id: Id, drive: &EmulatedDrive) -> Result<Frame, CanError> {
        let status = match (drive.faults, drive.state()) {
            (COMMUNICATION_LOST, _) => Status::LostCommunication,
            (0, State::Enabled) => Status::Enabled,
            (0, _) => Status::Disabled,
            _ => Status::Overload,
        };
        let reply = codec::Feedback {
            motor_low: self.0.motor.to_le_bytes()[0] & 0xF,
            status,
            motion: drive.motion(),
            drive_celsius: CELSIUS,
            rotor_celsius: CELSIUS,
        };
        codec::encode_feedback(answer_id, &reply, &drive.limits)
    }
}

/// Value of a register that was written or has a factory setting.
fn register_value(drive: &EmulatedDrive, register: u8) -> Option<u32> {
    #[expect(clippy::cast_possible_truncation, reason = "limits are small numbers")]
    let known = [
        (
            Register::PositionLimit,
            (drive.limits.position_rad as f32).to_bits(),
        ),
        (
            Register::VelocityLimit,
            (drive.limits.velocity_rad_s as f32).to_bits(),
        ),
        (
            Register::TorqueLimit,
            (drive.limits.torque_nm as f32).to_bits(),
        ),
        // Factory settings: no timeout, and a mode other than MIT.
        (Register::Timeout, 0),
        (Register::ControlMode, 2),
    ];
    let shipped = known
        .into_iter()
        .find(|(known, _)| *known as u8 == register)
        .map(|(_, value)| value);
    drive.setting(register.into()).or(shipped)
}
