//! Emulated motors for tests and simulators. They answer, report, follow commands, and stop when their watchdog
//! expires, as the manufacturers' documents describe.
//!
//! They were written from the same documents as the codecs. They therefore show that the driver works, but not that
//! the documents were understood correctly; only real motors can show that.

mod damiao;
mod drive;
mod odrive;
mod robstride;
mod shaft;
mod tmotor;

pub use odrive::endpoints;

use super::config::Family;
use crate::wire::can::canopen::NodeState;
use crate::wire::can::mit::{Command, Limits, Motion};
use crate::wire::can::{CanError, Frame, cia402};
use kinematics::Stamp;
use shaft::{Actuation, Shaft};
use std::collections::BTreeMap;
use std::time::Duration;

/// Report interval of `ODrive` axes and Robstride motors.
const REPORT: Duration = Duration::from_millis(10);
/// Heartbeat interval of drives and `ODrive` axes.
const HEARTBEAT: Duration = Duration::from_millis(100);
/// Temperature of windings and drives, degrees Celsius.
const CELSIUS: u8 = 30;

/// What a motor does with its shaft.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum State {
    /// Disabled: the shaft turns freely.
    Free,
    /// Executes its last command.
    Enabled,
    /// Stopped by its watchdog or a quick stop, and holds its position.
    Holding,
}

/// An emulated motor.
#[derive(Debug)]
pub struct EmulatedMotor {
    family: Family,
    limits: Limits,
    shaft: Shaft,
    actuation: Actuation,
    now: Option<Stamp>,
    /// Time up to which the shaft has been simulated.
    simulated_until: Option<Stamp>,
    /// Registers, parameters, endpoints or objects that were written, by number.
    settings: BTreeMap<u32, u32>,
    ignores_timeout: bool,
    /// When the watchdog was last reset, and when it last expired.
    watchdog_reset_at: Option<Stamp>,
    timed_out_at: Option<Stamp>,
    /// Fault bits in the numbering of the family.
    faults: u32,
    target: Option<Command>,
    /// Whether it sends unsolicited reports.
    reports: bool,
    last_report: Option<Stamp>,
    last_heartbeat: Option<Stamp>,
    node_state: NodeState,
    drive_state: cia402::State,
    /// For a drive: controlword and target that take effect at the next SYNC.
    pending_command: Option<(u16, i32)>,
    last_controlword: u16,
}

impl EmulatedMotor {
    /// Creates a disabled motor at rest at 0. `limits` are the values of a Damiao motor's registers; the limits of
    /// Robstride and T-Motor motors follow from their models.
    pub fn new(family: Family, limits: Limits) -> Self {
        let limits = match family {
            Family::Robstride { model, .. } => model.limits(),
            Family::TMotor { model, .. } => model.limits(),
            _ => limits,
        };
        Self {
            family,
            limits,
            shaft: Shaft::at_rest(),
            actuation: Actuation::Free,
            now: None,
            simulated_until: None,
            settings: BTreeMap::new(),
            ignores_timeout: false,
            watchdog_reset_at: None,
            timed_out_at: None,
            faults: 0,
            target: None,
            reports: matches!(family, Family::Odrive { .. }),
            last_report: None,
            last_heartbeat: None,
            node_state: NodeState::PreOperational,
            drive_state: cia402::State::SwitchOnDisabled,
            pending_command: None,
            last_controlword: 0,
        }
    }

    /// Sets the motion of the shaft. From then on the drive determines it, unless it is set again.
    pub fn set_motion(&mut self, motion: Motion) {
        self.shaft.motion = motion;
        self.simulated_until = None;
    }

    /// Current motion of the shaft.
    pub fn motion(&self) -> Motion {
        self.shaft.motion
    }

    /// What the motor does with its shaft.
    pub fn state(&self) -> State {
        match self.actuation {
            Actuation::Free => State::Free,
            Actuation::Mit(_) | Actuation::Follow(_) => State::Enabled,
            Actuation::Stop => State::Holding,
        }
    }

    /// The last command that it followed. Commands of drives with their own position loop have no gains.
    pub fn target(&self) -> Option<Command> {
        self.target
    }

    /// When its watchdog was last reset.
    pub fn watchdog_reset_at(&self) -> Option<Stamp> {
        self.watchdog_reset_at
    }

    /// When its watchdog last stopped it.
    pub fn timed_out_at(&self) -> Option<Stamp> {
        self.timed_out_at
    }

    /// From now on, ignores writes of the timeout without reporting an error, as older firmware does.
    pub fn ignore_timeout(&mut self) {
        self.ignores_timeout = true;
    }

    /// Simulates a failure: the motor releases its shaft and reports a fault.
    pub fn fail(&mut self) {
        self.actuation = Actuation::Free;
        match self.family {
            Family::Damiao { .. } => self.faults = damiao::OVERLOAD,
            Family::Robstride { .. } => self.faults = robstride::OVERLOAD,
            Family::TMotor { .. } => self.faults = tmotor::OVER_CURRENT,
            Family::Odrive { .. } => self.faults = odrive::CURRENT_LIMIT,
            Family::Cia402 { .. } => self.drive_state = cia402::State::Fault,
        }
    }

    /// Processes a frame at the time of the last [`EmulatedMotor::report`], and returns the answers; none if the
    /// frame is not addressed to this motor.
    ///
    /// # Errors
    /// If the protocol cannot encode an answer.
    pub fn take(&mut self, frame: &Frame) -> Result<Vec<Frame>, CanError> {
        match self.family {
            Family::Damiao { motor, feedback } => self.handle_damiao(frame, motor, feedback),
            Family::Robstride { motor, .. } => self.handle_robstride(frame, motor),
            Family::TMotor { motor, .. } => self.handle_tmotor(frame, motor),
            Family::Odrive { node } => self.handle_odrive(frame, node),
            Family::Cia402 { node, units } => self.handle_drive(frame, node, units),
        }
    }

    /// Advances the simulation of shaft and watchdog to `now`, and returns the unsolicited frames.
    pub fn report(&mut self, now: Stamp) -> Result<Vec<Frame>, CanError> {
        self.now = Some(now);
        if let Some(before) = self.simulated_until.replace(now) {
            self.shaft.advance(now.secs_since(before), &self.actuation, &self.limits);
        }
        let has_timed_out =
            |reset_at: Stamp| self.timeout().is_some_and(|timeout| now.duration_since(reset_at) > timeout);
        if self.watchdog_reset_at.is_some_and(has_timed_out) {
            self.time_out(now);
        }
        let mut sent = Vec::new();
        if self.reports && is_due(&mut self.last_report, now, REPORT) {
            sent.extend(match self.family {
                Family::Robstride { motor, .. } => Some(self.robstride_feedback(motor, true)?),
                Family::Odrive { node } => Some(self.odrive_motion(node)?),
                _ => None,
            });
        }
        let has_heartbeat = matches!(self.family, Family::Odrive { .. } | Family::Cia402 { .. });
        if has_heartbeat && is_due(&mut self.last_heartbeat, now, HEARTBEAT) {
            sent.push(match self.family {
                Family::Odrive { node } => self.odrive_heartbeat(node)?,
                Family::Cia402 { node, .. } => self.drive_heartbeat(node),
                _ => return Ok(sent),
            });
        }
        Ok(sent)
    }

    /// Timeout of the watchdog; `None` if it never expires.
    fn timeout(&self) -> Option<Duration> {
        match self.family {
            Family::Damiao { .. } => self.damiao_timeout(),
            Family::Robstride { .. } => self.robstride_timeout(),
            Family::TMotor { .. } => None,
            Family::Odrive { .. } => self.odrive_timeout(),
            Family::Cia402 { .. } => self.drive_timeout(),
        }
    }

    /// Applies the expiry of the watchdog.
    fn time_out(&mut self, now: Stamp) {
        self.watchdog_reset_at = None;
        if self.state() == State::Enabled {
            self.timed_out_at = Some(now);
        }
        match self.family {
            Family::Damiao { .. } if self.state() == State::Enabled => self.faults = damiao::COMMUNICATION_LOST,
            Family::Odrive { .. } => self.faults |= crate::wire::can::odrive::WATCHDOG_TIMER_EXPIRED,
            Family::Cia402 { .. } => return self.time_out_drive(),
            _ => {}
        }
        self.actuation = Actuation::Free;
    }

    /// Resets the watchdog.
    fn reset_watchdog(&mut self) {
        self.watchdog_reset_at = self.now;
    }

    /// Follows an MIT-mode command if the motor is enabled.
    fn obey(&mut self, command: Command) {
        if self.state() == State::Enabled {
            self.actuation = Actuation::Mit(command);
            self.target = Some(command);
            self.reset_watchdog();
        }
    }

    /// Writes a setting, unless it is a timeout and timeouts are ignored.
    fn set(&mut self, number: u32, value: u32, is_timeout: bool) {
        if !(is_timeout && self.ignores_timeout) {
            self.settings.insert(number, value);
        }
    }

    fn setting(&self, number: u32) -> Option<u32> {
        self.settings.get(&number).copied()
    }

    /// Enables the motor, holding the current position.
    fn switch_on(&mut self) {
        self.actuation = Actuation::Mit(Command { position_rad: self.shaft.motion.position_rad, ..Command::default() });
        self.reset_watchdog();
    }
}

/// Whether `interval` has passed since `last`; if so, sets `last` to now.
fn is_due(last: &mut Option<Stamp>, now: Stamp, interval: Duration) -> bool {
    let due = last.is_none_or(|last| now.duration_since(last) >= interval);
    if due {
        *last = Some(now);
    }
    due
}

#[cfg(test)]
mod tests {
    use super::super::ROBSTRIDE_HOST;
    use super::*;
    use crate::wire::can::canopen::{self, Direction, Nmt, Node, Pdo};
    use crate::wire::can::{Id, damiao as dm, robstride as rs};

    const LIMITS: Limits = Limits::of(12.5, 30.0, 10.0);
    const MILLIS: i64 = 1_000_000;

    /// Advances the time, then sends the frames to the motor.
    fn advance_and_send(motor: &mut EmulatedMotor, at_millis: i64, frames: &[Result<Frame, CanError>]) {
        motor.report(Stamp(at_millis * MILLIS)).expect("the values can be encoded");
        for frame in frames {
            motor.take(frame.as_ref().expect("a frame")).expect("the answer can be encoded");
        }
    }

    fn assert_times_out_between(motor: &mut EmulatedMotor, fed_millis: i64, timeout_millis: i64) {
        advance_and_send(motor, fed_millis + timeout_millis, &[]);
        assert_eq!((motor.state(), motor.timed_out_at()), (State::Enabled, None), "not yet");
        advance_and_send(motor, fed_millis + timeout_millis + 1, &[]);
        assert_ne!(motor.state(), State::Enabled);
        assert_eq!(motor.timed_out_at(), Some(Stamp((fed_millis + timeout_millis + 1) * MILLIS)));
    }

    #[test]
    fn damiao_times_out_and_needs_error_cleared() {
        let mut motor = EmulatedMotor::new(Family::Damiao { motor: 1, feedback: 0x11 }, LIMITS);
        let write = |register, value| {
            let access = dm::Access::Write(register, dm::Value::Integer(value));
            dm::encode_register(&dm::RegisterMessage { motor: 1, access }, None)
        };
        let command = Command { position_rad: 0.5, kp_nm_rad: 30.0, kd_nm_s_rad: 1.5, ..Command::default() };
        let set_up = [write(dm::Register::Timeout, 2000), write(dm::Register::ControlMode, dm::MIT_MODE)];
        advance_and_send(&mut motor, 0, &set_up);
        advance_and_send(&mut motor, 1, &[dm::encode_command(1, &command, &LIMITS)]);
        assert_eq!((motor.state(), motor.target()), (State::Free, None), "it is disabled");
        let enable = || dm::encode_state_command(1, dm::StateCommand::Enable);
        advance_and_send(&mut motor, 2, &[enable(), dm::encode_command(1, &command, &LIMITS)]);
        advance_and_send(&mut motor, 10, &[dm::encode_command(1, &command, &LIMITS)]);
        assert!(motor.motion().position_rad > 0.0);
        assert_times_out_between(&mut motor, 10, 100);
        advance_and_send(&mut motor, 200, &[enable()]);
        assert_eq!(motor.state(), State::Free, "its error has not been cleared");
        advance_and_send(&mut motor, 201, &[dm::encode_state_command(1, dm::StateCommand::ClearError), enable()]);
        assert_eq!(motor.state(), State::Enabled);
    }

    #[test]
    fn robstride_times_out_unless_timeout_ignored() {
        let model = rs::Model::Rs02;
        for ignores in [false, true] {
            let mut motor = EmulatedMotor::new(Family::Robstride { motor: 3, model }, LIMITS);
            if ignores {
                motor.ignore_timeout();
            }
            let encode = |request| rs::encode_request(ROBSTRIDE_HOST, 3, &request, &model.limits());
            let timeout = rs::timeout(0.05).expect("in range");
            advance_and_send(
                &mut motor,
                0,
                &[encode(rs::Request::Write(rs::Parameter::Timeout, timeout)), encode(rs::Request::Enable)],
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
        let (node, host) = (Node::new(5).expect("a node"), Node::new(127).expect("a node"));
        let units = cia402::Units { counts_per_turn: 65_536.0, rated_torque_nm: 1.0 };
        let mut motor = EmulatedMotor::new(Family::Cia402 { node, units }, LIMITS);
        let write = |object, value| canopen::encode_write(node, object, value);
        let (direction, pdo) = (Direction::Receive, Pdo::First);
        let id = pdo.id(direction, node);
        advance_and_send(
            &mut motor,
            0,
            &[
                write(canopen::CONSUMER_HEARTBEAT, canopen::consumer_heartbeat(host, 100).into()),
                write(cia402::ABORT_CONNECTION, cia402::ABORT_BY_QUICK_STOP),
                write(cia402::QUICK_STOP_OPTION, cia402::STAY_STOPPED),
                write(cia402::MODE, cia402::Mode::CyclicPosition as i64),
                write(pdo.mapping(direction, 1), cia402::CONTROLWORD.mapped().into()),
                write(pdo.mapping(direction, 2), cia402::TARGET_POSITION.mapped().into()),
                write(pdo.communication(direction, 2), 1),
                write(pdo.communication(direction, 1), id.value().into()),
                Ok(canopen::encode_nmt(Nmt::Start, Some(node))),
            ],
        );
        for (at_millis, controlword) in [(1, 0x06), (2, 0x07), (3, 0x0F), (50, 0x0F)] {
            let target = Frame::classic(id, &[controlword, 0, 0, 0x40, 0, 0]);
            let heartbeat = canopen::encode_heartbeat(host, NodeState::Operational);
            advance_and_send(&mut motor, at_millis, &[target, Ok(heartbeat), Ok(canopen::encode_sync())]);
        }
        assert_eq!(motor.state(), State::Enabled);
        assert_times_out_between(&mut motor, 50, 100);
        assert_eq!(motor.state(), State::Holding);
        advance_and_send(&mut motor, 2000, &[]);
        let held_motion = motor.motion();
        advance_and_send(&mut motor, 3000, &[Frame::classic(Id::standard(0x705).expect("11 bits"), &[5])]);
        assert_eq!((motor.motion(), motor.motion().velocity_rad_s), (held_motion, 0.0));
    }
}
