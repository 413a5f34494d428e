//! Sends requests to one motor and waits for the answers. It is used before the cycle starts, while
//! nothing else reads the bus.

use super::frame_io::{BusEvent, FrameIo, WireErrors};
use crate::wire::can::{CanError, Frame};
use crate::{Error, clock};
use std::cell::Cell;
use std::time::Duration;

/// Maximum time for an answer. On a full bus at 1 Mbit/s, a frame waits for some milliseconds. With
/// a longer time, the error about a missing motor would come later.
const MAX_ANSWER: Duration = Duration::from_millis(50);
/// Number of requests before the motor counts as silent. Repeating a request is harmless, because
/// all requests set or read absolute values. A single lost frame must not fail the set-up of an arm
/// with many motors.
const MAX_ATTEMPTS: usize = 4;

/// Request-response access to one motor.
pub struct MotorQuery<'a> {
    bus: &'a dyn FrameIo,
    joint: &'a str,
    errors: Cell<WireErrors>,
}

impl<'a> MotorQuery<'a> {
    /// Creates access to the motor of a joint.
    pub fn new(bus: &'a dyn FrameIo, joint: &'a str) -> Self {
        Self {
            bus,
            joint,
            errors: Cell::default(),
        }
    }

    /// Name of the motor in messages.
    pub fn name(&self) -> String {
        format!("joint {:?} on {:?}", self.joint, self.bus.interface())
    }

    /// Creates an error of this motor.
    pub fn fault(&self, reason: impl Into<String>) -> Error {
        let interface = self.bus.interface().to_owned();
        Error::Motor {
            joint: self.joint.to_owned(),
            interface,
            reason: reason.into(),
        }
    }

    /// Creates the error for a motor that does not report that it is disabled.
    pub fn not_disabled(&self, reported: &str) -> Error {
        self.fault(format!(
            "the motor was disabled but does not report it: {reported}"
        ))
    }

    /// Creates the error for a watchdog timeout that was not accepted.
    pub fn timeout_mismatch(&self, timeout: Duration, reported: &str) -> Error {
        let seconds = timeout.as_secs_f64();
        self.fault(format!("its timeout was set to {seconds} s but reads back as {reported}; the motor is not enabled"))
    }

    /// Creates the error for a control mode that was not accepted.
    pub fn mode_mismatch(&self, reported: &str) -> Error {
        self.fault(format!("its mode was set but reads back as {reported}"))
    }

    /// Converts the error of a codec to an error of this motor.
    pub fn map_error<T>(&self, result: Result<T, CanError>) -> Result<T, Error> {
        result.map_err(|error| self.fault(error.to_string()))
    }

    /// Sends an encoded frame.
    pub fn send(&self, frame: Result<Frame, CanError>) -> Result<(), Error> {
        let frame = self.map_error(frame)?;
        if self.bus.send(&frame)? {
            Ok(())
        } else {
            Err(self.fault("cannot send: the interface's queue stays full"))
        }
    }

    /// Returns the first result of `matches` on a received frame, or `None` if there is none within
    /// the time limit.
    pub fn wait<T>(
        &self,
        timeout_limit: Duration,
        mut matches: impl FnMut(&Frame) -> Option<T>,
    ) -> Result<Option<T>, Error> {
        // Other nodes keep sending, so frames that do not match must not extend the wait.
        let deadline = clock::now() + timeout_limit;
        loop {
            let remaining = deadline.duration_since(clock::now());
            if remaining.is_zero() {
                return Ok(None);
            }
            match self.bus.receive(remaining)? {
                Some((_, BusEvent::Frame(frame))) => {
                    if let Some(answer) = matches(&frame) {
                        return Ok(Some(answer));
                    }
                }
                Some((_, BusEvent::Errors(new_errors))) => {
                    let mut errors = self.errors.get();
                    errors.add(&new_errors);
                    self.errors.set(errors);
                }
                None => {}
            }
        }
    }

    /// Sends a request repeatedly until an answer arrives, up to a maximum number of attempts.
    pub fn request_answer<T>(
        &self,
        poll_frame: &Frame,
        mut matches: impl FnMut(&Frame) -> Option<T>,
    ) -> Result<T, Error> {
        for _ in 0..MAX_ATTEMPTS {
            // A full queue is not an error here. If the frame was not sent, no answer arrives, and
            // the next attempt sends it again.
            self.bus.send(poll_frame)?;
            if let Some(answer) = self.wait(MAX_ANSWER, &mut matches)? {
                return Ok(answer);
            }
        }
        let errors = self.errors.get();
        // Not every driver of a CAN controller reports unacknowledged frames, but all report the
        // resulting state of the error counters.
        Err(self.fault(match errors.n_unacknowledged + errors.n_passive + errors.n_bus_off {
            0 => format!("no answer to {MAX_ATTEMPTS} requests; check that the motor is powered and its id is correct"),
            _ => "no node acknowledges frames: the other nodes are off or use another bit rate, or the bus is cut or not terminated"
                .to_owned(),
        }))
    }
}
