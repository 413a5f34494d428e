//! The motor's side of a family's protocol.

use super::drive::EmulatedDrive;
use super::shaft::Actuation;
use crate::wire::can::{CanError, Frame};
use std::fmt::Debug;
use std::time::Duration;

/// The motor's side of a protocol, for one motor.
pub trait EmulatedProtocol: Debug + Send {
    /// Processes a frame, and returns the answers. There are no answers if the frame is not
    /// addressed to this motor.
    ///
    /// # Errors
    /// If the protocol cannot encode an answer.
    fn take(&mut self, frame: &Frame, drive: &mut EmulatedDrive) -> Result<Vec<Frame>, CanError>;
    /// Whether the motor reports periodically.
    fn reports(&self) -> bool {
        false
    }
    /// The periodic report, if there is one.
    fn report(&self, _drive: &EmulatedDrive) -> Result<Option<Frame>, CanError> {
        Ok(None)
    }
    /// The heartbeat, if there is one.
    fn heartbeat(&self, _drive: &EmulatedDrive) -> Result<Option<Frame>, CanError> {
        Ok(None)
    }
    /// Timeout of the watchdog; `None` if it never expires.
    fn timeout(&self, drive: &EmulatedDrive) -> Option<Duration>;
    /// Reaction to the expiry of the watchdog.
    fn time_out(&mut self, drive: &mut EmulatedDrive) {
        drive.actuation = Actuation::Free;
    }
    /// Reports a fault; the shaft has been released.
    fn fail(&mut self, drive: &mut EmulatedDrive);
}
