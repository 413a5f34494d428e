//! Motors on a CAN bus: frames as plain data and the protocols of four families.
//!
//! Every codec is pure: a [`Frame`] in, SI out, and back. Numbers that a field cannot hold are clamped where the makers' own
//! samples clamp (MIT packing, Robstride, ODrive's feed-forward) and refused everywhere else; no number is refused always.

pub mod canopen;
pub mod cia402;
pub mod damiao;
pub mod frame;
pub mod mit;
pub mod odrive;
pub mod robstride;
pub mod scale;
pub mod tmotor;

pub use frame::{Frame, Id};

/// A frame that cannot be made, or one that does not follow its protocol.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum CanError {
    /// A number too large for its kind of identifier.
    #[error("identifier {id:#x} does not fit into {bits} bits")]
    IdRange {
        /// The number.
        id: u32,
        /// 11 or 29.
        bits: u8,
    },
    /// A payload of a length that no frame of its format has.
    #[error("no {format} frame has {got_bytes} bytes")]
    PayloadLength {
        /// "classic" or "FD".
        format: &'static str,
        /// Bytes asked for.
        got_bytes: usize,
    },
    /// A frame that is no message of this kind: its identifier or its kind is another's.
    #[error("the frame {id:#x} is no {message}")]
    UnexpectedFrame {
        /// What was looked for.
        message: &'static str,
        /// Identifier of the frame.
        id: u32,
    },
    /// A message with too few or too many bytes.
    #[error("{message}: {got_bytes} bytes, expected {expected_bytes}")]
    Length {
        /// Which message.
        message: &'static str,
        /// Bytes there.
        got_bytes: usize,
        /// Bytes needed.
        expected_bytes: usize,
    },
    /// A field has a value that its protocol does not define.
    #[error("{field} is {raw:#x}, which the protocol does not define")]
    Undefined {
        /// Which field.
        field: &'static str,
        /// What it holds.
        raw: u32,
    },
    /// A number that is none, or infinite where that means nothing.
    #[error("{field} is not a finite number")]
    NotFinite {
        /// Which field.
        field: &'static str,
    },
    /// A number outside what its field can hold.
    #[error("{field} is {value}, must be {lower} to {upper}")]
    Range {
        /// Which field.
        field: &'static str,
        /// The number.
        value: f64,
        /// Least allowed.
        lower: f64,
        /// Most allowed.
        upper: f64,
    },
    /// The device refused to read or write a parameter.
    #[error("the device refused parameter {parameter:#x}")]
    Refused {
        /// Index of the parameter.
        parameter: u32,
    },
    /// The device broke off a transfer of an object.
    #[error("the device broke off the transfer of object {index:#06x}:{subindex:02x} with code {code:#010x} ({})", canopen::abort_text(*code))]
    Aborted {
        /// Index of the object.
        index: u16,
        /// Subindex of the object.
        subindex: u8,
        /// The abort code of CiA 301.
        code: u32,
    },
    /// The device answers with a transfer in segments: the object is longer than four bytes.
    #[error(
        "object {index:#06x}:{subindex:02x} comes in segments, only expedited transfers (up to 4 bytes) are spoken"
    )]
    Segmented {
        /// Index of the object.
        index: u16,
        /// Subindex of the object.
        subindex: u8,
    },
}

/// The one of `all` whose number a field holds.
fn decode_enum<T: Copy>(field: &'static str, raw: u32, all: &[T], number: impl Fn(T) -> u32) -> Result<T, CanError> {
    all.iter().copied().find(|known| number(*known) == raw).ok_or(CanError::Undefined { field, raw })
}

/// The eight bytes of a data frame with an 11-bit or 29-bit identifier; anything else is refused.
fn eight_bytes(frame: &Frame, message: &'static str, extended: bool) -> Result<[u8; 8], CanError> {
    let id = frame.id();
    if frame.is_remote() || id.is_extended() != extended {
        return Err(CanError::UnexpectedFrame { message, id: id.value() });
    }
    let got_bytes = frame.data().len();
    frame.data().try_into().map_err(|_| CanError::Length { message, got_bytes, expected_bytes: 8 })
}

#[cfg(test)]
mod testing {
    use super::{Frame, Id};

    /// Random numbers from a seed: Knuth's linear congruence, upper half.
    pub(super) struct Random(pub(super) u64);

    impl Random {
        pub(super) fn next(&mut self) -> u32 {
            self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (self.0 >> 32) as u32
        }

        /// A number from 0 to 1.
        pub(super) fn unit_interval(&mut self) -> f64 {
            f64::from(self.next()) / f64::from(u32::MAX)
        }
    }

    /// Frames of random kind, identifier, length and bytes; every fourth bears `id`.
    pub(super) fn random_frames(seed: u64, id: Id) -> impl Iterator<Item = Frame> {
        let mut random = Random(seed);
        (0..20_000).map(move |round| {
            let identifier = match random.next() % 2 {
                0 => Id::standard(random.next() & 0x7FF),
                _ => Id::extended(random.next() & 0x1FFF_FFFF),
            };
            let id = if round % 4 == 0 { id } else { identifier.expect("masked") };
            let bytes: Vec<u8> = (0..64).map(|_| random.next().to_le_bytes()[0]).collect();
            let len = usize::try_from(random.next() % 9).expect("small");
            match random.next() % 8 {
                0 => Frame::remote(id, len),
                1 => Frame::fd(id, &bytes[..[8, 12, 16, 64][len % 4]], true),
                2..5 => Frame::classic(id, &bytes[..8]),
                _ => Frame::classic(id, &bytes[..len]),
            }
            .expect("lengths of their formats")
        })
    }

    /// The same frame with every other length from 0 to 8, and twice as long as an FD frame: all must be refused.
    pub(super) fn truncated_and_doubled(frame: &Frame) -> Vec<Frame> {
        let bytes = [frame.data(), frame.data()].concat();
        let identifier = frame.data().len();
        let cut = (0..identifier).map(|len| Frame::classic(frame.id(), &bytes[..len]));
        let doubled = (identifier == 8).then(|| Frame::fd(frame.id(), &bytes, false));
        cut.chain(doubled).map(|built| built.expect("a length of its format")).collect()
    }
}
