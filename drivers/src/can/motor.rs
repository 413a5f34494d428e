//! One motor of any family: what is said to it so that it tells where it is, and what its frames mean for its joint.
//!
//! Reading never commands: Damiao motors are asked for feedback, Robstride motors report by themselves once they are told to,
//! `ODrive` axes send their cyclic messages, CiA 402 drives answer each SYNC with a PDO. An AK motor in MIT mode speaks only when it is
//! commanded, and a command without gains would make it limp: so it is only listened to, while another master commands it.

use super::ROBSTRIDE_HOST;
use super::bus::{Arrived, Bus, WireErrors};
use super::config::{Family, MotorConfig};
use crate::wire::can::canopen::{self, Direction, Nmt, NodeState, Object, Pdo, SdoAnswer};
use crate::wire::can::damiao::{self, Access, Register, RegisterMessage, Value};
use crate::wire::can::mit::Limits;
use crate::wire::can::robstride::{self, Parameter, Request};
use crate::wire::can::tmotor::{self, Thermometer};
use crate::wire::can::{CanError, Frame, Id, cia402, odrive};
use crate::{Error, clock};
use std::cell::Cell;
use std::time::Duration;

/// How long an answer may take; on a full bus at 1 Mbit/s a frame waits for some milliseconds.
const MAX_ANSWER: Duration = Duration::from_millis(50);
/// How often a question is asked before the motor counts as silent.
const MAX_ASKED: usize = 4;
/// How long a motor that reports by itself may take to do so.
const MAX_REPORT: Duration = Duration::from_secs(1);
/// Value of [`Parameter::ReportInterval`] for the shortest interval there is.
const SHORTEST_REPORT: u32 = 1;
/// Seconds from report to report at that value.
const ROBSTRIDE_REPORT_SECS: f64 = 0.01;
/// The usual interval of an `ODrive` encoder's message.
const ODRIVE_REPORT_SECS: f64 = 0.01;
/// An interval at which a drive sends its heartbeat, milliseconds.
const HEARTBEAT_MILLIS: i64 = 500;
/// A PDO's entry 2: send at every SYNC.
const EVERY_SYNC: i64 = 1;
/// Bit of a PDO's entry 1 that switches it off.
const PDO_OFF: i64 = 1 << 31;

/// What a joint does.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Reading {
    pub(super) position_rad: f64,
    pub(super) velocity_rad_s: f64,
    pub(super) effort_nm: Option<f64>,
}

/// A motor that was found on its bus.
#[derive(Clone, Debug)]
pub(super) struct Motor {
    config: MotorConfig,
    limits: Limits,
}

impl Motor {
    /// Asks the motor for what its counts cover, and has it report.
    pub(super) fn set_up(bus: &Bus, config: &MotorConfig) -> Result<Self, Error> {
        let talk = Talk { bus, config, errors: Cell::default() };
        let mut motor = Self { config: config.clone(), limits: Limits::of(1.0, 1.0, 1.0) };
        match config.family {
            Family::Damiao { motor: number, feedback } => {
                let [p_max, v_max, t_max] = [Register::PositionLimit, Register::VelocityLimit, Register::TorqueLimit]
                    .map(|register| talk.register(number, feedback, register));
                motor.limits = talk.said(damiao::limits_from_registers(p_max?, v_max?, t_max?))?;
                log::debug!("{}: counts cover {:?}", talk.name(), motor.limits);
            }
            Family::Robstride { motor: number, model } => {
                motor.limits = model.limits();
                let interval = Request::Write(Parameter::ReportInterval, robstride::Value::Whole(SHORTEST_REPORT));
                for request in [interval, Request::ReportActively(true)] {
                    let request = robstride::encode_request(ROBSTRIDE_HOST, number, &request, &motor.limits);
                    bus.send(&talk.said(request)?)?;
                }
                motor
                    .hear(&talk, "it does not report; is its number right, and its firmware one with active report?")?;
            }
            Family::TMotor { model, .. } => {
                motor.limits = model.limits();
                motor.hear(
                    &talk,
                    "an AK motor in MIT mode speaks only when another master commands it, and none does",
                )?;
            }
            Family::Odrive { .. } => motor.hear(
                &talk,
                "it sends no encoder estimates; set axis0.config.can.encoder_msg_rate_ms = 10, and look at its node_id",
            )?,
            Family::Cia402 { node, .. } => set_up_drive(&talk, node)?,
        }
        Ok(motor)
    }

    #[cfg(test)]
    pub(super) fn with_limits(config: MotorConfig, limits: Limits) -> Self {
        Self { config, limits }
    }

    pub(super) fn config(&self) -> &MotorConfig {
        &self.config
    }

    /// What is sent in each cycle so that it tells where it is; `None` where it tells unasked, or at a SYNC.
    pub(super) fn question(&self) -> Option<Frame> {
        match self.config.family {
            Family::Damiao { motor, .. } => {
                damiao::encode_register(&RegisterMessage { motor, access: Access::Refresh }, None).ok()
            }
            _ => None,
        }
    }

    pub(super) fn wants_sync(&self) -> bool {
        matches!(self.config.family, Family::Cia402 { .. })
    }

    /// A frame like those that tell where it is, and how often it comes in a second where that is not ours to say.
    pub(super) fn usual_answer(&self) -> (Frame, Option<f64>) {
        let (id, rate_hz) = match self.config.family {
            Family::Damiao { feedback, .. } => (Id::standard(feedback.into()), None),
            Family::Robstride { .. } => (Id::extended(0), Some(1.0 / ROBSTRIDE_REPORT_SECS)),
            Family::TMotor { .. } => (Id::standard(0), Some(0.0)),
            Family::Odrive { .. } => (Id::standard(0), Some(1.0 / ODRIVE_REPORT_SECS)),
            Family::Cia402 { node, .. } => (Ok(Pdo::First.id(Direction::Transmit, node)), None),
        };
        let id = id.unwrap_or(Id::standard(0).expect("the least there is"));
        (Frame::classic(id, &[0; 8]).expect("eight bytes"), rate_hz)
    }

    /// What its joint does, where a frame tells; `None` where it is of another motor or about something else.
    pub(super) fn read(&self, frame: &Frame) -> Option<Reading> {
        let (position, velocity, torque) = match self.config.family {
            Family::Damiao { motor, feedback } => {
                let is_its = frame.id() == Id::standard(feedback.into()).ok()? && !is_register(frame, motor);
                let told = is_its.then(|| damiao::decode_feedback(frame, &self.limits).ok()).flatten()?;
                if u16::from(told.motor_low) != motor & 0xF {
                    return None;
                }
                (told.motion.position_rad, told.motion.velocity_rad_s, Some(told.motion.torque_nm))
            }
            Family::Robstride { motor, .. } => match robstride::decode_answer(frame, ROBSTRIDE_HOST, &self.limits) {
                Ok(robstride::Answer::Feedback(told)) if told.motor == motor => {
                    (told.motion.position_rad, told.motion.velocity_rad_s, Some(told.motion.torque_nm))
                }
                _ => return None,
            },
            Family::TMotor { motor, .. } => {
                // Commands to motors bear their numbers; what comes back bears the master's, and the motor's in its first byte.
                if frame.id().value() == u32::from(motor) {
                    return None;
                }
                let told = tmotor::decode_feedback(frame, &self.limits, Thermometer::Less40).ok()?;
                if told.motor != motor {
                    return None;
                }
                (told.motion.position_rad, told.motion.velocity_rad_s, Some(told.motion.torque_nm))
            }
            Family::Odrive { node } => match odrive::decode_answer(frame) {
                Ok((from, odrive::Answer::Motion { position_rad, velocity_rad_s })) if from == node => {
                    (position_rad, velocity_rad_s, None)
                }
                _ => return None,
            },
            Family::Cia402 { node, units } => {
                if frame.id() != Pdo::First.id(Direction::Transmit, node) || frame.is_remote() {
                    return None;
                }
                let [a, b, c, d, e, f, g, h] = *<&[u8; 8]>::try_from(frame.data()).ok()?;
                let [position, velocity] = [[a, b, c, d], [e, f, g, h]].map(i32::from_le_bytes);
                (units.rad_from_raw(position), units.rad_from_raw(velocity), None)
            }
        };
        let direction = if self.config.is_reversed { -1.0 } else { 1.0 };
        let per_turn = direction / self.config.gear_ratio;
        Some(Reading {
            position_rad: position * per_turn + self.config.offset_rad,
            velocity_rad_s: velocity * per_turn,
            effort_nm: torque.map(|torque| torque / per_turn),
        })
    }

    /// Waits until the motor tells where it is.
    fn hear(&self, talk: &Talk<'_>, silent: &str) -> Result<(), Error> {
        talk.wait(MAX_REPORT, |frame| self.read(frame))?.map(drop).ok_or_else(|| talk.fault(silent))
    }
}

/// Whether a Damiao motor's frame is about a register: an answer that came too late for its question is no feedback.
fn is_register(frame: &Frame, motor: u16) -> bool {
    damiao::decode_register(frame).is_ok_and(|message| message.motor == motor)
}

/// A conversation with one motor while nothing else reads the bus.
struct Talk<'a> {
    bus: &'a Bus,
    config: &'a MotorConfig,
    errors: Cell<WireErrors>,
}

impl Talk<'_> {
    fn name(&self) -> String {
        format!("joint {:?} on {:?}", self.config.joint, self.bus.config().interface)
    }

    fn fault(&self, reason: impl Into<String>) -> Error {
        let interface = self.bus.config().interface.clone();
        Error::Motor { joint: self.config.joint.clone(), interface, reason: reason.into() }
    }

    /// What a codec said, as an error of this motor.
    fn said<T>(&self, result: Result<T, CanError>) -> Result<T, Error> {
        result.map_err(|error| self.fault(error.to_string()))
    }

    /// The first frame within a time that `answers`.
    fn wait<T>(&self, within: Duration, mut answers: impl FnMut(&Frame) -> Option<T>) -> Result<Option<T>, Error> {
        let until = clock::now() + within;
        loop {
            let left = until.duration_since(clock::now());
            if left.is_zero() {
                return Ok(None);
            }
            match self.bus.receive(left)? {
                Some((_, Arrived::Frame(frame))) => {
                    if let Some(answer) = answers(&frame) {
                        return Ok(Some(answer));
                    }
                }
                Some((_, Arrived::Errors(more))) => {
                    let mut errors = self.errors.get();
                    errors.add(&more);
                    self.errors.set(errors);
                }
                None => {}
            }
        }
    }

    /// Asks until an answer comes, some times.
    fn ask<T>(&self, question: &Frame, mut answers: impl FnMut(&Frame) -> Option<T>) -> Result<T, Error> {
        for _ in 0..MAX_ASKED {
            self.bus.send(question)?;
            if let Some(answer) = self.wait(MAX_ANSWER, &mut answers)? {
                return Ok(answer);
            }
        }
        let errors = self.errors.get();
        Err(self.fault(match errors.n_unacknowledged + errors.n_bus_off {
            0 => format!("no answer to {MAX_ASKED} questions; is the motor powered and its number right?"),
            _ => "nobody acknowledges frames: the others are off, at another bit rate, or the bus is cut or not terminated"
                .to_owned(),
        }))
    }

    /// Reads a register of a Damiao motor that holds a real number.
    fn register(&self, motor: u16, feedback: u16, register: Register) -> Result<f32, Error> {
        let question = RegisterMessage { motor, access: Access::Read(register) };
        let question = self.said(damiao::encode_register(&question, None))?;
        let answer_id = self.said(Id::standard(feedback.into()))?;
        self.ask(&question, |frame| match damiao::decode_register(frame) {
            Ok(RegisterMessage { motor: from, access: Access::Told(told, Value::Real(value)) })
                if frame.id() == answer_id && from == motor && told == register =>
            {
                Some(value)
            }
            _ => None,
        })
    }

    /// Sets an object of a CANopen node.
    fn set(&self, node: canopen::Node, object: Object, value: i64) -> Result<(), Error> {
        let question = self.said(canopen::encode_write(node, object, value))?;
        let answer = self.ask(&question, |frame| match canopen::decode_sdo(frame) {
            Ok((from, SdoAnswer::Written { index, subindex })) => {
                (from == node && (index, subindex) == (object.index, object.subindex)).then_some(Ok(()))
            }
            Err(error @ CanError::Aborted { index, .. }) => (index == object.index).then_some(Err(error)),
            _ => None,
        })?;
        self.said(answer)
    }
}

/// Has a drive send position and velocity at every SYNC, and starts it; it stays switched off.
///
/// Source: CiA 301, section 7.5.2.36: a PDO is switched off while its mapping is changed.
fn set_up_drive(talk: &Talk<'_>, node: canopen::Node) -> Result<(), Error> {
    let pdo = |entry| Pdo::First.communication(Direction::Transmit, entry);
    let place = |place| Pdo::First.mapping(Direction::Transmit, place);
    let id = i64::from(Pdo::First.id(Direction::Transmit, node).value());
    talk.bus.send(&canopen::encode_nmt(Nmt::EnterPreOperational, Some(node)))?;
    for (object, value) in [
        (pdo(1), id | PDO_OFF),
        (place(0), 0),
        (place(1), cia402::POSITION.mapped().into()),
        (place(2), cia402::VELOCITY.mapped().into()),
        (place(0), 2),
        (pdo(2), EVERY_SYNC),
        (pdo(1), id),
        (canopen::PRODUCER_HEARTBEAT, HEARTBEAT_MILLIS),
    ] {
        talk.set(node, object, value)?;
    }
    talk.bus.send(&canopen::encode_nmt(Nmt::Start, Some(node)))?;
    let started = talk.wait(MAX_REPORT, |frame| match canopen::decode_heartbeat(frame) {
        Ok((from, NodeState::Operational)) => (from == node).then_some(()),
        _ => None,
    })?;
    started.ok_or_else(|| talk.fault("the drive was started and does not say that it is operational"))
}
