//! Readings of a depth image without outliers, in squares of pixels.

use crate::config::MapConfig;

/// Readings of neighboring pixels on the same surface differ by less than this fraction of the
/// depth, or by a voxel: at a distance of 1 m and with a focal length of 600 pixels, the surface is
/// then inclined by up to 87 degrees.
const MAX_STEP_FRAC: f32 = 0.03;

/// Images are reduced to at most this many samples per row. At a distance of 1 m, a camera that is 70
/// degrees wide then has four samples per voxel of 2 cm and direction.
const MAX_SAMPLES: usize = 320;

/// Valid readings of a square of pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Sample {
    /// The smallest one, meters; infinite if there is none.
    pub(crate) near_m: f32,
    /// The largest one, meters; 0 if there is none.
    pub(crate) far_m: f32,
    /// Number of pixels with a valid reading.
    pub(crate) n_valid: f32,
}

/// The samples of an image.
#[derive(Clone, Debug)]
pub(crate) struct Samples {
    width: usize,
    samples: Vec<Sample>,
}

/// Pixels per side of a sample, for an image of a width.
pub(crate) fn sample_px(width_px: usize) -> usize {
    width_px.div_ceil(MAX_SAMPLES)
}

impl Samples {
    /// Samples of readings without outliers. Samples at the right and lower edges may be smaller.
    pub(crate) fn new(readings_m: &[f32], width_px: usize) -> Self {
        const EMPTY: Sample = Sample {
            near_m: f32::INFINITY,
            far_m: 0.0,
            n_valid: 0.0,
        };
        let side_px = sample_px(width_px);
        let width = width_px.div_ceil(side_px);
        let height = (readings_m.len() / width_px).div_ceil(side_px);
        let mut samples = vec![EMPTY; width * height];
        let rows = samples.chunks_exact_mut(width);
        for (samples, rows_m) in rows.zip(readings_m.chunks(side_px * width_px)) {
            for row_m in rows_m.chunks_exact(width_px) {
                for (sample, pixels_m) in samples.iter_mut().zip(row_m.chunks(side_px)) {
                    for z_m in pixels_m.iter().filter(|z_m| **z_m > 0.0) {
                        sample.near_m = sample.near_m.min(*z_m);
                        sample.far_m = sample.far_m.max(*z_m);
                        sample.n_valid += 1.0;
                    }
                }
            }
        }
        Self { width, samples }
    }

    /// The rows.
    pub(crate) fn rows(&self) -> impl Iterator<Item = &[Sample]> {
        self.samples.chunks_exact(self.width)
    }
}

/// Readings with at least one neighbor of a similar depth, up to the maximum depth; 0 for all
/// others. Pixels at the border of the image have too few neighbors.
pub(crate) fn without_outliers(depth_m: &[f32], width: usize, config: &MapConfig) -> Vec<f32> {
    #[expect(clippy::cast_possible_truncation, reason = "depth is in f32")]
    let [voxel_m, min_m, max_m] =
        [config.voxel_m, config.min_depth_m, config.max_depth_m].map(|m| m as f32);
    let mut kept = vec![0.0; depth_m.len()];
    let height = depth_m.len() / width;
    if width < 3 || height < 3 {
        return kept;
    }
    for row in 1..height - 1 {
        let line = |row: usize| &depth_m[row * width..(row + 1) * width];
        let (above, own, below) = (line(row - 1), line(row), line(row + 1));
        let kept = &mut kept[row * width + 1..(row + 1) * width - 1];
        for (ix, kept) in kept.iter_mut().enumerate() {
            let z = own[ix + 1];
            let max_step = voxel_m.max(MAX_STEP_FRAC * z);
            // Comparisons with NaN are false. Readings of 0 differ from all valid ones by more.
            let is_close = |other: f32| (other - z).abs() <= max_step;
            let is_kept = is_close(above[ix])
                | is_close(above[ix + 1])
                | is_close(above[ix + 2])
                | is_close(own[ix])
                | is_close(own[ix + 2])
                | is_close(below[ix])
                | is_close(below[ix + 1])
                | is_close(below[ix + 2]);
            let is_valid = z >= min_m && z < f32::INFINITY;
            *kept = if is_kept & is_valid {
                z.min(max_m)
            } else {
                0.0
            };
        }
    }
    kept
}
