//! An emulated T-Motor AK motor in MIT mode.

use super::codec::{self, Fault, Health, Thermometer};
use crate::can::emulated::{Actuation, CELSIUS, EmulatedDrive, EmulatedProtocol};
use crate::wire::can::{CanError, Frame, Id, mit};
use std::time::Duration;

const OVER_CURRENT: u32 = Fault::OverCurrent as u32;

#[derive(Debug)]
pub(super) struct EmulatedTMotor {
    pub(super) motor: u8,
}

impl EmulatedProtocol for EmulatedTMotor {
    /// Processes a frame. The motor answers every frame that is addressed to it.
    fn take(&mut self, frame: &Frame, drive: &mut EmulatedDrive) -> Result<Vec<Frame>, CanError> {
        let Ok(bytes) = <[u8; 8]>::try_from(frame.data()) else {
            return Ok(Vec::new());
        };
        if frame.id() != Id::standard(self.motor.into())? {
            return Ok(Vec::new());
        }
        match bytes {
            [
                0xFF,
                0xFF,
                0xFF,
                0xFF,
                0xFF,
                0xFF,
                0xFF,
                state_command @ 0xFC..=0xFE,
            ] => match state_command {
                0xFC if drive.faults == 0 => drive.switch_on(),
                0xFD => {
                    drive.actuation = Actuation::Free;
                    drive.faults = 0;
                }
                _ => {}
            },
            command => drive.obey(mit::decode(&command, &drive.limits)),
        }
        // Every frame gets an answer, even if it is ignored, because a driver polls with the
        // command that disables the motor.
        let fault = if drive.faults == 0 {
            Fault::None
        } else {
            Fault::OverCurrent
        };
        let health = Some(Health {
            drive_celsius: CELSIUS.into(),
            fault,
        });
        let reply = codec::Feedback {
            motor: self.motor,
            motion: drive.motion(),
            health,
        };
        Ok(vec![codec::encode_feedback(
            0,
            &reply,
            &drive.limits,
            Thermometer::Offset40,
        )?])
    }

    fn timeout(&self, _drive: &EmulatedDrive) -> Option<Duration> {
        None
    }

    fn fail(&mut self, drive: &mut EmulatedDrive) {
        drive.faults = OVER_CURRENT;
    }
}
