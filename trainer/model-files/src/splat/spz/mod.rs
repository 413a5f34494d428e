//! Splats in `.spz` files (Niantic). This module reads versions 2 to 4. It writes version 3, which
//! more programs read than version 4.
//!
//! The file contains a header and the means, opacities, constant colors, scales, rotations and
//! higher color coefficients of all splats. It is compressed (`container.rs`). Each value is
//! quantized to a few bits (`quantize.rs`).
//!
//! The axes of `.spz` are right, up, back, unless an extension names other axes (`axes.rs`). Other
//! programs interpret the axes of a `.ply`, which are also fieldrig's axes, as right, down, front.
//! Like those programs, this module flips the signs of y and z. Viewers then show both kinds of
//! files in the same way.
//!
//! Source: "SPZ file format", Niantic, versions 2 to 4, <https://github.com/nianticlabs/spz>.

mod axes;
mod container;
mod quantize;

use crate::Error;
use crate::splat::arrays::SplatArrays;
use axes::Axes;
use container::{Header, IS_ANTIALIASED, MAGIC, MAX_USED_SH_DEGREE};
use flate2::Compression;
use flate2::write::GzEncoder;
use std::io::Write;
use std::path::Path;

/// The version that is written.
const WRITTEN_VERSION: u32 = 3;
/// Maximum number of fractional bits of a mean, for steps of 15 micrometers. Finer steps would be
/// below the accuracy of any scan, and their random bits would compress badly.
const MAX_FRACTIONAL_BITS: u8 = 16;

/// Reads a `.spz` file of splats.
pub fn read(path: &Path) -> Result<SplatArrays, Error> {
    super::read_with(path, from_bytes)
}

/// Writes a `.spz` file of splats. A failed write leaves no partial file at `path`.
///
/// Values outside the range of the format are clamped, except for means. Coordinates beyond 8388 km
/// are an error.
pub fn write(path: &Path, splats: &SplatArrays) -> Result<(), Error> {
    let uncompressed = uncompressed_bytes(&splats.clone().checked()?)?;
    let written = files::replace(path, |file| {
        let mut gzip = GzEncoder::new(file, Compression::default());
        gzip.write_all(&uncompressed)?;
        gzip.finish().map(drop)
    });
    written.map_err(|source| Error::Write {
        path: path.to_owned(),
        source,
    })
}

/// The splats, and notes about what is not used.
fn from_bytes(bytes: &[u8]) -> Result<(SplatArrays, Vec<String>), String> {
    let contents = container::contents(bytes)?;
    let (axes, n_used_bytes) = axes::from_extensions(&contents.extensions)?;
    let notes = contents
        .header
        .notes(contents.n_extension_bytes - n_used_bytes);
    Ok((splats(&contents.header, axes, &contents.body), notes))
}

/// Decodes the splats of a body whose length matches the header.
fn splats(header: &Header, axes: Axes, body: &[u8]) -> SplatArrays {
    // Attributes are stored one after another, each for all splats.
    let n_splats = header.n_splats;
    let mut rest = body;
    let [means, alphas, colors, scales, rotations, higher] =
        header.attribute_bytes().map(|bytes_per_splat| {
            let (array, after) = rest.split_at(n_splats * bytes_per_splat);
            rest = after;
            array
        });
    let n_higher = header.n_higher_coefficients();
    let sh_signs = axes.sh_signs();
    let mut sh = Vec::with_capacity(n_splats * (n_higher.min(sh_signs.len()) + 1));
    for (splat_ix, color) in colors.as_chunks::<3>().0.iter().enumerate() {
        sh.push(color.map(quantize::color_from_byte));
        let coefficients = higher[3 * n_higher * splat_ix..][..3 * n_higher]
            .as_chunks::<3>()
            .0;
        // There are no signs for the coefficients of degree 4, which are left out.
        let signed = coefficients.iter().zip(sh_signs);
        sh.extend(signed.map(|(rgb, sign)| rgb.map(|byte| sign * quantize::sh_from_byte(byte))));
    }
    // Version 2 has three bytes per rotation, and later versions have four.
    let rotations_wxyz = if header.has_short_rotations() {
        rotations
            .as_chunks()
            .0
            .iter()
            .map(|bytes| rotation_wxyz(axes, quantize::rotation_from_three(*bytes)))
            .collect()
    } else {
        rotations
            .as_chunks()
            .0
            .iter()
            .map(|bytes| rotation_wxyz(axes, quantize::rotation_from_smallest(*bytes)))
            .collect()
    };
    SplatArrays {
        means: means
            .as_chunks()
            .0
            .iter()
            .map(|bytes| mean(axes, header.fractional_bits, bytes))
            .collect(),
        log_scales: scales
            .as_chunks::<3>()
            .0
            .iter()
            .map(|bytes| bytes.map(quantize::log_scale_from_byte))
            .collect(),
        rotations_wxyz,
        opacity_logits: alphas
            .iter()
            .map(|byte| quantize::opacity_logit_from_byte(*byte))
            .collect(),
        sh,
        sh_degree: header.sh_degree.min(MAX_USED_SH_DEGREE),
        is_antialiased: header.is_antialiased(),
    }
}

/// Decodes a mean, which is three signed 24-bit numbers.
fn mean(axes: Axes, fractional_bits: u8, bytes: &[u8; 9]) -> [f32; 3] {
    let [x, y, z] = [0, 3, 6].map(|at| [bytes[at], bytes[at + 1], bytes[at + 2]]);
    axes.vector([x, y, z].map(|fixed| quantize::mean_from_fixed(fixed, fractional_bits)))
}

/// Converts a decoded rotation to fieldrig's axes and order.
fn rotation_wxyz(axes: Axes, xyzw: [f32; 4]) -> [f32; 4] {
    let [x, y, z] = axes.rotation_xyz([xyzw[0], xyzw[1], xyzw[2]]);
    [xyzw[3], x, y, z]
}

/// Encodes the header and the splats without compression.
fn uncompressed_bytes(splats: &SplatArrays) -> Result<Vec<u8>, Error> {
    let max_splats = files::Budget::SPLATS.max_elements;
    let n_splats = u32::try_from(splats.n_splats())
        .ok()
        .filter(|n| u64::from(*n) <= max_splats)
        .ok_or_else(|| {
            Error::SplatArrays(format!(
                "found {} splats, .spz holds at most {max_splats}",
                splats.n_splats()
            ))
        })?;
    let fractional_bits = fractional_bits(&splats.means)?;
    let axes = Axes::RIGHT_UP_BACK;
    let sh_signs = axes.sh_signs();
    // The fields of the header are: signature, version, number of splats, degree, fractional bits,
    // flags, reserved.
    let mut bytes = MAGIC.to_vec();
    bytes.extend(
        [WRITTEN_VERSION, n_splats]
            .map(u32::to_le_bytes)
            .as_flattened(),
    );
    bytes.extend([
        u8::try_from(splats.sh_degree).expect("checked to be at most 3"),
        fractional_bits,
    ]);
    bytes.extend([
        if splats.is_antialiased {
            IS_ANTIALIASED
        } else {
            0
        },
        0,
    ]);
    // The attributes, in the order of `Header::attribute_bytes`.
    for mean in &splats.means {
        let fixed = axes
            .vector(*mean)
            .map(|meters| quantize::fixed_from_mean(meters, fractional_bits));
        bytes.extend(fixed.as_flattened());
    }
    bytes.extend(
        splats
            .opacity_logits
            .iter()
            .map(|logit| quantize::byte_from_opacity_logit(*logit)),
    );
    let n_coefficients = splats.n_coefficients();
    for coefficients in splats.sh.chunks_exact(n_coefficients) {
        bytes.extend(coefficients[0].map(quantize::byte_from_color));
    }
    for log_scale in &splats.log_scales {
        bytes.extend(log_scale.map(quantize::byte_from_log_scale));
    }
    for [w, x, y, z] in &splats.rotations_wxyz {
        let [x, y, z] = axes.rotation_xyz([*x, *y, *z]);
        bytes.extend(quantize::smallest_from_rotation([x, y, z, *w]));
    }
    for coefficients in splats.sh.chunks_exact(n_coefficients) {
        for (rgb, sign) in coefficients[1..].iter().zip(sh_signs) {
            bytes.extend(rgb.map(|value| quantize::byte_from_sh(sign * value)));
        }
    }
    Ok(bytes)
}

/// Largest number of fractional bits at which all means are in range.
fn fractional_bits(means: &[[f32; 3]]) -> Result<u8, Error> {
    // One number of bits applies to all means, so the farthest splat determines the accuracy.
    let max_coordinate_m = means
        .as_flattened()
        .iter()
        .map(|meters| f64::from(meters.abs()))
        .fold(0.0, f64::max);
    let fits =
        |bits: &u8| max_coordinate_m * f64::from(1_u32 << bits) <= f64::from(quantize::MAX_FIXED);
    (0..=MAX_FRACTIONAL_BITS).rev().find(fits).ok_or_else(|| {
        Error::SplatArrays(format!(
            "a mean has a coordinate of {max_coordinate_m:.0} m, .spz holds at most {} m",
            quantize::MAX_FIXED
        ))
    })
}

#[cfg(test)]
mod tests;
