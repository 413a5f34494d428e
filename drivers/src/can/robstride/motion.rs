//! Moves a Robstride motor in motion mode.

use super::codec::{self, Answer, Faults, Mode, Parameter, Request, Value};
use super::{HOST, Robstride};
use crate::Error;
use crate::can::family::{Health, MAX_CHANGE, MotionProtocol};
use crate::can::query::MotorQuery;
use crate::can::watchdog::WatchdogPlan;
use crate::wire::can::mit::{Command, Limits};
use crate::wire::can::{CanError, Frame};

/// A Robstride motor that may be moved.
#[derive(Debug)]
pub(super) struct RobstrideMotion {
    pub(super) address: Robstride,
    pub(super) limits: Limits,
}

impl RobstrideMotion {
    fn encode(&self, request: &Request) -> Result<Frame, CanError> {
        codec::encode_request(HOST, self.address.motor, request, &self.limits)
    }

    /// Writes a parameter and reads it back.
    fn set(
        &self,
        query: &MotorQuery<'_>,
        parameter: Parameter,
        value: Value,
    ) -> Result<Value, Error> {
        self.address
            .send(query, &Request::Write(parameter, value), &self.limits)?;
        self.address.parameter(query, parameter, &self.limits)
    }
}

impl MotionProtocol for RobstrideMotion {
    fn switch_off(&self, query: &MotorQuery<'_>) -> Result<(), Error> {
        self.address
            .send(query, &Request::Stop { clear_fault: true }, &self.limits)?;
        // The answer to the stop and the periodic reports have the same content, and an earlier
        // report may still be queued. The wait ends at the first message that shows the new state.
        let mut last = None;
        let off = query.wait(MAX_CHANGE, |frame| {
            let reported = self.address.feedback(frame, &self.limits)?;
            last = Some((reported.mode, reported.faults));
            (last == Some((Mode::Reset, Faults(0)))).then_some(())
        })?;
        off.ok_or_else(|| query.not_disabled(&format!("{last:?}")))
    }

    fn set_watchdog(&self, query: &MotorQuery<'_>, plan: &WatchdogPlan) -> Result<(), Error> {
        let requested = query.map_error(codec::timeout(plan.timeout.as_secs_f64()))?;
        match self.set(query, Parameter::Timeout, requested)? {
            reported if reported == requested => Ok(()),
            reported => Err(query.timeout_mismatch(plan.timeout, &format!("{reported:?} ticks"))),
        }
    }

    fn set_mode(&self, query: &MotorQuery<'_>, _plan: &WatchdogPlan) -> Result<(), Error> {
        let requested = Value::Integer(codec::MOTION_MODE);
        match self.set(query, Parameter::RunMode, requested)? {
            reported if reported == requested => Ok(()),
            reported => Err(query.mode_mismatch(&format!("{reported:?}"))),
        }
    }

    fn enable(&self) -> Result<Vec<Frame>, CanError> {
        Ok(vec![self.encode(&Request::Enable)?])
    }

    fn command(&self, command: &Command) -> Result<Frame, CanError> {
        self.encode(&Request::Move(*command))
    }

    fn release(&self) -> Result<Frame, CanError> {
        // A fault stays set until a person recovers the arm, so that its reason can still be read.
        self.encode(&Request::Stop { clear_fault: false })
    }

    fn health(&mut self, frame: &Frame) -> Option<Health> {
        match codec::decode_answer(frame, HOST, &self.limits) {
            Ok(Answer::Feedback(reported)) if reported.motor == self.address.motor => {
                Some(match (reported.mode, reported.faults) {
                    (Mode::Run, Faults(0)) => Health::Enabled,
                    // A motor whose watchdog has expired is in its reset mode without any fault
                    // bit.
                    (_, Faults(0)) => Health::Off,
                    (_, Faults(bits)) => {
                        Health::Fault(format!("the motor reports the fault bits {bits:#08b}"))
                    }
                })
            }
            Ok(Answer::Fault {
                motor: from,
                faults,
                ..
            }) if from == self.address.motor && faults != 0 => Some(Health::Fault(format!(
                "the motor reports the faults {faults:#x}"
            ))),
            _ => None,
        }
    }
}
