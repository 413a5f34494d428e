//! CAN frames as plain data, and the encodings that several motor families share. The codec of a
//! family is in its folder of [`can`](crate::can).
//!
//! Every codec is pure and only converts between a [`Frame`] and SI values. Values outside the
//! range of a field are clamped if the manufacturers' own examples clamp them (MIT packing,
//! Robstride, ODrive's feedforward). Otherwise, they are errors. NaN is always an error.

pub mod canopen;
pub mod frame;
pub mod mit;
pub mod scale;

pub use frame::{Frame, Id};

/// A frame is invalid, or does not follow its protocol.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum CanError {
    /// The number is too large for this kind of identifier.
    #[error("identifier {id:#x} does not fit into {bits} bits")]
    IdRange {
        /// The number.
        id: u32,
        /// Number of bits of the identifier, 11 or 29.
        bits: u8,
    },
    /// The frame format does not allow this payload length.
    #[error("invalid payload length for frame format {format}: {got_bytes} bytes")]
    PayloadLength {
        /// "classic" or "FD".
        format: &'static str,
        /// Requested length in bytes.
        got_bytes: usize,
    },
    /// According to its ID or format, a frame is not a message of the expected kind.
    #[error("expected {message}, found a frame with identifier {id:#x}")]
    UnexpectedFrame {
        /// Expected message.
        message: &'static str,
        /// Identifier of the frame.
        id: u32,
    },
    /// A message has the wrong length.
    #[error("{message}: {got_bytes} bytes, expected {expected_bytes}")]
    Length {
        /// Name of the message.
        message: &'static str,
        /// Actual length in bytes.
        got_bytes: usize,
        /// Expected length in bytes.
        expected_bytes: usize,
    },
    /// A field has a value that the protocol does not define.
    #[error("{field} is {raw:#x}, which the protocol does not define")]
    Undefined {
        /// Which field.
        field: &'static str,
        /// Its value.
        raw: u32,
    },
    /// A field contains NaN, or infinity where it is not allowed.
    #[error("{field} is not a finite number")]
    NotFinite {
        /// Which field.
        field: &'static str,
    },
    /// A number is outside the range of its field.
    #[error("{field} is {value}, must be {lower} to {upper}")]
    Range {
        /// Which field.
        field: &'static str,
        /// The number.
        value: f64,
        /// Minimum.
        lower: f64,
        /// Maximum.
        upper: f64,
    },
    /// The device refused to read or write a parameter.
    #[error("the device refused parameter {parameter:#x}")]
    Refused {
        /// Index of the parameter.
        parameter: u32,
    },
    /// The device aborted an SDO transfer.
    #[error("the device aborted the transfer of object {index:#06x}:{subindex:02x} with code {code:#010x} ({})", canopen::abort_text(*code))]
    Aborted {
        /// Index of the object.
        index: u16,
        /// Subindex of the object.
        subindex: u8,
        /// The abort code of CiA 301.
        code: u32,
    },
    /// The device answered with a segmented transfer, because the object is longer than four bytes.
    #[error(
        "object {index:#06x}:{subindex:02x} uses a segmented transfer, but only expedited transfers (up to 4 bytes) are supported"
    )]
    Segmented {
        /// Index of the object.
        index: u16,
        /// Subindex of the object.
        subindex: u8,
    },
}

/// Finds the variant in `all` whose number is `raw`.
pub(crate) fn decode_enum<T: Copy>(
    field: &'static str,
    raw: u32,
    all: &[T],
    number: impl Fn(T) -> u32,
) -> Result<T, CanError> {
    all.iter()
        .copied()
        .find(|known| number(*known) == raw)
        .ok_or(CanError::Undefined { field, raw })
}

/// Returns the eight bytes of a data frame with an 11-bit or 29-bit identifier. Any other frame is
/// an error.
pub(crate) fn eight_bytes(
    frame: &Frame,
    message: &'static str,
    extended: bool,
) -> Result<[u8; 8], CanError> {
    let id = frame.id();
    // The same number means different messages in both kinds of identifiers.
    if frame.is_remote() || id.is_extended() != extended {
        return Err(CanError::UnexpectedFrame {
            message,
            id: id.value(),
        });
    }
    let got_bytes = frame.data().len();
    frame.data().try_into().map_err(|_| CanError::Length {
        message,
        got_bytes,
        expected_bytes: 8,
    })
}

#[cfg(test)]
pub(crate) mod testing {
    use super::{Frame, Id};
    use numbers::random::Random;

    /// Frames of random format, identifier, length and bytes. Every fourth frame has the identifier
    /// `id`.
    pub(crate) fn random_frames(seed: u64, id: Id) -> impl Iterator<Item = Frame> {
        let mut random = Random::new(seed);
        (0..20_000).map(move |round| {
            let identifier = match random.below(2) {
                0 => Id::standard(random.bits_32() & 0x7FF),
                _ => Id::extended(random.bits_32() & 0x1FFF_FFFF),
            };
            let id = if round % 4 == 0 {
                id
            } else {
                identifier.expect("the identifier is masked to 11 or 29 bits")
            };
            let bytes = random.bytes(64);
            let len = random.below(9);
            match random.below(8) {
                0 => Frame::remote(id, len),
                1 => Frame::fd(id, &bytes[..[8, 12, 16, 64][len % 4]], true),
                2..5 => Frame::classic(id, &bytes[..8]),
                _ => Frame::classic(id, &bytes[..len]),
            }
            .expect("the lengths are valid for the formats")
        })
    }

    /// The frame truncated to every shorter length, and an FD frame of twice the length. Codecs
    /// must reject all of these frames.
    pub(crate) fn truncated_and_doubled(frame: &Frame) -> Vec<Frame> {
        let bytes = [frame.data(), frame.data()].concat();
        let n_bytes = frame.data().len();
        let cut = (0..n_bytes).map(|len| Frame::classic(frame.id(), &bytes[..len]));
        let doubled = (n_bytes == 8).then(|| Frame::fd(frame.id(), &bytes, false));
        cut.chain(doubled)
            .map(|built| built.expect("the length is valid for the format"))
            .collect()
    }
}
