//! Moves a Damiao motor in MIT mode.

use super::Damiao;
use super::codec::{self, Access, Register, RegisterMessage, StateCommand, Status, Value};
use crate::Error;
use crate::can::family::{COMMUNICATION_LOST, Health, MotionProtocol};
use crate::can::query::MotorQuery;
use crate::can::watchdog::WatchdogPlan;
use crate::wire::can::mit::{Command, Limits};
use crate::wire::can::{CanError, Frame};

/// A Damiao motor that may be moved.
#[derive(Debug)]
pub(super) struct DamiaoMotion {
    pub(super) address: Damiao,
    pub(super) limits: Limits,
}

impl DamiaoMotion {
    /// Writes a register and reads it back.
    fn set(
        &self,
        query: &MotorQuery<'_>,
        register: Register,
        value: Value,
    ) -> Result<Value, Error> {
        let message = RegisterMessage {
            motor: self.address.motor,
            access: Access::Write(register, value),
        };
        query.send(codec::encode_register(&message, None))?;
        self.address.register(query, register)
    }
}

impl MotionProtocol for DamiaoMotion {
    fn switch_off(&self, query: &MotorQuery<'_>) -> Result<(), Error> {
        // The command to clear a fault is sent only if there is a fault, so that the fault can be
        // logged first. A motor whose fault was cleared may be enabled, so it is disabled again.
        let mut status = Status::Enabled;
        for state_command in [
            StateCommand::Disable,
            StateCommand::ClearError,
            StateCommand::Disable,
        ] {
            status = query.request_answer(
                &query.map_error(codec::encode_state_command(
                    self.address.motor,
                    state_command,
                ))?,
                |frame| {
                    self.address
                        .feedback(frame, &self.limits)
                        .map(|reported| reported.status)
                },
            )?;
            if status == Status::Disabled {
                return Ok(());
            }
            log::warn!("{}: the motor reports {status:?}", query.name());
        }
        Err(query.not_disabled(&format!("{status:?}")))
    }

    fn set_watchdog(&self, query: &MotorQuery<'_>, plan: &WatchdogPlan) -> Result<(), Error> {
        let requested =
            Value::Integer(query.map_error(codec::timeout_ticks(plan.timeout.as_secs_f64()))?);
        match self.set(query, Register::Timeout, requested)? {
            reported if reported == requested => Ok(()),
            reported => Err(query.timeout_mismatch(plan.timeout, &format!("{reported:?} ticks"))),
        }
    }

    fn set_mode(&self, query: &MotorQuery<'_>, _plan: &WatchdogPlan) -> Result<(), Error> {
        let requested = Value::Integer(codec::MIT_MODE);
        match self.set(query, Register::ControlMode, requested)? {
            reported if reported == requested => Ok(()),
            reported => Err(query.mode_mismatch(&format!("{reported:?}"))),
        }
    }

    fn enable(&self) -> Result<Vec<Frame>, CanError> {
        Ok(vec![codec::encode_state_command(
            self.address.motor,
            StateCommand::Enable,
        )?])
    }

    fn command(&self, command: &Command) -> Result<Frame, CanError> {
        codec::encode_command(self.address.motor, command, &self.limits)
    }

    fn release(&self) -> Result<Frame, CanError> {
        codec::encode_state_command(self.address.motor, StateCommand::Disable)
    }

    fn health(&mut self, frame: &Frame) -> Option<Health> {
        let reported = self.address.feedback(frame, &self.limits)?;
        Some(match reported.status {
            Status::Disabled => Health::Off,
            Status::Enabled => Health::Enabled,
            Status::LostCommunication => Health::Fault(COMMUNICATION_LOST.to_owned()),
            status => Health::Fault(format!("the motor stopped: {status:?}")),
        })
    }
}
