//! An emulated Robstride motor.

use super::shaft::Actuation;
use super::{CELSIUS, EmulatedMotor, State};
use crate::can::ROBSTRIDE_HOST;
use crate::wire::can::robstride::{self, Faults, Mode, Parameter};
use crate::wire::can::{CanError, Frame, Id};
use std::time::Duration;

pub(super) const OVERLOAD: u32 = Faults::OVERLOAD as u32;
/// Ticks of its timeout per second.
const TICKS_HZ: f64 = 20_000.0;

impl EmulatedMotor {
    pub(super) fn handle_robstride(&mut self, frame: &Frame, motor: u8) -> Result<Vec<Frame>, CanError> {
        let id = frame.id();
        let [kind, _, host, to] = id.value().to_be_bytes();
        let Ok(bytes) = <[u8; 8]>::try_from(frame.data()) else { return Ok(Vec::new()) };
        if !id.is_extended() || frame.is_remote() || to != motor {
            return Ok(Vec::new());
        }
        let [low, high, _, _, a, b, c, d] = bytes;
        let parameter = u32::from(u16::from_le_bytes([low, high]));
        match kind {
            1 => {
                let command = robstride::decode_move(frame, motor, &self.limits);
                if self.setting(Parameter::RunMode as u32).is_none_or(|mode| mode == robstride::MOTION_MODE) {
                    command.into_iter().for_each(|command| self.obey(command));
                }
            }
            3 if self.faults == 0 => self.switch_on(),
            4 => {
                self.actuation = Actuation::Free;
                if low == 1 {
                    self.faults = 0;
                }
            }
            17 => {
                let [a, b, c, d] = self.setting(parameter).unwrap_or(0).to_le_bytes();
                let id = Id::extended(17 << 24 | u32::from(motor) << 8 | u32::from(host))?;
                return Ok(vec![Frame::classic(id, &[low, high, 0, 0, a, b, c, d])?]);
            }
            18 => {
                let is_timeout = parameter == Parameter::Timeout as u32;
                self.set(parameter, u32::from_le_bytes([a, b, c, d]), is_timeout);
            }
            24 => {
                self.reports = bytes[6] == 1;
                return Ok(Vec::new());
            }
            _ => return Ok(Vec::new()),
        }
        Ok(vec![self.robstride_feedback(motor, false)?])
    }

    pub(super) fn robstride_timeout(&self) -> Option<Duration> {
        let ticks = self.setting(Parameter::Timeout as u32).filter(|ticks| *ticks > 0)?;
        Some(Duration::from_secs_f64(f64::from(ticks) / TICKS_HZ))
    }

    pub(super) fn robstride_feedback(&self, motor: u8, is_unsolicited: bool) -> Result<Frame, CanError> {
        let reply = robstride::Feedback {
            motor,
            is_unsolicited,
            mode: if self.state() == State::Enabled { Mode::Run } else { Mode::Reset },
            faults: Faults(self.faults.to_le_bytes()[0]),
            motion: self.shaft.motion,
            winding_celsius: CELSIUS.into(),
        };
        robstride::encode_feedback(ROBSTRIDE_HOST, &reply, &self.limits)
    }
}
