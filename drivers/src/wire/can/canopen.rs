//! CANopen: network management, heartbeats, SYNC, expedited SDO transfers, and PDO mapping.
//!
//! Source: CiA 301 (CANopen application layer and communication profile) 4.2.0, sections 7.2.2
//! (PDO), 7.2.4 (SDO and its abort codes), 7.2.8 (NMT, heartbeat) and 7.5.2 (objects).
//! christiansandberg/canopen uses the same bytes. Segmented and block transfers are not supported,
//! because no object that a drive needs is longer than four bytes.

use super::{CanError, Frame, Id, decode_enum};

/// Names of messages in errors.
const SDO: &str = "SDO answer";
const HEARTBEAT: &str = "CANopen heartbeat";

/// Node ID, 1 to 127.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Node(u8);

impl Node {
    /// Creates a node ID.
    pub fn new(number: u8) -> Result<Self, CanError> {
        match number {
            1..=127 => Ok(Self(number)),
            _ => Err(CanError::Range {
                field: "the node",
                value: number.into(),
                lower: 1.0,
                upper: 127.0,
            }),
        }
    }

    /// The number.
    pub fn number(self) -> u8 {
        self.0
    }
}

/// An NMT command, which requests a node state.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Nmt {
    /// Enter the operational state: send and accept PDOs.
    Start = 0x01,
    /// Enter the stopped state, in which a node sends only heartbeats and accepts only NMT
    /// commands.
    Stop = 0x02,
    /// Enter the pre-operational state: SDOs but no PDOs.
    EnterPreOperational = 0x80,
    /// Restart the node.
    ResetNode = 0x81,
    /// Restart the communication.
    ResetCommunication = 0x82,
}

/// Node state reported by a heartbeat.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum NodeState {
    /// The node has just started.
    BootUp = 0x00,
    /// The node handles only heartbeats and NMT commands.
    Stopped = 0x04,
    /// The node sends and accepts PDOs.
    Operational = 0x05,
    /// The node handles SDOs but no PDOs.
    PreOperational = 0x7F,
}

/// An entry of the object dictionary.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Object {
    /// Index.
    pub index: u16,
    /// Subindex.
    pub subindex: u8,
    /// Length of its value in bytes: 1, 2 or 4.
    pub n_bytes: u8,
}

/// Entry 1 of the consumer heartbeat time. The node is in bits 16 to 22, and the milliseconds are
/// in bits 0 to 15. With this entry, a drive stops when the host's heartbeat is missing.
pub const CONSUMER_HEARTBEAT: Object = Object {
    index: 0x1016,
    subindex: 1,
    n_bytes: 4,
};
/// Producer heartbeat time, milliseconds. A value of 0 disables the heartbeat.
pub const PRODUCER_HEARTBEAT: Object = Object {
    index: 0x1017,
    subindex: 0,
    n_bytes: 2,
};

/// Number of a PDO. A node has four in each direction.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
#[expect(missing_docs, reason = "the names are ordinal numbers")]
pub enum Pdo {
    First = 0,
    Second = 1,
    Third = 2,
    Fourth = 3,
}

/// Direction of a PDO, from the node's point of view.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Direction {
    /// From the host to the node.
    Receive,
    /// From the node to the host.
    Transmit,
}

impl Pdo {
    /// Default identifier according to CiA 301.
    pub fn id(self, direction: Direction, node: Node) -> Id {
        let base = match direction {
            Direction::Receive => 0x200,
            Direction::Transmit => 0x180,
        };
        Id::standard(base + 0x100 * u32::from(self as u8) + u32::from(node.0))
            .expect("the identifier is at most 0x57F")
    }

    /// The mapping object. Entry 0 is the number of mapped objects, and the following entries are
    /// these objects.
    pub fn mapping(self, direction: Direction, entry: u8) -> Object {
        let base = match direction {
            Direction::Receive => 0x1600,
            Direction::Transmit => 0x1A00,
        };
        Object {
            index: base + self as u16,
            subindex: entry,
            n_bytes: if entry == 0 { 1 } else { 4 },
        }
    }

    /// The communication object. Entry 1 is the identifier of the PDO, in which bit 31 disables the
    /// PDO. Entry 2 is the transmission type.
    pub fn communication(self, direction: Direction, entry: u8) -> Object {
        let base = match direction {
            Direction::Receive => 0x1400,
            Direction::Transmit => 0x1800,
        };
        Object {
            index: base + self as u16,
            subindex: entry,
            n_bytes: if entry == 1 { 4 } else { 1 },
        }
    }
}

impl Object {
    /// The entry of this object in a PDO mapping, which consists of index, subindex and length in
    /// bits.
    pub fn mapped(self) -> u32 {
        u32::from(self.index) << 16 | u32::from(self.subindex) << 8 | (8 * u32::from(self.n_bytes))
    }

    /// Decodes an entry of a PDO mapping. Only lengths of 1, 2 or 4 whole bytes are supported.
    pub fn from_mapped(entry: u32) -> Result<Self, CanError> {
        let [high, low, subindex, n_bits] = entry.to_be_bytes();
        match n_bits {
            8 | 16 | 32 => Ok(Self {
                index: u16::from_be_bytes([high, low]),
                subindex,
                n_bytes: n_bits / 8,
            }),
            _ => Err(CanError::Undefined {
                field: "the length of a mapped object in bits",
                raw: n_bits.into(),
            }),
        }
    }
}

/// The value of [`CONSUMER_HEARTBEAT`] with which a drive reacts after `millis` without a heartbeat
/// from `host`. If `millis` is 0, the reaction is disabled.
pub fn consumer_heartbeat(host: Node, millis: u16) -> u32 {
    u32::from(host.0) << 16 | u32::from(millis)
}

/// Encodes an NMT command to one node, or to all nodes.
pub fn encode_nmt(state_command: Nmt, node: Option<Node>) -> Frame {
    data_frame(0, &[state_command as u8, node.map_or(0, Node::number)])
}

/// Encodes the SYNC at which nodes send and accept their cyclic PDOs.
pub fn encode_sync() -> Frame {
    data_frame(0x80, &[])
}

/// Encodes a heartbeat of the host or of an emulated node. Without the host's heartbeat, drives
/// stop.
pub fn encode_heartbeat(node: Node, state: NodeState) -> Frame {
    data_frame(0x700 + u32::from(node.0), &[state as u8])
}

/// Decodes a heartbeat.
pub fn decode_heartbeat(frame: &Frame) -> Result<(Node, NodeState), CanError> {
    let (node, bytes) = from_node(frame, 0x700, HEARTBEAT)?;
    let &[state] = bytes else {
        return Err(CanError::Length {
            message: HEARTBEAT,
            got_bytes: bytes.len(),
            expected_bytes: 1,
        });
    };
    let states = [
        NodeState::BootUp,
        NodeState::Stopped,
        NodeState::Operational,
        NodeState::PreOperational,
    ];
    Ok((
        node,
        decode_enum("the state of the node", state.into(), &states, |known| {
            known as u32
        })?,
    ))
}

/// Encodes a request to read an object of a node.
pub fn encode_read(node: Node, object: Object) -> Frame {
    let [low, high] = object.index.to_le_bytes();
    data_frame(
        0x600 + u32::from(node.0),
        &[0x40, low, high, object.subindex, 0, 0, 0, 0],
    )
}

/// Encodes a request to write an object of a node. Negative values are encoded as two's complement.
///
/// # Errors
/// Fails if the value does not fit into the object.
pub fn encode_write(node: Node, object: Object, value: i64) -> Result<Frame, CanError> {
    let n_bits = 8 * u32::from(object.n_bytes);
    let command = match object.n_bytes {
        1 => 0x2F,
        2 => 0x2B,
        4 => 0x23,
        n_bytes => {
            return Err(CanError::Undefined {
                field: "the bytes of an object",
                raw: n_bytes.into(),
            });
        }
    };
    // The range extends from the smallest signed to the largest unsigned number. Objects of the
    // same length may be signed or unsigned, and their bytes are the same.
    let lower = -(1_i64 << (n_bits - 1));
    let upper = (1_i64 << n_bits) - 1;
    if !(lower..=upper).contains(&value) {
        #[expect(clippy::cast_precision_loss, reason = "only for the error message")]
        let [value, lower, upper] = [value, lower, upper].map(|number| number as f64);
        return Err(CanError::Range {
            field: "the value of an object",
            value,
            lower,
            upper,
        });
    }
    let [low, high] = object.index.to_le_bytes();
    let mut bytes = [command, low, high, object.subindex, 0, 0, 0, 0];
    let n_bytes = usize::from(object.n_bytes);
    bytes[4..4 + n_bytes].copy_from_slice(&value.to_le_bytes()[..n_bytes]);
    Ok(data_frame(0x600 + u32::from(node.0), &bytes))
}

/// Answer of a node to an SDO request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SdoAnswer {
    /// The object was written.
    Written {
        /// Index of the object.
        index: u16,
        /// Subindex of the object.
        subindex: u8,
    },
    /// Value of an object. `n_bytes` is 4 if the node does not report the length.
    Value {
        /// The object, with the length that the node reports.
        object: Object,
        /// The bytes of the value. Unused upper bytes are 0. Use [`signed`] for values that may be
        /// negative.
        raw: u32,
    },
}

/// Interprets the lower `n_bytes` (1, 2 or 4) as two's complement.
pub fn signed(raw: u32, n_bytes: u8) -> i32 {
    // The arithmetic shift to the right copies the sign bit into the unused bits.
    let n_unused_bits = 32 - 8 * u32::from(n_bytes.clamp(1, 4));
    (raw << n_unused_bits).cast_signed() >> n_unused_bits
}

/// Decodes a node's answer to an SDO request. An aborted or segmented transfer is an error.
pub fn decode_sdo(frame: &Frame) -> Result<(Node, SdoAnswer), CanError> {
    let (node, bytes) = from_node(frame, 0x580, SDO)?;
    let &[command, low, high, subindex, a, b, c, d] = bytes else {
        return Err(CanError::Length {
            message: SDO,
            got_bytes: bytes.len(),
            expected_bytes: 8,
        });
    };
    let index = u16::from_le_bytes([low, high]);
    let value = u32::from_le_bytes([a, b, c, d]);
    // The upper three bits are the command. In answers to a read, the other bits contain the number
    // of unused bytes and the flags "expedited" and "length given".
    match (command >> 5, command & 0b10 != 0, command & 0b01 != 0) {
        (3, ..) => Ok((node, SdoAnswer::Written { index, subindex })),
        (4, ..) => Err(CanError::Aborted {
            index,
            subindex,
            code: value,
        }),
        (2, true, has_length) => {
            let n_bytes = if has_length {
                4 - (command >> 2 & 0b11)
            } else {
                4
            };
            // Bytes beyond the reported length are undefined.
            let raw = value & (u32::MAX >> (32 - 8 * u32::from(n_bytes)));
            Ok((
                node,
                SdoAnswer::Value {
                    object: Object {
                        index,
                        subindex,
                        n_bytes,
                    },
                    raw,
                },
            ))
        }
        (2, false, _) | (0 | 1 | 6, ..) => Err(CanError::Segmented { index, subindex }),
        _ => Err(CanError::Undefined {
            field: "the command of an SDO answer",
            raw: command.into(),
        }),
    }
}

/// Meaning of an SDO abort code.
pub fn abort_text(code: u32) -> &'static str {
    match code {
        0x0503_0000 => "toggle bit not alternated",
        0x0504_0000 => "timed out",
        0x0504_0001 => "command unknown",
        0x0504_0005 => "out of memory",
        0x0601_0000 => "access not supported",
        0x0601_0001 => "write only",
        0x0601_0002 => "read only",
        0x0602_0000 => "no such object",
        0x0604_0041 => "cannot be mapped to a PDO",
        0x0604_0042 => "mapped objects exceed the PDO",
        0x0604_0043 => "parameters incompatible",
        0x0604_0047 => "internal incompatibility",
        0x0606_0000 => "hardware error",
        0x0607_0010 => "length does not match",
        0x0607_0012 => "too long",
        0x0607_0013 => "too short",
        0x0609_0011 => "no such subindex",
        0x0609_0030 => "value out of range",
        0x0609_0031 => "value too high",
        0x0609_0032 => "value too low",
        0x0800_0000 => "general error",
        0x0800_0020 => "cannot be stored",
        0x0800_0021 => "cannot be stored: local control",
        0x0800_0022 => "cannot be stored in the present state",
        _ => "unknown code",
    }
}

fn data_frame(id: u32, bytes: &[u8]) -> Frame {
    let id = Id::standard(id).expect("the identifier is at most 0x700 plus 127");
    Frame::classic(id, bytes).expect("at most eight bytes")
}

/// Returns the node and the bytes of a data frame whose identifier is `base` plus the node ID.
fn from_node<'a>(
    frame: &'a Frame,
    base: u32,
    message: &'static str,
) -> Result<(Node, &'a [u8]), CanError> {
    let id = frame.id().value();
    let node = id
        .checked_sub(base)
        .and_then(|number| Node::new(u8::try_from(number).ok()?).ok());
    match node {
        // FD frames and 29-bit identifiers of other devices on the bus may have the same number.
        Some(node) if !frame.is_remote() && !frame.is_fd() && !frame.id().is_extended() => {
            Ok((node, frame.data()))
        }
        _ => Err(CanError::UnexpectedFrame { message, id }),
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::{random_frames, truncated_and_doubled};
    use super::*;

    const NODE: Node = Node(5);
    const TARGET: Object = Object {
        index: 0x607A,
        subindex: 0,
        n_bytes: 4,
    };

    #[test]
    fn encoded_frames_match_published_bytes() {
        assert_eq!(encode_nmt(Nmt::Start, None), data_frame(0, &[1, 0]));
        assert_eq!(
            encode_nmt(Nmt::ResetNode, Some(NODE)),
            data_frame(0, &[0x81, 5])
        );
        assert_eq!(encode_sync(), data_frame(0x80, &[]));
        assert_eq!(
            encode_heartbeat(Node(127), NodeState::Operational),
            data_frame(0x77F, &[5])
        );
        // The bytes are from test_sdo of christiansandberg/canopen, which uploads 0x1018:01 and
        // downloads 0x1017 in expedited transfers.
        let vendor = Object {
            index: 0x1018,
            subindex: 1,
            n_bytes: 4,
        };
        assert_eq!(
            encode_read(Node(2), vendor),
            data_frame(0x602, &[0x40, 0x18, 0x10, 0x01, 0, 0, 0, 0])
        );
        assert_eq!(
            encode_write(Node(2), PRODUCER_HEARTBEAT, 4000),
            Ok(data_frame(0x602, &[0x2B, 0x17, 0x10, 0, 0xA0, 0x0F, 0, 0]))
        );
        let mode = Object {
            index: 0x6060,
            subindex: 0,
            n_bytes: 1,
        };
        assert_eq!(
            encode_write(NODE, mode, -1),
            Ok(data_frame(0x605, &[0x2F, 0x60, 0x60, 0, 0xFF, 0, 0, 0]))
        );
        assert_eq!(
            encode_write(NODE, TARGET, -2),
            Ok(data_frame(
                0x605,
                &[0x23, 0x7A, 0x60, 0, 0xFE, 0xFF, 0xFF, 0xFF]
            ))
        );
        assert_eq!(consumer_heartbeat(Node(127), 100), 0x007F_0064);
        assert_eq!(TARGET.mapped(), 0x607A_0020);
    }

    #[test]
    fn pdos_have_standard_identifiers_and_objects() {
        let ids = |direction| {
            [Pdo::First, Pdo::Second, Pdo::Third, Pdo::Fourth]
                .map(|pdo| pdo.id(direction, NODE).value())
        };
        assert_eq!(ids(Direction::Transmit), [0x185, 0x285, 0x385, 0x485]);
        assert_eq!(ids(Direction::Receive), [0x205, 0x305, 0x405, 0x505]);
        assert_eq!(
            Pdo::First.mapping(Direction::Receive, 0),
            Object {
                index: 0x1600,
                subindex: 0,
                n_bytes: 1
            }
        );
        assert_eq!(
            Pdo::Second.mapping(Direction::Transmit, 2),
            Object {
                index: 0x1A01,
                subindex: 2,
                n_bytes: 4
            }
        );
        assert_eq!(
            Pdo::Third.communication(Direction::Transmit, 1),
            Object {
                index: 0x1802,
                subindex: 1,
                n_bytes: 4
            }
        );
        assert_eq!(
            Pdo::Fourth.communication(Direction::Receive, 2),
            Object {
                index: 0x1403,
                subindex: 2,
                n_bytes: 1
            }
        );
        assert_eq!(Object::from_mapped(0x607A_0020), Ok(TARGET));
        assert!(Object::from_mapped(0x607A_0021).is_err());
    }

    #[test]
    fn answers_are_decoded() {
        let read = |bytes: &[u8]| decode_sdo(&data_frame(0x585, bytes)).map(|(_, answer)| answer);
        let value = |n_bytes, raw| SdoAnswer::Value {
            object: Object {
                index: 0x6064,
                subindex: 0,
                n_bytes,
            },
            raw,
        };
        assert_eq!(
            read(&[0x43, 0x64, 0x60, 0, 1, 2, 3, 4]),
            Ok(value(4, 0x0403_0201))
        );
        assert_eq!(
            read(&[0x4B, 0x64, 0x60, 0, 0xFE, 0xFF, 9, 9]),
            Ok(value(2, 0xFFFE))
        );
        assert_eq!(read(&[0x4F, 0x64, 0x60, 0, 7, 9, 9, 9]), Ok(value(1, 7)));
        assert_eq!(read(&[0x42, 0x64, 0x60, 0, 1, 0, 0, 0]), Ok(value(4, 1)));
        assert_eq!(
            read(&[0x60, 0x7A, 0x60, 0, 0, 0, 0, 0]),
            Ok(SdoAnswer::Written {
                index: 0x607A,
                subindex: 0
            })
        );
        // christiansandberg/canopen, test_abort.
        let aborted = read(&[0x80, 0x18, 0x10, 0x01, 0x11, 0x00, 0x09, 0x06]);
        assert_eq!(
            aborted,
            Err(CanError::Aborted {
                index: 0x1018,
                subindex: 1,
                code: 0x0609_0011
            })
        );
        assert!(
            aborted
                .expect_err("aborted")
                .to_string()
                .ends_with("0x06090011 (no such subindex)")
        );
        let name = read(&[0x41, 0x08, 0x10, 0, 0x1A, 0, 0, 0]);
        assert_eq!(
            name,
            Err(CanError::Segmented {
                index: 0x1008,
                subindex: 0
            })
        );
        assert!(
            name.expect_err("segmented")
                .to_string()
                .contains("0x1008:00 uses a segmented transfer")
        );
        let states = [
            NodeState::BootUp,
            NodeState::Stopped,
            NodeState::Operational,
            NodeState::PreOperational,
        ];
        for state in states {
            assert_eq!(
                decode_heartbeat(&encode_heartbeat(NODE, state)),
                Ok((NODE, state))
            );
        }
        assert_eq!(
            [
                signed(0xFFFE, 2),
                signed(0x7FFE, 2),
                signed(0xFF, 1),
                signed(u32::MAX, 4)
            ],
            [-2, 0x7FFE, -1, -1]
        );
    }

    #[test]
    fn invalid_messages_are_rejected() {
        for number in [0, 128, 255] {
            assert!(Node::new(number).is_err());
        }
        for (object, value) in [
            (PRODUCER_HEARTBEAT, 65_536),
            (PRODUCER_HEARTBEAT, -32_769),
            (TARGET, 1 << 32),
        ] {
            assert!(
                matches!(
                    encode_write(NODE, object, value),
                    Err(CanError::Range { .. })
                ),
                "{value}"
            );
        }
        assert!(
            encode_write(
                NODE,
                Object {
                    n_bytes: 8,
                    ..TARGET
                },
                0
            )
            .is_err()
        );
        for malformed in
            truncated_and_doubled(&data_frame(0x585, &[0x43, 0x64, 0x60, 0, 1, 2, 3, 4]))
        {
            assert!(decode_sdo(&malformed).is_err(), "{malformed:?}");
        }
        for (id, bytes) in [
            (0x705, &[][..]),
            (0x705, &[5, 5]),
            (0x705, &[6]),
            (0x700, &[5]),
            (0x6FF, &[5]),
        ] {
            assert!(
                decode_heartbeat(&data_frame(id, bytes)).is_err(),
                "{id:x} {bytes:?}"
            );
        }
        assert!(matches!(
            decode_sdo(&data_frame(0x605, &[0x43; 8])),
            Err(CanError::UnexpectedFrame { .. })
        ));
        let mut n_read = 0;
        for frame in random_frames(29, Id::standard(0x585).expect("11 bits")) {
            n_read += i32::from(decode_sdo(&frame).is_ok());
            let _ = decode_heartbeat(&frame);
        }
        assert!(n_read > 100, "{n_read}");
    }
}
