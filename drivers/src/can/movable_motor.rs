//! One motor that may be moved: its preparation while it is disabled, its commands in each cycle, and its health
//! according to its reports.
//!
//! Positions are sent as planned, with their velocity as feedforward where the protocol supports it. Motors in MIT
//! mode get the rig's stiffness and damping with each command; `ODrive` axes and CiA 402 drives keep the gains that
//! they were tuned to.

use super::ROBSTRIDE_HOST;
use super::config::{Family, MotorConfig};
use super::frame_io::FrameIo;
use super::motor::{Motor, Reading, map_pdo_at_every_sync, start_drive};
use super::query::MotorQuery;
use super::watchdog::{self, WatchdogPlan};
use crate::motion::{MotionLimits, OnLoss};
use crate::wire::can::canopen::{self, Direction, Pdo};
use crate::wire::can::damiao::{self, Access, Register, RegisterMessage};
use crate::wire::can::mit::Command;
use crate::wire::can::robstride::{self, Faults, Parameter, Request};
use crate::wire::can::tmotor::{self, Thermometer};
use crate::wire::can::{CanError, Frame, Id, cia402, odrive};
use crate::{Error, clock};
use std::time::Duration;

/// Maximum time for a motor to report that it is disabled, or in another mode.
const MAX_CHANGE: Duration = Duration::from_secs(1);
/// An `ODrive` axis reports its state ten times per second, and its position a hundred times.
const ODRIVE_HEARTBEAT_HZ: f64 = 10.0;
/// Report rate of `ODrive` axes and Robstride motors.
const REPORT_HZ: f64 = 100.0;
/// Longest interval between reports of a motor that reports unasked.
const MAX_UNSOLICITED_INTERVAL: Duration = Duration::from_millis(50);
/// SDO abort code of a drive that does not have the object.
const NO_SUCH_OBJECT: u32 = 0x0602_0000;

/// State of a motor according to its last report.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Health {
    /// Disabled.
    Off,
    /// Enabled: it follows commands.
    Enabled,
    /// It stopped because of a fault.
    Fault(String),
}

/// Frames sent and received while a motor moves: those of each cycle, and others with their rate in Hz.
pub(super) struct Traffic {
    pub(super) cycle_frames: Vec<Frame>,
    pub(super) unsolicited: Vec<(Frame, f64)>,
}

/// A motor that may be moved. It is disabled until [`MovableMotor::enable`] is sent.
#[derive(Debug)]
pub(super) struct MovableMotor {
    motor: Motor,
    health: Option<Health>,
    /// State of a CiA 402 drive.
    drive: cia402::State,
}

impl MovableMotor {
    /// Finds a motor, disables it, clears its faults, sets its watchdog and its mode, and verifies both.
    pub(super) fn prepare(bus: &dyn FrameIo, config: &MotorConfig, plan: &WatchdogPlan) -> Result<Self, Error> {
        let motor = match config.family {
            // It answers only commands, so it is polled with the command that disables it.
            Family::TMotor { model, .. } => Motor::with_limits(config.clone(), model.limits()),
            _ => Motor::set_up(bus, config)?,
        };
        let movable_motor = Self { motor, health: None, drive: cia402::State::NotReadyToSwitchOn };
        let query = MotorQuery::new(bus, &config.joint);
        movable_motor.check_gains(&query)?;
        movable_motor.switch_off(&query)?;
        watchdog::set(&query, &config.family, movable_motor.motor.limits(), plan)?;
        movable_motor.set_mode(&query, plan)?;
        Ok(movable_motor)
    }

    pub(super) fn config(&self) -> &MotorConfig {
        self.motor.config()
    }

    /// The motor for reading only.
    pub(super) fn motor(&self) -> &Motor {
        &self.motor
    }

    pub(super) fn health(&self) -> Option<&Health> {
        self.health.as_ref()
    }

    /// Forgets the last reported health.
    pub(super) fn clear_health(&mut self) {
        self.health = None;
    }

    /// Limits of the joint, reduced to the range of the motor's raw values.
    pub(super) fn limits(&self, joint: &MotionLimits) -> MotionLimits {
        let (config, per_turn) = (self.motor.config(), self.motor.per_turn());
        let (max_rad, max_rad_s) = match config.family {
            Family::Odrive { .. } => (f64::INFINITY, f64::INFINITY),
            Family::Cia402 { units, .. } => (units.rad_from_raw(i32::MAX), f64::INFINITY),
            _ => (self.motor.limits().position_rad, self.motor.limits().velocity_rad_s),
        };
        let max = max_rad * per_turn.abs();
        let [lower, upper] = joint.position;
        MotionLimits {
            position: [lower.max(config.offset_rad - max), upper.min(config.offset_rad + max)],
            velocity: joint.velocity.min(max_rad_s * per_turn.abs()),
            ..*joint
        }
    }

    /// How long the motor may be silent before it counts as lost. `default_limit` applies to most families.
    pub(super) fn max_silence(&self, default_limit: Duration) -> Duration {
        match self.motor.config().family {
            Family::Odrive { .. } => default_limit.max(MAX_UNSOLICITED_INTERVAL),
            _ => default_limit,
        }
    }

    /// Traffic on its bus while it moves.
    pub(super) fn traffic(family: &Family) -> Traffic {
        let frame_of_8_bytes = |id: Id| Frame::classic(id, &[0; 8]).expect("eight bytes");
        let (short, long) =
            (frame_of_8_bytes(Id::standard(0).expect("small")), frame_of_8_bytes(Id::extended(0).expect("small")));
        let (cycle_frames, unsolicited) = match family {
            Family::Damiao { .. } | Family::TMotor { .. } => (vec![short; 2], vec![]),
            Family::Robstride { .. } => (vec![long; 2], vec![(long, REPORT_HZ)]),
            Family::Odrive { .. } => (vec![short], vec![(short, REPORT_HZ), (short, ODRIVE_HEARTBEAT_HZ)]),
            // Target, position and state.
            Family::Cia402 { .. } => (vec![short; 3], vec![]),
        };
        Traffic { cycle_frames, unsolicited }
    }

    /// The frame that polls the position of the disabled motor; `None` if it reports unasked or at a SYNC.
    pub(super) fn poll_frame(&self) -> Option<Frame> {
        match self.motor.config().family {
            Family::TMotor { motor, .. } => tmotor::encode_state_command(motor, tmotor::StateCommand::Disable).ok(),
            _ => self.motor.poll_frame(),
        }
    }

    pub(super) fn needs_sync(&self) -> bool {
        self.motor.needs_sync()
    }

    /// Frames that enable it. A CiA 402 drive needs none, because its commands enable it.
    pub(super) fn enable(&self) -> Result<Vec<Frame>, CanError> {
        let limits = self.motor.limits();
        match self.motor.config().family {
            Family::Damiao { motor, .. } => {
                Ok(vec![damiao::encode_state_command(motor, damiao::StateCommand::Enable)?])
            }
            Family::Robstride { motor, .. } => {
                Ok(vec![robstride::encode_request(ROBSTRIDE_HOST, motor, &Request::Enable, limits)?])
            }
            Family::TMotor { motor, .. } => {
                Ok(vec![tmotor::encode_state_command(motor, tmotor::StateCommand::Enable)?])
            }
            Family::Odrive { node } => {
                let closed = odrive::Request::SetState(odrive::State::ClosedLoopControl);
                // Its watchdog may have expired while it was disabled.
                [odrive::Request::ClearErrors, closed].iter().map(|it| odrive::encode_request(node, it)).collect()
            }
            Family::Cia402 { .. } => Ok(Vec::new()),
        }
    }

    /// A command for the position and velocity of its joint, rad and rad/s.
    pub(super) fn command(&self, position_rad: f64, velocity_rad_s: f64) -> Result<Frame, CanError> {
        let stiffness = self.gains().map_or(0.0, |[kp, _]| kp);
        self.command_with(position_rad, velocity_rad_s, stiffness)
    }

    fn command_with(&self, position_rad: f64, velocity_rad_s: f64, kp_nm_rad: f64) -> Result<Frame, CanError> {
        let per_turn = self.motor.per_turn();
        let position_rad = (position_rad - self.motor.config().offset_rad) / per_turn;
        let velocity_rad_s = velocity_rad_s / per_turn;
        let kd_nm_s_rad = self.gains().map_or(0.0, |[_, kd]| kd);
        let command = Command { position_rad, velocity_rad_s, kp_nm_rad, kd_nm_s_rad, torque_nm: 0.0 };
        let limits = self.motor.limits();
        match self.motor.config().family {
            Family::Damiao { motor, .. } => damiao::encode_command(motor, &command, limits),
            Family::Robstride { motor, .. } => {
                robstride::encode_request(ROBSTRIDE_HOST, motor, &Request::Move(command), limits)
            }
            Family::TMotor { motor, .. } => tmotor::encode_command(motor, &command, limits),
            Family::Odrive { node } => {
                let request = odrive::Request::SetPosition { position_rad, velocity_rad_s, torque_nm: 0.0 };
                odrive::encode_request(node, &request)
            }
            Family::Cia402 { node, units } => {
                // Advances the drive by one state towards enabled, and keeps it there. This does not reset a fault.
                let state_command = match self.drive {
                    cia402::State::OperationEnabled => cia402::StateCommand::EnableOperation,
                    state => state.next_enabling_command(false).unwrap_or(cia402::StateCommand::DisableVoltage),
                };
                let [low, high] = state_command.controlword().to_le_bytes();
                let [a, b, c, d] = units.raw_from_rad("the target position", position_rad)?.to_le_bytes();
                Frame::classic(Pdo::First.id(Direction::Receive, node), &[low, high, a, b, c, d])
            }
        }
    }

    /// The fail-safe command, which makes the motor do what `on_loss` specifies without further commands.
    /// `position_rad` is the last commanded position of its joint.
    pub(super) fn shutdown(&self, on_loss: OnLoss, position_rad: f64) -> Result<Vec<Frame>, CanError> {
        match (on_loss, self.motor.config().family) {
            (OnLoss::Release, _) => self.release(),
            (OnLoss::Hold, Family::Cia402 { node, .. }) => {
                Ok(vec![state_command(node, cia402::StateCommand::QuickStop)?])
            }
            (OnLoss::Hold, _) => Ok(vec![self.command(position_rad, 0.0)?]),
            (OnLoss::Damp, _) => Ok(vec![self.command_with(position_rad, 0.0, 0.0)?]),
        }
    }

    /// Frames that disable it.
    fn release(&self) -> Result<Vec<Frame>, CanError> {
        let frame = match self.motor.config().family {
            Family::Damiao { motor, .. } => damiao::encode_state_command(motor, damiao::StateCommand::Disable),
            Family::Robstride { motor, .. } => {
                let stop = Request::Stop { clear_fault: false };
                robstride::encode_request(ROBSTRIDE_HOST, motor, &stop, self.motor.limits())
            }
            Family::TMotor { motor, .. } => tmotor::encode_state_command(motor, tmotor::StateCommand::Disable),
            Family::Odrive { node } => odrive::encode_request(node, &odrive::Request::SetState(odrive::State::Idle)),
            Family::Cia402 { node, .. } => state_command(node, cia402::StateCommand::DisableVoltage),
        };
        Ok(vec![frame?])
    }

    /// Updates the motor's health from a frame, and returns the reading of its joint, if the frame has one.
    pub(super) fn process_frame(&mut self, frame: &Frame) -> Option<Reading> {
        let reading = self.motor.read(frame);
        let is_feedback = reading.is_some();
        let limits = *self.motor.limits();
        let family = self.motor.config().family;
        match family {
            Family::Damiao { .. } if is_feedback => {
                let reported = damiao::decode_feedback(frame, &limits).ok()?;
                self.health = Some(match reported.status {
                    damiao::Status::Disabled => Health::Off,
                    damiao::Status::Enabled => Health::Enabled,
                    damiao::Status::LostCommunication => Health::Fault(COMMUNICATION_LOST.to_owned()),
                    status => Health::Fault(format!("the motor stopped: {status:?}")),
                });
            }
            Family::Robstride { motor, .. } => match robstride::decode_answer(frame, ROBSTRIDE_HOST, &limits) {
                Ok(robstride::Answer::Feedback(reported)) if reported.motor == motor => {
                    self.health = Some(match (reported.mode, reported.faults) {
                        (robstride::Mode::Run, Faults(0)) => Health::Enabled,
                        (_, Faults(0)) => Health::Off,
                        (_, Faults(bits)) => Health::Fault(format!("the motor reports the fault bits {bits:#08b}")),
                    });
                }
                Ok(robstride::Answer::Fault { motor: from, faults, .. }) if from == motor && faults != 0 => {
                    self.health = Some(Health::Fault(format!("the motor reports the faults {faults:#x}")));
                }
                _ => {}
            },
            Family::TMotor { .. } if is_feedback => {
                let reported = tmotor::decode_feedback(frame, &limits, Thermometer::Offset40).ok()?;
                // It does not report whether it is enabled.
                self.health = Some(match reported.health.map(|health| health.fault) {
                    None | Some(tmotor::Fault::None) => Health::Enabled,
                    Some(fault) => Health::Fault(format!("the motor stopped: {fault:?}")),
                });
            }
            Family::Odrive { node } => {
                if let Ok((from, odrive::Answer::Heartbeat { errors, state })) = odrive::decode_answer(frame)
                    && from == node
                {
                    self.health = Some(match (errors, state) {
                        (0, odrive::State::ClosedLoopControl) => Health::Enabled,
                        (0, _) => Health::Off,
                        (odrive::WATCHDOG_TIMER_EXPIRED, _) => Health::Fault(COMMUNICATION_LOST.to_owned()),
                        (errors, _) => Health::Fault(format!("the axis reports the errors {errors:#x}")),
                    });
                }
            }
            Family::Cia402 { node, .. } => {
                if let Some(state) = state_of(frame, node) {
                    self.drive = state;
                    self.health = Some(match state {
                        cia402::State::OperationEnabled => Health::Enabled,
                        cia402::State::QuickStopActive => Health::Fault("the drive made a quick stop".to_owned()),
                        cia402::State::Fault | cia402::State::FaultReactionActive => {
                            Health::Fault("the drive reports a fault".to_owned())
                        }
                        _ => Health::Off,
                    });
                }
            }
            _ => {}
        }
        reading
    }

    /// Stiffness and damping of the motor: those of its joint, divided by the square of the gear ratio.
    fn gains(&self) -> Option<[f64; 2]> {
        let squared = self.motor.per_turn().powi(2);
        let gains = self.motor.config().gains?;
        Some([gains.stiffness_nm_rad * squared, gains.damping_nm_s_rad * squared])
    }

    /// Checks the gains against the motor's range, because larger values would be clamped silently.
    fn check_gains(&self, query: &MotorQuery<'_>) -> Result<(), Error> {
        let Some([kp, kd]) = self.gains() else { return Ok(()) };
        let max = self.motor.limits();
        match kp <= max.kp_nm_rad && kd <= max.kd_nm_s_rad {
            true => Ok(()),
            false => Err(query.fault(format!(
                "stiffness and damping at the motor are {kp} N m / rad and {kd} N m s / rad, but its protocol supports at most {} and {}",
                max.kp_nm_rad, max.kd_nm_s_rad
            ))),
        }
    }

    /// Disables the motor, and clears its faults after logging them.
    fn switch_off(&self, query: &MotorQuery<'_>) -> Result<(), Error> {
        let switch_off_error =
            |why: String| query.fault(format!("the motor was disabled but does not report it: {why}"));
        match self.motor.config().family {
            Family::Damiao { motor, .. } => {
                let mut status = damiao::Status::Enabled;
                for state_command in
                    [damiao::StateCommand::Disable, damiao::StateCommand::ClearError, damiao::StateCommand::Disable]
                {
                    status = query.request_answer(
                        &query.map_error(damiao::encode_state_command(motor, state_command))?,
                        |frame| {
                            self.motor.read(frame)?;
                            damiao::decode_feedback(frame, self.motor.limits()).ok().map(|reported| reported.status)
                        },
                    )?;
                    if status == damiao::Status::Disabled {
                        return Ok(());
                    }
                    log::warn!("{}: the motor reports {status:?}", query.name());
                }
                Err(switch_off_error(format!("{status:?}")))
            }
            Family::Robstride { motor, .. } => {
                let limits = self.motor.limits();
                query.robstride(motor, &Request::Stop { clear_fault: true }, limits)?;
                let mut last = None;
                let off =
                    query.wait(MAX_CHANGE, |frame| match robstride::decode_answer(frame, ROBSTRIDE_HOST, limits) {
                        Ok(robstride::Answer::Feedback(reported)) if reported.motor == motor => {
                            last = Some((reported.mode, reported.faults));
                            (last == Some((robstride::Mode::Reset, Faults(0)))).then_some(())
                        }
                        _ => None,
                    })?;
                off.ok_or_else(|| switch_off_error(format!("{last:?}")))
            }
            Family::TMotor { motor, .. } => {
                let disable = query.map_error(tmotor::encode_state_command(motor, tmotor::StateCommand::Disable))?;
                query.request_answer(&disable, |frame| self.motor.read(frame)).map(drop)
            }
            Family::Odrive { node } => {
                let idle = odrive::Request::SetState(odrive::State::Idle);
                for request in [idle, odrive::Request::ClearErrors] {
                    query.send(odrive::encode_request(node, &request))?;
                }
                let mut last = None;
                let off = query.wait(MAX_CHANGE, |frame| match odrive::decode_answer(frame) {
                    Ok((from, odrive::Answer::Heartbeat { errors, state })) if from == node => {
                        last = Some((errors & !odrive::WATCHDOG_TIMER_EXPIRED, state));
                        (last == Some((0, odrive::State::Idle))).then_some(())
                    }
                    _ => None,
                })?;
                off.ok_or_else(|| switch_off_error(format!("{last:?} (errors, state)")))
            }
            Family::Cia402 { node, .. } => {
                let deadline = clock::now() + MAX_CHANGE;
                loop {
                    let statusword = query.get(node, cia402::STATUSWORD)?;
                    let [low, high, ..] = statusword.to_le_bytes();
                    let state = query.map_error(cia402::State::from_statusword(u16::from_le_bytes([low, high])))?;
                    let requested = match state {
                        cia402::State::SwitchOnDisabled => return Ok(()),
                        cia402::State::Fault => {
                            log::warn!("{}: the drive reports a fault; resetting it", query.name());
                            cia402::StateCommand::ResetFault
                        }
                        _ => cia402::StateCommand::DisableVoltage,
                    };
                    if clock::now() > deadline {
                        return Err(switch_off_error(format!("{state:?}")));
                    }
                    // A reset takes effect on the rising edge of its bit.
                    for state_command in [cia402::StateCommand::DisableVoltage, requested] {
                        query.set(node, cia402::CONTROLWORD, state_command.controlword().into())?;
                    }
                }
            }
        }
    }

    /// Sets the control mode, which determines the meaning of commands.
    fn set_mode(&self, query: &MotorQuery<'_>, plan: &WatchdogPlan) -> Result<(), Error> {
        let mode_mismatch =
            |reported: String| Err(query.fault(format!("its mode was set but reads back as {reported}")));
        match self.motor.config().family {
            Family::Damiao { motor, feedback } => {
                let requested = damiao::Value::Integer(damiao::MIT_MODE);
                let access = Access::Write(Register::ControlMode, requested);
                query.send(damiao::encode_register(&RegisterMessage { motor, access }, None))?;
                match query.register(motor, feedback, Register::ControlMode)? {
                    reported if reported == requested => Ok(()),
                    reported => mode_mismatch(format!("{reported:?}")),
                }
            }
            Family::Robstride { motor, .. } => {
                let requested = robstride::Value::Integer(robstride::MOTION_MODE);
                query.robstride(motor, &Request::Write(Parameter::RunMode, requested), self.motor.limits())?;
                match query.parameter(motor, Parameter::RunMode, self.motor.limits())? {
                    reported if reported == requested => Ok(()),
                    reported => mode_mismatch(format!("{reported:?}")),
                }
            }
            Family::TMotor { .. } => Ok(()),
            Family::Odrive { node } => {
                query.send(odrive::encode_request(node, &odrive::Request::SetMode(odrive::Control::Position)))
            }
            Family::Cia402 { node, .. } => set_drive_mode(query, node, plan.period),
        }
    }
}

/// Fault of a motor whose own timeout has expired.
const COMMUNICATION_LOST: &str = "it received no command for longer than its timeout";

/// A state command to a drive outside the cycle.
fn state_command(node: canopen::Node, state_command: cia402::StateCommand) -> Result<Frame, CanError> {
    canopen::encode_write(node, cia402::CONTROLWORD, state_command.controlword().into())
}

/// The state in a drive's second PDO.
fn state_of(frame: &Frame, node: canopen::Node) -> Option<cia402::State> {
    if frame.id() != Pdo::Second.id(Direction::Transmit, node) || frame.is_remote() {
        return None;
    }
    let statusword = u16::from_le_bytes(<[u8; 2]>::try_from(frame.data()).ok()?);
    cia402::State::from_statusword(statusword).ok()
}

/// Makes the drive accept a position and report its state at every SYNC.
fn set_drive_mode(query: &MotorQuery<'_>, node: canopen::Node, period: Duration) -> Result<(), Error> {
    let supported = query.get(node, cia402::SUPPORTED_MODES)?;
    if !cia402::Mode::CyclicPosition.is_in(supported) {
        return Err(query.fault(format!(
            "the drive has no cyclic synchronous position mode (object 0x6502 is {supported:#x}), and no other mode is supported"
        )));
    }
    query.set(node, cia402::MODE, cia402::Mode::CyclicPosition as i64)?;
    let deadline = clock::now() + MAX_CHANGE;
    while query.get(node, cia402::MODE_DISPLAY)? != cia402::Mode::CyclicPosition as u32 {
        if clock::now() > deadline {
            return Err(query.fault("the drive does not change to cyclic synchronous position mode"));
        }
    }
    // With drives the period is in whole milliseconds. A drive that does not interpolate does not have this object.
    let millis = i64::try_from(period.as_millis()).unwrap_or(i64::MAX);
    for (object, value) in [(cia402::INTERPOLATION_PERIOD, millis), (cia402::INTERPOLATION_EXPONENT, -3)] {
        match query.try_set(node, object, value)? {
            Err(CanError::Aborted { code: NO_SUCH_OBJECT, .. }) => break,
            result => query.map_error(result)?,
        }
    }
    let mut entries =
        map_pdo_at_every_sync(Pdo::First, Direction::Receive, node, &[cia402::CONTROLWORD, cia402::TARGET_POSITION]);
    entries.extend(map_pdo_at_every_sync(Pdo::Second, Direction::Transmit, node, &[cia402::STATUSWORD]));
    start_drive(query, node, &entries)
}

#[cfg(test)]
mod tests {
    use super::super::config::Gains;
    use super::*;
    use crate::wire::can::mit::{self, Limits};

    const LIMITS: Limits = Limits::of(12.5, 30.0, 10.0);

    /// A motor behind a gear of 4 that turns in the opposite direction.
    fn movable_motor(family: Family) -> MovableMotor {
        let config = MotorConfig {
            joint: "elbow".to_owned(),
            bus_ix: 0,
            family,
            gear_ratio: 4.0,
            is_reversed: true,
            offset_rad: 0.5,
            gains: Some(Gains { stiffness_nm_rad: 160.0, damping_nm_s_rad: 16.0 }),
        };
        let motor = Motor::with_limits(config, LIMITS);
        MovableMotor { motor, health: None, drive: cia402::State::NotReadyToSwitchOn }
    }

    fn damiao() -> MovableMotor {
        movable_motor(Family::Damiao { motor: 1, feedback: 0x11 })
    }

    #[test]
    fn commands_are_in_motor_coordinates() {
        let sent = damiao().command(1.0, 0.25).expect("numbers");
        let got = mit::decode(sent.data().try_into().expect("eight bytes"), &LIMITS);
        // Half a raw unit of 16 and 12 bits.
        assert!((got.position_rad + 2.0).abs() < 2e-4 && (got.velocity_rad_s + 1.0).abs() < 8e-3, "{got:?}");
        assert!((got.kp_nm_rad - 10.0).abs() < 0.07 && (got.kd_nm_s_rad - 1.0).abs() < 7e-4, "{got:?}");
        assert!(got.torque_nm.abs() < 3e-3, "{got:?}");
        let damping_frames = damiao().shutdown(OnLoss::Damp, 1.0).expect("numbers");
        let got = mit::decode(damping_frames[0].data().try_into().expect("eight bytes"), &LIMITS);
        assert!(got.kp_nm_rad == 0.0 && (got.kd_nm_s_rad - 1.0).abs() < 7e-4, "{got:?}");
    }

    #[test]
    fn joint_limits_are_clamped_to_motor_range() {
        let wide = MotionLimits { position: [-9.0, f64::INFINITY], velocity: 20.0, acceleration: 1.0, jerk: 1.0 };
        let limits = damiao().limits(&wide);
        assert_eq!((limits.position, limits.velocity), ([0.5 - 3.125, 0.5 + 3.125], 7.5));
        let narrow = MotionLimits { position: [-1.0, 1.0], velocity: 0.5, acceleration: 1.0, jerk: 1.0 };
        assert_eq!(damiao().limits(&narrow), narrow);
    }

    #[test]
    fn commands_enable_drive_but_do_not_reset_faults() {
        let node = canopen::Node::new(5).expect("a node");
        let units = cia402::Units { counts_per_turn: 65_536.0, rated_torque_nm: 1.0 };
        let mut drive = movable_motor(Family::Cia402 { node, units });
        let mut process_state = |state: cia402::State| {
            let id = Pdo::Second.id(Direction::Transmit, node);
            let reported = Frame::classic(id, &state.statusword().to_le_bytes()).expect("two bytes");
            assert_eq!(drive.process_frame(&reported), None, "a statusword is not a position");
            let command = drive.command(0.5, 0.0).expect("numbers");
            assert_eq!((command.id(), &command.data()[2..]), (Pdo::First.id(Direction::Receive, node), &[0; 4][..]));
            (command.data()[0], drive.health().cloned())
        };
        assert_eq!(process_state(cia402::State::SwitchOnDisabled), (0x06, Some(Health::Off)));
        assert_eq!(process_state(cia402::State::ReadyToSwitchOn), (0x07, Some(Health::Off)));
        assert_eq!(process_state(cia402::State::SwitchedOn), (0x0F, Some(Health::Off)));
        assert_eq!(process_state(cia402::State::OperationEnabled), (0x0F, Some(Health::Enabled)));
        for state in [cia402::State::Fault, cia402::State::QuickStopActive] {
            let (controlword, health) = process_state(state);
            assert!(controlword == 0 && matches!(health, Some(Health::Fault(_))), "{state:?} {health:?}");
        }
    }
}
