//! Damiao motors. They answer each command and each poll with feedback. The ranges of their raw
//! values are in their registers.
//!
//! Watchdog: register `TIMEOUT`. When it expires, the motor leaves the enabled state and reports
//! "communication lost". Source: Damiao DM-J4310-2EC manual V1.0, as in
//! `jia-xie/python-damiao-driver` `docs/concept/`.

pub mod codec;
#[cfg(feature = "emulation")]
mod emulated;
#[cfg(any(test, fuzzing))]
mod fuzz;
mod motion;

use super::family::{
    MotionProtocol, MotorFamily, MotorProtocol, MotorReading, Reports, Traffic, frame_of_8_bytes,
    short_frame,
};
use super::query::MotorQuery;
use super::settings::{AllowedValues, MotorKey, MotorSettings, SettingValue};
use super::watchdog::Watchdog;
use crate::Error;
use crate::motion::OnLoss;
use crate::wire::can::mit::Limits;
use crate::wire::can::{Frame, Id};
use codec::{Access, Register, RegisterMessage, Value};
use std::ops::RangeInclusive;
use std::sync::Arc;

/// Maximum ID of a motor and of its answers. The next higher ID is that of register messages.
const MAX_ID: u64 = 0x7FE;
const FEEDBACK_ID: &str = "feedback_id";
/// IDs of motors that are searched. New motors have the ID 1, and arms number their motors.
const SEARCHED_IDS: RangeInclusive<u16> = 1..=32;

/// The family.
#[derive(Debug)]
pub struct DamiaoFamily;

impl MotorFamily for DamiaoFamily {
    fn name(&self) -> &'static str {
        "damiao"
    }

    fn title(&self) -> &'static str {
        "Damiao"
    }

    fn ids(&self) -> RangeInclusive<u64> {
        0..=MAX_ID
    }

    fn keys(&self) -> Vec<MotorKey> {
        vec![MotorKey {
            name: FEEDBACK_ID,
            allowed: AllowedValues::Whole(0..=MAX_ID),
            required: Some("CAN ID of the motor's feedback, its register MST_ID"),
        }]
    }

    fn has_gains(&self) -> bool {
        true
    }

    fn motor(&self, settings: &MotorSettings) -> Option<Arc<dyn MotorProtocol>> {
        let motor = u16::try_from(settings.id).ok()?;
        let feedback = u16::try_from(settings.whole(FEEDBACK_ID)?).ok()?;
        Some(Arc::new(Damiao { motor, feedback }))
    }

    fn identification_requests(&self) -> Vec<Frame> {
        SEARCHED_IDS.filter_map(feedback_id_request).collect()
    }

    /// Reads the answer to a request for the feedback ID: it has the CAN ID that it reports.
    fn identify(&self, frame: &Frame) -> Option<MotorSettings> {
        let message = codec::decode_register(frame).ok()?;
        let Access::Reported(Register::FeedbackId, Value::Integer(feedback)) = message.access
        else {
            return None;
        };
        let is_from_motor = frame.id() == Id::standard(feedback).ok()?;
        let feedback = SettingValue::Whole(feedback.into());
        is_from_motor.then(|| MotorSettings::new(message.motor).with(FEEDBACK_ID, feedback))
    }

    #[cfg(any(test, fuzzing))]
    fn fuzzing(&self) -> super::family::FamilyFuzzing {
        fuzz::fuzzing()
    }
}

/// The request for the feedback ID of a motor.
fn feedback_id_request(motor: u16) -> Option<Frame> {
    let access = Access::Read(Register::FeedbackId);
    codec::encode_register(&RegisterMessage { motor, access }, None).ok()
}

/// A Damiao motor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Damiao {
    /// Motor ID.
    pub motor: u16,
    /// CAN ID of its answers (register `MST_ID`).
    pub feedback: u16,
}

impl Damiao {
    /// Reads a register.
    fn register(self, query: &MotorQuery<'_>, register: Register) -> Result<Value, Error> {
        let poll_frame = RegisterMessage {
            motor: self.motor,
            access: Access::Read(register),
        };
        let poll_frame = query.map_error(codec::encode_register(&poll_frame, None))?;
        let answer_id = query.map_error(Id::standard(self.feedback.into()))?;
        // Several motors may answer with the same CAN ID, so the answer must also name the motor
        // and the register.
        query.request_answer(&poll_frame, |frame| match codec::decode_register(frame) {
            Ok(RegisterMessage {
                motor: from,
                access: Access::Reported(reported, value),
            }) if frame.id() == answer_id && from == self.motor && reported == register => {
                Some(value)
            }
            _ => None,
        })
    }

    /// Reads a register that contains a floating-point number.
    fn float_register(self, query: &MotorQuery<'_>, register: Register) -> Result<f32, Error> {
        match self.register(query, register)? {
            Value::Float(real) => Ok(real),
            Value::Integer(_) => Err(query.fault(format!(
                "register {register:?} is not a floating-point number"
            ))),
        }
    }

    /// The feedback in a frame; `None` if the frame is from another motor or has other content.
    fn feedback(self, frame: &Frame, limits: &Limits) -> Option<codec::Feedback> {
        let is_from_motor =
            frame.id() == Id::standard(self.feedback.into()).ok()? && !self.is_register(frame);
        let feedback = is_from_motor
            .then(|| codec::decode_feedback(frame, limits).ok())
            .flatten()?;
        // Feedback contains only the lower four bits of the ID. They detect a second motor with the
        // same feedback ID.
        (u16::from(feedback.motor_low) == self.motor & 0xF).then_some(feedback)
    }

    /// Whether a frame from the motor is a register answer. A late register answer must not be
    /// mistaken for feedback.
    fn is_register(self, frame: &Frame) -> bool {
        codec::decode_register(frame).is_ok_and(|message| message.motor == self.motor)
    }
}

impl MotorProtocol for Damiao {
    fn family(&self) -> &'static dyn MotorFamily {
        &DamiaoFamily
    }

    fn settings(&self) -> MotorSettings {
        MotorSettings::new(self.motor).with(FEEDBACK_ID, SettingValue::Whole(self.feedback.into()))
    }

    /// Returns both IDs, because a motor would mistake answers of another motor with its ID for
    /// commands.
    fn addresses(&self) -> Vec<u32> {
        vec![self.motor.into(), self.feedback.into()]
    }

    fn ranges(&self) -> Option<Limits> {
        None
    }

    fn set_up(&self, query: &MotorQuery<'_>) -> Result<Limits, Error> {
        // The ranges are read from the registers instead of taken from the model, because owners
        // can change these registers. With wrong ranges, all positions would be scaled wrongly
        // without any error.
        let [p_max, v_max, t_max] = [
            Register::PositionLimit,
            Register::VelocityLimit,
            Register::TorqueLimit,
        ]
        .map(|register| self.float_register(query, register));
        let limits = query.map_error(codec::limits_from_registers(p_max?, v_max?, t_max?))?;
        log::debug!("{}: ranges of raw values: {limits:?}", query.name());
        Ok(limits)
    }

    fn reports(&self) -> Reports {
        Reports::WhenPolled
    }

    fn poll_frame(&self) -> Option<Frame> {
        codec::encode_register(
            &RegisterMessage {
                motor: self.motor,
                access: Access::Refresh,
            },
            None,
        )
        .ok()
    }

    fn typical_answer(&self) -> (Frame, Option<f64>) {
        (
            Id::standard(self.feedback.into()).map_or_else(|_| short_frame(), frame_of_8_bytes),
            None,
        )
    }

    fn read(&self, frame: &Frame, limits: &Limits) -> Option<MotorReading> {
        self.feedback(frame, limits)
            .map(|feedback| feedback.motion.into())
    }

    fn traffic(&self) -> Traffic {
        Traffic {
            cycle_frames: vec![short_frame(); 2],
            unsolicited: vec![],
        }
    }

    fn watchdog(&self) -> Watchdog {
        Watchdog::Available(&[OnLoss::Release])
    }

    fn motion(&self, limits: &Limits) -> Box<dyn MotionProtocol> {
        Box::new(motion::DamiaoMotion {
            address: *self,
            limits: *limits,
        })
    }

    #[cfg(feature = "emulation")]
    fn emulated(&self) -> Box<dyn super::emulated::EmulatedProtocol> {
        Box::new(emulated::EmulatedDamiao(*self))
    }
}
