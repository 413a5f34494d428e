//! Moves an AK motor in MIT mode. A disabled motor is polled with the command that disables it.

use super::TMotor;
use super::codec::{self, Fault, StateCommand};
use crate::Error;
use crate::can::family::{Health, MotionProtocol};
use crate::can::query::MotorQuery;
use crate::can::watchdog::WatchdogPlan;
use crate::wire::can::mit::{Command, Limits};
use crate::wire::can::{CanError, Frame};

/// An AK motor that may be moved.
#[derive(Debug)]
pub(super) struct TMotorMotion {
    pub(super) address: TMotor,
    pub(super) limits: Limits,
}

impl MotionProtocol for TMotorMotion {
    fn switch_off(&self, query: &MotorQuery<'_>) -> Result<(), Error> {
        // The motor does not report whether it is enabled. Its answer only shows that it has
        // received the command, which also clears faults.
        let disable = query.map_error(self.release())?;
        query
            .request_answer(&disable, |frame| self.address.feedback(frame, &self.limits))
            .map(drop)
    }

    fn set_watchdog(&self, _query: &MotorQuery<'_>, _plan: &WatchdogPlan) -> Result<(), Error> {
        Ok(())
    }

    fn set_mode(&self, _query: &MotorQuery<'_>, _plan: &WatchdogPlan) -> Result<(), Error> {
        Ok(())
    }

    fn poll_disabled(&self) -> Option<Frame> {
        self.release().ok()
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
        // The motor does not report whether it is enabled.
        Some(match reported.health.map(|health| health.fault) {
            // Firmware of 2020 and earlier reports no faults. With such firmware, a motor that has
            // stopped is detected by its following error.
            None | Some(Fault::None) => Health::Enabled,
            Some(fault) => Health::Fault(format!("the motor stopped: {fault:?}")),
        })
    }
}
