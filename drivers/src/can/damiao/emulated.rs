//! An emulated Damiao motor.

use super::{CELSIUS, EmulatedMotor, State};
use crate::can::emulated::shaft::Actuation;
use crate::wire::can::damiao::{self, MIT_MODE, Register, Status};
use crate::wire::can::{CanError, Frame, Id, mit};
use std::time::Duration;

/// Faults, numbered as in the feedback.
pub(super) const COMMUNICATION_LOST: u32 = Status::LostCommunication as u32;
pub(super) const OVERLOAD: u32 = Status::Overload as u32;

impl EmulatedMotor {
    pub(super) fn handle_damiao(&mut self, frame: &Frame, motor: u16, feedback: u16) -> Result<Vec<Frame>, CanError> {
        let answer_id = Id::standard(feedback.into())?;
        let Ok(bytes) = <[u8; 8]>::try_from(frame.data()) else { return Ok(Vec::new()) };
        if frame.id() == Id::standard(0x7FF)? {
            let [low, high, code, register, a, b, c, d] = bytes;
            if u16::from_le_bytes([low, high]) != motor {
                return Ok(Vec::new());
            }
            let reply = |value: u32, code: u8| {
                let [a, b, c, d] = value.to_le_bytes();
                Frame::classic(answer_id, &[low, high, code, register, a, b, c, d])
            };
            return match code {
                0x33 => self.damiao_register(register).map(|value| reply(value, code)).into_iter().collect(),
                0x55 => {
                    self.set(register.into(), u32::from_le_bytes([a, b, c, d]), register == Register::Timeout as u8);
                    Ok(vec![reply(u32::from_le_bytes([a, b, c, d]), code)?])
                }
                0xCC => Ok(vec![self.damiao_feedback(motor, answer_id)?]),
                _ => Ok(Vec::new()),
            };
        }
        if frame.id() != Id::standard(motor.into())? {
            return Ok(Vec::new());
        }
        match bytes {
            [0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, state_command @ 0xFB..=0xFE] => match state_command {
                0xFB => self.faults = 0,
                0xFC if self.faults == 0 => self.switch_on(),
                0xFD => self.actuation = Actuation::Free,
                _ => {}
            },
            command if self.damiao_register(Register::ControlMode as u8) == Some(MIT_MODE) => {
                self.obey(mit::decode(&command, &self.limits));
            }
            _ => {}
        }
        Ok(vec![self.damiao_feedback(motor, answer_id)?])
    }

    fn damiao_register(&self, register: u8) -> Option<u32> {
        #[expect(clippy::cast_possible_truncation, reason = "limits are small numbers")]
        let known = [
            (Register::PositionLimit, (self.limits.position_rad as f32).to_bits()),
            (Register::VelocityLimit, (self.limits.velocity_rad_s as f32).to_bits()),
            (Register::TorqueLimit, (self.limits.torque_nm as f32).to_bits()),
            // Factory settings: no timeout, and a mode other than MIT.
            (Register::Timeout, 0),
            (Register::ControlMode, 2),
        ];
        let shipped = known.into_iter().find(|(known, _)| *known as u8 == register).map(|(_, value)| value);
        self.setting(register.into()).or(shipped)
    }

    pub(super) fn damiao_timeout(&self) -> Option<Duration> {
        let ticks = self.damiao_register(Register::Timeout as u8).filter(|ticks| *ticks > 0)?;
        Some(Duration::from_secs_f64(damiao::timeout_secs(ticks)))
    }

    fn damiao_feedback(&self, motor: u16, answer_id: Id) -> Result<Frame, CanError> {
        let status = match (self.faults, self.state()) {
            (COMMUNICATION_LOST, _) => Status::LostCommunication,
            (0, State::Enabled) => Status::Enabled,
            (0, _) => Status::Disabled,
            _ => Status::Overload,
        };
        let reply = damiao::Feedback {
            motor_low: motor.to_le_bytes()[0] & 0xF,
            status,
            motion: self.shaft.motion,
            drive_celsius: CELSIUS,
            rotor_celsius: CELSIUS,
        };
        damiao::encode_feedback(answer_id, &reply, &self.limits)
    }
}
