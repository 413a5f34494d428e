//! CubeMars (T-Motor) AK motors in MIT mode. They reply only to commands, and a command without
//! gains would make a motor limp. A read-only arm therefore sends nothing and only listens while
//! another master commands the motors.
//!
//! Watchdog: none. The motor executes its last command forever. Source: CubeMars AK Series Module
//! Product Manual, MIT mode.

pub mod codec;
#[cfg(feature = "emulation")]
mod emulated;
#[cfg(any(test, fuzzing))]
mod fuzz;
mod motion;

pub use codec::Model;

use super::family::{
    MotionProtocol, MotorFamily, MotorProtocol, MotorReading, Reports, Traffic, short_frame,
};
use super::query::MotorQuery;
use super::settings::{AllowedValues, MotorKey, MotorSettings, word};
use super::watchdog::Watchdog;
use crate::Error;
use crate::motion::OnLoss;
use crate::wire::can::Frame;
use crate::wire::can::mit::Limits;
use codec::{Feedback, Thermometer};
use std::ops::RangeInclusive;
use std::sync::Arc;

const MODEL: &str = "model";
const MODELS: [(&str, Model); 6] = [
    ("ak10-9", Model::Ak10x9),
    ("ak60-6", Model::Ak60x6),
    ("ak70-10", Model::Ak70x10),
    ("ak80-6", Model::Ak80x6),
    ("ak80-9", Model::Ak80x9),
    ("ak80-64", Model::Ak80x64),
];

/// The family.
#[derive(Debug)]
pub struct TMotorFamily;

impl MotorFamily for TMotorFamily {
    fn name(&self) -> &'static str {
        "tmotor"
    }

    fn title(&self) -> &'static str {
        "T-Motor"
    }

    fn ids(&self) -> RangeInclusive<u64> {
        0..=u8::MAX.into()
    }

    fn keys(&self) -> Vec<MotorKey> {
        let allowed = AllowedValues::Words(MODELS.iter().map(|(name, _)| *name).collect());
        vec![MotorKey {
            name: MODEL,
            allowed,
            required: Some("model printed on the motor"),
        }]
    }

    fn has_gains(&self) -> bool {
        true
    }

    fn motor(&self, settings: &MotorSettings) -> Option<Arc<dyn MotorProtocol>> {
        let motor = u8::try_from(settings.id).ok()?;
        let model = settings.choice(MODEL, &MODELS)?;
        Some(Arc::new(TMotor { motor, model }))
    }

    #[cfg(any(test, fuzzing))]
    fn fuzzing(&self) -> super::family::FamilyFuzzing {
        fuzz::fuzzing()
    }
}

/// An AK motor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TMotor {
    /// Motor ID.
    pub motor: u8,
    /// Model, which determines the ranges of its raw values.
    pub model: Model,
}

impl TMotor {
    /// The feedback in a frame; `None` if the frame is from another motor or has other content.
    fn feedback(self, frame: &Frame, limits: &Limits) -> Option<Feedback> {
        // The CAN ID of commands is the ID of the motor. The CAN ID of answers is the ID of the
        // master, and their first byte is the ID of the motor.
        if frame.id().value() == u32::from(self.motor) {
            return None;
        }
        let feedback = codec::decode_feedback(frame, limits, Thermometer::Offset40).ok()?;
        (feedback.motor == self.motor).then_some(feedback)
    }
}

impl MotorProtocol for TMotor {
    fn family(&self) -> &'static dyn MotorFamily {
        &TMotorFamily
    }

    fn settings(&self) -> MotorSettings {
        MotorSettings::new(self.motor).with(MODEL, word(&MODELS, &self.model))
    }

    fn addresses(&self) -> Vec<u32> {
        vec![self.motor.into()]
    }

    fn ranges(&self) -> Option<Limits> {
        Some(self.model.limits())
    }

    fn set_up(&self, _query: &MotorQuery<'_>) -> Result<Limits, Error> {
        Ok(self.model.limits())
    }

    fn reports(&self) -> Reports {
        Reports::WhenCommanded {
            if_silent: "an AK motor in MIT mode answers only when another master commands it, and none does",
        }
    }

    fn typical_answer(&self) -> (Frame, Option<f64>) {
        // The motor answers another master at a rate that is unknown here, so its answers are left
        // out of the bus load.
        (short_frame(), Some(0.0))
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
        // All three actions are commands in MIT mode. The motor executes a command until it
        // receives the next one, so each of them can be the last command.
        let actions = &[OnLoss::Hold, OnLoss::Damp, OnLoss::Release];
        Watchdog::Missing {
            reason: "a motor of this family has no watchdog",
            actions,
        }
    }

    fn motion(&self, limits: &Limits) -> Box<dyn MotionProtocol> {
        Box::new(motion::TMotorMotion {
            address: *self,
            limits: *limits,
        })
    }

    #[cfg(feature = "emulation")]
    fn emulated(&self) -> Box<dyn super::emulated::EmulatedProtocol> {
        Box::new(emulated::EmulatedTMotor { motor: self.motor })
    }
}
