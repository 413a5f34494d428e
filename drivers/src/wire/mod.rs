//! Byte codecs. They consist of pure `encode` and `decode` functions without sockets and clocks.

pub mod base_drive;
pub mod can;
pub mod datagram;
pub mod descriptor;
pub mod foxglove;
pub mod joint_state;
pub(crate) mod json;
pub mod point_cloud;
pub mod protobuf;

/// The bytes do not follow their format.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum Malformed {
    /// The bytes end inside a field.
    #[error("the message ends inside a field")]
    Truncated,
    /// The wire type of a field is unknown or not allowed for this field.
    #[error("wire type {wire_type} is not allowed for field {field}")]
    WireType {
        /// Number of the field.
        field: u32,
        /// The wire type found.
        wire_type: u8,
    },
    /// A number is outside its range.
    #[error("field {field} is outside its range")]
    Range {
        /// Number of the field.
        field: u32,
    },
    /// A string is not UTF-8.
    #[error("field {field} is not UTF-8 text")]
    Text {
        /// Number of the field.
        field: u32,
    },
    /// A required field is missing.
    #[error("the {name} is missing")]
    Missing {
        /// Name of the field.
        name: &'static str,
    },
    /// The pixel format is unknown.
    #[error("the pixel format {name:?} is unknown")]
    PixelFormat {
        /// Name of the pixel format.
        name: String,
    },
    /// A field has a value that contradicts the rest of the message or is not supported.
    #[error("{name} is {found}, expected {expected}")]
    Unsupported {
        /// Name of the field.
        name: &'static str,
        /// Value found.
        found: String,
        /// Values allowed.
        expected: String,
    },
    /// The JSON does not match its schema.
    #[error("{reason}")]
    Json {
        /// Message of the parser.
        reason: String,
    },
}
