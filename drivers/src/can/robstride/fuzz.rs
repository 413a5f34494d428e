//! An example motor for fuzzing, and the codec's functions on arbitrary frames.

use super::codec::{self, Model};
use super::{HOST, Robstride};
use crate::can::family::{FamilyFuzzing, LIMITS};
use crate::wire::can::Frame;
use std::sync::Arc;

const MOTOR: Robstride = Robstride {
    motor: 2,
    model: Model::Rs02,
};

pub(super) fn fuzzing() -> FamilyFuzzing {
    let encode = |request| {
        codec::encode_request(HOST, MOTOR.motor, &request, &MOTOR.model.limits())
            .expect("the example can be encoded")
    };
    FamilyFuzzing {
        motor: Arc::new(MOTOR),
        run_codecs,
        set_up: vec![encode(codec::Request::ReportActively(true))],
        command: encode(codec::Request::Move(crate::can::family::STIFF_COMMAND)),
        transcript: include_str!("transcript.txt"),
        other_master: None,
    }
}

fn run_codecs(frame: &Frame) {
    let _ = codec::decode_answer(frame, HOST, &LIMITS);
}
