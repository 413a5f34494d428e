//! An emulated Robstride motor.

use super::HOST;
use super::codec::{self, Faults, Mode, Parameter};
use crate::can::emulated::{Actuation, CELSIUS, EmulatedDrive, EmulatedProtocol, State};
use crate::wire::can::{CanError, Frame, Id};
use std::time::Duration;

const OVERLOAD: u32 = Faults::OVERLOAD as u32;
/// Ticks per second in which the timeout of the motor is given.
const TICKS_HZ: f64 = 20_000.0;

#[derive(Debug)]
pub(super) struct EmulatedRobstride {
    pub(super) motor: u8,
    /// Whether the motor sends periodic reports.
    pub(super) reports: bool,
}

impl EmulatedProtocol for EmulatedRobstride {
    fn take(&mut self, frame: &Frame, drive: &mut EmulatedDrive) -> Result<Vec<Frame>, CanError> {
        let id = frame.id();
        let [kind, _, host, to] = id.value().to_be_bytes();
        let Ok(bytes) = <[u8; 8]>::try_from(frame.data()) else {
            return Ok(Vec::new());
        };
        if !id.is_extended() || frame.is_remote() || to != self.motor {
            return Ok(Vec::new());
        }
        let [low, high, _, _, a, b, c, d] = bytes;
        let parameter = u32::from(u16::from_le_bytes([low, high]));
        match kind {
            0 => {
                let id = Id::extended(u32::from(self.motor) << 8 | 0xFE)?;
                return Ok(vec![Frame::classic(id, &[self.motor; 8])?]);
            }
            1 => {
                // In other modes, the motor ignores motion commands. Motion mode is the factory
                // setting.
                let command = codec::decode_move(frame, self.motor, &drive.limits);
                if drive
                    .setting(Parameter::RunMode as u32)
                    .is_none_or(|mode| mode == codec::MOTION_MODE)
                {
                    command.into_iter().for_each(|command| drive.obey(command));
                }
            }
            3 if drive.faults == 0 => drive.switch_on(),
            4 => {
                drive.actuation = Actuation::Free;
                if low == 1 {
                    drive.faults = 0;
                }
            }
            17 => {
                let [a, b, c, d] = drive.setting(parameter).unwrap_or(0).to_le_bytes();
                let id = Id::extended(17 << 24 | u32::from(self.motor) << 8 | u32::from(host))?;
                return Ok(vec![Frame::classic(id, &[low, high, 0, 0, a, b, c, d])?]);
            }
            18 => {
                let is_timeout = parameter == Parameter::Timeout as u32;
                drive.set(parameter, u32::from_le_bytes([a, b, c, d]), is_timeout);
            }
            24 => {
                self.reports = bytes[6] == 1;
                return Ok(Vec::new());
            }
            _ => return Ok(Vec::new()),
        }
        Ok(vec![self.feedback(drive, false)?])
    }

    fn reports(&self) -> bool {
        self.reports
    }

    fn report(&self, drive: &EmulatedDrive) -> Result<Option<Frame>, CanError> {
        self.feedback(drive, true).map(Some)
    }

    fn timeout(&self, drive: &EmulatedDrive) -> Option<Duration> {
        let ticks = drive
            .setting(Parameter::Timeout as u32)
            .filter(|ticks| *ticks > 0)?;
        Some(Duration::from_secs_f64(f64::from(ticks) / TICKS_HZ))
    }

    fn fail(&mut self, drive: &mut EmulatedDrive) {
        drive.faults = OVERLOAD;
    }
}

impl EmulatedRobstride {
    fn feedback(&self, drive: &EmulatedDrive, is_unsolicited: bool) -> Result<Frame, CanError> {
        let reply = codec::Feedback {
            motor: self.motor,
            is_unsolicited,
            mode: if drive.state() == State::Enabled {
                Mode::Run
            } else {
                Mode::Reset
            },
            faults: Faults(drive.faults.to_le_bytes()[0]),
            motion: drive.motion(),
            winding_celsius: CELSIUS.into(),
        };
        codec::encode_feedback(HOST, &reply, &drive.limits)
    }
}
