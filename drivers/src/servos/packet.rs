//! Packets on a bus of servos: instructions to servos, and their status packets.

use std::fmt::Debug;

/// The ID that addresses all servos.
pub(super) const BROADCAST: u8 = 0xFE;

/// An instruction to one or several servos. Addresses and lengths are in bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Instruction<'a> {
    /// Reports its presence.
    Ping,
    /// Reads registers.
    Read {
        /// Address of the first register.
        address: u16,
        /// Number of bytes.
        len: u16,
    },
    /// Writes registers.
    Write {
        /// Address of the first register.
        address: u16,
        /// Bytes to write.
        data: &'a [u8],
    },
    /// Reads the same registers of several servos. Each servo answers with its own packet, in the
    /// order of the IDs.
    SyncRead {
        /// Address of the first register.
        address: u16,
        /// Number of bytes.
        len: u16,
        /// The servos.
        ids: &'a [u8],
    },
    /// Like `SyncRead`, but all answers together are one packet.
    FastSyncRead {
        /// Address of the first register.
        address: u16,
        /// Number of bytes.
        len: u16,
        /// The servos.
        ids: &'a [u8],
    },
    /// Writes the same registers of several servos. The servos do not answer.
    SyncWrite {
        /// Address of the first register.
        address: u16,
        /// ID and bytes of each servo. All have the same number of bytes.
        values: &'a [(u8, Vec<u8>)],
    },
}

/// Answer of a servo.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Status {
    /// ID of the servo.
    pub id: u8,
    /// Error byte. Its meaning depends on the protocol.
    pub error: u8,
    /// Contents of the registers that were read.
    pub data: Vec<u8>,
}

/// Result of searching received bytes for a packet.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Scan {
    /// The bytes start with a packet. It contains several answers after a
    /// [`FastSyncRead`](Instruction::FastSyncRead), and none if it is not an answer.
    Packet {
        /// The answers.
        statuses: Vec<Status>,
        /// Length of the packet.
        n_bytes: usize,
    },
    /// The bytes start with a packet whose checksum is wrong.
    Corrupt {
        /// Number of bytes to skip.
        n_bytes: usize,
    },
    /// The first bytes belong to no packet.
    Garbage {
        /// Number of bytes to skip.
        n_bytes: usize,
    },
    /// More bytes are needed.
    Incomplete,
}

/// The packet format of a protocol.
pub trait PacketFormat: Debug + Sync {
    /// Encodes an instruction. `id` is ignored for instructions to several servos.
    fn encode(&self, id: u8, instruction: &Instruction<'_>) -> Vec<u8>;
    /// Searches received bytes for the next packet. `len` is the number of bytes that each servo
    /// was asked for.
    fn decode(&self, bytes: &[u8], len: u16) -> Scan;
    /// Number of bytes that servos send in answer to an instruction.
    fn answer_bytes(&self, instruction: &Instruction<'_>) -> usize;
}

/// Number of bytes before the first occurrence of a header. A partial header at the end may become
/// a header with the next bytes, so it does not count.
pub(super) fn bytes_before_header(bytes: &[u8], header: &[u8]) -> usize {
    (0..bytes.len())
        .find(|start| {
            let rest = &bytes[*start..];
            let n = rest.len().min(header.len());
            rest[..n] == header[..n]
        })
        .unwrap_or(bytes.len())
}
