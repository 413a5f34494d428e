//! The protobuf wire format.
//!
//! Source: Protocol Buffers documentation, "Encoding". Groups do not exist in proto3 and are
//! errors.

use super::Malformed;

const VARINT: u8 = 0;
const FIXED64: u8 = 1;
const LENGTH: u8 = 2;
const FIXED32: u8 = 5;

/// Encoder of a message.
#[derive(Clone, Debug, Default)]
pub struct Message(Vec<u8>);

impl Message {
    /// An empty message with capacity for `bytes`.
    pub fn with_capacity(bytes: usize) -> Self {
        Self(Vec::with_capacity(bytes))
    }

    /// Appends an integer. Negative numbers of `int32` and `int64` are encoded as 64-bit two's
    /// complement.
    pub fn varint(&mut self, field: u32, value: u64) -> &mut Self {
        self.key(field, VARINT);
        self.raw_varint(value);
        self
    }

    /// Appends a `fixed32`.
    pub fn fixed32(&mut self, field: u32, value: u32) -> &mut Self {
        self.key(field, FIXED32);
        self.0.extend(value.to_le_bytes());
        self
    }

    /// Appends a `double`, bit for bit.
    pub fn double(&mut self, field: u32, value: f64) -> &mut Self {
        self.key(field, FIXED64);
        self.0.extend(value.to_le_bytes());
        self
    }

    /// Appends a packed `repeated double`.
    pub fn doubles(&mut self, field: u32, values: &[f64]) -> &mut Self {
        self.key(field, LENGTH);
        self.raw_varint(values.len() as u64 * 8);
        self.0
            .extend(values.iter().flat_map(|value| value.to_le_bytes()));
        self
    }

    /// Appends `bytes`, a `string` or an encoded message.
    pub fn bytes(&mut self, field: u32, value: &[u8]) -> &mut Self {
        self.key(field, LENGTH);
        self.raw_varint(value.len() as u64);
        self.0.extend_from_slice(value);
        self
    }

    /// Appends a nested message.
    pub fn message(&mut self, field: u32, inner: &Self) -> &mut Self {
        self.bytes(field, &inner.0)
    }

    /// The encoded bytes.
    pub fn into_bytes(self) -> Vec<u8> {
        self.0
    }

    fn key(&mut self, field: u32, wire_type: u8) {
        self.raw_varint(u64::from(field) << 3 | u64::from(wire_type));
    }

    fn raw_varint(&mut self, mut value: u64) {
        // Each byte has seven bits of the number, the lowest bits first. The high bit of a byte
        // means that more bytes follow.
        while value >= 0x80 {
            self.0.push(value.to_le_bytes()[0] | 0x80);
            value >>= 7;
        }
        self.0.push(value.to_le_bytes()[0]);
    }
}

/// One decoded field.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Field<'a> {
    /// Number of the field.
    pub number: u32,
    /// Its value.
    pub value: Value<'a>,
}

/// Value of a field on the wire.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Value<'a> {
    /// An integer.
    Varint(u64),
    /// Eight bytes.
    Fixed64(u64),
    /// Four bytes.
    Fixed32(u32),
    /// Bytes, text, a message or packed numbers.
    Length(&'a [u8]),
}

impl<'a> Field<'a> {
    /// The value as an integer.
    pub fn varint(&self) -> Result<u64, Malformed> {
        match self.value {
            Value::Varint(value) => Ok(value),
            _ => Err(self.wrong_type()),
        }
    }

    /// The value as a `fixed32`.
    pub fn fixed32(&self) -> Result<u32, Malformed> {
        match self.value {
            Value::Fixed32(value) => Ok(value),
            _ => Err(self.wrong_type()),
        }
    }

    /// The value as a `double`, bit for bit.
    pub fn double(&self) -> Result<f64, Malformed> {
        match self.value {
            Value::Fixed64(bits) => Ok(f64::from_bits(bits)),
            _ => Err(self.wrong_type()),
        }
    }

    /// The value as bytes.
    pub fn bytes(&self) -> Result<&'a [u8], Malformed> {
        match self.value {
            Value::Length(bytes) => Ok(bytes),
            _ => Err(self.wrong_type()),
        }
    }

    /// The value as text.
    pub fn text(&self) -> Result<&'a str, Malformed> {
        std::str::from_utf8(self.bytes()?).map_err(|_| Malformed::Text { field: self.number })
    }

    fn wrong_type(&self) -> Malformed {
        let wire_type = match self.value {
            Value::Varint(_) => VARINT,
            Value::Fixed64(_) => FIXED64,
            Value::Fixed32(_) => FIXED32,
            Value::Length(_) => LENGTH,
        };
        Malformed::WireType {
            field: self.number,
            wire_type,
        }
    }
}

/// Iterator over the fields of a message. It ends after the first error.
#[derive(Clone, Debug)]
pub struct Fields<'a>(&'a [u8]);

/// Iterates over the fields of an encoded message, in their order.
pub fn fields(message: &[u8]) -> Fields<'_> {
    Fields(message)
}

impl<'a> Iterator for Fields<'a> {
    type Item = Result<Field<'a>, Malformed>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.0.is_empty() {
            return None;
        }
        let field = self.field();
        // Without the length of a field, the next field cannot be found.
        if field.is_err() {
            self.0 = &[];
        }
        Some(field)
    }
}

impl<'a> Fields<'a> {
    fn field(&mut self) -> Result<Field<'a>, Malformed> {
        let key = self.varint()?;
        let number = u32::try_from(key >> 3).map_err(|_| Malformed::Range { field: u32::MAX })?;
        let wire_type = key.to_le_bytes()[0] & 7;
        // The wire type gives the length even of unknown fields, so messages of newer versions can
        // be read.
        let value = match wire_type {
            VARINT => Value::Varint(self.varint()?),
            FIXED64 => Value::Fixed64(u64::from_le_bytes(self.array()?)),
            FIXED32 => Value::Fixed32(u32::from_le_bytes(self.array()?)),
            LENGTH => {
                let n_bytes = usize::try_from(self.varint()?)
                    .map_err(|_| Malformed::Range { field: number })?;
                Value::Length(self.take(n_bytes)?)
            }
            _ => {
                return Err(Malformed::WireType {
                    field: number,
                    wire_type,
                });
            }
        };
        Ok(Field { number, value })
    }

    fn varint(&mut self) -> Result<u64, Malformed> {
        let mut value = 0;
        // Ten groups of seven bits hold 64 bits. The format allows no more. The loop therefore ends
        // even if all bytes have the high bit set.
        for shift in (0..64).step_by(7) {
            let [byte] = self.array()?;
            value |= u64::from(byte & 0x7f) << shift;
            if byte < 0x80 {
                return Ok(value);
            }
        }
        Err(Malformed::Truncated)
    }

    fn take(&mut self, n_bytes: usize) -> Result<&'a [u8], Malformed> {
        let (chunk, rest) = self
            .0
            .split_at_checked(n_bytes)
            .ok_or(Malformed::Truncated)?;
        self.0 = rest;
        Ok(chunk)
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], Malformed> {
        let (chunk, rest) = self.0.split_first_chunk().ok_or(Malformed::Truncated)?;
        self.0 = rest;
        Ok(*chunk)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn documented_examples_match_published_bytes() {
        // These are the examples of the Protocol Buffers documentation. Field 1 is 150, field 2 is
        // "testing", and field 3 contains the first message.
        let mut inner = Message::default();
        inner.varint(1, 150);
        let mut outer = Message::default();
        outer.bytes(2, b"testing").message(3, &inner);
        assert_eq!(inner.into_bytes(), [0x08, 0x96, 0x01]);
        assert_eq!(outer.into_bytes(), b"\x12\x07testing\x1a\x03\x08\x96\x01");
    }

    #[test]
    fn fields_round_trip() {
        let mut message = Message::default();
        message
            .varint(1, u64::MAX)
            .fixed32(2, 7)
            .double(16, -0.0)
            .doubles(1005, &[1.5, f64::MIN_POSITIVE]);
        let bytes = message.into_bytes();
        let read: Vec<_> = fields(&bytes)
            .map(|field| field.expect("own bytes"))
            .collect();
        assert_eq!(
            read.iter().map(|field| field.number).collect::<Vec<_>>(),
            [1, 2, 16, 1005]
        );
        assert_eq!(read[0].varint(), Ok(u64::MAX));
        assert_eq!(read[1].fixed32(), Ok(7));
        assert_eq!(read[2].double().map(f64::to_bits), Ok((-0.0_f64).to_bits()));
        assert_eq!(read[3].bytes().map(<[u8]>::len), Ok(16));
        assert_eq!(
            read[1].varint(),
            Err(Malformed::WireType {
                field: 2,
                wire_type: FIXED32
            })
        );
    }

    #[test]
    fn truncation_is_detected() {
        let mut message = Message::default();
        message
            .bytes(2, b"testing")
            .double(3, 1.0)
            .varint(4, 1 << 40);
        let bytes = message.into_bytes();
        let field_ends = [9, 18, bytes.len()]; // Ends of the three fields: a cut there leaves a valid shorter message.
        for n_bytes in 1..bytes.len() {
            let is_truncated = fields(&bytes[..n_bytes]).any(|field| field.is_err());
            assert_eq!(
                is_truncated,
                !field_ends.contains(&n_bytes),
                "cut after {n_bytes} bytes"
            );
        }
        assert!(fields(&[0xff; 11]).all(|field| field.is_err()));
        assert!(fields(&[0x0b]).all(|field| field
            == Err(Malformed::WireType {
                field: 1,
                wire_type: 3
            })));
    }
}
