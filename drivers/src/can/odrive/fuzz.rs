//! An example axis for fuzzing, and the codec's functions on arbitrary frames.

use super::Odrive;
use super::codec::{self, Node};
use crate::can::family::FamilyFuzzing;
use crate::wire::can::Frame;
use std::sync::Arc;

pub(super) fn fuzzing() -> FamilyFuzzing {
    let node = Node::new(4).expect("below 64");
    FamilyFuzzing {
        motor: Arc::new(Odrive {
            node,
            endpoints: None,
        }),
        run_codecs,
        set_up: Vec::new(),
        command: {
            let request = codec::Request::SetPosition {
                position_rad: 1.0,
                velocity_rad_s: 0.0,
                torque_nm: 0.0,
            };
            codec::encode_request(node, &request).expect("the example can be encoded")
        },
        transcript: include_str!("transcript.txt"),
        other_master: None,
    }
}

fn run_codecs(frame: &Frame) {
    let _ = codec::decode_answer(frame);
}
