//! Splats in `.splat` files: 32 bytes per splat, without a header and without colors that depend on
//! the direction.
//!
//! Source: Kwok, antimatter15/splat, <https://github.com/antimatter15/splat>.

use super::ply::SH_0;
use crate::Error;
use crate::splat::arrays::SplatArrays;
use std::path::Path;

/// Size of a splat: three floats for the mean, three floats for the standard deviations, four bytes
/// for color and opacity, and four bytes for the rotation.
const SPLAT_BYTES: usize = 32;
/// Standard deviations of 0, which have no finite logarithm, are raised to this value. A nanometer
/// is invisible at any distance.
const MIN_SCALE: f32 = 1e-9;

/// Reads a `.splat` file. Splats with invalid numbers are left out, with a warning.
pub fn read(path: &Path) -> Result<SplatArrays, Error> {
    super::read_with(path, |bytes| Ok((from_bytes(bytes)?, Vec::new())))
}

fn from_bytes(bytes: &[u8]) -> Result<SplatArrays, String> {
    // The format has no signature, so only the length can be checked.
    let (rows, rest) = bytes.as_chunks::<SPLAT_BYTES>();
    if rows.is_empty() || !rest.is_empty() {
        return Err(format!(
            "it has {} bytes, expected a multiple of {SPLAT_BYTES} above 0",
            bytes.len()
        ));
    }
    // Quaternions are stored as `128 q + 128`, w first. Colors are stored without spherical
    // harmonics.
    let rotation =
        |row: &[u8; SPLAT_BYTES]| [28, 29, 30, 31].map(|at| (f32::from(row[at]) - 128.0) / 128.0);
    let color =
        |row: &[u8; SPLAT_BYTES]| [24, 25, 26].map(|at| (f32::from(row[at]) / 255.0 - 0.5) / SH_0);
    Ok(SplatArrays {
        means: rows.iter().map(|row| floats(row, 0)).collect(),
        log_scales: rows
            .iter()
            .map(|row| floats(row, 12).map(log_scale))
            .collect(),
        rotations_wxyz: rows.iter().map(rotation).collect(),
        opacity_logits: rows.iter().map(|row| opacity_logit(row[27])).collect(),
        sh: rows.iter().map(color).collect(),
        sh_degree: 0,
        is_antialiased: false,
    })
}

/// The three floats that start at a byte of a row.
fn floats(row: &[u8; SPLAT_BYTES], start: usize) -> [f32; 3] {
    [0, 4, 8].map(|at| f32::from_le_bytes(std::array::from_fn(|ix| row[start + at + ix])))
}

/// Logarithm of a standard deviation. It is NaN for invalid standard deviations.
fn log_scale(scale: f32) -> f32 {
    // This comparison is false for NaN and negative numbers. The caller leaves out splats with NaN.
    if scale >= 0.0 {
        scale.max(MIN_SCALE).ln()
    } else {
        f32::NAN
    }
}

/// Bytes 0 and 255 are decoded as 0.25 and 254.75, because opacities of 0 and 1 have no finite
/// logit.
fn opacity_logit(byte: u8) -> f32 {
    let opacity = f32::from(byte).clamp(0.25, 254.75) / 255.0;
    (opacity / (1.0 - opacity)).ln()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(mean: [f32; 3], scales: [f32; 3], rgba: [u8; 4], rotation_wxyz: [u8; 4]) -> Vec<u8> {
        let floats: Vec<u8> = mean
            .into_iter()
            .chain(scales)
            .flat_map(f32::to_le_bytes)
            .collect();
        [&floats[..], &rgba, &rotation_wxyz].concat()
    }

    #[test]
    fn values_are_decoded_as_specified() {
        let first = row(
            [1.0, -2.0, 3.0],
            [0.5, 1.0, 0.0],
            [255, 0, 51, 51],
            [192, 128, 64, 0],
        );
        let second = row([0.0; 3], [1.0; 3], [128; 4], [255, 128, 128, 128]);
        let splats = from_bytes(&[first, second].concat())
            .unwrap()
            .checked()
            .unwrap();
        assert_eq!(
            (splats.n_splats(), splats.sh_degree, splats.is_antialiased),
            (2, 0, false)
        );
        assert_eq!(splats.means[0], [1.0, -2.0, 3.0]);
        assert_eq!(splats.log_scales[0], [0.5_f32.ln(), 0.0, MIN_SCALE.ln()]);
        assert_eq!(splats.rotations_wxyz[0], [0.5, 0.0, -0.5, -1.0]);
        assert!(
            (splats.opacity(0) - 0.2).abs() < 1e-6,
            "{}",
            splats.opacity(0)
        );
        let color = splats.sh[0].map(|coefficient| SH_0 * coefficient + 0.5);
        assert!(
            color
                .iter()
                .zip([1.0, 0.0, 0.2])
                .all(|(got, expected)| (got - expected).abs() < 1e-6),
            "{color:?}"
        );
        assert_eq!(splats.means[1], [0.0; 3]);
    }

    #[test]
    fn invalid_files_and_splats_are_named() {
        assert_eq!(
            from_bytes(&[]).unwrap_err(),
            "it has 0 bytes, expected a multiple of 32 above 0"
        );
        assert_eq!(
            from_bytes(&[0; 33]).unwrap_err(),
            "it has 33 bytes, expected a multiple of 32 above 0"
        );
        let valid = row([0.0; 3], [1.0; 3], [0, 0, 0, 255], [255, 128, 128, 128]);
        let negative_scale = row([0.0; 3], [1.0, -1.0, 1.0], [0; 4], [255, 128, 128, 128]);
        let no_rotation = row([0.0; 3], [1.0; 3], [0; 4], [128; 4]);
        let not_finite = row([f32::NAN, 0.0, 0.0], [1.0; 3], [0; 4], [255, 128, 128, 128]);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("scene.splat");
        std::fs::write(
            &path,
            [&valid[..], &negative_scale, &no_rotation, &not_finite].concat(),
        )
        .unwrap();
        let splats = read(&path).unwrap();
        assert_eq!(
            (splats.n_splats(), splats.opacity_logits[0].is_finite()),
            (1, true)
        );
        assert!(matches!(
            read(&folder.path().join("none.splat")),
            Err(Error::Read { .. })
        ));
    }

    #[test]
    fn file_of_another_program_is_read() {
        let Some(folder) = test_support::data_folder("splats") else {
            return;
        };
        let splats = read(&folder.join("minimal.splat")).unwrap();
        assert_eq!(
            splats.means,
            [
                [-1.0, 0.0, -1.0],
                [0.0, 0.0, -1.0],
                [-1.0, 0.0, 0.0],
                [0.0; 3]
            ]
        );
        assert!(
            splats
                .log_scales
                .as_flattened()
                .iter()
                .all(|scale| (scale - 0.1_f32.ln()).abs() < 1e-6)
        );
        assert!((0..4).all(|ix| (splats.opacity(ix) - 230.0 / 255.0).abs() < 1e-6));
    }
}
