//! An example drive for fuzzing, and the codec's functions on arbitrary frames.

use super::{Cia402, Units, codec};
use crate::can::family::FamilyFuzzing;
use crate::fuzz::input::take;
use crate::wire::can::Frame;
use crate::wire::can::canopen::Node;
use std::sync::Arc;

pub(super) fn fuzzing() -> FamilyFuzzing {
    let node = Node::new(5).expect("below 128");
    FamilyFuzzing {
        motor: Arc::new(Cia402 {
            node,
            units: Units {
                counts_per_turn: 4096.0,
                rated_torque_nm: 2.0,
            },
        }),
        run_codecs,
        set_up: set_up(node),
        command: {
            use crate::wire::can::canopen::{Direction, Pdo};
            Frame::classic(Pdo::First.id(Direction::Receive, node), &[0, 0, 0, 4, 0, 0])
                .expect("the example can be encoded")
        },
        transcript: include_str!("transcript.txt"),
        other_master: None,
    }
}

fn set_up(node: Node) -> Vec<Frame> {
    use crate::wire::can::canopen::{Direction, Nmt, Pdo, encode_nmt, encode_write};
    let pdo = Pdo::First;
    let direction = Direction::Transmit;
    let objects = [
        (pdo.mapping(direction, 1), codec::POSITION.mapped().into()),
        (pdo.mapping(direction, 2), codec::VELOCITY.mapped().into()),
        (pdo.mapping(direction, 0), 2),
        (pdo.communication(direction, 2), 1),
        (
            pdo.communication(direction, 1),
            i64::from(pdo.id(direction, node).value()),
        ),
    ];
    let objects = objects.map(|(object, value)| {
        encode_write(node, object, value).expect("the example can be encoded")
    });
    objects
        .into_iter()
        .chain([encode_nmt(Nmt::Start, Some(node))])
        .collect()
}

fn run_codecs(frame: &Frame) {
    let number = u32::from_le_bytes(take(&mut frame.data()));
    if let Ok(state) = codec::State::from_statusword((number & 0xFFFF) as u16) {
        let _ = state
            .next_enabling_command(number >> 16 != 0)
            .map(|state_command| state.after(state_command));
    }
}
