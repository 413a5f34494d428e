//! Splats in `.spz` files (Niantic): reads versions 2 and 3, writes version 3.
//!
//! The file is a gzip stream. It contains a header and the means, opacities, constant colors, scales, rotations and
//! higher color coefficients of all splats. Each value is quantized to a few bits (`quantize.rs`).
//!
//! The axes of `.spz` are right, up, back. Other programs interpret the axes of a `.ply`, which are also our axes, as
//! right, down, front. Like those programs, we flip the signs of y and z, so that viewers show both files alike.
//!
//! Source: "SPZ file format", Niantic, versions 2 and 3, <https://github.com/nianticlabs/spz>.

mod quantize;

use crate::Error;
use crate::splat::arrays::SplatArrays;
use flate2::Compression;
use flate2::bufread::GzDecoder;
use flate2::write::GzEncoder;
use std::io::{ErrorKind, Read, Write};
use std::path::Path;

const MAGIC: [u8; 4] = *b"NGSP";
const GZIP: [u8; 2] = [0x1f, 0x8b];
const HEADER_BYTES: usize = 16;
/// Oldest supported version. Version 1 stored means as 16-bit floats.
const MIN_VERSION: u32 = 2;
/// Newest supported version, and the version that is written. Later versions are not gzip streams.
const MAX_VERSION: u32 = 3;
/// Header flag: the splats were trained with the opacity correction of Mip-Splatting.
const IS_ANTIALIASED: u8 = 1;
/// Header flag: extensions follow the splats.
const HAS_EXTENSIONS: u8 = 2;
/// Maximum number of splats. A larger number in a header indicates damage.
const MAX_SPLATS: u32 = 100_000_000;
/// Maximum ratio of uncompressed to compressed size. Files of splats have 2 to 4.
const MAX_COMPRESSION: u64 = 50;
/// Uncompressed size that is accepted at any ratio.
const ALWAYS_ACCEPTED_BYTES: u64 = 64 << 20;
/// Maximum number of fractional bits of a mean, for steps of 15 micrometers.
const MAX_FRACTIONAL_BITS: u8 = 16;
/// Factors of the higher color coefficients when y and z change their signs: -1 for basis functions that change sign.
const SH_SIGNS: [f32; 15] = [-1.0, -1.0, 1.0, -1.0, 1.0, 1.0, -1.0, 1.0, -1.0, 1.0, -1.0, -1.0, 1.0, -1.0, 1.0];

/// Reads a `.spz` file of splats.
pub fn read(path: &Path) -> Result<SplatArrays, Error> {
    let bytes = files::read(path, files::NO_LIMIT).map_err(|source| Error::Read { path: path.to_owned(), source })?;
    let (splats, notes) = from_bytes(&bytes).map_err(|reason| Error::SplatFile { path: path.to_owned(), reason })?;
    for note in notes {
        log::warn!("{}: {note}", path.display());
    }
    splats.without_invalid(path)
}

/// Writes a `.spz` file of splats. A failed write leaves no partial file at `path`.
///
/// Values outside the range of the format are clamped, except for means: coordinates beyond 8388 km are an error.
pub fn write(path: &Path, splats: &SplatArrays) -> Result<(), Error> {
    let uncompressed = uncompressed_bytes(&splats.clone().checked()?)?;
    let written = files::replace(path, |file| {
        let mut gzip = GzEncoder::new(file, Compression::default());
        gzip.write_all(&uncompressed)?;
        gzip.finish().map(drop)
    });
    written.map_err(|source| Error::Write { path: path.to_owned(), source })
}

/// The header of a file.
struct Header {
    version: u32,
    n_splats: usize,
    sh_degree: u32,
    fractional_bits: u8,
    flags: u8,
}

impl Header {
    fn parse(bytes: [u8; HEADER_BYTES]) -> Result<Self, String> {
        let word = |at: usize| u32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]]);
        if bytes[..4] != MAGIC {
            return Err("the decompressed data does not begin with \"NGSP\"".to_owned());
        }
        let (version, n_splats, [sh_degree, fractional_bits, flags, _]) =
            (word(4), word(8), [bytes[12], bytes[13], bytes[14], bytes[15]]);
        check_version(version)?;
        if n_splats > MAX_SPLATS {
            return Err(format!("the header specifies {n_splats} splats, expected at most {MAX_SPLATS}"));
        }
        if sh_degree > 3 {
            return Err(format!("spherical harmonics of degree {sh_degree}, expected at most 3"));
        }
        if fractional_bits > 23 {
            return Err(format!("means have {fractional_bits} fractional bits, expected at most 23"));
        }
        Ok(Self { version, n_splats: n_splats as usize, sh_degree: sh_degree.into(), fractional_bits, flags })
    }

    fn notes(&self, n_extension_bytes: u64) -> Vec<String> {
        let mut notes = Vec::new();
        if n_extension_bytes > 0 {
            notes.push(format!("{n_extension_bytes} bytes of extensions are not used"));
        }
        let unknown = self.flags & !(IS_ANTIALIASED | HAS_EXTENSIONS);
        if unknown != 0 {
            notes.push(format!("the unknown header flags {unknown:#x} are not used"));
        }
        notes
    }

    fn n_higher_coefficients(&self) -> usize {
        (self.sh_degree as usize + 1).pow(2) - 1
    }

    fn rotation_bytes(&self) -> usize {
        if self.version == 2 { 3 } else { 4 }
    }

    /// Size of all splats in bytes.
    fn n_body_bytes(&self) -> u64 {
        self.n_splats as u64 * (16 + self.rotation_bytes() + 3 * self.n_higher_coefficients()) as u64
    }
}

fn check_version(version: u32) -> Result<(), String> {
    match version {
        MIN_VERSION..=MAX_VERSION => Ok(()),
        _ => Err(format!("format version {version}, expected {MIN_VERSION} or {MAX_VERSION}")),
    }
}

/// The splats, and notes about what is not used.
fn from_bytes(bytes: &[u8]) -> Result<(SplatArrays, Vec<String>), String> {
    if let [b'N', b'G', b'S', b'P', version @ ..] = bytes
        && let Some(version) = version.first_chunk()
    {
        check_version(u32::from_le_bytes(*version))?;
    }
    if !bytes.starts_with(&GZIP) {
        return Err("not a gzip stream".to_owned());
    }
    let mut gzip = GzDecoder::new(bytes);
    let mut header = [0; HEADER_BYTES];
    gzip.read_exact(&mut header).map_err(|error| read_error(&error))?;
    let header = Header::parse(header)?;
    let max_body_bytes = ALWAYS_ACCEPTED_BYTES.max(MAX_COMPRESSION * bytes.len() as u64);
    if header.n_body_bytes() > max_body_bytes {
        return Err(format!(
            "the header specifies {} splats, which a file of {} bytes cannot contain",
            header.n_splats,
            bytes.len()
        ));
    }
    let mut body = Vec::new();
    gzip.by_ref().take(header.n_body_bytes()).read_to_end(&mut body).map_err(|error| read_error(&error))?;
    if (body.len() as u64) < header.n_body_bytes() {
        let (n_splats, n_bytes) = (header.n_splats, header.n_body_bytes());
        return Err(format!("truncated: {n_splats} splats need {n_bytes} bytes, found {}", body.len()));
    }
    // Reading to the end also verifies the checksum of the stream.
    let n_more = std::io::copy(&mut gzip, &mut std::io::sink()).map_err(|error| read_error(&error))?;
    if n_more > 0 && header.flags & HAS_EXTENSIONS == 0 {
        return Err(format!("{n_more} bytes follow the last splat"));
    }
    match gzip.into_inner().len() {
        0 => Ok((splats(&header, &body), header.notes(n_more))),
        n => Err(format!("{n} bytes follow the gzip stream")),
    }
}

fn read_error(error: &std::io::Error) -> String {
    match error.kind() {
        ErrorKind::UnexpectedEof => "truncated".to_owned(),
        _ => format!("damaged ({error})"),
    }
}

/// Decodes the splats of a body whose length matches the header.
fn splats(header: &Header, body: &[u8]) -> SplatArrays {
    let n_splats = header.n_splats;
    let mut rest = body;
    let mut next = |bytes_per_splat: usize| {
        let (array, after) = rest.split_at(n_splats * bytes_per_splat);
        rest = after;
        array
    };
    let n_higher = header.n_higher_coefficients();
    let [means, alphas, colors] = [9, 1, 3].map(&mut next);
    let [scales, rotations, higher] = [3, header.rotation_bytes(), 3 * n_higher].map(&mut next);
    let mut sh = Vec::with_capacity(n_splats * (n_higher + 1));
    for (splat_ix, color) in colors.as_chunks::<3>().0.iter().enumerate() {
        sh.push(color.map(quantize::color_from_byte));
        let coefficients = higher[3 * n_higher * splat_ix..][..3 * n_higher].as_chunks::<3>().0;
        let signed = coefficients.iter().zip(SH_SIGNS);
        sh.extend(signed.map(|(rgb, sign)| rgb.map(|byte| sign * quantize::sh_from_byte(byte))));
    }
    let mean = |bytes: &[u8; 9]| {
        let [x, y, z] = [0, 3, 6].map(|at| [bytes[at], bytes[at + 1], bytes[at + 2]]);
        flipped([x, y, z].map(|fixed| quantize::mean_from_fixed(fixed, header.fractional_bits)))
    };
    let rotation = |xyzw: [f32; 4]| {
        let [x, y, z] = flipped([xyzw[0], xyzw[1], xyzw[2]]);
        [xyzw[3], x, y, z]
    };
    let rotations_wxyz = if header.version == 2 {
        rotations.as_chunks().0.iter().map(|bytes| rotation(quantize::rotation_from_three(*bytes))).collect()
    } else {
        rotations.as_chunks().0.iter().map(|bytes| rotation(quantize::rotation_from_smallest(*bytes))).collect()
    };
    SplatArrays {
        means: means.as_chunks().0.iter().map(mean).collect(),
        log_scales: scales.as_chunks::<3>().0.iter().map(|bytes| bytes.map(quantize::log_scale_from_byte)).collect(),
        rotations_wxyz,
        opacity_logits: alphas.iter().map(|byte| quantize::opacity_logit_from_byte(*byte)).collect(),
        sh,
        sh_degree: header.sh_degree,
        is_antialiased: header.flags & IS_ANTIALIASED != 0,
    }
}

/// Rotates by 180 degrees about x, which converts between our axes and those of the format.
fn flipped([x, y, z]: [f32; 3]) -> [f32; 3] {
    [x, -y, -z]
}

/// Encodes the header and the splats without compression.
fn uncompressed_bytes(splats: &SplatArrays) -> Result<Vec<u8>, Error> {
    let n_splats = u32::try_from(splats.n_splats()).ok().filter(|n| *n <= MAX_SPLATS).ok_or_else(|| {
        Error::SplatArrays(format!("found {} splats, .spz holds at most {MAX_SPLATS}", splats.n_splats()))
    })?;
    let fractional_bits = fractional_bits(&splats.means)?;
    let mut bytes = MAGIC.to_vec();
    bytes.extend([MAX_VERSION, n_splats].map(u32::to_le_bytes).as_flattened());
    bytes.extend([u8::try_from(splats.sh_degree).expect("checked to be at most 3"), fractional_bits]);
    bytes.extend([if splats.is_antialiased { IS_ANTIALIASED } else { 0 }, 0]);
    for mean in &splats.means {
        bytes.extend(flipped(*mean).map(|meters| quantize::fixed_from_mean(meters, fractional_bits)).as_flattened());
    }
    bytes.extend(splats.opacity_logits.iter().map(|logit| quantize::byte_from_opacity_logit(*logit)));
    let n_coefficients = splats.n_coefficients();
    for coefficients in splats.sh.chunks_exact(n_coefficients) {
        bytes.extend(coefficients[0].map(quantize::byte_from_color));
    }
    for log_scale in &splats.log_scales {
        bytes.extend(log_scale.map(quantize::byte_from_log_scale));
    }
    for [w, x, y, z] in &splats.rotations_wxyz {
        let [x, y, z] = flipped([*x, *y, *z]);
        bytes.extend(quantize::smallest_from_rotation([x, y, z, *w]));
    }
    for coefficients in splats.sh.chunks_exact(n_coefficients) {
        for (rgb, sign) in coefficients[1..].iter().zip(SH_SIGNS) {
            bytes.extend(rgb.map(|value| quantize::byte_from_sh(sign * value)));
        }
    }
    Ok(bytes)
}

/// Largest number of fractional bits at which all means are in range.
fn fractional_bits(means: &[[f32; 3]]) -> Result<u8, Error> {
    let max_coordinate_m = means.as_flattened().iter().map(|meters| f64::from(meters.abs())).fold(0.0, f64::max);
    let fits = |bits: &u8| max_coordinate_m * f64::from(1_u32 << bits) <= f64::from(quantize::MAX_FIXED);
    (0..=MAX_FRACTIONAL_BITS).rev().find(fits).ok_or_else(|| {
        Error::SplatArrays(format!(
            "a mean has a coordinate of {max_coordinate_m:.0} m, .spz holds at most {} m",
            quantize::MAX_FIXED
        ))
    })
}

#[cfg(test)]
mod tests;
