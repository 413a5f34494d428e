//! Decodes the MCAP records that recordings consist of. Lengths are checked against the available
//! bytes before use.
//!
//! Source: the MCAP format specification, <https://mcap.dev/spec>, "Records".

use super::records::ATTACHMENT;
use std::collections::BTreeMap;

const SCHEMA: u8 = 0x03;
const CHANNEL: u8 = 0x04;
const MESSAGE: u8 = 0x05;
const METADATA: u8 = 0x0C;

/// A decoded record.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Record<'a> {
    Schema {
        id: u16,
        name: &'a str,
    },
    Channel {
        id: u16,
        schema_id: u16,
        topic: &'a str,
        encoding: &'a str,
        metadata: BTreeMap<&'a str, &'a str>,
    },
    Message {
        channel_id: u16,
        data: &'a [u8],
    },
    Attachment {
        name: &'a str,
        data: &'a [u8],
    },
    /// Entries of another program under a common name.
    Metadata {
        name: &'a str,
    },
    /// Other records: indices, statistics and records of newer writers.
    Other,
}

/// The reason why a record cannot be decoded.
#[derive(Debug, PartialEq, Eq, thiserror::Error)]
pub(super) enum RecordError {
    #[error("a record ends inside a field")]
    Truncated,
    #[error("a name is not UTF-8")]
    Text,
    #[error("the checksum of attachment {name:?} does not match")]
    Checksum { name: String },
}

impl<'a> Record<'a> {
    pub(super) fn decode(opcode: u8, bytes: &'a [u8]) -> Result<Self, RecordError> {
        let mut fields = Fields(bytes);
        Ok(match opcode {
            SCHEMA => Self::Schema {
                id: fields.two()?,
                name: fields.text()?,
            },
            CHANNEL => {
                let id = fields.two()?;
                let schema_id = fields.two()?;
                let topic = fields.text()?;
                let encoding = fields.text()?;
                let n_bytes = fields.four()?.into();
                // The map has its own length in bytes, so its entries cannot reach into the next
                // field.
                let mut entries = Fields(fields.bytes(n_bytes)?);
                let mut metadata = BTreeMap::new();
                while !entries.0.is_empty() {
                    metadata.insert(entries.text()?, entries.text()?);
                }
                Self::Channel {
                    id,
                    schema_id,
                    topic,
                    encoding,
                    metadata,
                }
            }
            MESSAGE => {
                let channel_id = fields.two()?;
                let _sequence = fields.four()?;
                let _times = fields.bytes(8 + 8)?;
                Self::Message {
                    channel_id,
                    // The data of a message extend to the end of the record, without a length.
                    data: fields.0,
                }
            }
            ATTACHMENT => {
                let _times = fields.bytes(8 + 8)?;
                let name = fields.text()?;
                let _media_type = fields.text()?;
                let n_bytes = fields.eight()?;
                let data = fields.bytes(n_bytes)?;
                let checksummed = &bytes[..bytes.len() - fields.0.len()];
                let stored_crc = fields.four()?;
                // 0 means that the writer computed no checksum.
                if stored_crc != 0 && stored_crc != crc32fast::hash(checksummed) {
                    return Err(RecordError::Checksum {
                        // The name may come from a damaged record, and may then be megabytes of
                        // garbage.
                        name: name.chars().take(100).collect(),
                    });
                }
                Self::Attachment { name, data }
            }
            METADATA => Self::Metadata {
                name: fields.text()?,
            },
            _ => Self::Other,
        })
    }
}

/// Remaining bytes of a record.
struct Fields<'a>(&'a [u8]);

impl<'a> Fields<'a> {
    fn bytes(&mut self, n_bytes: u64) -> Result<&'a [u8], RecordError> {
        let n_bytes = usize::try_from(n_bytes).map_err(|_| RecordError::Truncated)?;
        let (field, rest) = self
            .0
            .split_at_checked(n_bytes)
            .ok_or(RecordError::Truncated)?;
        self.0 = rest;
        Ok(field)
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], RecordError> {
        let (field, rest) = self.0.split_first_chunk().ok_or(RecordError::Truncated)?;
        self.0 = rest;
        Ok(*field)
    }

    fn two(&mut self) -> Result<u16, RecordError> {
        self.array().map(u16::from_le_bytes)
    }

    fn four(&mut self) -> Result<u32, RecordError> {
        self.array().map(u32::from_le_bytes)
    }

    fn eight(&mut self) -> Result<u64, RecordError> {
        self.array().map(u64::from_le_bytes)
    }

    fn text(&mut self) -> Result<&'a str, RecordError> {
        let n_bytes = self.four()?.into();
        std::str::from_utf8(self.bytes(n_bytes)?).map_err(|_| RecordError::Text)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn text(text: &str) -> Vec<u8> {
        [
            &u32::try_from(text.len()).expect("short").to_le_bytes()[..],
            text.as_bytes(),
        ]
        .concat()
    }

    fn attachment(checksum: impl Fn(&[u8]) -> u32) -> Vec<u8> {
        let body = [
            &[0; 16][..],
            &text("rig.toml"),
            &text("text/plain"),
            &3_u64.to_le_bytes(),
            b"abc",
        ]
        .concat();
        [&body[..], &checksum(&body).to_le_bytes()].concat()
    }

    #[test]
    fn records_decode_and_truncated_ones_fail() {
        let entries = [text("joint_names"), text("a,b")].concat();
        let n_entries = u32::try_from(entries.len()).expect("short").to_le_bytes();
        let channel = [
            &[7, 0, 3, 0][..],
            &text("/joints"),
            &text("json"),
            &n_entries,
            &entries,
        ]
        .concat();
        let schema = [&[3, 0][..], &text("s"), &text("jsonschema"), &text("{}")].concat();
        let complete = attachment(crc32fast::hash);
        let metadata = BTreeMap::from([("joint_names", "a,b")]);
        for (opcode, bytes, expected) in [
            (
                CHANNEL,
                &channel,
                Record::Channel {
                    id: 7,
                    schema_id: 3,
                    topic: "/joints",
                    encoding: "json",
                    metadata,
                },
            ),
            (SCHEMA, &schema, Record::Schema { id: 3, name: "s" }),
            (
                ATTACHMENT,
                &complete,
                Record::Attachment {
                    name: "rig.toml",
                    data: b"abc",
                },
            ),
            (
                METADATA,
                &text("calibration"),
                Record::Metadata {
                    name: "calibration",
                },
            ),
        ] {
            assert_eq!(Record::decode(opcode, bytes), Ok(expected));
            for n_bytes in 0..7 {
                assert_eq!(
                    Record::decode(opcode, &bytes[..n_bytes]),
                    Err(RecordError::Truncated),
                    "{opcode}: {n_bytes} bytes"
                );
            }
        }
        assert_eq!(Record::decode(0x0B, &[]), Ok(Record::Other));
        assert_eq!(
            Record::decode(ATTACHMENT, &attachment(|_| 0)),
            Record::decode(ATTACHMENT, &complete),
            "a checksum of 0 means none"
        );
        let damaged = attachment(|_| 1);
        let checksum_error = Record::decode(ATTACHMENT, &damaged);
        assert_eq!(
            checksum_error,
            Err(RecordError::Checksum {
                name: "rig.toml".to_owned()
            })
        );
    }

    #[test]
    fn huge_length_allocates_no_memory() {
        let huge = [&[7, 0, 3, 0][..], &u32::MAX.to_le_bytes(), b"/joints"].concat();
        assert_eq!(Record::decode(CHANNEL, &huge), Err(RecordError::Truncated));
        assert_eq!(
            Record::decode(SCHEMA, &[1, 0, 1, 0, 0, 0, 0xff]),
            Err(RecordError::Text)
        );
    }
}
