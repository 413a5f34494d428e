//! Decodes the instruction packets that emulated servos receive, and encodes their answers.

use super::servo::ServoKind;
use crate::servos::dynamixel::{crc, encode_packet, unstuffed};
use crate::servos::feetech::checksum;
use crate::servos::packet::{BROADCAST, bytes_before_header};

/// Instruction of answers of Dynamixel servos.
const STATUS: u8 = 0x55;

/// An instruction packet.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct ReceivedInstruction {
    pub(super) id: u8,
    pub(super) code: u8,
    pub(super) parameters: Vec<u8>,
}

/// Takes the next instruction from received bytes. Removes the bytes that were used, and those that
/// belong to no valid packet. `None` if more bytes are needed.
pub(super) fn take(kind: ServoKind, bytes: &mut Vec<u8>) -> Option<ReceivedInstruction> {
    let header: &[u8] = match kind {
        ServoKind::Feetech => &[0xFF, 0xFF],
        ServoKind::Dynamixel => &[0xFF, 0xFF, 0xFD, 0x00],
    };
    loop {
        bytes.drain(..bytes_before_header(bytes, header));
        let n_bytes = match (kind, &bytes[..]) {
            (ServoKind::Feetech, [_, _, _, length, ..]) => 4 + usize::from(*length),
            (ServoKind::Dynamixel, [_, _, _, _, _, low, high, ..]) => {
                7 + usize::from(u16::from_le_bytes([*low, *high]))
            }
            _ => return None,
        };
        let packet = bytes.get(..n_bytes)?;
        match decode(kind, packet) {
            Some(instruction) => {
                bytes.drain(..n_bytes);
                return Some(instruction);
            }
            None => drop(bytes.drain(..1)),
        }
    }
}

/// Decodes a packet; `None` if its checksum is wrong.
fn decode(kind: ServoKind, packet: &[u8]) -> Option<ReceivedInstruction> {
    match kind {
        ServoKind::Feetech => {
            let (sum, content) = packet.get(2..)?.split_last()?;
            let [id, _, code, parameters @ ..] = content else {
                return None;
            };
            (checksum(content) == *sum).then(|| ReceivedInstruction {
                id: *id,
                code: *code,
                parameters: parameters.to_vec(),
            })
        }
        ServoKind::Dynamixel => {
            let (content, sum) = packet.split_at_checked(packet.len().checked_sub(2)?)?;
            let [_, _, _, _, id, _, _, stuffed @ ..] = content else {
                return None;
            };
            let content_bytes = unstuffed(stuffed);
            let (code, parameters) = content_bytes.split_first()?;
            (crc(content).to_le_bytes() == sum).then(|| ReceivedInstruction {
                id: *id,
                code: *code,
                parameters: parameters.to_vec(),
            })
        }
    }
}

/// Encodes the answer of one servo.
pub(super) fn answer(kind: ServoKind, id: u8, error: u8, data: &[u8]) -> Vec<u8> {
    match kind {
        ServoKind::Feetech => {
            let length = u8::try_from(data.len() + 2).unwrap_or(u8::MAX);
            let mut packet = [&[0xFF, 0xFF, id, length, error], data].concat();
            packet.push(checksum(&packet[2..]));
            packet
        }
        ServoKind::Dynamixel => encode_packet(id, STATUS, &[&[error], data].concat()),
    }
}

/// Encodes the common answer of Dynamixel servos to a fast sync read: error, ID and data of each
/// servo.
pub(super) fn fast_answer(answers: &[(u8, u8, Vec<u8>)]) -> Vec<u8> {
    let n_content: usize = answers.iter().map(|(.., data)| data.len() + 4).sum();
    let length = u16::try_from(n_content + 1).unwrap_or(u16::MAX);
    let mut packet = vec![0xFF, 0xFF, 0xFD, 0x00, BROADCAST];
    packet.extend(length.to_le_bytes());
    packet.push(STATUS);
    for (error, id, data) in answers {
        packet.extend([*error, *id]);
        packet.extend(data);
        packet.extend(crc(&packet).to_le_bytes());
    }
    packet
}
