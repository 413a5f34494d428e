//! Emulated motors for tests and simulators. They answer, report, follow commands, and stop when
//! their watchdog expires, as the manufacturers' documents describe.
//!
//! The emulated motors were written from the same documents as the codecs. Tests against them
//! therefore cannot show whether the documents were understood correctly; only real motors can show
//! that.

mod drive;
mod protocol;
mod shaft;

pub use drive::{EmulatedDrive, State};
pub use protocol::EmulatedProtocol;
pub(super) use shaft::Actuation;

use super::family::MotorProtocol;
use crate::wire::can::mit::{Command, Limits, Motion};
use crate::wire::can::{CanError, Frame};
use kinematics::Stamp;
use std::time::Duration;

/// Interval of periodic reports.
const REPORT: Duration = Duration::from_millis(10);
/// Interval of heartbeats.
const HEARTBEAT: Duration = Duration::from_millis(100);
/// Temperature of windings and drives, degrees Celsius.
pub(super) const CELSIUS: u8 = 30;

/// An emulated motor.
#[derive(Debug)]
pub struct EmulatedMotor {
    protocol: Box<dyn EmulatedProtocol>,
    drive: EmulatedDrive,
    last_report: Option<Stamp>,
    last_heartbeat: Option<Stamp>,
}

impl EmulatedMotor {
    /// Creates a disabled motor at rest at position 0. `limits` are the ranges of raw values that
    /// the motor reports. They are ignored for motors that report no ranges, because those ranges
    /// follow from the model.
    pub fn new(motor: &dyn MotorProtocol, limits: Limits) -> Self {
        let drive = EmulatedDrive::new(motor.ranges().unwrap_or(limits));
        Self {
            protocol: motor.emulated(),
            drive,
            last_report: None,
            last_heartbeat: None,
        }
    }

    /// Sets the motion of the shaft. From then on, the drive determines the motion until it is set
    /// again.
    pub fn set_motion(&mut self, motion: Motion) {
        self.drive.set_motion(motion);
    }

    /// Sets mechanical stops: the lowest and highest position of the shaft. They simulate an
    /// obstacle.
    pub fn set_stops(&mut self, stops_rad: [f64; 2]) {
        self.drive.set_stops(stops_rad);
    }

    /// Current motion of the shaft.
    pub fn motion(&self) -> Motion {
        self.drive.motion()
    }

    /// Control state of the motor.
    pub fn state(&self) -> State {
        self.drive.state()
    }

    /// The last command that the motor followed. Commands of drives with their own position loop
    /// have no gains.
    pub fn target(&self) -> Option<Command> {
        self.drive.target
    }

    /// Time at which the motor's watchdog was last reset.
    pub fn watchdog_reset_at(&self) -> Option<Stamp> {
        self.drive.watchdog_reset_at
    }

    /// Time at which the watchdog last stopped the motor.
    pub fn timed_out_at(&self) -> Option<Stamp> {
        self.drive.timed_out_at
    }

    /// Makes the motor ignore writes of the timeout without reporting an error, as older firmware
    /// does.
    pub fn ignore_timeout(&mut self) {
        self.drive.ignores_timeout = true;
    }

    /// Simulates a failure: the motor releases its shaft and reports a fault.
    pub fn fail(&mut self) {
        self.drive.actuation = Actuation::Free;
        self.protocol.fail(&mut self.drive);
    }

    /// Processes a frame at the time of the last [`EmulatedMotor::report`], and returns the
    /// answers. There are none if the frame is not addressed to this motor.
    ///
    /// # Errors
    /// If the protocol cannot encode an answer.
    pub fn take(&mut self, frame: &Frame) -> Result<Vec<Frame>, CanError> {
        self.protocol.take(frame, &mut self.drive)
    }

    /// Advances the simulation of shaft and watchdog to `now`, and returns the unsolicited frames.
    pub fn report(&mut self, now: Stamp) -> Result<Vec<Frame>, CanError> {
        self.drive.advance(now);
        // The shaft moves up to `now` under the last command before the watchdog is checked. This
        // is called once per millisecond, so the reaction is delayed by a millisecond at most.
        if self.has_timed_out(now) {
            self.time_out(now);
        }
        let mut sent = Vec::new();
        if self.protocol.reports() && is_due(&mut self.last_report, now, REPORT) {
            sent.extend(self.protocol.report(&self.drive)?);
        }
        if is_due(&mut self.last_heartbeat, now, HEARTBEAT) {
            sent.extend(self.protocol.heartbeat(&self.drive)?);
        }
        Ok(sent)
    }

    /// Whether the watchdog has been running for longer than its timeout.
    fn has_timed_out(&self, now: Stamp) -> bool {
        // A watchdog that was never reset is not running.
        let Some(reset_at) = self.drive.watchdog_reset_at else {
            return false;
        };
        self.protocol
            .timeout(&self.drive)
            .is_some_and(|timeout| now.duration_since(reset_at) > timeout)
    }

    /// Lets the watchdog expire.
    fn time_out(&mut self, now: Stamp) {
        // It expires once, and runs again after the next command.
        self.drive.watchdog_reset_at = None;
        // The time is recorded for tests, which check when the watchdog stopped a motor. An idle
        // motor is not stopped.
        if self.state() == State::Enabled {
            self.drive.timed_out_at = Some(now);
        }
        self.protocol.time_out(&mut self.drive);
    }
}

/// Returns whether `interval` has passed since `last`. If so, sets `last` to now.
fn is_due(last: &mut Option<Stamp>, now: Stamp, interval: Duration) -> bool {
    let due = last.is_none_or(|last| now.duration_since(last) >= interval);
    if due {
        *last = Some(now);
    }
    due
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::can::cia402::{Cia402, Units, codec as cia402};
    use crate::can::damiao::{Damiao, codec as dm};
    use crate::can::robstride::{HOST, Robstride, codec as rs};
    use crate::wire::can::Id;
    use crate::wire::can::canopen::{self, Direction, Nmt, Node, NodeState, Pdo};

    const LIMITS: Limits = Limits::of(12.5, 30.0, 10.0);
    const MILLIS: i64 = 1_000_000;

    /// Advances the time, then sends the frames to the motor.
    fn advance_and_send(
        motor: &mut EmulatedMotor,
        at_millis: i64,
        frames: &[Result<Frame, CanError>],
    ) {
        motor
            .report(Stamp(at_millis * MILLIS))
            .expect("the values can be encoded");
        for frame in frames {
            motor
                .take(frame.as_ref().expect("a frame"))
                .expect("the answer can be encoded");
        }
    }

    fn assert_times_out_between(motor: &mut EmulatedMotor, fed_millis: i64, timeout_millis: i64) {
        advance_and_send(motor, fed_millis + timeout_millis, &[]);
        assert_eq!(
            (motor.state(), motor.timed_out_at()),
            (State::Enabled, None),
            "not yet"
        );
        advance_and_send(motor, fed_millis + timeout_millis + 1, &[]);
        assert_ne!(motor.state(), State::Enabled);
        assert_eq!(
            motor.timed_out_at(),
            Some(Stamp((fed_millis + timeout_millis + 1) * MILLIS))
        );
    }

    #[test]
    fn damiao_times_out_and_needs_error_cleared() {
        let mut motor = EmulatedMotor::new(
            &Damiao {
                motor: 1,
                feedback: 0x11,
            },
            LIMITS,
        );
        let write = |register, value| {
            let access = dm::Access::Write(register, dm::Value::Integer(value));
            dm::encode_register(&dm::RegisterMessage { motor: 1, access }, None)
        };
        let command = Command {
            position_rad: 0.5,
            kp_nm_rad: 30.0,
            kd_nm_s_rad: 1.5,
            ..Command::default()
        };
        let set_up = [
            write(dm::Register::Timeout, 2000),
            write(dm::Register::ControlMode, dm::MIT_MODE),
        ];
        advance_and_send(&mut motor, 0, &set_up);
        advance_and_send(&mut motor, 1, &[dm::encode_command(1, &command, &LIMITS)]);
        assert_eq!(
            (motor.state(), motor.target()),
            (State::Free, None),
            "it is disabled"
        );
        let enable = || dm::encode_state_command(1, dm::StateCommand::Enable);
        advance_and_send(
            &mut motor,
            2,
            &[enable(), dm::encode_command(1, &command, &LIMITS)],
        );
        advance_and_send(&mut motor, 10, &[dm::encode_command(1, &command, &LIMITS)]);
        assert!(motor.motion().position_rad > 0.0);
        assert_times_out_between(&mut motor, 10, 100);
        advance_and_send(&mut motor, 200, &[enable()]);
        assert_eq!(motor.state(), State::Free, "its error has not been cleared");
        advance_and_send(
            &mut motor,
            201,
            &[
                dm::encode_state_command(1, dm::StateCommand::ClearError),
                enable(),
            ],
        );
        assert_eq!(motor.state(), State::Enabled);
    }

    #[test]
    fn robstride_times_out_unless_timeout_ignored() {
        let model = rs::Model::Rs02;
        for ignores in [false, true] {
            let mut motor = EmulatedMotor::new(&Robstride { motor: 3, model }, LIMITS);
            if ignores {
                motor.ignore_timeout();
            }
            let encode = |request| rs::encode_request(HOST, 3, &request, &model.limits());
            let timeout = rs::timeout(0.05).expect("in range");
            advance_and_send(
                &mut motor,
                0,
                &[
                    encode(rs::Request::Write(rs::Parameter::Timeout, timeout)),
                    encode(rs::Request::Enable),
                ],
            );
            match ignores {
                false => assert_times_out_between(&mut motor, 0, 50),
                true => advance_and_send(&mut motor, 5000, &[]),
            }
            assert_eq!(motor.state() == State::Enabled, ignores);
        }
    }

    #[test]
    fn drive_quick_stops_and_holds_on_heartbeat_loss() {
        let (node, host) = (
            Node::new(5).expect("a node"),
            Node::new(127).expect("a node"),
        );
        let units = Units {
            counts_per_turn: 65_536.0,
            rated_torque_nm: 1.0,
        };
        let mut motor = EmulatedMotor::new(&Cia402 { node, units }, LIMITS);
        let write = |object, value| canopen::encode_write(node, object, value);
        let (direction, pdo) = (Direction::Receive, Pdo::First);
        let id = pdo.id(direction, node);
        advance_and_send(
            &mut motor,
            0,
            &[
                write(
                    canopen::CONSUMER_HEARTBEAT,
                    canopen::consumer_heartbeat(host, 100).into(),
                ),
                write(cia402::ABORT_CONNECTION, cia402::ABORT_BY_QUICK_STOP),
                write(cia402::QUICK_STOP_OPTION, cia402::STAY_STOPPED),
                write(cia402::MODE, cia402::Mode::CyclicPosition as i64),
                write(
                    pdo.mapping(direction, 1),
                    cia402::CONTROLWORD.mapped().into(),
                ),
                write(
                    pdo.mapping(direction, 2),
                    cia402::TARGET_POSITION.mapped().into(),
                ),
                write(pdo.communication(direction, 2), 1),
                write(pdo.communication(direction, 1), id.value().into()),
                Ok(canopen::encode_nmt(Nmt::Start, Some(node))),
            ],
        );
        for (at_millis, controlword) in [(1, 0x06), (2, 0x07), (3, 0x0F), (50, 0x0F)] {
            let target = Frame::classic(id, &[controlword, 0, 0, 0x40, 0, 0]);
            let heartbeat = canopen::encode_heartbeat(host, NodeState::Operational);
            advance_and_send(
                &mut motor,
                at_millis,
                &[target, Ok(heartbeat), Ok(canopen::encode_sync())],
            );
        }
        assert_eq!(motor.state(), State::Enabled);
        assert_times_out_between(&mut motor, 50, 100);
        assert_eq!(motor.state(), State::Holding);
        advance_and_send(&mut motor, 2000, &[]);
        let held_motion = motor.motion();
        advance_and_send(
            &mut motor,
            3000,
            &[Frame::classic(Id::standard(0x705).expect("11 bits"), &[5])],
        );
        assert_eq!(
            (motor.motion(), motor.motion().velocity_rad_s),
            (held_motion, 0.0)
        );
    }
}
