//! Reads the records of an MCAP file sequentially, inside and outside of chunks.
//!
//! Source: the MCAP format specification, <https://mcap.dev/spec>. Memory is allocated for received bytes, not for
//! declared lengths. Only uncompressed chunks are supported, as written by the recorder.

use crc32fast::Hasher;
use std::io::Read;

/// Longer records are treated as damage. The largest valid record contains one image.
const MAX_RECORD_BYTES: u64 = 512 << 20;
/// Maximum allocation before any byte of a record was read.
const MAX_PREALLOCATED_BYTES: u64 = 1 << 20;
/// Header of a record: opcode and length.
const HEAD_BYTES: usize = 1 + 8;
/// Header of a chunk up to the name of its compression: times, length, checksum, length of the name.
const CHUNK_HEAD_BYTES: usize = 8 + 8 + 8 + 4 + 4;

const FOOTER: u8 = 0x02;
const CHUNK: u8 = 0x06;

/// Why reading ends before the end of a file.
#[derive(Debug, thiserror::Error)]
pub(super) enum ReadError {
    #[error("is truncated")]
    Truncated,
    #[error("is damaged (a record of {n_bytes} bytes)")]
    TooLong { n_bytes: u64 },
    #[error("is damaged (the records of a chunk are longer than the chunk)")]
    ExceedsChunk,
    #[error("is damaged (a chunk has the checksum {computed:#010x}, expected {reported:#010x})")]
    Checksum { reported: u32, computed: u32 },
    #[error("cannot be read (its chunks are compressed with {compression:?})")]
    Compressed { compression: String },
    #[error("cannot be read")]
    Read(#[from] std::io::Error),
}

/// A file after its leading magic bytes.
#[derive(Debug)]
pub(super) struct Records<R> {
    input: R,
    chunk: Option<Chunk>,
    ended: bool,
}

/// A chunk that is being read.
#[derive(Debug)]
struct Chunk {
    /// Remaining bytes of its records.
    n_remaining: u64,
    /// Number of bytes after the records.
    n_padding: u64,
    /// Checksum of all its records; 0 if the writer stored none.
    checksum: u32,
    hasher: Hasher,
}

/// Opcode and bytes of one record.
pub(super) struct RawRecord {
    pub(super) opcode: u8,
    pub(super) bytes: Vec<u8>,
}

impl<R: Read> Records<R> {
    pub(super) fn new(input: R) -> Self {
        Self { input, chunk: None, ended: false }
    }

    /// Returns the next record, or `None` at the footer and after an error.
    pub(super) fn next(&mut self) -> Result<Option<RawRecord>, ReadError> {
        let next = if self.ended { Ok(None) } else { self.read() };
        self.ended |= !matches!(next, Ok(Some(_)));
        next
    }

    fn read(&mut self) -> Result<Option<RawRecord>, ReadError> {
        loop {
            if let Some(chunk) = self.chunk.take_if(|chunk| chunk.n_remaining == 0) {
                let computed = chunk.hasher.finalize();
                if chunk.checksum != 0 && chunk.checksum != computed {
                    return Err(ReadError::Checksum { reported: chunk.checksum, computed });
                }
                self.skip(chunk.n_padding)?;
            }
            let [opcode, length @ ..] = self.array::<HEAD_BYTES>()?;
            let n_bytes = u64::from_le_bytes(length);
            if let Some(chunk) = &mut self.chunk {
                let n_total = n_bytes.saturating_add(HEAD_BYTES as u64);
                chunk.n_remaining = chunk.n_remaining.checked_sub(n_total).ok_or(ReadError::ExceedsChunk)?;
                let bytes = bytes_of(&mut self.input, n_bytes)?;
                chunk.hasher.update(&[opcode]);
                chunk.hasher.update(&length);
                chunk.hasher.update(&bytes);
                return Ok(Some(RawRecord { opcode, bytes }));
            }
            match opcode {
                CHUNK => self.chunk = Some(self.begin_chunk(n_bytes)?),
                FOOTER => return Ok(None),
                _ => return Ok(Some(RawRecord { opcode, bytes: bytes_of(&mut self.input, n_bytes)? })),
            }
        }
    }

    fn begin_chunk(&mut self, n_bytes: u64) -> Result<Chunk, ReadError> {
        let head = self.array::<CHUNK_HEAD_BYTES>()?;
        let four = |at: usize| u32::from_le_bytes([head[at], head[at + 1], head[at + 2], head[at + 3]]);
        let (checksum, n_name) = (four(24), u64::from(four(28)));
        let name = bytes_of(&mut self.input, n_name)?;
        let n_remaining = u64::from_le_bytes(self.array()?);
        if !name.is_empty() {
            return Err(ReadError::Compressed {
                compression: String::from_utf8_lossy(&name).chars().take(20).collect(),
            });
        }
        let n_head = CHUNK_HEAD_BYTES as u64 + 8;
        let n_padding =
            n_bytes.checked_sub(n_head).and_then(|n| n.checked_sub(n_remaining)).ok_or(ReadError::ExceedsChunk)?;
        Ok(Chunk { n_remaining, n_padding, checksum, hasher: Hasher::new() })
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], ReadError> {
        let mut bytes = [0; N];
        self.input.read_exact(&mut bytes).map_err(|error| match error.kind() {
            std::io::ErrorKind::UnexpectedEof => ReadError::Truncated,
            _ => error.into(),
        })?;
        Ok(bytes)
    }

    fn skip(&mut self, n_bytes: u64) -> Result<(), ReadError> {
        let n_skipped = std::io::copy(&mut self.input.by_ref().take(n_bytes), &mut std::io::sink())?;
        if n_skipped == n_bytes { Ok(()) } else { Err(ReadError::Truncated) }
    }
}

/// Reads the given number of bytes. Memory grows with the bytes received.
fn bytes_of(input: &mut impl Read, n_bytes: u64) -> Result<Vec<u8>, ReadError> {
    if n_bytes > MAX_RECORD_BYTES {
        return Err(ReadError::TooLong { n_bytes });
    }
    let n_preallocated = usize::try_from(n_bytes.min(MAX_PREALLOCATED_BYTES)).expect("at most one megabyte");
    let mut bytes = Vec::with_capacity(n_preallocated);
    input.take(n_bytes).read_to_end(&mut bytes)?;
    if bytes.len() as u64 == n_bytes { Ok(bytes) } else { Err(ReadError::Truncated) }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn record(opcode: u8, bytes: &[u8]) -> Vec<u8> {
        [&[opcode][..], &(bytes.len() as u64).to_le_bytes(), bytes].concat()
    }

    /// A chunk with the given records, declared length and checksum, followed by three extra bytes.
    fn chunk(records: &[u8], reported_bytes: u64, checksum: u32, compression: &str) -> Vec<u8> {
        let n_name = u32::try_from(compression.len()).expect("short").to_le_bytes();
        let head =
            [&[0; 24][..], &checksum.to_le_bytes(), &n_name, compression.as_bytes(), &reported_bytes.to_le_bytes()];
        record(CHUNK, &[&head.concat()[..], records, &[9; 3]].concat())
    }

    fn read(bytes: &[u8]) -> (Vec<(u8, Vec<u8>)>, Option<String>) {
        let mut records = Records::new(bytes);
        let mut all = Vec::new();
        loop {
            match records.next() {
                Ok(Some(RawRecord { opcode, bytes })) => all.push((opcode, bytes)),
                Ok(None) => return (all, None),
                Err(read_error) => {
                    assert!(matches!(records.next(), Ok(None)), "nothing after an error");
                    return (all, Some(read_error.to_string()));
                }
            }
        }
    }

    #[test]
    fn records_inside_and_outside_chunks_are_in_order() {
        let inner = [record(5, b"five"), record(4, b"")].concat();
        let n_inner = inner.len() as u64;
        let checksum = crc32fast::hash(&inner);
        let footer = record(FOOTER, &[0; 20]);
        let file = [record(1, b"one"), chunk(&inner, n_inner, checksum, ""), record(7, b"seven"), footer].concat();
        let expected: Vec<(u8, Vec<u8>)> =
            [(1, "one"), (5, "five"), (4, ""), (7, "seven")].map(|(opcode, text)| (opcode, text.into())).into();
        assert_eq!(read(&file), (expected.clone(), None));
        for n_bytes in 0..file.len() - 28 {
            let (before, reported) = read(&file[..n_bytes]);
            assert_eq!(
                (&before[..], reported.as_deref()),
                (&expected[..before.len()], Some("is truncated")),
                "{n_bytes}"
            );
        }
    }

    #[test]
    fn inconsistent_lengths_and_checksums_are_errors() {
        let inner = record(5, b"five");
        let n_inner = inner.len() as u64;
        for (bytes, reason) in [
            (chunk(&inner, n_inner - 1, 0, ""), "longer than the chunk"),
            (chunk(&inner, n_inner + 4, 0, ""), "longer than the chunk"),
            (chunk(&inner, u64::MAX, 0, ""), "longer than the chunk"),
            (chunk(&inner, n_inner, 1, ""), "checksum"),
            (chunk(&inner, n_inner, 0, "zstd"), "compressed with \"zstd\""),
            ([&[3][..], &u64::MAX.to_le_bytes()].concat(), "a record of 18446744073709551615 bytes"),
            ([&[3][..], &(400_u64 << 20).to_le_bytes()].concat(), "is truncated"),
        ] {
            let reported = read(&[bytes, record(1, b"one")].concat()).1.expect(reason);
            assert!(reported.contains(reason), "{reported}, expected {reason}");
        }
    }
}
