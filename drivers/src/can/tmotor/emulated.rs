//! An emulated T-Motor AK motor in MIT mode.

use super::shaft::Actuation;
use super::{CELSIUS, EmulatedMotor};
use crate::wire::can::tmotor::{self, Fault, Health, Thermometer};
use crate::wire::can::{CanError, Frame, Id, mit};

pub(super) const OVER_CURRENT: u32 = Fault::OverCurrent as u32;

impl EmulatedMotor {
    /// Processes a frame. The motor answers every frame that is addressed to it.
    pub(super) fn handle_tmotor(&mut self, frame: &Frame, motor: u8) -> Result<Vec<Frame>, CanError> {
        let Ok(bytes) = <[u8; 8]>::try_from(frame.data()) else { return Ok(Vec::new()) };
        if frame.id() != Id::standard(motor.into())? {
            return Ok(Vec::new());
        }
        match bytes {
            [0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, state_command @ 0xFC..=0xFE] => match state_command {
                0xFC if self.faults == 0 => self.switch_on(),
                0xFD => {
                    self.actuation = Actuation::Free;
                    self.faults = 0;
                }
                _ => {}
            },
            command => self.obey(mit::decode(&command, &self.limits)),
        }
        let fault = if self.faults == 0 { Fault::None } else { Fault::OverCurrent };
        let health = Some(Health { drive_celsius: CELSIUS.into(), fault });
        let reply = tmotor::Feedback { motor, motion: self.shaft.motion, health };
        Ok(vec![tmotor::encode_feedback(0, &reply, &self.limits, Thermometer::Offset40)?])
    }
}
