//! Header and containers of `.spz` files. Versions 2 and 3 are a gzip stream or not compressed. In
//! version 4, each attribute is a Zstandard stream.

use files::Budget;
use flate2::bufread::GzDecoder;
use ruzstd::decoding::FrameDecoder;
use std::borrow::Cow;
use std::io::{ErrorKind, Read};

pub(super) const MAGIC: [u8; 4] = *b"NGSP";
const GZIP: [u8; 2] = [0x1f, 0x8b];
/// Size of the header of versions 2 and 3. Version 4 begins with the same fields.
pub(super) const HEADER_BYTES: usize = 16;
/// Size of the header of version 4.
pub(super) const LONG_HEADER_BYTES: usize = 32;
/// Size of a row of the table of streams, which has the compressed and the uncompressed size.
const ROW_BYTES: usize = 16;
/// Oldest supported version. Version 1, with means as 16-bit floats, was never released.
const MIN_VERSION: u32 = 2;
/// First version with Zstandard streams.
const FIRST_ZSTD_VERSION: u32 = 4;
/// Newest supported version.
const MAX_VERSION: u32 = 4;
/// Header flag of splats that were trained with the opacity correction of Mip-Splatting.
pub(super) const IS_ANTIALIASED: u8 = 1;
/// Header flag of files that have extensions.
pub(super) const HAS_EXTENSIONS: u8 = 2;
/// Maximum degree of the spherical harmonics in a file.
const MAX_SH_DEGREE: u8 = 4;
/// Maximum degree that is used.
pub(super) const MAX_USED_SH_DEGREE: u32 = 3;
/// Maximum size of extensions that are searched for the axes. All known extensions together have
/// less than 100 bytes.
const MAX_EXTENSION_BYTES: u64 = 1 << 20;

/// The uncompressed contents of a file.
pub(super) struct Contents<'a> {
    pub(super) header: Header,
    /// The attributes, one after another, with the sizes of [`Header::attribute_bytes`].
    pub(super) body: Cow<'a, [u8]>,
    /// The records of the extensions.
    pub(super) extensions: Cow<'a, [u8]>,
    /// Size of everything that is neither header, table nor attribute. It is larger than
    /// `extensions` if the extensions are not announced in the header or exceed
    /// [`MAX_EXTENSION_BYTES`].
    pub(super) n_extension_bytes: u64,
}

/// The header of a file.
pub(super) struct Header {
    version: u32,
    pub(super) n_splats: usize,
    pub(super) sh_degree: u32,
    pub(super) fractional_bits: u8,
    flags: u8,
}

impl Header {
    fn parse(bytes: [u8; HEADER_BYTES]) -> Result<Self, String> {
        let word = |at: usize| {
            u32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]])
        };
        if bytes[..4] != MAGIC {
            return Err("the decompressed data does not begin with \"NGSP\"".to_owned());
        }
        let version = word(4);
        let n_splats = word(8);
        let [sh_degree, fractional_bits, flags] = [bytes[12], bytes[13], bytes[14]];
        if !(MIN_VERSION..=MAX_VERSION).contains(&version) {
            return Err(format!(
                "format version {version}, expected {MIN_VERSION} to {MAX_VERSION}"
            ));
        }
        if Budget::SPLATS.check_elements(n_splats.into()).is_err() {
            let max_splats = Budget::SPLATS.max_elements;
            return Err(format!(
                "the header specifies {n_splats} splats, expected at most {max_splats}"
            ));
        }
        if sh_degree > MAX_SH_DEGREE {
            return Err(format!(
                "spherical harmonics of degree {sh_degree}, expected at most {MAX_SH_DEGREE}"
            ));
        }
        // A mean has 23 bits and a sign.
        if fractional_bits > 23 {
            return Err(format!(
                "means have {fractional_bits} fractional bits, expected at most 23"
            ));
        }
        Ok(Self {
            version,
            n_splats: n_splats as usize,
            sh_degree: sh_degree.into(),
            fractional_bits,
            flags,
        })
    }

    pub(super) fn is_antialiased(&self) -> bool {
        self.flags & IS_ANTIALIASED != 0
    }

    /// Whether rotations are stored as x, y and z with one byte each. In that case, w follows from
    /// x, y and z.
    pub(super) fn has_short_rotations(&self) -> bool {
        self.version == 2
    }

    /// Number of color coefficients per splat and channel, without the constant coefficient.
    pub(super) fn n_higher_coefficients(&self) -> usize {
        (self.sh_degree as usize + 1).pow(2) - 1
    }

    /// Bytes per splat of the attributes: means, opacities, constant colors, log scales, rotations,
    /// higher color coefficients.
    pub(super) fn attribute_bytes(&self) -> [usize; 6] {
        let rotation = if self.has_short_rotations() { 3 } else { 4 };
        [9, 1, 3, 3, rotation, 3 * self.n_higher_coefficients()]
    }

    /// What is not used, for warnings.
    pub(super) fn notes(&self, n_unused_extension_bytes: u64) -> Vec<String> {
        let mut notes = Vec::new();
        if n_unused_extension_bytes > 0 {
            notes.push(format!(
                "{n_unused_extension_bytes} bytes of extensions are not used"
            ));
        }
        let unknown = self.flags & !(IS_ANTIALIASED | HAS_EXTENSIONS);
        if unknown != 0 {
            notes.push(format!(
                "the unknown header flags {unknown:#x} are not used"
            ));
        }
        if self.sh_degree > MAX_USED_SH_DEGREE {
            notes.push(format!(
                "its color coefficients above degree {MAX_USED_SH_DEGREE} are not used"
            ));
        }
        notes
    }

    fn has_extensions(&self) -> bool {
        self.flags & HAS_EXTENSIONS != 0
    }

    /// Size of all attributes in bytes. Fails if a file of this size cannot contain them.
    fn n_body_bytes(&self, n_file_bytes: usize) -> Result<usize, String> {
        // A small file can claim billions of splats. Compression has a limit, so such a file is
        // rejected before memory is allocated.
        let n_body_bytes =
            self.n_splats as u64 * self.attribute_bytes().iter().sum::<usize>() as u64;
        let is_possible = Budget::SPLATS
            .check_decoded(n_body_bytes, n_file_bytes as u64)
            .is_ok();
        let n_splats = self.n_splats;
        usize::try_from(n_body_bytes).ok().filter(|_| is_possible).ok_or_else(|| {
            format!("the header specifies {n_splats} splats, which a file of {n_file_bytes} bytes cannot contain")
        })
    }

    fn truncated(&self, n_body_bytes: usize, n_found: usize) -> String {
        format!(
            "truncated: {} splats need {n_body_bytes} bytes, found {n_found}",
            self.n_splats
        )
    }
}

/// Decompresses a file.
pub(super) fn contents(bytes: &[u8]) -> Result<Contents<'_>, String> {
    if bytes.starts_with(&GZIP) {
        return from_gzip(bytes);
    }
    if !bytes.starts_with(&MAGIC) {
        return Err("it begins neither with a gzip stream nor with \"NGSP\"".to_owned());
    }
    let header = Header::parse(*bytes.first_chunk::<HEADER_BYTES>().ok_or("truncated")?)?;
    match header.version {
        FIRST_ZSTD_VERSION.. => from_zstd(header, bytes),
        _ => from_uncompressed(header, bytes),
    }
}

fn from_gzip(bytes: &[u8]) -> Result<Contents<'_>, String> {
    let mut gzip = GzDecoder::new(bytes);
    let mut header = [0; HEADER_BYTES];
    gzip.read_exact(&mut header)
        .map_err(|error| gzip_error(&error))?;
    let header = Header::parse(header)?;
    if header.version >= FIRST_ZSTD_VERSION {
        return Err(format!(
            "a gzip stream of format version {}, which has no gzip stream",
            header.version
        ));
    }
    // Every read is limited, because a stream can decompress to more bytes than the header
    // specifies.
    let n_body_bytes = header.n_body_bytes(bytes.len())?;
    let mut body = Vec::new();
    gzip.by_ref()
        .take(n_body_bytes as u64)
        .read_to_end(&mut body)
        .map_err(|error| gzip_error(&error))?;
    if body.len() < n_body_bytes {
        return Err(header.truncated(n_body_bytes, body.len()));
    }
    let mut extensions = Vec::new();
    gzip.by_ref()
        .take(MAX_EXTENSION_BYTES)
        .read_to_end(&mut extensions)
        .map_err(|error| gzip_error(&error))?;
    // Reading to the end also verifies the checksum of the stream.
    let n_more =
        std::io::copy(&mut gzip, &mut std::io::sink()).map_err(|error| gzip_error(&error))?;
    let n_extension_bytes = extensions.len() as u64 + n_more;
    if n_extension_bytes > 0 && !header.has_extensions() {
        return Err(format!("{n_extension_bytes} bytes follow the last splat"));
    }
    match gzip.into_inner().len() {
        0 => Ok(Contents {
            header,
            body: body.into(),
            extensions: extensions.into(),
            n_extension_bytes,
        }),
        n => Err(format!("{n} bytes follow the gzip stream")),
    }
}

fn gzip_error(error: &std::io::Error) -> String {
    match error.kind() {
        ErrorKind::UnexpectedEof => "truncated".to_owned(),
        _ => format!("damaged ({error})"),
    }
}

fn from_uncompressed(header: Header, bytes: &[u8]) -> Result<Contents<'_>, String> {
    let rest = &bytes[HEADER_BYTES..];
    let n_body_bytes = header.n_body_bytes(bytes.len())?;
    let Some((body, extensions)) = rest.split_at_checked(n_body_bytes) else {
        return Err(header.truncated(n_body_bytes, rest.len()));
    };
    if !extensions.is_empty() && !header.has_extensions() {
        return Err(format!("{} bytes follow the last splat", extensions.len()));
    }
    let n_extension_bytes = extensions.len() as u64;
    Ok(Contents {
        header,
        body: body.into(),
        extensions: extensions.into(),
        n_extension_bytes,
    })
}

fn from_zstd(header: Header, bytes: &[u8]) -> Result<Contents<'_>, String> {
    let long_header = bytes
        .first_chunk::<LONG_HEADER_BYTES>()
        .ok_or("truncated")?;
    let n_streams = usize::from(long_header[15]);
    let table_start = u32::from_le_bytes(std::array::from_fn(|ix| long_header[16 + ix])) as usize;
    // Phase 1 checks that the table and the streams are in the file. An attribute without bytes has
    // no stream.
    let sizes = header
        .attribute_bytes()
        .map(|per_splat| header.n_splats * per_splat);
    let sizes: Vec<usize> = sizes.into_iter().filter(|size| *size > 0).collect();
    if n_streams != sizes.len() {
        return Err(format!("{n_streams} streams, expected {}", sizes.len()));
    }
    let extensions = bytes.get(LONG_HEADER_BYTES..table_start).ok_or_else(|| {
        let n_bytes = bytes.len();
        format!("the table of streams begins at byte {table_start}, expected {LONG_HEADER_BYTES} to {n_bytes}")
    })?;
    let n_extension_bytes = extensions.len() as u64;
    let (table, mut streams) = bytes[table_start..]
        .split_at_checked(ROW_BYTES * n_streams)
        .ok_or("truncated")?;
    // Phase 2 decompresses each stream into its own part of the body, so that a stream with a wrong
    // size cannot shift the attributes after it.
    let mut body = vec![0_u8; header.n_body_bytes(bytes.len())?];
    let mut undecoded = body.as_mut_slice();
    for (stream_ix, (row, size)) in table
        .as_chunks::<ROW_BYTES>()
        .0
        .iter()
        .zip(sizes)
        .enumerate()
    {
        let [n_compressed, n_uncompressed] = [0, 8].map(|at| u64_at(row, at));
        if n_uncompressed != size as u64 {
            return Err(format!(
                "stream {stream_ix} has {n_uncompressed} uncompressed bytes, expected {size}"
            ));
        }
        let n_compressed = usize::try_from(n_compressed).unwrap_or(usize::MAX);
        let (stream, others) = streams.split_at_checked(n_compressed).ok_or("truncated")?;
        let (attribute, after) = undecoded.split_at_mut(size);
        decompress(stream, attribute)
            .map_err(|reason| format!("stream {stream_ix} is damaged ({reason})"))?;
        streams = others;
        undecoded = after;
    }
    if !streams.is_empty() {
        return Err(format!("{} bytes follow the last stream", streams.len()));
    }
    // Bytes that the header does not announce are not records.
    let extensions: &[u8] = if header.has_extensions() {
        extensions
    } else {
        &[]
    };
    Ok(Contents {
        header,
        body: body.into(),
        extensions: extensions.into(),
        n_extension_bytes,
    })
}

fn u64_at(row: &[u8; ROW_BYTES], start: usize) -> u64 {
    u64::from_le_bytes(std::array::from_fn(|ix| row[start + ix]))
}

/// Decompresses Zstandard frames that contain exactly the bytes of an attribute.
fn decompress(frames: &[u8], attribute: &mut [u8]) -> Result<(), String> {
    let n_decoded = FrameDecoder::new()
        .decode_all(frames, attribute)
        .map_err(|error| error.to_string())?;
    if n_decoded == attribute.len() {
        Ok(())
    } else {
        Err(format!(
            "it contains {n_decoded} bytes, expected {}",
            attribute.len()
        ))
    }
}

#[cfg(test)]
mod tests {
    use super::decompress;
    use ruzstd::encoding::{CompressionLevel, compress_to_vec};

    #[test]
    fn frames_contain_exactly_the_attribute() {
        let compressed = |bytes: &[u8]| compress_to_vec(bytes, CompressionLevel::Fastest);
        let decompressed = |frames: &[u8], n_bytes: usize| {
            let mut attribute = vec![0; n_bytes];
            decompress(frames, &mut attribute).map(|()| attribute)
        };
        let [whole, first, second] = [&b"attribute"[..], b"attri", b"bute"].map(compressed);
        assert_eq!(decompressed(&whole, 9).unwrap(), b"attribute");
        assert_eq!(
            decompressed(&[&first[..], &second].concat(), 9).unwrap(),
            b"attribute",
            "two frames"
        );
        assert_eq!(
            decompressed(&whole, 10).unwrap_err(),
            "it contains 9 bytes, expected 10"
        );
        assert!(
            decompressed(&whole, 8).is_err(),
            "longer than the attribute"
        );
        assert_eq!(
            decompressed(&[], 9).unwrap_err(),
            "it contains 0 bytes, expected 9"
        );
        assert!(
            decompressed(&whole[..whole.len() - 1], 9).is_err(),
            "truncated"
        );
    }
}
