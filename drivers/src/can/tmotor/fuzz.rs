//! An example motor for fuzzing, and the codec's functions on arbitrary frames.

use super::TMotor;
use super::codec::{self, Model, Thermometer};
use crate::can::family::{FamilyFuzzing, LIMITS};
use crate::wire::can::Frame;
use std::sync::Arc;

const MOTOR: TMotor = TMotor {
    motor: 3,
    model: Model::Ak80x9,
};

pub(super) fn fuzzing() -> FamilyFuzzing {
    FamilyFuzzing {
        motor: Arc::new(MOTOR),
        run_codecs,
        set_up: Vec::new(),
        command: codec::encode_command(
            MOTOR.motor,
            &crate::can::family::STIFF_COMMAND,
            &MOTOR.model.limits(),
        )
        .expect("the example can be encoded"),
        transcript: include_str!("transcript.txt"),
        other_master: crate::wire::can::Id::standard(MOTOR.motor.into())
            .and_then(|id| Frame::classic(id, &[0; 8]))
            .ok(),
    }
}

fn run_codecs(frame: &Frame) {
    for thermometer in [Thermometer::Offset40, Thermometer::Plain] {
        let _ = codec::decode_feedback(frame, &LIMITS, thermometer);
    }
}
