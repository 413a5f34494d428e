//! Moves an `ODrive` axis in position mode.

use super::codec::{self, Answer, Code, Control, Node, Request, State};
use super::endpoints::Endpoints;
use crate::Error;
use crate::can::family::{COMMUNICATION_LOST, Health, MAX_CHANGE, MotionProtocol};
use crate::can::query::MotorQuery;
use crate::can::watchdog::WatchdogPlan;
use crate::wire::can::mit::Command;
use crate::wire::can::{CanError, Frame};
use std::time::Duration;

/// Longest interval between reports of an axis. Encoder messages come every 10 ms by default. The
/// limit tolerates a few lost messages and axes that are set to a lower rate.
const MAX_REPORT_INTERVAL: Duration = Duration::from_millis(50);

/// An `ODrive` axis that may be moved.
#[derive(Debug)]
pub(super) struct OdriveMotion {
    pub(super) node: Node,
    pub(super) endpoints: Option<Endpoints>,
}

impl OdriveMotion {
    fn encode(&self, request: &Request) -> Result<Frame, CanError> {
        codec::encode_request(self.node, request)
    }

    /// Sends a request, and returns the answer.
    fn ask<T>(
        &self,
        query: &MotorQuery<'_>,
        request: &Request,
        matches: impl Fn(Answer) -> Option<T>,
    ) -> Result<T, Error> {
        let poll_frame = query.map_error(self.encode(request))?;
        query.request_answer(&poll_frame, |frame| match codec::decode_answer(frame) {
            Ok((from, answer)) if from == self.node => matches(answer),
            _ => None,
        })
    }

    /// Checks that the endpoint numbers belong to the firmware of the axis.
    fn check_endpoints(&self, query: &MotorQuery<'_>, endpoints: &Endpoints) -> Result<(), Error> {
        // As in `can_restore_config.py` of ODrive, this comes before any write.
        let (hardware, firmware) =
            self.ask(query, &Request::Ask(Code::Version), |answer| match answer {
                Answer::Version { hardware, firmware } => Some((hardware, firmware)),
                _ => None,
            })?;
        if endpoints.match_versions(hardware, firmware) {
            Ok(())
        } else {
            Err(query.fault(format!(
                "it runs firmware {firmware:?} on hardware {hardware:?}, but arm.motion.odrive_endpoints is for firmware {} on hardware {}",
                endpoints.firmware, endpoints.hardware
            )))
        }
    }
}

impl MotionProtocol for OdriveMotion {
    fn switch_off(&self, query: &MotorQuery<'_>) -> Result<(), Error> {
        for request in [Request::SetState(State::Idle), Request::ClearErrors] {
            query.send(self.encode(&request))?;
        }
        // Neither of these requests is answered, but the heartbeat reports state and errors.
        let mut last = None;
        let off = query.wait(MAX_CHANGE, |frame| match codec::decode_answer(frame) {
            Ok((from, Answer::Heartbeat { errors, state })) if from == self.node => {
                // A watchdog that is still enabled from an earlier run expires again while the axis
                // is idle, so this error may be set at any time.
                last = Some((errors & !codec::WATCHDOG_TIMER_EXPIRED, state));
                (last == Some((0, State::Idle))).then_some(())
            }
            _ => None,
        })?;
        off.ok_or_else(|| query.not_disabled(&format!("{last:?} (errors, state)")))
    }

    fn set_watchdog(&self, query: &MotorQuery<'_>, plan: &WatchdogPlan) -> Result<(), Error> {
        let Some(endpoints) = &self.endpoints else {
            return Ok(());
        };
        self.check_endpoints(query, endpoints)?;
        // A flag is one byte. In an answer, the bytes after the flag are undefined.
        let settings = [
            (
                endpoints.watchdog_timeout,
                plan.timeout.as_secs_f32().to_le_bytes(),
                4,
            ),
            (endpoints.enable_watchdog, [1, 0, 0, 0], 1),
        ];
        for (number, bytes, n_bytes) in settings {
            // The timeout is written before the watchdog is enabled. In the other order, the
            // watchdog would run with an old timeout.
            query.send(self.encode(&Request::WriteEndpoint(number, bytes)))?;
            let reported = self.ask(
                query,
                &Request::ReadEndpoint(number),
                |answer| match answer {
                    Answer::Endpoint(reported, bytes) => (reported == number).then_some(bytes),
                    _ => None,
                },
            )?;
            if reported[..n_bytes] != bytes[..n_bytes] {
                return Err(query.timeout_mismatch(
                    plan.timeout,
                    &format!("{reported:?} in endpoint {number}"),
                ));
            }
        }
        Ok(())
    }

    fn set_mode(&self, query: &MotorQuery<'_>, _plan: &WatchdogPlan) -> Result<(), Error> {
        // The mode cannot be read over CANSimple. If the mode is wrong, the first motion causes a
        // following error.
        query.send(self.encode(&Request::SetMode(Control::Position)))
    }

    fn enable(&self) -> Result<Vec<Frame>, CanError> {
        // The watchdog of the axis may have expired while the axis was disabled.
        [
            Request::ClearErrors,
            Request::SetState(State::ClosedLoopControl),
        ]
        .iter()
        .map(|it| self.encode(it))
        .collect()
    }

    fn command(&self, command: &Command) -> Result<Frame, CanError> {
        let Command {
            position_rad,
            velocity_rad_s,
            ..
        } = *command;
        self.encode(&Request::SetPosition {
            position_rad,
            velocity_rad_s,
            // There is no model of the load that could predict a torque.
            torque_nm: 0.0,
        })
    }

    fn release(&self) -> Result<Frame, CanError> {
        self.encode(&Request::SetState(State::Idle))
    }

    fn health(&mut self, frame: &Frame) -> Option<Health> {
        match codec::decode_answer(frame) {
            Ok((from, Answer::Heartbeat { errors, state })) if from == self.node => {
                Some(match (errors, state) {
                    (0, State::ClosedLoopControl) => Health::Enabled,
                    // An axis that is idle without an error was disabled by another program or a
                    // person.
                    (0, _) => Health::Off,
                    (codec::WATCHDOG_TIMER_EXPIRED, _) => {
                        Health::Fault(COMMUNICATION_LOST.to_owned())
                    }
                    (errors, _) => {
                        Health::Fault(format!("the axis reports the errors {errors:#x}"))
                    }
                })
            }
            _ => None,
        }
    }

    /// The limit follows from the report interval, because the axis reports without being polled.
    fn max_silence(&self, default_limit: Duration) -> Duration {
        default_limit.max(MAX_REPORT_INTERVAL)
    }
}
