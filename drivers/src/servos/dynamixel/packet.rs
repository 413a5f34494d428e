//! The packet format of Dynamixel protocol 2.0.
//!
//! Source: ROBOTIS e-Manual, "DYNAMIXEL Protocol 2.0": `FF FF FD 00 ID LENGTH INSTRUCTION
//! PARAMETERS CRC`, little endian. The CRC is CRC-16/BUYPASS (polynomial 0x8005, initial value 0)
//! of all bytes before it.

use crate::servos::packet::{
    BROADCAST, Instruction, PacketFormat, Scan, Status, bytes_before_header,
};

const HEADER: [u8; 4] = [0xFF, 0xFF, 0xFD, 0x00];
/// Bytes inside a packet that look like a header. They are followed by an additional 0xFD.
const STUFFED: [u8; 3] = [0xFF, 0xFF, 0xFD];
/// Header, ID and length.
const N_HEAD: usize = 7;
/// A status packet without data: head, instruction, error and CRC.
const N_MIN_STATUS: usize = 11;
/// A ping is answered with a model number and a firmware version.
pub(super) const N_PING_DATA: usize = 3;
/// Largest length field of a packet. A servo has fewer than 1024 bytes of registers, and a fast
/// sync read of 40 servos with 20 bytes each has fewer bytes. A larger length is noise, and waiting
/// for so many bytes would delay the next answer.
const MAX_LENGTH: usize = 1100;
/// Instruction of answers.
const STATUS: u8 = 0x55;
/// Instruction, error and CRC.
const N_STATUS_FRAME: usize = 4;

/// The packet format of Dynamixel protocol 2.0.
#[derive(Debug)]
pub(in crate::servos) struct DynamixelPackets;

impl PacketFormat for DynamixelPackets {
    fn encode(&self, id: u8, instruction: &Instruction<'_>) -> Vec<u8> {
        let range = |address: u16, len: u16| [address.to_le_bytes(), len.to_le_bytes()].concat();
        match *instruction {
            Instruction::Ping => packet(id, 0x01, &[]),
            Instruction::Read { address, len } => packet(id, 0x02, &range(address, len)),
            Instruction::Write { address, data } => {
                packet(id, 0x03, &[&address.to_le_bytes(), data].concat())
            }
            Instruction::SyncRead { address, len, ids } => {
                packet(BROADCAST, 0x82, &[&range(address, len), ids].concat())
            }
            Instruction::FastSyncRead { address, len, ids } => {
                packet(BROADCAST, 0x8A, &[&range(address, len), ids].concat())
            }
            Instruction::SyncWrite { address, values } => {
                let len = values.first().map_or(0, |(_, data)| data.len());
                let len = u16::try_from(len).unwrap_or(u16::MAX);
                let mut parameters = range(address, len);
                for (id, data) in values {
                    parameters.push(*id);
                    parameters.extend(data);
                }
                packet(BROADCAST, 0x83, &parameters)
            }
        }
    }

    fn decode(&self, bytes: &[u8], len: u16) -> Scan {
        let n_before = bytes_before_header(bytes, &HEADER);
        if n_before > 0 {
            return Scan::Garbage { n_bytes: n_before };
        }
        let Some(&[_, _, _, _, id, low, high]) = bytes.first_chunk::<N_HEAD>() else {
            return Scan::Incomplete;
        };
        let length = usize::from(u16::from_le_bytes([low, high]));
        if !(3..=MAX_LENGTH).contains(&length) {
            return Scan::Garbage { n_bytes: 1 };
        }
        let n_bytes = N_HEAD + length;
        let Some(packet) = bytes.get(..n_bytes) else {
            return Scan::Incomplete;
        };
        let (checked, sum) = packet.split_at(n_bytes - 2);
        if crc(checked).to_le_bytes() != sum {
            // The header may have been noise, so the search continues after it.
            return Scan::Corrupt { n_bytes: 1 };
        }
        let content = &checked[N_HEAD..];
        let statuses = match (content, id) {
            ([STATUS, answers @ ..], BROADCAST) => fast_answers(answers, usize::from(len)),
            ([STATUS, answer @ ..], id) => answer_of(id, &unstuffed(answer)),
            // Some adapters echo what they send.
            _ => Vec::new(),
        };
        Scan::Packet { statuses, n_bytes }
    }

    fn answer_bytes(&self, instruction: &Instruction<'_>) -> usize {
        match *instruction {
            Instruction::Ping => N_MIN_STATUS + N_PING_DATA,
            Instruction::Write { .. } => N_MIN_STATUS,
            Instruction::Read { len, .. } => N_MIN_STATUS + usize::from(len),
            Instruction::SyncRead { len, ids, .. } => ids.len() * (N_MIN_STATUS + usize::from(len)),
            Instruction::FastSyncRead { len, ids, .. } => {
                N_HEAD + 1 + ids.len() * (N_STATUS_FRAME + usize::from(len))
            }
            Instruction::SyncWrite { .. } => 0,
        }
    }
}

/// The answer in a status packet, without the instruction and the CRC.
fn answer_of(id: u8, answer: &[u8]) -> Vec<Status> {
    answer
        .split_first()
        .map(|(error, data)| Status {
            id,
            error: *error,
            data: data.to_vec(),
        })
        .into_iter()
        .collect()
}

/// The answers in the packet of a fast sync read. Each consists of an error, an ID and `len` bytes.
/// Between two answers is the CRC of the packet up to there. These CRCs are not checked, because
/// the last one covers all bytes.
fn fast_answers(answers: &[u8], len: usize) -> Vec<Status> {
    let is_whole = (answers.len() + 2).is_multiple_of(len + N_STATUS_FRAME);
    if !is_whole {
        return Vec::new();
    }
    answers
        .chunks(len + N_STATUS_FRAME)
        .map(|answer| Status {
            error: answer[0],
            id: answer[1],
            data: answer[2..2 + len].to_vec(),
        })
        .collect()
}

/// Inserts the additional byte after each sequence that looks like a header.
fn stuffed(content: &[u8]) -> Vec<u8> {
    let mut stuffed = Vec::with_capacity(content.len());
    for byte in content {
        stuffed.push(*byte);
        if stuffed.ends_with(&STUFFED) {
            stuffed.push(0xFD);
        }
    }
    stuffed
}

/// Removes the additional bytes.
pub(in crate::servos) fn unstuffed(content: &[u8]) -> Vec<u8> {
    let mut plain: Vec<u8> = Vec::with_capacity(content.len());
    let mut is_after_stuffed = false;
    for byte in content {
        if std::mem::take(&mut is_after_stuffed) && *byte == 0xFD {
            continue;
        }
        plain.push(*byte);
        is_after_stuffed = plain.ends_with(&STUFFED);
    }
    plain
}

/// Encodes a packet. Also used for status packets, whose instruction is 0x55.
pub(in crate::servos) fn packet(id: u8, instruction: u8, parameters: &[u8]) -> Vec<u8> {
    let content = stuffed(&[&[instruction], parameters].concat());
    let length = u16::try_from(content.len() + 2).unwrap_or(u16::MAX);
    let mut packet = [&HEADER[..], &[id], &length.to_le_bytes(), &content].concat();
    packet.extend(crc(&packet).to_le_bytes());
    packet
}

/// CRC-16/BUYPASS.
pub(in crate::servos) fn crc(bytes: &[u8]) -> u16 {
    const POLYNOMIAL: u16 = 0x8005;
    bytes.iter().fold(0, |crc, byte| {
        let shifted_in: u16 = crc ^ (u16::from(*byte) << 8);
        (0..8).fold(shifted_in, |crc, _| {
            let shifted = crc << 1;
            if crc & 0x8000 == 0 {
                shifted
            } else {
                shifted ^ POLYNOMIAL
            }
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn encode(id: u8, instruction: Instruction<'_>) -> Vec<u8> {
        DynamixelPackets.encode(id, &instruction)
    }

    #[test]
    fn packets_match_the_examples_of_the_manual() {
        assert_eq!(
            encode(1, Instruction::Ping),
            [0xFF, 0xFF, 0xFD, 0x00, 0x01, 0x03, 0x00, 0x01, 0x19, 0x4E]
        );
        let (address, len) = (132, 4);
        assert_eq!(
            encode(1, Instruction::Read { address, len }),
            [
                0xFF, 0xFF, 0xFD, 0x00, 0x01, 0x07, 0x00, 0x02, 0x84, 0x00, 0x04, 0x00, 0x1D, 0x15
            ]
        );
        let write = Instruction::Write {
            address: 116,
            data: &512_i32.to_le_bytes(),
        };
        assert_eq!(
            encode(1, write),
            [
                0xFF, 0xFF, 0xFD, 0x00, 0x01, 0x09, 0x00, 0x03, 0x74, 0x00, 0x00, 0x02, 0x00, 0x00,
                0xCA, 0x89
            ]
        );
        let ids = &[1, 2];
        assert_eq!(
            encode(0, Instruction::SyncRead { address, len, ids }),
            [
                0xFF, 0xFF, 0xFD, 0x00, 0xFE, 0x09, 0x00, 0x82, 0x84, 0x00, 0x04, 0x00, 0x01, 0x02,
                0xCE, 0xFA
            ]
        );
        let values = [
            (1, 150_i32.to_le_bytes().to_vec()),
            (2, 170_i32.to_le_bytes().to_vec()),
        ];
        let sync_write = Instruction::SyncWrite {
            address: 116,
            values: &values,
        };
        assert_eq!(
            encode(0, sync_write),
            [
                0xFF, 0xFF, 0xFD, 0x00, 0xFE, 0x11, 0x00, 0x83, 0x74, 0x00, 0x04, 0x00, 0x01, 0x96,
                0x00, 0x00, 0x00, 0x02, 0xAA, 0x00, 0x00, 0x00, 0x82, 0x87
            ]
        );
    }

    #[test]
    fn answers_of_the_manual_are_decoded() {
        let answer = [
            0xFF, 0xFF, 0xFD, 0x00, 0x02, 0x08, 0x00, 0x55, 0x00, 0x1F, 0x08, 0x00, 0x00, 0xBA,
            0xBE,
        ];
        let status = Status {
            id: 2,
            error: 0,
            data: vec![0x1F, 0x08, 0x00, 0x00],
        };
        let expected = Scan::Packet {
            statuses: vec![status],
            n_bytes: 15,
        };
        assert_eq!(DynamixelPackets.decode(&answer, 4), expected);
        for n in 0..answer.len() {
            assert_eq!(
                DynamixelPackets.decode(&answer[..n], 4),
                Scan::Incomplete,
                "{n}"
            );
        }
        let mut damaged = answer;
        damaged[9] ^= 0x10;
        assert_eq!(
            DynamixelPackets.decode(&damaged, 4),
            Scan::Corrupt { n_bytes: 1 }
        );
        let noisy = [&[0x00, 0xFF, 0x12][..], &answer].concat();
        assert_eq!(
            DynamixelPackets.decode(&noisy, 4),
            Scan::Garbage { n_bytes: 3 }
        );
    }

    #[test]
    fn fast_answers_share_a_packet() {
        // Two servos report four bytes each. The CRC between them is that of the bytes before it.
        let mut bytes = [&HEADER[..], &[BROADCAST, 17, 0, STATUS]].concat();
        for (error, id, position) in [(0, 3, 166_i32), (0x80, 7, -5)] {
            bytes.extend([error, id]);
            bytes.extend(position.to_le_bytes());
            bytes.extend(crc(&bytes).to_le_bytes());
        }
        let Scan::Packet { statuses, n_bytes } = DynamixelPackets.decode(&bytes, 4) else {
            panic!("{bytes:?}");
        };
        assert_eq!(n_bytes, 24);
        let ids: Vec<_> = statuses
            .iter()
            .map(|status| (status.id, status.error))
            .collect();
        assert_eq!(ids, [(3, 0), (7, 0x80)]);
        assert_eq!(statuses[1].data, (-5_i32).to_le_bytes());
        let ids = &[3, 7];
        let (address, len) = (132, 4);
        let instruction = Instruction::FastSyncRead { address, len, ids };
        assert_eq!(DynamixelPackets.answer_bytes(&instruction), bytes.len());
    }

    #[test]
    fn data_that_looks_like_a_header_is_stuffed() {
        let data = [0xFF, 0xFF, 0xFD, 0xFD, 0x01, 0xFF, 0xFF, 0xFD];
        let sent = packet(1, STATUS, &[&[0], &data[..]].concat());
        assert_eq!(sent.len(), N_MIN_STATUS + data.len() + 2);
        let Scan::Packet { statuses, .. } = DynamixelPackets.decode(&sent, 8) else {
            panic!("{sent:?}");
        };
        assert_eq!(statuses[0].data, data);
    }

    #[test]
    fn echoed_instructions_are_no_answers() {
        let echo = encode(1, Instruction::Ping);
        let scan = Scan::Packet {
            statuses: Vec::new(),
            n_bytes: echo.len(),
        };
        assert_eq!(DynamixelPackets.decode(&echo, 0), scan);
    }
}
