//! Splats for kernel benchmarks. They are a synthetic cloud, or come from a file of a peer
//! implementation.

use crate::Error;
use crate::splat::arrays::SplatArrays;
use npyz::npz::file_name_from_array_name;
use npyz::{NpyFile, Order};
use numbers::random::Random;
use std::fs::File;
use std::io::{self, BufReader};
use std::path::Path;
use zip::ZipArchive;
use zip::result::ZipError;

const SH_DEGREE: u32 = 3;
const N_COEFFICIENTS: usize = 16;

/// Patches of [`scan_cloud`]: center and standard deviation, meters.
const PATCHES: [([f64; 2], f64); 4] = [
    ([-0.5, 0.2], 0.1),
    ([0.3, -0.3], 0.14),
    ([0.7, 0.4], 0.2),
    ([-1.1, -0.6], 0.14),
];
/// Fraction of splats in patches. The next constant is the fraction of large splats.
const PATCH_FRAC: f64 = 0.25;
const LARGE_FRAC: f64 = 0.005;
/// Number of splats that cover the whole image.
const N_HUGE: usize = 3;
/// Median sizes (standard deviations) in meters, times the square root of the number of splats.
const WALL_SIZE: f64 = 5.6;
const PATCH_SIZE: f64 = 1.9;
const LARGE_SIZE: f64 = 60.0;

/// Generates `n_splats` random splats of SH degree 3. Equal seeds give equal splats.
///
/// Means are uniform in the cube from -1 to 1. All other values are normally distributed. Log
/// scales have a mean of `ln(0.6 / n^(1/3))` and a standard deviation of 0.3. The standard
/// deviation is 1 for quaternion components, 1.5 for opacity logits, 0.5 for the constant color
/// coefficient, and 0.2 for the other coefficients.
#[expect(clippy::cast_possible_truncation, reason = "drawn in f64, used in f32")]
pub fn synthetic_cloud(n_splats: usize, seed: u64) -> SplatArrays {
    let mut random = Random::new(seed);
    // Splats fill a volume, so their spacing is inversely proportional to the cube root of their
    // number.
    let typical_log_scale = (0.6 / (n_splats as f64).cbrt()).ln();
    let mut splats = SplatArrays {
        sh_degree: SH_DEGREE,
        ..SplatArrays::default()
    };
    for _ in 0..n_splats {
        splats
            .means
            .push(std::array::from_fn(|_| (2.0 * random.unit() - 1.0) as f32));
        splats.log_scales.push(std::array::from_fn(|_| {
            (typical_log_scale + 0.3 * random.normal()) as f32
        }));
        splats
            .rotations_wxyz
            .push(std::array::from_fn(|_| random.normal() as f32));
        splats.opacity_logits.push((1.5 * random.normal()) as f32);
        splats.sh.extend(random_color(&mut random));
    }
    splats
}

/// Color coefficients of [`synthetic_cloud`].
#[expect(clippy::cast_possible_truncation, reason = "drawn in f64, used in f32")]
fn random_color(random: &mut Random) -> [[f32; 3]; N_COEFFICIENTS] {
    std::array::from_fn(|coefficient_ix| {
        let deviation = if coefficient_ix == 0 { 0.5 } else { 0.2 };
        std::array::from_fn(|_| (deviation * random.normal()) as f32)
    })
}

/// Generates `n_splats` splats that resemble a scan with depth, for a camera at z = -3.2 that looks
/// along z. Equal seeds give equal splats.
///
/// Most splats are flat and lie on an uneven wall around z = 0, whose edges lie outside an image
/// with a focal length of 0.9 image widths. A fraction `PATCH_FRAC` of the splats is smaller and
/// lies in a few `PATCHES`, where the lists of the tiles are several times longer. A fraction
/// `LARGE_FRAC` is large, and `N_HUGE` splats cover the whole image.
#[expect(clippy::cast_possible_truncation, reason = "drawn in f64, used in f32")]
pub fn scan_cloud(n_splats: usize, seed: u64) -> SplatArrays {
    let mut random = Random::new(seed);
    // Sizes in pixels are the same if the number of splats per pixel is the same.
    let scale_m = 1.0 / (n_splats as f64).sqrt();
    let mut splats = SplatArrays {
        sh_degree: SH_DEGREE,
        ..SplatArrays::default()
    };
    for splat_ix in 0..n_splats {
        // The random number is drawn for every splat, even for huge splats, so that the number of
        // huge splats does not change the other splats.
        let kind = random.unit();
        let (xy_m, size_m, depth_m) = if splat_ix < N_HUGE {
            ([0.2 * random.normal(), 0.2 * random.normal()], 3.0, 0.0)
        } else if kind < PATCH_FRAC {
            let ([x_m, y_m], spread_m) = PATCHES[splat_ix % PATCHES.len()];
            let xy_m = [
                x_m + spread_m * random.normal(),
                y_m + spread_m * random.normal(),
            ];
            (xy_m, PATCH_SIZE * scale_m, 0.02 * random.normal())
        } else {
            let xy_m = [
                2.3 * (2.0 * random.unit() - 1.0),
                1.8 * (2.0 * random.unit() - 1.0),
            ];
            let size = if kind > 1.0 - LARGE_FRAC {
                LARGE_SIZE
            } else {
                WALL_SIZE
            };
            (xy_m, size * scale_m, 0.01 * random.normal())
        };
        // The wall is uneven, so that the order by depth differs from the order in the list.
        let [x_m, y_m] = xy_m;
        splats.means.push(
            [
                x_m,
                y_m,
                0.3 * (2.0 * x_m).sin() * (1.7 * y_m).cos() + depth_m,
            ]
            .map(|m| m as f32),
        );
        // Splats are flat along the third axis and elongated along the second.
        let log_size = size_m.ln() + 0.5 * random.normal();
        let flatness = [0.0, 0.4 * random.normal(), -2.0];
        splats
            .log_scales
            .push(flatness.map(|along| (log_size + along) as f32));
        // The splats are roughly parallel to the wall.
        splats
            .rotations_wxyz
            .push([1.0, 0.2, 0.2, 1.0].map(|deviation| (deviation * random.normal()) as f32));
        splats
            .opacity_logits
            .push((1.5 * random.normal() - 1.5) as f32);
        splats.sh.extend(random_color(&mut random));
    }
    splats
}

/// Reads a cloud written with numpy's `savez`: `means`, `quats` (w first), `log_scales`,
/// `opacities_logit`, `sh` (n, 16, 3), all f32.
pub fn load_cloud_npz(path: &Path) -> Result<SplatArrays, Error> {
    read_npz(path)
        .map_err(|error| Error::SplatFile {
            path: path.to_owned(),
            reason: error.to_string(),
        })?
        .checked()
}

/// Reads the arrays of a cloud, without checking them.
fn read_npz(path: &Path) -> io::Result<SplatArrays> {
    let mut file = ZipArchive::new(BufReader::new(files::open(path)?))?;
    Ok(SplatArrays {
        means: rows(&mut file, "means", &[3])?,
        log_scales: rows(&mut file, "log_scales", &[3])?,
        rotations_wxyz: rows(&mut file, "quats", &[4])?,
        opacity_logits: rows::<1>(&mut file, "opacities_logit", &[])?.concat(),
        sh: rows(&mut file, "sh", &[N_COEFFICIENTS as u64, 3])?,
        sh_degree: SH_DEGREE,
        is_antialiased: false,
    })
}

/// Reads an f32 array of shape (n, `inner_shape`) as rows of `N`.
fn rows<const N: usize>(
    file: &mut ZipArchive<BufReader<File>>,
    name: &str,
    inner_shape: &[u64],
) -> io::Result<Vec<[f32; N]>> {
    let member = file
        .by_name(&file_name_from_array_name(name))
        .map_err(|error| match error {
            ZipError::FileNotFound => io::Error::other(format!("array {name:?} is missing")),
            error => error.into(),
        })?;
    let array = NpyFile::new(member)?;
    if array
        .shape()
        .split_first()
        .is_none_or(|(_, inner)| inner != inner_shape)
    {
        let message = format!(
            "array {name:?} has shape {:?}, expected n followed by {inner_shape:?}",
            array.shape()
        );
        return Err(io::Error::other(message));
    }
    // In Fortran order, the values of one splat are not adjacent.
    if array.order() != Order::C {
        return Err(io::Error::other(format!(
            "array {name:?} is in Fortran order, expected C order"
        )));
    }
    Ok(array.into_vec::<f32>()?.as_chunks::<N>().0.to_vec())
}

#[cfg(test)]
mod tests {
    use super::*;
    use npyz::WriterBuilder;

    /// Mean and standard deviation.
    fn moments(values: &[f32]) -> (f64, f64) {
        let n = values.len() as f64;
        let mean = values.iter().copied().map(f64::from).sum::<f64>() / n;
        let variance = values
            .iter()
            .map(|&value| (f64::from(value) - mean).powi(2))
            .sum::<f64>()
            / n;
        (mean, variance.sqrt())
    }

    /// Five standard errors of the standard deviation of the smallest array, for 20 000 splats.
    const DEVIATION_FRAC: f64 = 0.03;

    fn assert_spread(what: &str, values: &[f32], mean: f64, deviation: f64) {
        let (got_mean, got_deviation) = moments(values);
        assert!(
            (got_mean - mean).abs() < DEVIATION_FRAC * deviation.max(0.1),
            "{what}: mean {got_mean}"
        );
        assert!(
            (got_deviation / deviation - 1.0).abs() < DEVIATION_FRAC,
            "{what}: deviation {got_deviation}"
        );
    }

    #[test]
    fn cloud_has_the_documented_distribution() {
        let n_splats = 20_000;
        let cloud = synthetic_cloud(n_splats, 0).checked().unwrap();
        assert_eq!(cloud.n_splats(), n_splats);
        assert_spread(
            "means",
            cloud.means.as_flattened(),
            0.0,
            1.0 / 3.0_f64.sqrt(),
        );
        assert!(
            cloud
                .means
                .as_flattened()
                .iter()
                .all(|x| (-1.0..1.0).contains(x))
        );
        let typical = (0.6 / (n_splats as f64).cbrt()).ln();
        assert_spread("log scales", cloud.log_scales.as_flattened(), typical, 0.3);
        assert_spread("rotations", cloud.rotations_wxyz.as_flattened(), 0.0, 1.0);
        assert_spread("opacities", &cloud.opacity_logits, 0.0, 1.5);
        let (constant, rest): (Vec<_>, Vec<_>) = cloud
            .sh
            .iter()
            .enumerate()
            .partition(|(ix, _)| ix % N_COEFFICIENTS == 0);
        let flat = |part: Vec<(usize, &[f32; 3])>| {
            part.iter()
                .flat_map(|(_, color)| **color)
                .collect::<Vec<_>>()
        };
        assert_spread("constant color", &flat(constant), 0.0, 0.5);
        assert_spread("color", &flat(rest), 0.0, 0.2);
    }

    #[test]
    fn same_seed_gives_the_same_cloud() {
        assert_eq!(synthetic_cloud(50, 7), synthetic_cloud(50, 7));
        assert_ne!(synthetic_cloud(50, 7), synthetic_cloud(50, 8));
    }

    /// Writes arrays of f32 in numpy's format.
    fn write_npz(path: &Path, arrays: &[(&str, &[f32], &[u64])]) {
        let mut file = zip::ZipWriter::new(File::create(path).unwrap());
        for (name, values, shape) in arrays {
            file.start_file(
                file_name_from_array_name(name),
                zip::write::SimpleFileOptions::default(),
            )
            .unwrap();
            let options = npyz::WriteOptions::new().default_dtype().shape(shape);
            let mut array = options.writer(&mut file).begin_nd().unwrap();
            array.extend(values.iter().copied()).unwrap();
            array.finish().unwrap();
        }
        file.finish().unwrap();
    }

    /// Writes the arrays of a cloud, except for `omitted`.
    fn write_cloud(path: &Path, cloud: &SplatArrays, omitted: &str) {
        let n = cloud.n_splats() as u64;
        let mut arrays: Vec<(&str, &[f32], &[u64])> = Vec::new();
        let shapes = [vec![n, 3], vec![n, 4], vec![n], vec![n, 16, 3]];
        arrays.push(("means", cloud.means.as_flattened(), &shapes[0]));
        arrays.push(("quats", cloud.rotations_wxyz.as_flattened(), &shapes[1]));
        arrays.push(("log_scales", cloud.log_scales.as_flattened(), &shapes[0]));
        arrays.push(("opacities_logit", &cloud.opacity_logits, &shapes[2]));
        arrays.push(("sh", cloud.sh.as_flattened(), &shapes[3]));
        arrays.retain(|(name, ..)| *name != omitted);
        write_npz(path, &arrays);
    }

    #[test]
    fn numpy_arrays_round_trip() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("cloud.npz");
        let cloud = synthetic_cloud(9, 3);
        write_cloud(&path, &cloud, "");
        assert_eq!(load_cloud_npz(&path).unwrap(), cloud);
        write_cloud(&path, &cloud, "quats");
        assert!(
            load_cloud_npz(&path)
                .unwrap_err()
                .to_string()
                .contains("array \"quats\" is missing")
        );
        write_npz(&path, &[("means", &[0.0; 9 * 4], &[9, 4])]);
        assert!(
            load_cloud_npz(&path)
                .unwrap_err()
                .to_string()
                .contains("has shape [9, 4]")
        );
        std::fs::write(&path, b"not a zip").unwrap();
        assert!(matches!(
            load_cloud_npz(&path),
            Err(Error::SplatFile { .. })
        ));
        assert!(matches!(
            load_cloud_npz(&folder.path().join("none.npz")),
            Err(Error::SplatFile { .. })
        ));
    }
}
