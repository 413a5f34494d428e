//! Requests to one motor and its answers, for use before the cycle starts, while nothing else reads the bus.

use super::ROBSTRIDE_HOST;
use super::frame_io::{BusEvent, FrameIo, WireErrors};
use crate::wire::can::canopen::{self, Object, SdoAnswer};
use crate::wire::can::damiao::{self, Access, Register, RegisterMessage};
use crate::wire::can::mit::Limits;
use crate::wire::can::robstride::{self, Parameter, Request};
use crate::wire::can::{CanError, Frame, Id, odrive};
use crate::{Error, clock};
use std::cell::Cell;
use std::time::Duration;

/// Maximum time for an answer. On a full bus at 1 Mbit/s a frame waits for some milliseconds.
const MAX_ANSWER: Duration = Duration::from_millis(50);
/// Number of requests before the motor counts as silent.
const MAX_ATTEMPTS: usize = 4;

/// Request-response access to one motor.
pub(super) struct MotorQuery<'a> {
    bus: &'a dyn FrameIo,
    joint: &'a str,
    errors: Cell<WireErrors>,
}

impl<'a> MotorQuery<'a> {
    /// Access to the motor of a joint.
    pub(super) fn new(bus: &'a dyn FrameIo, joint: &'a str) -> Self {
        Self { bus, joint, errors: Cell::default() }
    }

    pub(super) fn name(&self) -> String {
        format!("joint {:?} on {:?}", self.joint, self.bus.interface())
    }

    pub(super) fn fault(&self, reason: impl Into<String>) -> Error {
        let interface = self.bus.interface().to_owned();
        Error::Motor { joint: self.joint.to_owned(), interface, reason: reason.into() }
    }

    /// Converts the error of a codec to an error of this motor.
    pub(super) fn map_error<T>(&self, result: Result<T, CanError>) -> Result<T, Error> {
        result.map_err(|error| self.fault(error.to_string()))
    }

    /// Sends an encoded frame.
    pub(super) fn send(&self, frame: Result<Frame, CanError>) -> Result<(), Error> {
        let frame = self.map_error(frame)?;
        match self.bus.send(&frame)? {
            true => Ok(()),
            false => Err(self.fault("cannot send: the interface's queue stays full")),
        }
    }

    /// Returns the first result of `matches` on a received frame, or `None` if there is none within the time limit.
    pub(super) fn wait<T>(
        &self,
        timeout_limit: Duration,
        mut matches: impl FnMut(&Frame) -> Option<T>,
    ) -> Result<Option<T>, Error> {
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
    pub(super) fn request_answer<T>(
        &self,
        poll_frame: &Frame,
        mut matches: impl FnMut(&Frame) -> Option<T>,
    ) -> Result<T, Error> {
        for _ in 0..MAX_ATTEMPTS {
            self.bus.send(poll_frame)?;
            if let Some(answer) = self.wait(MAX_ANSWER, &mut matches)? {
                return Ok(answer);
            }
        }
        let errors = self.errors.get();
        // Not every controller's driver reports unacknowledged frames, but all report the resulting state of the
        // error counters.
        Err(self.fault(match errors.n_unacknowledged + errors.n_passive + errors.n_bus_off {
            0 => format!("no answer to {MAX_ATTEMPTS} requests; check that the motor is powered and its id is correct"),
            _ => "no node acknowledges frames: the other nodes are off or use another bit rate, or the bus is cut or not terminated"
                .to_owned(),
        }))
    }

    /// Reads a register of a Damiao motor.
    pub(super) fn register(&self, motor: u16, feedback: u16, register: Register) -> Result<damiao::Value, Error> {
        let poll_frame = RegisterMessage { motor, access: Access::Read(register) };
        let poll_frame = self.map_error(damiao::encode_register(&poll_frame, None))?;
        let answer_id = self.map_error(Id::standard(feedback.into()))?;
        self.request_answer(&poll_frame, |frame| match damiao::decode_register(frame) {
            Ok(RegisterMessage { motor: from, access: Access::Reported(reported, value) })
                if frame.id() == answer_id && from == motor && reported == register =>
            {
                Some(value)
            }
            _ => None,
        })
    }

    /// Sends a request to a Robstride motor.
    pub(super) fn robstride(&self, motor: u8, request: &Request, limits: &Limits) -> Result<(), Error> {
        self.send(robstride::encode_request(ROBSTRIDE_HOST, motor, request, limits))
    }

    /// Reads a parameter of a Robstride motor.
    pub(super) fn parameter(
        &self,
        motor: u8,
        parameter: Parameter,
        limits: &Limits,
    ) -> Result<robstride::Value, Error> {
        let poll_frame = robstride::encode_request(ROBSTRIDE_HOST, motor, &Request::Read(parameter), limits);
        self.request_answer(&self.map_error(poll_frame)?, |frame| {
            match robstride::decode_answer(frame, ROBSTRIDE_HOST, limits) {
                Ok(robstride::Answer::Parameter { motor: from, parameter: reported, value }) => {
                    (from == motor && reported == parameter).then_some(value)
                }
                _ => None,
            }
        })
    }

    /// Sends a request to an `ODrive` axis, and returns its answer.
    pub(super) fn axis<T>(
        &self,
        node: odrive::Node,
        request: &odrive::Request,
        matches: impl Fn(odrive::Answer) -> Option<T>,
    ) -> Result<T, Error> {
        let poll_frame = self.map_error(odrive::encode_request(node, request))?;
        self.request_answer(&poll_frame, |frame| match odrive::decode_answer(frame) {
            Ok((from, answer)) if from == node => matches(answer),
            _ => None,
        })
    }

    /// Reads an object of a CANopen node; the upper bytes are 0 if it is shorter.
    pub(super) fn get(&self, node: canopen::Node, object: Object) -> Result<u32, Error> {
        let answer =
            self.request_answer(&canopen::encode_read(node, object), |frame| match canopen::decode_sdo(frame) {
                Ok((from, SdoAnswer::Value { object: reported, raw })) => (from == node
                    && (reported.index, reported.subindex) == (object.index, object.subindex))
                    .then_some(Ok(raw)),
                Err(error @ (CanError::Aborted { index, .. } | CanError::Segmented { index, .. })) => {
                    (index == object.index).then_some(Err(error))
                }
                _ => None,
            })?;
        self.map_error(answer)
    }

    /// Writes an object of a CANopen node and verifies it.
    pub(super) fn set_and_check(&self, node: canopen::Node, object: Object, value: i64) -> Result<(), Error> {
        self.set(node, object, value)?;
        let bits = u32::MAX >> (32 - 8 * u32::from(object.n_bytes));
        let reported = self.get(node, object)? & bits;
        match i64::from(reported) == value & i64::from(bits) {
            true => Ok(()),
            false => Err(self.fault(format!(
                "object {:#06x}:{:02x} was set to {value} but reads back as {reported:#x}",
                object.index, object.subindex
            ))),
        }
    }

    /// Writes an object of a CANopen node.
    pub(super) fn set(&self, node: canopen::Node, object: Object, value: i64) -> Result<(), Error> {
        let answer = self.try_set(node, object, value)?;
        self.map_error(answer)
    }

    /// Like [`MotorQuery::set`], but returns a refusal of the node as the inner error.
    pub(super) fn try_set(
        &self,
        node: canopen::Node,
        object: Object,
        value: i64,
    ) -> Result<Result<(), CanError>, Error> {
        let poll_frame = self.map_error(canopen::encode_write(node, object, value))?;
        self.request_answer(&poll_frame, |frame| match canopen::decode_sdo(frame) {
            Ok((from, SdoAnswer::Written { index, subindex })) => {
                (from == node && (index, subindex) == (object.index, object.subindex)).then_some(Ok(()))
            }
            Err(error @ CanError::Aborted { index, .. }) => (index == object.index).then_some(Err(error)),
            _ => None,
        })
    }
}
