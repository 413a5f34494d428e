//! One motor of any family: the frames that make it report its position, and what its frames mean for its joint.
//!
//! Reading never commands a motor. Damiao motors are polled for feedback, Robstride motors report periodically once
//! configured, `ODrive` axes send cyclic messages, and CiA 402 drives answer each SYNC with a PDO. An AK motor in MIT
//! mode answers only commands, and a command without gains would make it limp. It is therefore only listened to,
//! while another master commands it.

use super::ROBSTRIDE_HOST;
use super::config::{Family, MotorConfig};
use super::frame_io::FrameIo;
use super::query::MotorQuery;
use crate::Error;
use crate::wire::can::canopen::{self, Direction, Nmt, NodeState, Object, Pdo};
use crate::wire::can::damiao::{self, Access, Register, RegisterMessage, Value};
use crate::wire::can::mit::Limits;
use crate::wire::can::robstride::{self, Parameter, Request};
use crate::wire::can::tmotor::{self, Thermometer};
use crate::wire::can::{Frame, Id, cia402, odrive};
use std::time::Duration;

/// Maximum time until the first report of a motor that reports unasked.
const MAX_REPORT: Duration = Duration::from_secs(1);
/// Value of [`Parameter::ReportInterval`] for the shortest interval.
const SHORTEST_REPORT: u32 = 1;
/// Report interval at that value, seconds.
const ROBSTRIDE_REPORT_SECS: f64 = 0.01;
/// Default interval of an `ODrive` encoder's message, seconds.
const ODRIVE_REPORT_SECS: f64 = 0.01;
/// Heartbeat interval that a drive is set to, milliseconds.
const HEARTBEAT_MILLIS: i64 = 500;
/// PDO communication entry 2: send at every SYNC.
const EVERY_SYNC: i64 = 1;
/// Bit of PDO communication entry 1 that disables the PDO.
const PDO_OFF: i64 = 1 << 31;
/// Greater positions (rad) or velocities (rad/s) of a joint are treated as noise.
pub(super) const MAX_RAD: f64 = 1e4;

/// Position, velocity and effort of a joint.
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
    /// Reads the ranges of the motor's raw values, if it has them, and makes it report.
    pub(super) fn set_up(bus: &dyn FrameIo, config: &MotorConfig) -> Result<Self, Error> {
        let query = MotorQuery::new(bus, &config.joint);
        let mut motor = Self::with_limits(config.clone(), Limits::of(1.0, 1.0, 1.0));
        match config.family {
            Family::Damiao { motor: number, feedback } => {
                let real = |register| match query.register(number, feedback, register)? {
                    Value::Float(real) => Ok(real),
                    Value::Integer(_) => {
                        Err(query.fault(format!("register {register:?} is not a floating-point number")))
                    }
                };
                let [p_max, v_max, t_max] =
                    [Register::PositionLimit, Register::VelocityLimit, Register::TorqueLimit].map(real);
                motor.limits = query.map_error(damiao::limits_from_registers(p_max?, v_max?, t_max?))?;
                log::debug!("{}: ranges of raw values: {:?}", query.name(), motor.limits);
            }
            Family::Robstride { motor: number, model } => {
                motor.limits = model.limits();
                let interval = Request::Write(Parameter::ReportInterval, robstride::Value::Integer(SHORTEST_REPORT));
                for request in [interval, Request::ReportActively(true)] {
                    query.robstride(number, &request, &motor.limits)?;
                }
                motor.wait_for_reading(
                    &query,
                    "the motor does not report; check its id, and whether its firmware supports active reporting",
                )?;
            }
            Family::TMotor { model, .. } => {
                motor.limits = model.limits();
                motor.wait_for_reading(
                    &query,
                    "an AK motor in MIT mode answers only when another master commands it, and none does",
                )?;
            }
            Family::Odrive { .. } => motor.wait_for_reading(
                &query,
                "it sends no encoder estimates; set axis0.config.can.encoder_msg_rate_ms = 10, and check its node_id",
            )?,
            Family::Cia402 { node, .. } => set_up_drive(&query, node)?,
        }
        Ok(motor)
    }

    /// A motor with these ranges of its raw values.
    pub(super) fn with_limits(config: MotorConfig, limits: Limits) -> Self {
        Self { config, limits }
    }

    pub(super) fn config(&self) -> &MotorConfig {
        &self.config
    }

    /// Ranges of its raw values, for families that have them.
    pub(super) fn limits(&self) -> &Limits {
        &self.limits
    }

    /// Turns of the joint per turn of the motor; negative if they turn in opposite directions.
    pub(super) fn per_turn(&self) -> f64 {
        let direction = if self.config.is_reversed { -1.0 } else { 1.0 };
        direction / self.config.gear_ratio
    }

    /// The frame that polls its position in each cycle; `None` if it reports unasked or at a SYNC.
    pub(super) fn poll_frame(&self) -> Option<Frame> {
        match self.config.family {
            Family::Damiao { motor, .. } => {
                damiao::encode_register(&RegisterMessage { motor, access: Access::Refresh }, None).ok()
            }
            _ => None,
        }
    }

    pub(super) fn needs_sync(&self) -> bool {
        matches!(self.config.family, Family::Cia402 { .. })
    }

    /// A frame like its position reports, and their rate in Hz if the motor determines it.
    pub(super) fn typical_answer(&self) -> (Frame, Option<f64>) {
        let (id, rate_hz) = match self.config.family {
            Family::Damiao { feedback, .. } => (Id::standard(feedback.into()), None),
            Family::Robstride { .. } => (Id::extended(0), Some(1.0 / ROBSTRIDE_REPORT_SECS)),
            Family::TMotor { .. } => (Id::standard(0), Some(0.0)),
            Family::Odrive { .. } => (Id::standard(0), Some(1.0 / ODRIVE_REPORT_SECS)),
            Family::Cia402 { node, .. } => (Ok(Pdo::First.id(Direction::Transmit, node)), None),
        };
        let id = id.unwrap_or(Id::standard(0).expect("0 is a valid identifier"));
        (Frame::classic(id, &[0; 8]).expect("eight bytes"), rate_hz)
    }

    /// The reading of its joint in a frame; `None` if the frame is from another motor or has other content.
    pub(super) fn read(&self, frame: &Frame) -> Option<Reading> {
        let (position, velocity, torque) = match self.config.family {
            Family::Damiao { motor, feedback } => {
                let is_from_motor = frame.id() == Id::standard(feedback.into()).ok()? && !is_register(frame, motor);
                let feedback_message =
                    is_from_motor.then(|| damiao::decode_feedback(frame, &self.limits).ok()).flatten()?;
                if u16::from(feedback_message.motor_low) != motor & 0xF {
                    return None;
                }
                (
                    feedback_message.motion.position_rad,
                    feedback_message.motion.velocity_rad_s,
                    Some(feedback_message.motion.torque_nm),
                )
            }
            Family::Robstride { motor, .. } => match robstride::decode_answer(frame, ROBSTRIDE_HOST, &self.limits) {
                Ok(robstride::Answer::Feedback(feedback_message)) if feedback_message.motor == motor => (
                    feedback_message.motion.position_rad,
                    feedback_message.motion.velocity_rad_s,
                    Some(feedback_message.motion.torque_nm),
                ),
                _ => return None,
            },
            Family::TMotor { motor, .. } => {
                // Commands carry the motor's number as identifier; answers carry the master's, and the motor's number
                // in the first byte.
                if frame.id().value() == u32::from(motor) {
                    return None;
                }
                let feedback_message = tmotor::decode_feedback(frame, &self.limits, Thermometer::Offset40).ok()?;
                if feedback_message.motor != motor {
                    return None;
                }
                (
                    feedback_message.motion.position_rad,
                    feedback_message.motion.velocity_rad_s,
                    Some(feedback_message.motion.torque_nm),
                )
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
        let per_turn = self.per_turn();
        let reading = Reading {
            position_rad: position * per_turn + self.config.offset_rad,
            velocity_rad_s: velocity * per_turn,
            effort_nm: torque.map(|torque| torque / per_turn),
        };
        (reading.position_rad.abs() <= MAX_RAD && reading.velocity_rad_s.abs() <= MAX_RAD).then_some(reading)
    }

    /// Waits for the first reading.
    fn wait_for_reading(&self, query: &MotorQuery<'_>, timeout_reason: &str) -> Result<(), Error> {
        query.wait(MAX_REPORT, |frame| self.read(frame))?.map(drop).ok_or_else(|| query.fault(timeout_reason))
    }
}

/// Whether a frame of a Damiao motor is a register answer: an answer that arrives late must not be taken for
/// feedback.
fn is_register(frame: &Frame, motor: u16) -> bool {
    damiao::decode_register(frame).is_ok_and(|message| message.motor == motor)
}

/// Makes a drive send position and velocity at every SYNC, and starts it. The drive stays disabled.
fn set_up_drive(query: &MotorQuery<'_>, node: canopen::Node) -> Result<(), Error> {
    let mut entries =
        map_pdo_at_every_sync(Pdo::First, Direction::Transmit, node, &[cia402::POSITION, cia402::VELOCITY]);
    entries.push((canopen::PRODUCER_HEARTBEAT, HEARTBEAT_MILLIS));
    start_drive(query, node, &entries)
}

/// The entries that map objects into a PDO of a drive and have it sent, or accepted, at every SYNC.
///
/// Source: CiA 301, section 7.5.2.36: a PDO is disabled while its mapping is changed.
pub(super) fn map_pdo_at_every_sync(
    pdo: Pdo,
    direction: Direction,
    node: canopen::Node,
    objects: &[Object],
) -> Vec<(Object, i64)> {
    let id = i64::from(pdo.id(direction, node).value());
    let mut entries = vec![(pdo.communication(direction, 1), id | PDO_OFF), (pdo.mapping(direction, 0), 0)];
    for (entry, object) in (1..).zip(objects) {
        entries.push((pdo.mapping(direction, entry), object.mapped().into()));
    }
    entries.push((pdo.mapping(direction, 0), i64::try_from(objects.len()).expect("at most eight objects")));
    entries.extend([(pdo.communication(direction, 2), EVERY_SYNC), (pdo.communication(direction, 1), id)]);
    entries
}

/// Writes entries while a drive's PDOs are inactive, then starts the PDOs.
pub(super) fn start_drive(query: &MotorQuery<'_>, node: canopen::Node, entries: &[(Object, i64)]) -> Result<(), Error> {
    query.send(Ok(canopen::encode_nmt(Nmt::EnterPreOperational, Some(node))))?;
    for (object, value) in entries {
        query.set(node, *object, *value)?;
    }
    query.send(Ok(canopen::encode_nmt(Nmt::Start, Some(node))))?;
    let started = query.wait(MAX_REPORT, |frame| match canopen::decode_heartbeat(frame) {
        Ok((from, NodeState::Operational)) => (from == node).then_some(()),
        _ => None,
    })?;
    started.ok_or_else(|| query.fault("the drive was started but did not report the operational state"))
}
