//! Reads the records of an MCAP file sequentially, inside and outside of chunks.
//!
//! Source: the MCAP format specification, <https://mcap.dev/spec>. Memory is allocated for received
//! bytes, not for declared lengths. The recorder writes uncompressed chunks, whose records are
//! available as soon as they are complete. A compressed chunk from another program is decompressed
//! as a whole.

use crc32fast::Hasher;
use files::Budget;
use lz4_flex::frame::FrameDecoder;
use ruzstd::decoding::StreamingDecoder;
use std::io::{Cursor, Read, Seek, SeekFrom};

/// Maximum allocation before any byte of a record was read. Most records are smaller and need one
/// allocation. The limit bounds the allocation that a damaged length causes.
const MAX_PREALLOCATED_BYTES: u64 = 1 << 20;
/// Length of a record's header: opcode and length.
const HEAD_BYTES: usize = 1 + 8;
/// Length of a chunk's header up to the name of the compression. This part contains the times, the
/// uncompressed length, the checksum, and the length of the name.
const CHUNK_HEAD_BYTES: usize = 8 + 8 + 8 + 4 + 4;

const FOOTER: u8 = 0x02;
pub(super) const ATTACHMENT: u8 = 0x09;
const CHUNK: u8 = 0x06;

/// The reason why reading ends before the end of a file.
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
    #[error("is damaged (a chunk cannot be decompressed: {reason})")]
    Decompress { reason: String },
    #[error("is damaged (a chunk decompresses to {n_bytes} bytes, expected {declared_bytes})")]
    DecompressedLength { n_bytes: u64, declared_bytes: u64 },
    #[error(
        "cannot be read (its chunks are compressed with {compression:?}, supported are zstd and lz4)"
    )]
    Compression { compression: String },
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
    /// Decompressed records of the chunk. `None` if the records are uncompressed and follow in the
    /// file.
    decompressed: Option<Cursor<Vec<u8>>>,
    /// Remaining bytes of its records.
    n_remaining: u64,
    /// Number of bytes after the records.
    n_padding: u64,
    /// Checksum of all records of the chunk. It is 0 if the writer stored no checksum.
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
        Self {
            input,
            chunk: None,
            ended: false,
        }
    }

    /// Returns the next record, or `None` at the footer and after an error.
    pub(super) fn next(&mut self) -> Result<Option<RawRecord>, ReadError> {
        let next = if self.ended { Ok(None) } else { self.read() };
        // After an error, the position in the file is no longer meaningful, so reading ends.
        self.ended |= !matches!(next, Ok(Some(_)));
        next
    }

    fn read(&mut self) -> Result<Option<RawRecord>, ReadError> {
        loop {
            // The checksum is checked after the last record of the chunk has been returned. A wrong
            // checksum ends the recording, but the records that were already returned remain
            // usable.
            if let Some(chunk) = self.chunk.take_if(|chunk| chunk.n_remaining == 0) {
                let computed = chunk.hasher.finalize();
                if chunk.checksum != 0 && chunk.checksum != computed {
                    return Err(ReadError::Checksum {
                        reported: chunk.checksum,
                        computed,
                    });
                }
                self.skip(chunk.n_padding)?;
            }
            let Some(Chunk {
                decompressed,
                n_remaining,
                hasher,
                ..
            }) = &mut self.chunk
            else {
                let (opcode, n_bytes, _) = head_of(&mut self.input)?;
                match opcode {
                    CHUNK => self.chunk = Some(self.begin_chunk(n_bytes)?),
                    FOOTER => return Ok(None),
                    _ => {
                        return Ok(Some(RawRecord {
                            opcode,
                            bytes: bytes_of(&mut self.input, n_bytes)?,
                        }));
                    }
                }
                continue;
            };
            // Records of an uncompressed chunk are read straight from the file. A chunk that was
            // cut off by a crash thus yields all its complete records.
            let input: &mut dyn Read = match decompressed {
                Some(records) => records,
                None => &mut self.input,
            };
            // The length is compared before reading, because a record must not contain bytes from
            // after the chunk.
            if *n_remaining < HEAD_BYTES as u64 {
                return Err(ReadError::ExceedsChunk);
            }
            let (opcode, n_bytes, head) = head_of(&mut *input)?;
            let n_total = n_bytes.saturating_add(HEAD_BYTES as u64);
            *n_remaining = n_remaining
                .checked_sub(n_total)
                .ok_or(ReadError::ExceedsChunk)?;
            let bytes = bytes_of(input, n_bytes)?;
            hasher.update(&head);
            hasher.update(&bytes);
            return Ok(Some(RawRecord { opcode, bytes }));
        }
    }

    fn begin_chunk(&mut self, n_bytes: u64) -> Result<Chunk, ReadError> {
        let head: [u8; CHUNK_HEAD_BYTES] = array(&mut self.input)?;
        let four =
            |at: usize| u32::from_le_bytes([head[at], head[at + 1], head[at + 2], head[at + 3]]);
        let n_uncompressed = u64::from(four(16)) | u64::from(four(20)) << 32;
        let checksum = four(24);
        let n_name = u64::from(four(28));
        let compression = bytes_of(&mut self.input, n_name)?;
        let n_stored = u64::from_le_bytes(array(&mut self.input)?);
        let n_head = CHUNK_HEAD_BYTES as u64 + n_name + 8;
        // Newer writers may add fields after the records.
        let n_padding = n_bytes
            .checked_sub(n_head)
            .and_then(|n| n.checked_sub(n_stored))
            .ok_or(ReadError::ExceedsChunk)?;
        let (decompressed, n_remaining) = if compression.is_empty() {
            (None, n_stored)
        } else {
            let decompress = decompressor(&compression)?;
            let stored = bytes_of(&mut self.input, n_stored)?;
            (
                Some(Cursor::new(decompress_all(
                    decompress,
                    &stored,
                    n_uncompressed,
                )?)),
                n_uncompressed,
            )
        };
        Ok(Chunk {
            decompressed,
            n_remaining,
            n_padding,
            checksum,
            hasher: Hasher::new(),
        })
    }

    fn skip(&mut self, n_bytes: u64) -> Result<(), ReadError> {
        let n_skipped =
            std::io::copy(&mut self.input.by_ref().take(n_bytes), &mut std::io::sink())?;
        if n_skipped == n_bytes {
            Ok(())
        } else {
            Err(ReadError::Truncated)
        }
    }
}

/// Reads the attachments of a file after its leading magic bytes, and skips everything else. Damage
/// ends the search.
pub(super) fn attachments(mut input: impl Read + Seek) -> Vec<RawRecord> {
    let mut attachments = Vec::new();
    while let Ok((opcode, n_bytes, _)) = head_of(&mut input) {
        match opcode {
            FOOTER => break,
            ATTACHMENT => match bytes_of(&mut input, n_bytes) {
                Ok(bytes) => attachments.push(RawRecord { opcode, bytes }),
                Err(_) => break,
            },
            _ => match i64::try_from(n_bytes).map(|n_bytes| input.seek(SeekFrom::Current(n_bytes)))
            {
                Ok(Ok(_)) => {}
                _ => break,
            },
        }
    }
    attachments
}

/// Reads opcode and length of a record. Returns them with their bytes.
fn head_of(input: impl Read) -> Result<(u8, u64, [u8; HEAD_BYTES]), ReadError> {
    let head @ [opcode, length @ ..] = array::<HEAD_BYTES>(input)?;
    Ok((opcode, u64::from_le_bytes(length), head))
}

fn array<const N: usize>(mut input: impl Read) -> Result<[u8; N], ReadError> {
    let mut bytes = [0; N];
    input
        .read_exact(&mut bytes)
        .map_err(|error| match error.kind() {
            std::io::ErrorKind::UnexpectedEof => ReadError::Truncated,
            _ => error.into(),
        })?;
    Ok(bytes)
}

/// Reads the given number of bytes. A number above [`Budget::RECORD`] counts as damage. Memory
/// grows with the bytes received.
fn bytes_of(input: &mut (impl Read + ?Sized), n_bytes: u64) -> Result<Vec<u8>, ReadError> {
    if Budget::RECORD.check_bytes(n_bytes).is_err() {
        return Err(ReadError::TooLong { n_bytes });
    }
    // `n_bytes` is the length that the file declares. Memory is allocated only for bytes that are
    // actually read.
    let n_preallocated =
        usize::try_from(n_bytes.min(MAX_PREALLOCATED_BYTES)).expect("at most one megabyte");
    let mut bytes = Vec::with_capacity(n_preallocated);
    input.take(n_bytes).read_to_end(&mut bytes)?;
    if bytes.len() as u64 == n_bytes {
        Ok(bytes)
    } else {
        Err(ReadError::Truncated)
    }
}

/// A function that appends at most the given number of decompressed bytes of one frame, and
/// advances the input past the bytes read.
type Decompress = fn(&mut &[u8], u64, &mut Vec<u8>) -> std::io::Result<()>;

/// Returns the decompressor for the name of a compression in the file.
fn decompressor(compression: &[u8]) -> Result<Decompress, ReadError> {
    match compression {
        b"zstd" => Ok(decompress_zstd),
        b"lz4" => Ok(decompress_lz4),
        other => Err(ReadError::Compression {
            compression: String::from_utf8_lossy(other).chars().take(20).collect(),
        }),
    }
}

fn decompress_zstd(frames: &mut &[u8], n_bytes: u64, records: &mut Vec<u8>) -> std::io::Result<()> {
    let frame = StreamingDecoder::new(frames).map_err(std::io::Error::other)?;
    frame.take(n_bytes).read_to_end(records).map(drop)
}

fn decompress_lz4(frames: &mut &[u8], n_bytes: u64, records: &mut Vec<u8>) -> std::io::Result<()> {
    FrameDecoder::new(frames)
        .take(n_bytes)
        .read_to_end(records)
        .map(drop)
}

/// Decompresses the frames of a chunk to the declared number of bytes.
fn decompress_all(
    decompress: Decompress,
    mut frames: &[u8],
    declared_bytes: u64,
) -> Result<Vec<u8>, ReadError> {
    if Budget::RECORD.check_bytes(declared_bytes).is_err() {
        return Err(ReadError::TooLong {
            n_bytes: declared_bytes,
        });
    }
    let mut records = Vec::new();
    // A chunk may consist of several frames, as parallel compressors write them.
    while (records.len() as u64) < declared_bytes && !frames.is_empty() {
        decompress(
            &mut frames,
            declared_bytes - records.len() as u64,
            &mut records,
        )
        .map_err(|error| ReadError::Decompress {
            reason: error.to_string(),
        })?;
    }
    let n_bytes = records.len() as u64;
    if n_bytes == declared_bytes {
        Ok(records)
    } else {
        Err(ReadError::DecompressedLength {
            n_bytes,
            declared_bytes,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Write;

    fn record(opcode: u8, bytes: &[u8]) -> Vec<u8> {
        [&[opcode][..], &(bytes.len() as u64).to_le_bytes(), bytes].concat()
    }

    /// A chunk with the given bytes of records, declared lengths and checksum, followed by three
    /// extra bytes.
    fn chunk(
        records: &[u8],
        [n_stored, n_uncompressed]: [usize; 2],
        checksum: u32,
        compression: &str,
    ) -> Vec<u8> {
        let n_name = u32::try_from(compression.len())
            .expect("short")
            .to_le_bytes();
        let length = |n_bytes: usize| (n_bytes as u64).to_le_bytes();
        let head = [
            &[0; 16][..],
            &length(n_uncompressed),
            &checksum.to_le_bytes(),
            &n_name,
            compression.as_bytes(),
            &length(n_stored),
        ];
        record(CHUNK, &[&head.concat()[..], records, &[9; 3]].concat())
    }

    fn zstd(bytes: &[u8]) -> Vec<u8> {
        ruzstd::encoding::compress_to_vec(bytes, ruzstd::encoding::CompressionLevel::Fastest)
    }

    fn lz4(bytes: &[u8]) -> Vec<u8> {
        let mut encoder = lz4_flex::frame::FrameEncoder::new(Vec::new());
        encoder.write_all(bytes).expect("memory");
        encoder.finish().expect("memory")
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
        let checksum = crc32fast::hash(&inner);
        let footer = record(FOOTER, &[0; 20]);
        let expected: Vec<(u8, Vec<u8>)> = [(1, "one"), (5, "five"), (4, ""), (7, "seven")]
            .map(|(opcode, text)| (opcode, text.into()))
            .into();
        let two_frames = |compress: fn(&[u8]) -> Vec<u8>| {
            [compress(&inner[..9]), compress(&inner[9..])].concat()
        };
        for (stored, compression) in [
            (inner.clone(), ""),
            (zstd(&inner), "zstd"),
            (lz4(&inner), "lz4"),
            (two_frames(zstd), "zstd"),
            (two_frames(lz4), "lz4"),
        ] {
            let chunk = chunk(&stored, [stored.len(), inner.len()], checksum, compression);
            let file = [
                record(1, b"one"),
                chunk,
                record(7, b"seven"),
                footer.clone(),
            ]
            .concat();
            assert_eq!(read(&file), (expected.clone(), None), "{compression}");
            for n_bytes in 0..file.len() - 28 {
                let (before, reported) = read(&file[..n_bytes]);
                assert_eq!(
                    (&before[..], reported.as_deref()),
                    (&expected[..before.len()], Some("is truncated")),
                    "{compression}: {n_bytes}"
                );
            }
        }
    }

    #[test]
    fn inconsistent_lengths_and_checksums_are_errors() {
        let inner = record(5, b"five");
        let n = inner.len();
        let [zstd, lz4] = [zstd(&inner), lz4(&inner)];
        let [n_zstd, n_lz4] = [zstd.len(), lz4.len()];
        for (bytes, reason) in [
            (
                chunk(&inner, [n - 1, n - 1], 0, ""),
                "longer than the chunk",
            ),
            (
                chunk(&inner, [n + 1, n + 1], 0, ""),
                "longer than the chunk",
            ),
            (
                chunk(&inner, [n + 4, n + 4], 0, ""),
                "longer than the chunk",
            ),
            (
                chunk(&inner, [usize::MAX, n], 0, ""),
                "longer than the chunk",
            ),
            (chunk(&inner, [n, n], 1, ""), "checksum"),
            (
                chunk(&inner, [n, n], 0, "brotli"),
                "compressed with \"brotli\", supported are zstd and lz4",
            ),
            (chunk(&zstd, [n_zstd, n], 1, "zstd"), "checksum"),
            (chunk(&lz4, [n_lz4, n], 1, "lz4"), "checksum"),
            (
                chunk(&zstd, [n_zstd, n - 1], 0, "zstd"),
                "longer than the chunk",
            ),
            (
                chunk(&lz4, [n_lz4, n - 1], 0, "lz4"),
                "longer than the chunk",
            ),
            (
                chunk(&zstd, [n_zstd, n + 1], 0, "zstd"),
                "decompresses to 13 bytes, expected 14",
            ),
            (
                chunk(&lz4, [n_lz4, n + 1], 0, "lz4"),
                "decompresses to 13 bytes, expected 14",
            ),
            (
                chunk(&zstd[..n_zstd - 1], [n_zstd - 1, n], 0, "zstd"),
                "cannot be decompressed",
            ),
            (chunk(&inner, [n, n], 0, "zstd"), "cannot be decompressed"),
            (chunk(&inner, [n, n], 0, "lz4"), "cannot be decompressed"),
            (
                chunk(&zstd, [n_zstd, usize::MAX], 0, "zstd"),
                "a record of 18446744073709551615 bytes",
            ),
            (
                [&[3][..], &u64::MAX.to_le_bytes()].concat(),
                "a record of 18446744073709551615 bytes",
            ),
            (
                [&[3][..], &(400_u64 << 20).to_le_bytes()].concat(),
                "is truncated",
            ),
        ] {
            let reported = read(&[bytes, record(1, b"one")].concat()).1.expect(reason);
            assert!(reported.contains(reason), "{reported}, expected {reason}");
        }
    }
}
