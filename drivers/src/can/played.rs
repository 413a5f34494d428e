//! Motors as their bus sees them, for tests and simulators: they answer questions and report, as the makers' documents say.
//!
//! Written against the same documents as the codecs, so it shows that the driver works, not that the documents were understood;
//! only real motors do that.

use super::config::Family;
use crate::wire::can::canopen::{self, Direction, NodeState, Object, Pdo};
use crate::wire::can::damiao::{self, Access, Register, RegisterMessage, Value};
use crate::wire::can::mit::{Limits, Motion};
use crate::wire::can::robstride::{self, Faults};
use crate::wire::can::tmotor::{self, Fault, Health, Thermometer};
use crate::wire::can::{CanError, Frame, Id, cia402, odrive};
use kinematics::Stamp;
use std::collections::BTreeMap;
use std::time::Duration;

/// How often `ODrive` axes and Robstride motors report by themselves.
const REPORT: Duration = Duration::from_millis(10);
/// How often drives and `ODrive` axes say that they live.
const HEARTBEAT: Duration = Duration::from_millis(100);
/// Of windings and drives, degrees Celsius.
const CELSIUS: u8 = 30;

/// A motor.
#[derive(Debug)]
pub struct Played {
    family: Family,
    limits: Limits,
    motion: Motion,
    /// Whether it reports by itself.
    reports: bool,
    last_report: Option<Stamp>,
    last_heartbeat: Option<Stamp>,
    state: NodeState,
    /// Objects that were set.
    objects: BTreeMap<(u16, u8), u32>,
}

impl Played {
    /// A motor at rest at 0. `limits`: what a Damiao motor's registers tell; the others' follow from their models.
    pub fn new(family: Family, limits: Limits) -> Self {
        let limits = match family {
            Family::Robstride { model, .. } => model.limits(),
            Family::TMotor { model, .. } => model.limits(),
            _ => limits,
        };
        Self {
            family,
            limits,
            motion: Motion { position_rad: 0.0, velocity_rad_s: 0.0, torque_nm: 0.0 },
            reports: matches!(family, Family::Odrive { .. }),
            last_report: None,
            last_heartbeat: None,
            state: NodeState::PreOperational,
            objects: BTreeMap::new(),
        }
    }

    /// What its shaft does.
    pub fn set_motion(&mut self, motion: Motion) {
        self.motion = motion;
    }

    /// What it sends because of a frame; nothing where that is not for it. What its protocol cannot say is an error.
    pub fn take(&mut self, frame: &Frame) -> Result<Vec<Frame>, CanError> {
        match self.family {
            Family::Damiao { motor, feedback } => self.take_as_damiao(frame, motor, feedback),
            Family::Robstride { motor, .. } => {
                self.take_as_robstride(frame, motor);
                Ok(Vec::new())
            }
            Family::TMotor { motor, .. } => {
                let is_command = frame.id() == Id::standard(motor.into())? && frame.data().len() == 8;
                let health = Some(Health { drive_celsius: CELSIUS.into(), fault: Fault::None });
                let told = tmotor::Feedback { motor, motion: self.motion, health };
                let answer = || tmotor::encode_feedback(0, &told, &self.limits, Thermometer::Less40);
                if is_command { Ok(vec![answer()?]) } else { Ok(Vec::new()) }
            }
            Family::Odrive { .. } => Ok(Vec::new()),
            Family::Cia402 { node, units } => self.take_as_drive(frame, node, units),
        }
    }

    /// What it sends unasked by now.
    pub fn report(&mut self, now: Stamp) -> Result<Vec<Frame>, CanError> {
        let mut sent = Vec::new();
        if self.reports && is_due(&mut self.last_report, now, REPORT) {
            match self.family {
                Family::Robstride { motor, .. } => {
                    let told = robstride::Feedback {
                        motor,
                        is_unasked: true,
                        mode: robstride::Mode::Reset,
                        faults: Faults(0),
                        motion: self.motion,
                        winding_celsius: CELSIUS.into(),
                    };
                    sent.push(robstride::encode_feedback(super::ROBSTRIDE_HOST, &told, &self.limits)?);
                }
                Family::Odrive { node } => {
                    let Motion { position_rad, velocity_rad_s, .. } = self.motion;
                    sent.push(odrive::encode_answer(node, &odrive::Answer::Motion { position_rad, velocity_rad_s })?);
                }
                _ => {}
            }
        }
        match self.family {
            Family::Odrive { node } if is_due(&mut self.last_heartbeat, now, HEARTBEAT) => {
                let alive = odrive::Answer::Heartbeat { errors: 0, state: odrive::State::Idle };
                sent.push(odrive::encode_answer(node, &alive)?);
            }
            Family::Cia402 { node, .. } if is_due(&mut self.last_heartbeat, now, HEARTBEAT) => {
                sent.push(canopen::encode_heartbeat(node, self.state));
            }
            _ => {}
        }
        Ok(sent)
    }

    fn take_as_damiao(&self, frame: &Frame, motor: u16, feedback: u16) -> Result<Vec<Frame>, CanError> {
        let &[low, high, code, number, ..] = frame.data() else { return Ok(Vec::new()) };
        if frame.id() != Id::standard(0x7FF)? || u16::from_le_bytes([low, high]) != motor {
            return Ok(Vec::new());
        }
        let answer_id = Id::standard(feedback.into())?;
        #[expect(clippy::cast_possible_truncation, reason = "limits are small numbers")]
        let known = [
            (Register::PositionLimit, self.limits.position_rad as f32),
            (Register::VelocityLimit, self.limits.velocity_rad_s as f32),
            (Register::TorqueLimit, self.limits.torque_nm as f32),
        ];
        let told = known.into_iter().find(|(register, _)| *register as u8 == number);
        match (code, told) {
            (0x33, Some((register, value))) => {
                let access = Access::Told(register, Value::Real(value));
                Ok(vec![damiao::encode_register(&RegisterMessage { motor, access }, Some(answer_id))?])
            }
            (0xCC, _) => {
                let told = damiao::Feedback {
                    motor_low: motor.to_le_bytes()[0] & 0xF,
                    status: damiao::Status::Disabled,
                    motion: self.motion,
                    drive_celsius: CELSIUS,
                    rotor_celsius: CELSIUS,
                };
                Ok(vec![damiao::encode_feedback(answer_id, &told, &self.limits)?])
            }
            _ => Ok(Vec::new()),
        }
    }

    fn take_as_robstride(&mut self, frame: &Frame, motor: u8) {
        let [kind, _, _, to] = frame.id().value().to_be_bytes();
        if frame.id().is_extended() && to == motor && kind == 24 {
            self.reports = frame.data().get(6) == Some(&1);
        }
    }

    fn take_as_drive(
        &mut self,
        frame: &Frame,
        node: canopen::Node,
        units: cia402::Units,
    ) -> Result<Vec<Frame>, CanError> {
        if frame.is_remote() || frame.id().is_extended() {
            return Ok(Vec::new());
        }
        let sdo = 0x600 + u32::from(node.number());
        match (frame.id().value(), frame.data()) {
            (0, &[order, to]) if to == 0 || to == node.number() => {
                self.state = match order {
                    0x01 => NodeState::Operational,
                    0x02 => NodeState::Stopped,
                    0x80 => NodeState::PreOperational,
                    _ => NodeState::BootUp,
                };
                Ok(Vec::new())
            }
            (0x80, &[]) if self.state == NodeState::Operational => self.synchronous(node, units),
            (id, &[command, low, high, subindex, a, b, c, d]) if id == sdo && command >> 5 == 1 => {
                let index = u16::from_le_bytes([low, high]);
                self.objects.insert((index, subindex), u32::from_le_bytes([a, b, c, d]));
                let answer = [0x60, low, high, subindex, 0, 0, 0, 0];
                Ok(vec![Frame::classic(Id::standard(0x580 + u32::from(node.number()))?, &answer)?])
            }
            _ => Ok(Vec::new()),
        }
    }

    /// The first PDO as it was mapped, where it was switched on for every SYNC.
    fn synchronous(&self, node: canopen::Node, units: cia402::Units) -> Result<Vec<Frame>, CanError> {
        let object = |object: Object| self.objects.get(&(object.index, object.subindex)).copied();
        let id = Pdo::First.id(Direction::Transmit, node);
        let is_on = object(Pdo::First.communication(Direction::Transmit, 1)) == Some(id.value())
            && object(Pdo::First.communication(Direction::Transmit, 2)) == Some(1);
        if !is_on {
            return Ok(Vec::new());
        }
        let n = object(Pdo::First.mapping(Direction::Transmit, 0)).unwrap_or(0);
        let mut bytes = Vec::new();
        for place in 1..=u8::try_from(n).unwrap_or(8) {
            let mapped = object(Pdo::First.mapping(Direction::Transmit, place)).unwrap_or(0);
            let mapped = Object::from_mapped(mapped)?;
            let value = match mapped {
                cia402::POSITION => units.raw_from_rad("the position", self.motion.position_rad)?,
                cia402::VELOCITY => units.raw_from_rad("the velocity", self.motion.velocity_rad_s)?,
                _ => 0,
            };
            bytes.extend_from_slice(&value.to_le_bytes()[..usize::from(mapped.n_bytes)]);
        }
        Ok(vec![Frame::classic(id, &bytes)?])
    }
}

/// Whether so long has passed since the last time, which is then now.
fn is_due(last: &mut Option<Stamp>, now: Stamp, every: Duration) -> bool {
    let due = last.is_none_or(|last| now.duration_since(last) >= every);
    if due {
        *last = Some(now);
    }
    due
}
