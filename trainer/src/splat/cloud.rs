//! Clouds for kernel benchmarks: synthetic ones, and files written by a peer implementation.

use crate::Error;
use crate::splat::arrays::SplatArrays;
use candle_core::npy::NpzTensors;
use kinematics::random::Random;
use std::path::Path;

const SH_DEGREE: u32 = 3;
const N_COEFFICIENTS: usize = 16;

/// Generates `n_splats` random splats of color degree 3; the same for the same seed.
///
/// Means are uniform in the cube from -1 to 1. Log scales are normal around `ln(0.6 / n^(1/3))` with a standard
/// deviation of 0.3, rotations normal in four dimensions, and opacity logits normal with a standard deviation of 1.5.
/// Color coefficients are normal with standard deviations of 0.5 for the constant one and 0.2 for the others.
#[expect(clippy::cast_possible_truncation, reason = "drawn in f64, used in f32")]
pub fn synthetic_cloud(n_splats: usize, seed: u64) -> SplatArrays {
    let mut random = Random::new(seed);
    let typical_log_scale = (0.6 / (n_splats as f64).cbrt()).ln();
    let mut splats = SplatArrays { sh_degree: SH_DEGREE, ..SplatArrays::default() };
    for _ in 0..n_splats {
        splats.means.push(std::array::from_fn(|_| (2.0 * random.unit() - 1.0) as f32));
        splats.log_scales.push(std::array::from_fn(|_| (typical_log_scale + 0.3 * random.normal()) as f32));
        splats.rotations_wxyz.push(std::array::from_fn(|_| random.normal() as f32));
        splats.opacity_logits.push((1.5 * random.normal()) as f32);
        for coefficient_ix in 0..N_COEFFICIENTS {
            let deviation = if coefficient_ix == 0 { 0.5 } else { 0.2 };
            splats.sh.push(std::array::from_fn(|_| (deviation * random.normal()) as f32));
        }
    }
    splats
}

/// Reads a cloud written with numpy: `means`, `quats` (w first), `log_scales`, `opacities_logit`, `sh` (n, 16, 3),
/// all f32.
pub fn load_cloud_npz(path: &Path) -> Result<SplatArrays, Error> {
    let read = || -> candle_core::Result<SplatArrays> {
        let file = NpzTensors::new(path)?;
        Ok(SplatArrays {
            means: rows(&file, "means", &[3])?,
            log_scales: rows(&file, "log_scales", &[3])?,
            rotations_wxyz: rows(&file, "quats", &[4])?,
            opacity_logits: rows::<1>(&file, "opacities_logit", &[])?.concat(),
            sh: rows(&file, "sh", &[N_COEFFICIENTS, 3])?,
            sh_degree: SH_DEGREE,
        })
    };
    read().map_err(|error| Error::SplatFile { path: path.to_owned(), reason: error.to_string() })?.checked()
}

/// Reads an f32 array of shape (n, `inner_shape`) as rows of `N`.
fn rows<const N: usize>(file: &NpzTensors, name: &str, inner_shape: &[usize]) -> candle_core::Result<Vec<[f32; N]>> {
    let array = file.get(name)?.ok_or_else(|| candle_core::Error::Msg(format!("array {name:?} is missing")))?;
    if array.dims().split_first().is_none_or(|(_, inner)| inner != inner_shape) {
        let message = format!("array {name:?} has shape {:?}, expected n followed by {inner_shape:?}", array.dims());
        return Err(candle_core::Error::Msg(message));
    }
    Ok(array.flatten_all()?.to_vec1::<f32>()?.as_chunks::<N>().0.to_vec())
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::{DType, Device, Tensor};

    /// Mean and standard deviation.
    fn moments(values: &[f32]) -> (f64, f64) {
        let n = values.len() as f64;
        let mean = values.iter().copied().map(f64::from).sum::<f64>() / n;
        let variance = values.iter().map(|&value| (f64::from(value) - mean).powi(2)).sum::<f64>() / n;
        (mean, variance.sqrt())
    }

    /// For 20 000 splats: five standard errors of the standard deviation of the smallest array.
    const DEVIATION_FRAC: f64 = 0.03;

    fn assert_spread(what: &str, values: &[f32], mean: f64, deviation: f64) {
        let (got_mean, got_deviation) = moments(values);
        assert!((got_mean - mean).abs() < DEVIATION_FRAC * deviation.max(0.1), "{what}: mean {got_mean}");
        assert!((got_deviation / deviation - 1.0).abs() < DEVIATION_FRAC, "{what}: deviation {got_deviation}");
    }

    #[test]
    fn cloud_has_the_documented_distribution() {
        let n_splats = 20_000;
        let cloud = synthetic_cloud(n_splats, 0).checked().unwrap();
        assert_eq!(cloud.n_splats(), n_splats);
        assert_spread("means", cloud.means.as_flattened(), 0.0, 1.0 / 3.0_f64.sqrt());
        assert!(cloud.means.as_flattened().iter().all(|x| (-1.0..1.0).contains(x)));
        let typical = (0.6 / (n_splats as f64).cbrt()).ln();
        assert_spread("log scales", cloud.log_scales.as_flattened(), typical, 0.3);
        assert_spread("rotations", cloud.rotations_wxyz.as_flattened(), 0.0, 1.0);
        assert_spread("opacities", &cloud.opacity_logits, 0.0, 1.5);
        let (constant, rest): (Vec<_>, Vec<_>) =
            cloud.sh.iter().enumerate().partition(|(ix, _)| ix % N_COEFFICIENTS == 0);
        let flat = |part: Vec<(usize, &[f32; 3])>| part.iter().flat_map(|(_, color)| **color).collect::<Vec<_>>();
        assert_spread("constant color", &flat(constant), 0.0, 0.5);
        assert_spread("color", &flat(rest), 0.0, 0.2);
    }

    #[test]
    fn same_seed_gives_the_same_cloud() {
        assert_eq!(synthetic_cloud(50, 7), synthetic_cloud(50, 7));
        assert_ne!(synthetic_cloud(50, 7), synthetic_cloud(50, 8));
    }

    /// Writes the arrays of a cloud in numpy's format, except for `omitted`.
    fn write_npz(path: &Path, cloud: &SplatArrays, omitted: &str) {
        let n = cloud.n_splats();
        let array = |values: &[f32], shape: &[usize]| Tensor::from_slice(values, shape, &Device::Cpu).unwrap();
        let mut arrays = vec![
            ("means", array(cloud.means.as_flattened(), &[n, 3])),
            ("quats", array(cloud.rotations_wxyz.as_flattened(), &[n, 4])),
            ("log_scales", array(cloud.log_scales.as_flattened(), &[n, 3])),
            ("opacities_logit", array(&cloud.opacity_logits, &[n])),
            ("sh", array(cloud.sh.as_flattened(), &[n, 16, 3])),
        ];
        arrays.retain(|(name, _)| *name != omitted);
        Tensor::write_npz(&arrays, path).unwrap();
    }

    #[test]
    fn numpy_arrays_round_trip() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("cloud.npz");
        let cloud = synthetic_cloud(9, 3);
        write_npz(&path, &cloud, "");
        assert_eq!(load_cloud_npz(&path).unwrap(), cloud);
        write_npz(&path, &cloud, "quats");
        assert!(load_cloud_npz(&path).unwrap_err().to_string().contains("array \"quats\" is missing"));
        Tensor::write_npz(&[("means", Tensor::zeros((9, 4), DType::F32, &Device::Cpu).unwrap())], &path).unwrap();
        assert!(load_cloud_npz(&path).unwrap_err().to_string().contains("has shape [9, 4]"));
        std::fs::write(&path, b"not a zip").unwrap();
        assert!(matches!(load_cloud_npz(&path), Err(Error::SplatFile { .. })));
        assert!(matches!(load_cloud_npz(&folder.path().join("none.npz")), Err(Error::SplatFile { .. })));
    }
}
