//! An emulated `ODrive` axis. It follows target positions with its own position loop. Its watchdog
//! also runs while the axis is idle.

use super::Endpoints;
use super::codec::{self, Answer, Code, Node};
use crate::can::emulated::{Actuation, EmulatedDrive, EmulatedProtocol, State};
use crate::wire::can::mit::{Command, Motion};
use crate::wire::can::{CanError, Frame};
use std::f64::consts::TAU;
use std::time::Duration;

/// Error bit that the emulated axis reports on a failure.
const CURRENT_LIMIT: u32 = 1 << 12;
const HARDWARE: [u8; 3] = [4, 4, 58];
const FIRMWARE: [u8; 3] = [0, 6, 9];
const WATCHDOG_TIMEOUT: u16 = 218;
const ENABLE_WATCHDOG: u16 = 219;

/// Endpoint numbers of emulated axes.
pub fn endpoints() -> Endpoints {
    let dotted = |version: [u8; 3]| version.map(|part| part.to_string()).join(".");
    Endpoints {
        firmware: dotted(FIRMWARE),
        hardware: dotted(HARDWARE),
        watchdog_timeout: WATCHDOG_TIMEOUT,
        enable_watchdog: ENABLE_WATCHDOG,
    }
}

/// Changes the state of an axis to idle (1) or closed-loop control (8). Other states are ignored.
fn request_state(data: &[u8], drive: &mut EmulatedDrive) {
    match data {
        [1, 0, 0, 0] => drive.actuation = Actuation::Free,
        [8, 0, 0, 0] if drive.faults == 0 => {
            // The axis starts at its current position, whatever position was requested before.
            let position_rad = drive.motion().position_rad;
            drive.actuation = Actuation::Follow(Command {
                position_rad,
                ..Command::default()
            });
        }
        _ => {}
    }
}

#[derive(Debug)]
pub(super) struct EmulatedOdrive {
    pub(super) node: Node,
}

impl EmulatedProtocol for EmulatedOdrive {
    fn take(&mut self, frame: &Frame, drive: &mut EmulatedDrive) -> Result<Vec<Frame>, CanError> {
        let id = frame.id();
        if id.is_extended() || id.value() >> 5 != u32::from(self.node.number()) {
            return Ok(Vec::new());
        }
        let is_object = |code: Code| id.value() & 0x1F == code as u32;
        // A remote frame requests a message. Of the messages that nodes do not send periodically,
        // the driver needs only the version.
        if frame.is_remote() {
            let version = Answer::Version {
                hardware: HARDWARE,
                firmware: FIRMWARE,
            };
            return if is_object(Code::Version) {
                Ok(vec![codec::encode_answer(self.node, &version)?])
            } else {
                Ok(Vec::new())
            };
        }
        if is_object(Code::SetState) {
            request_state(frame.data(), drive);
        } else if is_object(Code::ClearErrors) {
            drive.faults = 0;
        } else if is_object(Code::SetPosition) {
            let &[a, b, c, d, e, f, ..] = frame.data() else {
                return Ok(Vec::new());
            };
            let command = Command {
                position_rad: f64::from(f32::from_le_bytes([a, b, c, d])) * TAU,
                velocity_rad_s: f64::from(i16::from_le_bytes([e, f])) * 1e-3 * TAU,
                ..Command::default()
            };
            // An idle axis does not remember targets.
            if drive.state() == State::Enabled {
                drive.actuation = Actuation::Follow(command);
                drive.target = Some(command);
            }
        } else if is_object(Code::EndpointRequest) {
            let &[operation, low, high, _, a, b, c, d] = frame.data() else {
                return Ok(Vec::new());
            };
            let number = u16::from_le_bytes([low, high]);
            if operation == 1 {
                drive.set(
                    number.into(),
                    u32::from_le_bytes([a, b, c, d]),
                    number == WATCHDOG_TIMEOUT,
                );
            } else {
                let value = drive.setting(number.into()).unwrap_or(0).to_le_bytes();
                return Ok(vec![codec::encode_answer(
                    self.node,
                    &Answer::Endpoint(number, value),
                )?]);
            }
        }
        // Any frame to the axis resets its watchdog.
        drive.reset_watchdog();
        Ok(Vec::new())
    }

    fn reports(&self) -> bool {
        true
    }

    fn report(&self, drive: &EmulatedDrive) -> Result<Option<Frame>, CanError> {
        let Motion {
            position_rad,
            velocity_rad_s,
            ..
        } = drive.motion();
        codec::encode_answer(
            self.node,
            &Answer::Motion {
                position_rad,
                velocity_rad_s,
            },
        )
        .map(Some)
    }

    fn heartbeat(&self, drive: &EmulatedDrive) -> Result<Option<Frame>, CanError> {
        let state = match drive.state() {
            State::Enabled => codec::State::ClosedLoopControl,
            State::Free | State::Holding => codec::State::Idle,
        };
        codec::encode_answer(
            self.node,
            &Answer::Heartbeat {
                errors: drive.faults,
                state,
            },
        )
        .map(Some)
    }

    fn timeout(&self, drive: &EmulatedDrive) -> Option<Duration> {
        let is_on = drive
            .setting(ENABLE_WATCHDOG.into())
            .is_some_and(|bytes| bytes & 1 == 1);
        let secs = f32::from_bits(drive.setting(WATCHDOG_TIMEOUT.into()).unwrap_or(0));
        if is_on {
            Duration::try_from_secs_f32(secs).ok()
        } else {
            None
        }
    }

    fn time_out(&mut self, drive: &mut EmulatedDrive) {
        drive.faults |= codec::WATCHDOG_TIMER_EXPIRED;
        drive.actuation = Actuation::Free;
    }

    fn fail(&mut self, drive: &mut EmulatedDrive) {
        drive.faults = CURRENT_LIMIT;
    }
}
