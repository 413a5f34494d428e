//! One motor that may be moved: how it is made ready while it is switched off, what is said to it in each cycle, and how it is by
//! what it tells.
//!
//! Positions go as they are planned, with their velocity ahead where the protocol has a place for it. Motors in MIT mode get the
//! rig's stiffness and damping with each command; `ODrive` axes and CiA 402 drives keep the gains that they were tuned to.

use super::ROBSTRIDE_HOST;
use super::bus::Bus;
use super::config::{Family, MotorConfig};
use super::motor::{Motor, Reading, every_sync, start_drive};
use super::talk::Talk;
use super::watchdog::{self, Plan};
use crate::motion::{MotionLimits, OnLoss};
use crate::wire::can::canopen::{self, Direction, Pdo};
use crate::wire::can::damiao::{self, Access, Register, RegisterMessage};
use crate::wire::can::mit::Command;
use crate::wire::can::robstride::{self, Faults, Parameter, Request};
use crate::wire::can::tmotor::{self, Thermometer};
use crate::wire::can::{CanError, Frame, Id, cia402, odrive};
use crate::{Error, clock};
use std::time::Duration;

/// How long a motor may take to say that it is off, or in another mode.
const MAX_CHANGE: Duration = Duration::from_secs(1);
/// An `ODrive` axis tells by itself how it is ten times a second, and where it is a hundred times.
const ODRIVE_HEARTBEAT_HZ: f64 = 10.0;
/// ... and so does a Robstride motor.
const REPORT_HZ: f64 = 100.0;
/// A motor that tells unasked where it is does so at least this often.
const MAX_UNASKED: Duration = Duration::from_millis(50);
/// What an SDO answer says where a drive has no such object.
const NO_SUCH_OBJECT: u32 = 0x0602_0000;

/// How a motor is, by what it told last.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Health {
    /// Switched off.
    Off,
    /// It obeys commands.
    Obeys,
    /// It stopped by itself.
    Fault(String),
}

/// Frames of both sides that keep a motor moving: those of each cycle, and others with how often they come in a second.
pub(super) struct Traffic {
    pub(super) of_a_cycle: Vec<Frame>,
    pub(super) unasked: Vec<(Frame, f64)>,
}

/// A motor that may be moved, and is switched off until [`Mover::enable`] is sent.
#[derive(Debug)]
pub(super) struct Mover {
    motor: Motor,
    health: Option<Health>,
    /// State of a CiA 402 drive.
    drive: cia402::State,
}

impl Mover {
    /// Finds a motor, switches it off, forgets its faults, sets its watchdog and its mode, and reads both back.
    pub(super) fn make_ready(bus: &Bus, config: &MotorConfig, plan: &Plan) -> Result<Self, Error> {
        let motor = match config.family {
            // It answers commands only, and is asked with the order that switches it off.
            Family::TMotor { model, .. } => Motor::with_limits(config.clone(), model.limits()),
            _ => Motor::set_up(bus, config)?,
        };
        let mover = Self { motor, health: None, drive: cia402::State::NotReadyToSwitchOn };
        let talk = Talk::new(bus, config);
        mover.check_gains(&talk)?;
        mover.switch_off(&talk)?;
        watchdog::set(&talk, &config.family, mover.motor.limits(), plan)?;
        mover.set_mode(&talk, plan)?;
        Ok(mover)
    }

    pub(super) fn config(&self) -> &MotorConfig {
        self.motor.config()
    }

    /// The motor alone, for who only reads it.
    pub(super) fn motor(&self) -> &Motor {
        &self.motor
    }

    pub(super) fn health(&self) -> Option<&Health> {
        self.health.as_ref()
    }

    /// Forgets what it told about itself.
    pub(super) fn forget(&mut self) {
        self.health = None;
    }

    /// The joint's limits, and no further and faster than the motor's counts go.
    pub(super) fn limits(&self, joint: &MotionLimits) -> MotionLimits {
        let (config, per_turn) = (self.motor.config(), self.motor.per_turn());
        let (most_rad, most_rad_s) = match config.family {
            Family::Odrive { .. } => (f64::INFINITY, f64::INFINITY),
            Family::Cia402 { units, .. } => (units.rad_from_raw(i32::MAX), f64::INFINITY),
            _ => (self.motor.limits().position_rad, self.motor.limits().velocity_rad_s),
        };
        let most = most_rad * per_turn.abs();
        let [lower, upper] = joint.position;
        MotionLimits {
            position: [lower.max(config.offset_rad - most), upper.min(config.offset_rad + most)],
            velocity: joint.velocity.min(most_rad_s * per_turn.abs()),
            ..*joint
        }
    }

    /// How long it may be silent before it counts as lost, where `usual` is what others may.
    pub(super) fn max_silence(&self, usual: Duration) -> Duration {
        match self.motor.config().family {
            Family::Odrive { .. } => usual.max(MAX_UNASKED),
            _ => usual,
        }
    }

    /// What goes over its bus while it moves.
    pub(super) fn traffic(family: &Family) -> Traffic {
        let eight = |id: Id| Frame::classic(id, &[0; 8]).expect("eight bytes");
        let (short, long) = (eight(Id::standard(0).expect("small")), eight(Id::extended(0).expect("small")));
        let (of_a_cycle, unasked) = match family {
            Family::Damiao { .. } | Family::TMotor { .. } => (vec![short; 2], vec![]),
            Family::Robstride { .. } => (vec![long; 2], vec![(long, REPORT_HZ)]),
            Family::Odrive { .. } => (vec![short], vec![(short, REPORT_HZ), (short, ODRIVE_HEARTBEAT_HZ)]),
            // Target, position and state.
            Family::Cia402 { .. } => (vec![short; 3], vec![]),
        };
        Traffic { of_a_cycle, unasked }
    }

    /// What is sent so that it tells where it is while it is off; `None` where it tells unasked, or at a SYNC.
    pub(super) fn question(&self) -> Option<Frame> {
        match self.motor.config().family {
            Family::TMotor { motor, .. } => tmotor::encode_order(motor, tmotor::Order::Disable).ok(),
            _ => self.motor.question(),
        }
    }

    pub(super) fn wants_sync(&self) -> bool {
        self.motor.wants_sync()
    }

    /// What switches it on; a CiA 402 drive is brought there by its commands.
    pub(super) fn enable(&self) -> Result<Vec<Frame>, CanError> {
        let limits = self.motor.limits();
        match self.motor.config().family {
            Family::Damiao { motor, .. } => Ok(vec![damiao::encode_order(motor, damiao::Order::Enable)?]),
            Family::Robstride { motor, .. } => {
                Ok(vec![robstride::encode_request(ROBSTRIDE_HOST, motor, &Request::Enable, limits)?])
            }
            Family::TMotor { motor, .. } => Ok(vec![tmotor::encode_order(motor, tmotor::Order::Enable)?]),
            Family::Odrive { node } => {
                let closed = odrive::Request::SetState(odrive::State::ClosedLoopControl);
                // Its watchdog may have run out while it was off.
                [odrive::Request::ClearErrors, closed].iter().map(|it| odrive::encode_request(node, it)).collect()
            }
            Family::Cia402 { .. } => Ok(Vec::new()),
        }
    }

    /// A command: where its joint shall be and how fast, rad and rad/s.
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
                // What brings it one state nearer to obeying, and keeps it there; a fault is not reset by this.
                let order = match self.drive {
                    cia402::State::OperationEnabled => cia402::Order::EnableOperation,
                    state => state.order_to_enable(false).unwrap_or(cia402::Order::DisableVoltage),
                };
                let [low, high] = order.controlword().to_le_bytes();
                let [a, b, c, d] = units.raw_from_rad("the target position", position_rad)?.to_le_bytes();
                Frame::classic(Pdo::First.id(Direction::Receive, node), &[low, high, a, b, c, d])
            }
        }
    }

    /// What is said to it last, where it shall do by itself from now on what `on_loss` says; `position_rad` is where its joint was sent.
    pub(super) fn leave(&self, on_loss: OnLoss, position_rad: f64) -> Result<Vec<Frame>, CanError> {
        match (on_loss, self.motor.config().family) {
            (OnLoss::Release, _) => self.release(),
            (OnLoss::Hold, Family::Cia402 { node, .. }) => Ok(vec![order(node, cia402::Order::QuickStop)?]),
            (OnLoss::Hold, _) => Ok(vec![self.command(position_rad, 0.0)?]),
            (OnLoss::Damp, _) => Ok(vec![self.command_with(position_rad, 0.0, 0.0)?]),
        }
    }

    /// What switches it off.
    fn release(&self) -> Result<Vec<Frame>, CanError> {
        let frame = match self.motor.config().family {
            Family::Damiao { motor, .. } => damiao::encode_order(motor, damiao::Order::Disable),
            Family::Robstride { motor, .. } => {
                let stop = Request::Stop { clear_fault: false };
                robstride::encode_request(ROBSTRIDE_HOST, motor, &stop, self.motor.limits())
            }
            Family::TMotor { motor, .. } => tmotor::encode_order(motor, tmotor::Order::Disable),
            Family::Odrive { node } => odrive::encode_request(node, &odrive::Request::SetState(odrive::State::Idle)),
            Family::Cia402 { node, .. } => order(node, cia402::Order::DisableVoltage),
        };
        Ok(vec![frame?])
    }

    /// What its joint does, where a frame tells; how it is, is kept.
    pub(super) fn hear(&mut self, frame: &Frame) -> Option<Reading> {
        let reading = self.motor.read(frame);
        let is_feedback = reading.is_some();
        let limits = *self.motor.limits();
        let family = self.motor.config().family;
        match family {
            Family::Damiao { .. } if is_feedback => {
                let told = damiao::decode_feedback(frame, &limits).ok()?;
                self.health = Some(match told.status {
                    damiao::Status::Disabled => Health::Off,
                    damiao::Status::Enabled => Health::Obeys,
                    damiao::Status::LostCommunication => Health::Fault(LOST.to_owned()),
                    status => Health::Fault(format!("it stopped: {status:?}")),
                });
            }
            Family::Robstride { motor, .. } => match robstride::decode_answer(frame, ROBSTRIDE_HOST, &limits) {
                Ok(robstride::Answer::Feedback(told)) if told.motor == motor => {
                    self.health = Some(match (told.mode, told.faults) {
                        (robstride::Mode::Run, Faults(0)) => Health::Obeys,
                        (_, Faults(0)) => Health::Off,
                        (_, Faults(bits)) => Health::Fault(format!("it has the fault bits {bits:#08b}")),
                    });
                }
                Ok(robstride::Answer::Fault { motor: from, faults, .. }) if from == motor && faults != 0 => {
                    self.health = Some(Health::Fault(format!("it has the faults {faults:#x}")));
                }
                _ => {}
            },
            Family::TMotor { .. } if is_feedback => {
                let told = tmotor::decode_feedback(frame, &limits, Thermometer::Less40).ok()?;
                // It does not tell whether it obeys.
                self.health = Some(match told.health.map(|health| health.fault) {
                    None | Some(tmotor::Fault::None) => Health::Obeys,
                    Some(fault) => Health::Fault(format!("it stopped: {fault:?}")),
                });
            }
            Family::Odrive { node } => {
                if let Ok((from, odrive::Answer::Heartbeat { errors, state })) = odrive::decode_answer(frame)
                    && from == node
                {
                    self.health = Some(match (errors, state) {
                        (0, odrive::State::ClosedLoopControl) => Health::Obeys,
                        (0, _) => Health::Off,
                        (odrive::WATCHDOG_TIMER_EXPIRED, _) => Health::Fault(LOST.to_owned()),
                        (errors, _) => Health::Fault(format!("it has the errors {errors:#x}")),
                    });
                }
            }
            Family::Cia402 { node, .. } => {
                if let Some(state) = state_of(frame, node) {
                    self.drive = state;
                    self.health = Some(match state {
                        cia402::State::OperationEnabled => Health::Obeys,
                        cia402::State::QuickStopActive => Health::Fault("it made a quick stop".to_owned()),
                        cia402::State::Fault | cia402::State::FaultReactionActive => {
                            Health::Fault("it has a fault".to_owned())
                        }
                        _ => Health::Off,
                    });
                }
            }
            _ => {}
        }
        reading
    }

    /// Stiffness and damping of the motor: those of its joint, divided by the square of the gear's ratio.
    fn gains(&self) -> Option<[f64; 2]> {
        let squared = self.motor.per_turn().powi(2);
        let gains = self.motor.config().gains?;
        Some([gains.stiffness_nm_rad * squared, gains.damping_nm_s_rad * squared])
    }

    /// What its counts do not hold would be cut off without a word.
    fn check_gains(&self, talk: &Talk<'_>) -> Result<(), Error> {
        let Some([kp, kd]) = self.gains() else { return Ok(()) };
        let most = self.motor.limits();
        match kp <= most.kp_nm_rad && kd <= most.kd_nm_s_rad {
            true => Ok(()),
            false => Err(talk.fault(format!(
                "its stiffness and damping are {kp} N m / rad and {kd} N m s / rad at the motor, whose counts hold up to {} and {}",
                most.kp_nm_rad, most.kd_nm_s_rad
            ))),
        }
    }

    /// Switches it off and forgets what had stopped it, which is logged.
    fn switch_off(&self, talk: &Talk<'_>) -> Result<(), Error> {
        let stuck = |why: String| talk.fault(format!("it is to be switched off and does not say so: {why}"));
        match self.motor.config().family {
            Family::Damiao { motor, .. } => {
                let mut status = damiao::Status::Enabled;
                for order in [damiao::Order::Disable, damiao::Order::ClearError, damiao::Order::Disable] {
                    status = talk.ask(&talk.said(damiao::encode_order(motor, order))?, |frame| {
                        self.motor.read(frame)?;
                        damiao::decode_feedback(frame, self.motor.limits()).ok().map(|told| told.status)
                    })?;
                    if status == damiao::Status::Disabled {
                        return Ok(());
                    }
                    log::warn!("{}: it tells {status:?}", talk.name());
                }
                Err(stuck(format!("{status:?}")))
            }
            Family::Robstride { motor, .. } => {
                let limits = self.motor.limits();
                talk.robstride(motor, &Request::Stop { clear_fault: true }, limits)?;
                let mut last = None;
                let off =
                    talk.wait(MAX_CHANGE, |frame| match robstride::decode_answer(frame, ROBSTRIDE_HOST, limits) {
                        Ok(robstride::Answer::Feedback(told)) if told.motor == motor => {
                            last = Some((told.mode, told.faults));
                            (last == Some((robstride::Mode::Reset, Faults(0)))).then_some(())
                        }
                        _ => None,
                    })?;
                off.ok_or_else(|| stuck(format!("{last:?}")))
            }
            Family::TMotor { motor, .. } => {
                let disable = talk.said(tmotor::encode_order(motor, tmotor::Order::Disable))?;
                talk.ask(&disable, |frame| self.motor.read(frame)).map(drop)
            }
            Family::Odrive { node } => {
                let idle = odrive::Request::SetState(odrive::State::Idle);
                for request in [idle, odrive::Request::ClearErrors] {
                    talk.send(odrive::encode_request(node, &request))?;
                }
                let mut last = None;
                let off = talk.wait(MAX_CHANGE, |frame| match odrive::decode_answer(frame) {
                    Ok((from, odrive::Answer::Heartbeat { errors, state })) if from == node => {
                        last = Some((errors & !odrive::WATCHDOG_TIMER_EXPIRED, state));
                        (last == Some((0, odrive::State::Idle))).then_some(())
                    }
                    _ => None,
                })?;
                off.ok_or_else(|| stuck(format!("{last:?} (errors, state)")))
            }
            Family::Cia402 { node, .. } => {
                let until = clock::now() + MAX_CHANGE;
                loop {
                    let statusword = talk.get(node, cia402::STATUSWORD)?;
                    let [low, high, ..] = statusword.to_le_bytes();
                    let state = talk.said(cia402::State::from_statusword(u16::from_le_bytes([low, high])))?;
                    let wanted = match state {
                        cia402::State::SwitchOnDisabled => return Ok(()),
                        cia402::State::Fault => {
                            log::warn!("{}: it has a fault, which is reset", talk.name());
                            cia402::Order::ResetFault
                        }
                        _ => cia402::Order::DisableVoltage,
                    };
                    if clock::now() > until {
                        return Err(stuck(format!("{state:?}")));
                    }
                    // A reset counts when its bit rises.
                    for order in [cia402::Order::DisableVoltage, wanted] {
                        talk.set(node, cia402::CONTROLWORD, order.controlword().into())?;
                    }
                }
            }
        }
    }

    /// What commands mean to it.
    fn set_mode(&self, talk: &Talk<'_>, plan: &Plan) -> Result<(), Error> {
        let differs = |told: String| Err(talk.fault(format!("its mode was set and reads back as {told}")));
        match self.motor.config().family {
            Family::Damiao { motor, feedback } => {
                let wanted = damiao::Value::Whole(damiao::MIT_MODE);
                let access = Access::Write(Register::ControlMode, wanted);
                talk.send(damiao::encode_register(&RegisterMessage { motor, access }, None))?;
                match talk.register(motor, feedback, Register::ControlMode)? {
                    told if told == wanted => Ok(()),
                    told => differs(format!("{told:?}")),
                }
            }
            Family::Robstride { motor, .. } => {
                let wanted = robstride::Value::Whole(robstride::MOTION_MODE);
                talk.robstride(motor, &Request::Write(Parameter::RunMode, wanted), self.motor.limits())?;
                match talk.parameter(motor, Parameter::RunMode, self.motor.limits())? {
                    told if told == wanted => Ok(()),
                    told => differs(format!("{told:?}")),
                }
            }
            Family::TMotor { .. } => Ok(()),
            Family::Odrive { node } => {
                talk.send(odrive::encode_request(node, &odrive::Request::SetMode(odrive::Control::Position)))
            }
            Family::Cia402 { node, .. } => set_drive_mode(talk, node, plan.period),
        }
    }
}

/// What a motor tells whose own timeout has passed.
const LOST: &str = "nothing of us came to it for longer than its timeout";

/// An order to a drive outside the cycle.
fn order(node: canopen::Node, order: cia402::Order) -> Result<Frame, CanError> {
    canopen::encode_write(node, cia402::CONTROLWORD, order.controlword().into())
}

/// The state in a drive's second PDO.
fn state_of(frame: &Frame, node: canopen::Node) -> Option<cia402::State> {
    if frame.id() != Pdo::Second.id(Direction::Transmit, node) || frame.is_remote() {
        return None;
    }
    let statusword = u16::from_le_bytes(<[u8; 2]>::try_from(frame.data()).ok()?);
    cia402::State::from_statusword(statusword).ok()
}

/// A position at every SYNC, and the state told at every SYNC.
fn set_drive_mode(talk: &Talk<'_>, node: canopen::Node, period: Duration) -> Result<(), Error> {
    let supported = talk.get(node, cia402::SUPPORTED_MODES)?;
    if !cia402::Mode::CyclicPosition.is_in(supported) {
        return Err(talk.fault(format!(
            "the drive has no cyclic synchronous position mode (object 0x6502 is {supported:#x}), and no other is spoken"
        )));
    }
    talk.set(node, cia402::MODE, cia402::Mode::CyclicPosition as i64)?;
    let until = clock::now() + MAX_CHANGE;
    while talk.get(node, cia402::MODE_DISPLAY)? != cia402::Mode::CyclicPosition as u32 {
        if clock::now() > until {
            return Err(talk.fault("the drive does not change to cyclic synchronous position mode"));
        }
    }
    // The period is whole milliseconds where there are drives; one that does not interpolate has no such object.
    let millis = i64::try_from(period.as_millis()).unwrap_or(i64::MAX);
    for (object, value) in [(cia402::INTERPOLATION_PERIOD, millis), (cia402::INTERPOLATION_EXPONENT, -3)] {
        match talk.try_set(node, object, value)? {
            Err(CanError::Aborted { code: NO_SUCH_OBJECT, .. }) => break,
            done => talk.said(done)?,
        }
    }
    let mut entries = every_sync(Pdo::First, Direction::Receive, node, &[cia402::CONTROLWORD, cia402::TARGET_POSITION]);
    entries.extend(every_sync(Pdo::Second, Direction::Transmit, node, &[cia402::STATUSWORD]));
    start_drive(talk, node, &entries)
}

#[cfg(test)]
mod tests {
    use super::super::config::Gains;
    use super::*;
    use crate::wire::can::mit::{self, Limits};

    const LIMITS: Limits = Limits::of(12.5, 30.0, 10.0);

    /// Behind a gear of 4, turning the other way.
    fn mover(family: Family) -> Mover {
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
        Mover { motor, health: None, drive: cia402::State::NotReadyToSwitchOn }
    }

    fn damiao() -> Mover {
        mover(Family::Damiao { motor: 1, feedback: 0x11 })
    }

    #[test]
    fn commands_are_of_the_motor_in_front_of_the_gear() {
        let sent = damiao().command(1.0, 0.25).expect("numbers");
        let got = mit::decode(sent.data().try_into().expect("eight bytes"), &LIMITS);
        // Half a count of 16 and 12 bits.
        assert!((got.position_rad + 2.0).abs() < 2e-4 && (got.velocity_rad_s + 1.0).abs() < 8e-3, "{got:?}");
        assert!((got.kp_nm_rad - 10.0).abs() < 0.07 && (got.kd_nm_s_rad - 1.0).abs() < 7e-4, "{got:?}");
        assert!(got.torque_nm.abs() < 3e-3, "{got:?}");
        let damped = damiao().leave(OnLoss::Damp, 1.0).expect("numbers");
        let got = mit::decode(damped[0].data().try_into().expect("eight bytes"), &LIMITS);
        assert!(got.kp_nm_rad == 0.0 && (got.kd_nm_s_rad - 1.0).abs() < 7e-4, "{got:?}");
    }

    #[test]
    fn a_joint_goes_no_further_and_no_faster_than_its_motors_counts() {
        let wide = MotionLimits { position: [-9.0, f64::INFINITY], velocity: 20.0, acceleration: 1.0, jerk: 1.0 };
        let limits = damiao().limits(&wide);
        assert_eq!((limits.position, limits.velocity), ([0.5 - 3.125, 0.5 + 3.125], 7.5));
        let narrow = MotionLimits { position: [-1.0, 1.0], velocity: 0.5, acceleration: 1.0, jerk: 1.0 };
        assert_eq!(damiao().limits(&narrow), narrow);
    }

    #[test]
    fn a_drive_is_brought_to_obey_by_its_commands_and_not_out_of_a_fault() {
        let node = canopen::Node::new(5).expect("a node");
        let units = cia402::Units { counts_per_turn: 65_536.0, rated_torque_nm: 1.0 };
        let mut drive = mover(Family::Cia402 { node, units });
        let mut tell = |state: cia402::State| {
            let id = Pdo::Second.id(Direction::Transmit, node);
            let told = Frame::classic(id, &state.statusword().to_le_bytes()).expect("two bytes");
            assert_eq!(drive.hear(&told), None, "it is no position");
            let command = drive.command(0.5, 0.0).expect("numbers");
            assert_eq!((command.id(), &command.data()[2..]), (Pdo::First.id(Direction::Receive, node), &[0; 4][..]));
            (command.data()[0], drive.health().cloned())
        };
        assert_eq!(tell(cia402::State::SwitchOnDisabled), (0x06, Some(Health::Off)));
        assert_eq!(tell(cia402::State::ReadyToSwitchOn), (0x07, Some(Health::Off)));
        assert_eq!(tell(cia402::State::SwitchedOn), (0x0F, Some(Health::Off)));
        assert_eq!(tell(cia402::State::OperationEnabled), (0x0F, Some(Health::Obeys)));
        for state in [cia402::State::Fault, cia402::State::QuickStopActive] {
            let (controlword, health) = tell(state);
            assert!(controlword == 0 && matches!(health, Some(Health::Fault(_))), "{state:?} {health:?}");
        }
    }
}
