//! Byte codecs: pure `encode` and `decode`, no sockets, no clocks.

pub mod can;
pub mod datagram;
pub mod descriptor;
pub mod foxglove;
pub mod joint_state;
pub mod point_cloud;
pub mod protobuf;

/// Bytes that do not follow their format.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum Malformed {
    /// The bytes end inside a field.
    #[error("the message ends inside a field")]
    Truncated,
    /// A field has a type that protobuf does not know or that this field cannot have.
    #[error("field {field} has wire type {wire_type}, which it cannot have")]
    WireType {
        /// Number of the field.
        field: u32,
        /// The type found.
        wire_type: u8,
    },
    /// A number is outside its range.
    #[error("field {field} is outside its range")]
    Range {
        /// Number of the field.
        field: u32,
    },
    /// A text is not UTF-8.
    #[error("field {field} is not UTF-8 text")]
    Text {
        /// Number of the field.
        field: u32,
    },
    /// A needed field is absent.
    #[error("the {name} is missing")]
    Missing {
        /// Name of the field.
        name: &'static str,
    },
    /// A format of pixels that this program does not know.
    #[error("the pixel format {name:?} is unknown")]
    PixelFormat {
        /// The format's name.
        name: String,
    },
    /// JSON that does not fit its schema.
    #[error("{reason}")]
    Json {
        /// What the parser says.
        reason: String,
    },
}
