//! Robstride motors with their private protocol. Once configured, they report periodically.
//!
//! Watchdog: parameter `canTimeout`. When it expires, the motor goes to its reset mode. Do not rely
//! on the damping of the parameter `damper`, which only protects unpowered motors against surges.
//! Source: RS00 to RS06 user manuals, sections 4.2 and 4.3.5.

pub mod codec;
#[cfg(feature = "emulation")]
mod emulated;
#[cfg(any(test, fuzzing))]
mod fuzz;
mod motion;
mod parameter;

pub use codec::Model;

use super::family::{
    MotionProtocol, MotorFamily, MotorProtocol, MotorReading, Reports, Traffic, frame_of_8_bytes,
};
use super::query::MotorQuery;
use super::settings::{AllowedValues, MotorKey, MotorSettings, word};
use super::watchdog::Watchdog;
use crate::Error;
use crate::motion::OnLoss;
use crate::wire::can::mit::Limits;
use crate::wire::can::{Frame, Id};
use codec::{Answer, Feedback, Parameter, Request, Value};
use std::ops::RangeInclusive;
use std::sync::Arc;

/// Our host ID, to which motors send their answers. The manufacturer's program uses the same ID, so
/// fieldrig and this program must not use one bus at the same time.
pub(super) const HOST: u8 = 0xFD;
/// Value of [`Parameter::ReportInterval`] for the shortest interval.
const SHORTEST_REPORT: u32 = 1;
/// Report rate at [`SHORTEST_REPORT`], Hz.
const REPORT_HZ: f64 = 100.0;
const MODEL: &str = "model";
const MODELS: [(&str, Model); 7] = [
    ("rs00", Model::Rs00),
    ("rs01", Model::Rs01),
    ("rs02", Model::Rs02),
    ("rs03", Model::Rs03),
    ("rs04", Model::Rs04),
    ("rs05", Model::Rs05),
    ("rs06", Model::Rs06),
];

/// The family.
#[derive(Debug)]
pub struct RobstrideFamily;

impl MotorFamily for RobstrideFamily {
    fn name(&self) -> &'static str {
        "robstride"
    }

    fn title(&self) -> &'static str {
        "Robstride"
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
        Some(Arc::new(Robstride { motor, model }))
    }

    /// Asks for serial numbers. New motors have the ID 127.
    fn identification_requests(&self) -> Vec<Frame> {
        let limits = Model::Rs00.limits(); // The request contains no scaled values.
        let request = |id| codec::encode_request(HOST, id, &Request::Identify, &limits).ok();
        (1..=127).filter_map(request).collect()
    }

    fn identify(&self, frame: &Frame) -> Option<MotorSettings> {
        match codec::decode_answer(frame, HOST, &Model::Rs00.limits()) {
            Ok(Answer::Identity { motor, .. }) => Some(MotorSettings::new(motor)),
            _ => None,
        }
    }

    #[cfg(any(test, fuzzing))]
    fn fuzzing(&self) -> super::family::FamilyFuzzing {
        fuzz::fuzzing()
    }
}

/// A Robstride motor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Robstride {
    /// Motor ID.
    pub motor: u8,
    /// Model, which determines the ranges of its raw values.
    pub model: Model,
}

impl Robstride {
    /// Sends a request.
    fn send(self, query: &MotorQuery<'_>, request: &Request, limits: &Limits) -> Result<(), Error> {
        query.send(codec::encode_request(HOST, self.motor, request, limits))
    }

    /// Reads a parameter.
    fn parameter(
        self,
        query: &MotorQuery<'_>,
        parameter: Parameter,
        limits: &Limits,
    ) -> Result<Value, Error> {
        let poll_frame = codec::encode_request(HOST, self.motor, &Request::Read(parameter), limits);
        query.request_answer(
            &query.map_error(poll_frame)?,
            |frame| match codec::decode_answer(frame, HOST, limits) {
                Ok(Answer::Parameter {
                    motor: from,
                    parameter: reported,
                    value,
                }) => (from == self.motor && reported == parameter).then_some(value),
                _ => None,
            },
        )
    }

    /// The feedback in a frame; `None` if the frame is from another motor or has other content.
    fn feedback(self, frame: &Frame, limits: &Limits) -> Option<Feedback> {
        match codec::decode_answer(frame, HOST, limits) {
            Ok(Answer::Feedback(feedback)) if feedback.motor == self.motor => Some(feedback),
            _ => None,
        }
    }
}

impl MotorProtocol for Robstride {
    fn family(&self) -> &'static dyn MotorFamily {
        &RobstrideFamily
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

    fn set_up(&self, query: &MotorQuery<'_>) -> Result<Limits, Error> {
        let limits = self.model.limits();
        let interval = Request::Write(Parameter::ReportInterval, Value::Integer(SHORTEST_REPORT));
        // The interval is set first, so that the first reports already come at the right rate. No
        // separate acknowledgment is needed, because the reports show that both requests were
        // executed.
        for request in [interval, Request::ReportActively(true)] {
            self.send(query, &request, &limits)?;
        }
        Ok(limits)
    }

    fn reports(&self) -> Reports {
        Reports::Unasked {
            if_silent: "the motor does not report; check its id, and whether its firmware supports active reporting",
        }
    }

    fn typical_answer(&self) -> (Frame, Option<f64>) {
        (long_frame(), Some(REPORT_HZ))
    }

    fn read(&self, frame: &Frame, limits: &Limits) -> Option<MotorReading> {
        self.feedback(frame, limits)
            .map(|feedback| feedback.motion.into())
    }

    fn traffic(&self) -> Traffic {
        Traffic {
            // A motor in motion answers each command, and still sends its periodic reports.
            cycle_frames: vec![long_frame(); 2],
            unsolicited: vec![(long_frame(), REPORT_HZ)],
        }
    }

    fn watchdog(&self) -> Watchdog {
        Watchdog::Available(&[OnLoss::Release])
    }

    fn motion(&self, limits: &Limits) -> Box<dyn MotionProtocol> {
        Box::new(motion::RobstrideMotion {
            address: *self,
            limits: *limits,
        })
    }

    #[cfg(feature = "emulation")]
    fn emulated(&self) -> Box<dyn super::emulated::EmulatedProtocol> {
        Box::new(emulated::EmulatedRobstride {
            motor: self.motor,
            reports: false,
        })
    }
}

/// A frame of eight bytes with a 29-bit identifier.
fn long_frame() -> Frame {
    frame_of_8_bytes(Id::extended(0).expect("0 is a valid identifier"))
}
