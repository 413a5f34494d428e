//! The packet format of Feetech servos.
//!
//! Source: Feetech, "Communication Protocol Manual of SCS/STS servos". It is the format of
//! Dynamixel protocol 1.0 with an additional sync read: `FF FF ID LENGTH INSTRUCTION PARAMETERS
//! CHECKSUM`, where the checksum is the complement of the sum of the bytes after the header.

use crate::servos::packet::{
    BROADCAST, Instruction, PacketFormat, Scan, Status, bytes_before_header,
};

const HEADER: [u8; 2] = [0xFF, 0xFF];
/// Header, ID and length.
const N_HEAD: usize = 4;
/// A status packet without data: header, ID, length, error and checksum.
const N_MIN_STATUS: usize = 6;
/// Largest length field of a status packet. A servo has fewer than 128 registers. A larger length
/// is noise, and waiting for so many bytes would delay the next answer.
const MAX_LENGTH: u8 = 130;
/// Maximum ID of a servo.
const MAX_ID: u8 = 0xFD;

/// The packet format of Feetech servos.
#[derive(Debug)]
pub(in crate::servos) struct FeetechPackets;

impl PacketFormat for FeetechPackets {
    fn encode(&self, id: u8, instruction: &Instruction<'_>) -> Vec<u8> {
        match *instruction {
            Instruction::Ping => packet(id, 0x01, &[]),
            Instruction::Read { address, len } => packet(id, 0x02, &[low(address), low(len)]),
            Instruction::Write { address, data } => {
                packet(id, 0x03, &[&[low(address)], data].concat())
            }
            // There is no fast sync read. The normal one gives the same answers.
            Instruction::SyncRead { address, len, ids }
            | Instruction::FastSyncRead { address, len, ids } => {
                packet(BROADCAST, 0x82, &[&[low(address), low(len)], ids].concat())
            }
            Instruction::SyncWrite { address, values } => {
                let len = values.first().map_or(0, |(_, data)| data.len());
                let mut parameters = vec![low(address), u8::try_from(len).unwrap_or(u8::MAX)];
                for (id, data) in values {
                    parameters.push(*id);
                    parameters.extend(data);
                }
                packet(BROADCAST, 0x83, &parameters)
            }
        }
    }

    fn decode(&self, bytes: &[u8], _len: u16) -> Scan {
        let n_before = bytes_before_header(bytes, &HEADER);
        if n_before > 0 {
            return Scan::Garbage { n_bytes: n_before };
        }
        let Some(&[_, _, id, length]) = bytes.first_chunk::<N_HEAD>() else {
            return Scan::Incomplete;
        };
        // An ID of 0xFF means that noise or another 0xFF precedes the header.
        if id > MAX_ID || !(2..=MAX_LENGTH).contains(&length) {
            return Scan::Garbage { n_bytes: 1 };
        }
        let n_bytes = N_HEAD + usize::from(length);
        let Some(packet) = bytes.get(..n_bytes) else {
            return Scan::Incomplete;
        };
        let (checked, sum) = packet.split_at(n_bytes - 1);
        if checksum(&checked[2..]) != sum[0] {
            // The header may have been noise, so the search continues after it.
            return Scan::Corrupt { n_bytes: 1 };
        }
        let status = Status {
            id,
            error: packet[N_HEAD],
            data: packet[N_HEAD + 1..n_bytes - 1].to_vec(),
        };
        Scan::Packet {
            statuses: vec![status],
            n_bytes,
        }
    }

    fn answer_bytes(&self, instruction: &Instruction<'_>) -> usize {
        match *instruction {
            Instruction::Ping | Instruction::Write { .. } => N_MIN_STATUS,
            Instruction::Read { len, .. } => N_MIN_STATUS + usize::from(len),
            Instruction::SyncRead { len, ids, .. } | Instruction::FastSyncRead { len, ids, .. } => {
                ids.len() * (N_MIN_STATUS + usize::from(len))
            }
            Instruction::SyncWrite { .. } => 0,
        }
    }
}

/// Addresses and lengths of this protocol have one byte.
fn low(number: u16) -> u8 {
    number.to_le_bytes()[0]
}

fn packet(id: u8, instruction: u8, parameters: &[u8]) -> Vec<u8> {
    let length = u8::try_from(parameters.len() + 2).unwrap_or(u8::MAX);
    let mut packet = [&HEADER, &[id, length, instruction][..], parameters].concat();
    packet.push(checksum(&packet[2..]));
    packet
}

/// Checksum of the bytes between the header and the checksum.
pub(in crate::servos) fn checksum(bytes: &[u8]) -> u8 {
    !bytes
        .iter()
        .fold(0, |sum: u8, byte| sum.wrapping_add(*byte))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn packets_match_the_examples_of_the_manual() {
        let encode = |id, instruction| FeetechPackets.encode(id, &instruction);
        assert_eq!(
            encode(1, Instruction::Ping),
            [0xFF, 0xFF, 0x01, 0x02, 0x01, 0xFB]
        );
        let (address, len) = (0x38, 2);
        assert_eq!(
            encode(1, Instruction::Read { address, len }),
            [0xFF, 0xFF, 0x01, 0x04, 0x02, 0x38, 0x02, 0xBE]
        );
        let data = [0x00, 0x08, 0x00, 0x00, 0xE8, 0x03];
        let write = Instruction::Write {
            address: 0x2A,
            data: &data,
        };
        assert_eq!(
            encode(1, write),
            [
                0xFF, 0xFF, 0x01, 0x09, 0x03, 0x2A, 0x00, 0x08, 0x00, 0x00, 0xE8, 0x03, 0xD5
            ]
        );
        let sync_read = Instruction::SyncRead {
            address: 0x38,
            len: 8,
            ids: &[1, 2],
        };
        assert_eq!(
            encode(0, sync_read),
            [0xFF, 0xFF, 0xFE, 0x06, 0x82, 0x38, 0x08, 0x01, 0x02, 0x36]
        );
        let values: Vec<_> = (1..=4).map(|id| (id, data.to_vec())).collect();
        let sync_write = Instruction::SyncWrite {
            address: 0x2A,
            values: &values,
        };
        let packet = encode(0, sync_write);
        assert_eq!(
            packet[..8],
            [0xFF, 0xFF, 0xFE, 0x20, 0x83, 0x2A, 0x06, 0x01]
        );
        assert_eq!((packet.len(), packet[35]), (36, 0x58));
    }

    #[test]
    fn answers_of_the_manual_are_decoded() {
        let answer = [0xFF, 0xFF, 0x01, 0x04, 0x00, 0x18, 0x05, 0xDD];
        let status = Status {
            id: 1,
            error: 0,
            data: vec![0x18, 0x05],
        };
        let packet = Scan::Packet {
            statuses: vec![status],
            n_bytes: 8,
        };
        assert_eq!(FeetechPackets.decode(&answer, 2), packet);
        for n in 0..answer.len() {
            assert_eq!(
                FeetechPackets.decode(&answer[..n], 2),
                Scan::Incomplete,
                "{n}"
            );
        }
    }

    #[test]
    fn noise_and_damaged_packets_are_skipped() {
        let decode = |bytes: &[u8]| FeetechPackets.decode(bytes, 2);
        assert_eq!(decode(&[0x00, 0x7F, 0xFF]), Scan::Garbage { n_bytes: 2 });
        assert_eq!(
            decode(&[0xFF, 0xFF, 0xFF, 0x01, 0x02]),
            Scan::Garbage { n_bytes: 1 },
            "three times 0xFF"
        );
        assert_eq!(
            decode(&[0xFF, 0xFF, 0x01, 0xF0, 0x00]),
            Scan::Garbage { n_bytes: 1 },
            "no servo has so many registers"
        );
        assert_eq!(
            decode(&[0xFF, 0xFF, 0x01, 0x04, 0x00, 0x19, 0x05, 0xDD]),
            Scan::Corrupt { n_bytes: 1 }
        );
    }
}
