//! Noise of color and depth images, and the holes of depth images.
#![expect(
    clippy::cast_possible_truncation,
    reason = "values are clamped before they become integers"
)]

use crate::config::{DepthConfig, SensorConfig};
use crate::random::RandomStream;
use rayon::prelude::{
    IndexedParallelIterator, IntoParallelRefMutIterator, ParallelIterator, ParallelSlice,
    ParallelSliceMut,
};

/// Rounds colors to bytes.
pub(crate) fn to_bytes(colors: &[f32]) -> Vec<u8> {
    colors.iter().map(|color| to_byte(*color)).collect()
}

fn to_byte(value: f32) -> u8 {
    (value.clamp(0.0, 255.0) + 0.5) as u8
}

/// Adds shot and read noise to `[height, width, 3]` colors of 0 to 255.
pub(crate) fn add_color_noise(
    colors: &[f32],
    sensor: &SensorConfig,
    random: RandomStream,
) -> Vec<u8> {
    /// Number of pixels that one task processes. It is small enough for many tasks, and large
    /// enough for a low overhead per task.
    const PIXELS_A_CHUNK: usize = 640;
    // A table of 256 square roots replaces one square root per channel.
    let sigma: [f32; 256] = std::array::from_fn(|level| noise_sigma(sensor, level as f64) as f32);
    let mut bytes = vec![0; colors.len()];
    bytes
        .par_chunks_mut(3 * PIXELS_A_CHUNK)
        .zip(colors.par_chunks(3 * PIXELS_A_CHUNK))
        .enumerate()
        .for_each(|(chunk, (bytes, colors))| {
            for (ix, (bytes, colors)) in bytes
                .chunks_exact_mut(3)
                .zip(colors.chunks_exact(3))
                .enumerate()
            {
                // The counter is the index of the pixel, so that the noise does not depend on the
                // division into tasks.
                let normals = random.normals((chunk * PIXELS_A_CHUNK + ix) as u64);
                for channel in 0..3 {
                    let level = usize::from(to_byte(colors[channel]));
                    bytes[channel] = to_byte(colors[channel] + sigma[level] * normals[channel]);
                }
            }
        });
    bytes
}

/// Standard deviation of the noise at a level of 0 to 255.
pub(crate) fn noise_sigma(sensor: &SensorConfig, level: f64) -> f64 {
    const MID_GRAY: f64 = 128.0;
    sensor.noise_sigma
        // The variance of shot noise is proportional to the brightness. The variance of read noise
        // is constant.
        * (1.0 - sensor.shot_frac + sensor.shot_frac * level / MID_GRAY)
            .max(0.0)
            .sqrt()
}

/// PSNR in dB of bytes against colors rounded to bytes. It is infinite if they are equal.
pub(crate) fn psnr(bytes: &[u8], colors: &[f32]) -> f64 {
    // A chunk's sum of squares fits into u32, because 4096 * 255^2 < 2^32.
    const SAMPLES_A_CHUNK: usize = 4096;
    // The data is processed in chunks, so that the innermost loop runs over slices.
    let squares = bytes
        .par_chunks(SAMPLES_A_CHUNK)
        .zip(colors.par_chunks(SAMPLES_A_CHUNK))
        .map(|(bytes, colors)| {
            let squares = bytes
                .iter()
                .zip(colors)
                .map(|(byte, color)| u32::from(byte.abs_diff(to_byte(*color))).pow(2));
            u64::from(squares.sum::<u32>())
        });
    let mean_square = squares.sum::<u64>() as f64 / bytes.len() as f64;
    10.0 * (255.0 * 255.0 / mean_square).log10()
}

/// Converts true depth to counts. It adds noise, range limits, holes and quantization. A count of 0
/// is a hole.
pub(crate) fn depth_counts(
    depth_m: &[f32],
    width: usize,
    depth: &DepthConfig,
    random: RandomStream,
    ideal: bool,
) -> Vec<u16> {
    let in_range =
        |meters: f32| f64::from(meters) >= depth.min_m && f64::from(meters) <= depth.max_m;
    let to_count = |meters: f64| {
        ((meters / (depth.factor * depth.meters_per_count)).clamp(0.0, f64::from(u16::MAX)) + 0.5)
            as u16
    };
    if ideal {
        return depth_m
            .iter()
            .map(|&meters| {
                if in_range(meters) {
                    to_count(meters.into())
                } else {
                    0
                }
            })
            .collect();
    }
    let holes = Holes::new(depth_m, width, depth.hole_frac, random);
    let mut counts = vec![0; depth_m.len()];
    counts.par_iter_mut().enumerate().for_each(|(ix, count)| {
        let meters = depth_m[ix];
        if in_range(meters) && !holes.contains(ix) {
            let normal = f64::from(random.normals(ix as u64)[0]);
            let meters = f64::from(meters);
            // The depth of a stereo camera is inversely proportional to the disparity, so a
            // constant disparity error gives a depth error that grows with the square of the depth.
            *count = to_count(meters + depth.noise_sigma_m * meters * meters * normal);
        }
    });
    counts
}

/// Pixels at which a stereo camera finds no match. Most holes are next to depth edges, and the rest
/// form small clusters.
struct Holes {
    is_edge: Vec<bool>,
    width: usize,
    random: RandomStream,
    edge_share: f64,
    cluster_share: f64,
}

/// Maximum fraction of edge pixels that become holes. With 1, every depth edge would be missing,
/// unlike in images of real cameras.
const MAX_EDGE_SHARE: f64 = 0.6;
/// Side of a cluster of holes, pixels.
const CLUSTER_PX: usize = 4;
/// First random counter that is used for holes. The noise uses smaller counters.
const HOLE_COUNTERS: u64 = 1 << 40;

impl Holes {
    fn new(depth_m: &[f32], width: usize, hole_frac: f64, random: RandomStream) -> Self {
        let mut is_edge = vec![false; depth_m.len()];
        is_edge
            .par_chunks_mut(width)
            .zip(depth_m.par_chunks(width))
            .for_each(|(is_edge, depth_m)| mark_edges(is_edge, depth_m));
        let n_edge = is_edge.iter().filter(|is_edge| **is_edge).count() as f64;
        let n_holes_target = hole_frac * depth_m.len() as f64;
        // Seven of ten holes are at depth edges, as long as there are enough edges. The rest is
        // spread over the other pixels.
        let edge_share = (0.7 * n_holes_target / n_edge.max(1.0)).min(MAX_EDGE_SHARE);
        let n_rest = depth_m.len() as f64 - n_edge;
        let cluster_share =
            ((n_holes_target - edge_share * n_edge) / n_rest.max(1.0)).clamp(0.0, 1.0);
        Self {
            is_edge,
            width,
            random,
            edge_share,
            cluster_share,
        }
    }

    fn contains(&self, ix: usize) -> bool {
        if self.is_edge[ix] {
            return self.random.unit(HOLE_COUNTERS + ix as u64) < self.edge_share;
        }
        // All pixels of a cluster share a random number.
        let row = ix / self.width;
        let column = ix % self.width;
        let cluster = (row / CLUSTER_PX * self.width + column / CLUSTER_PX) as u64;
        self.random.unit(2 * HOLE_COUNTERS + cluster) < self.cluster_share
    }
}

/// Marks the pixels of a row within two pixels of a depth jump. There, the surface is visible to
/// only one of the two imagers.
fn mark_edges(is_edge: &mut [bool], depth_m: &[f32]) {
    const EDGE_RADIUS_PX: usize = 2;
    /// Depth difference that counts as an edge, as a fraction of the depth. On moderately slanted
    /// surfaces, differences are smaller.
    const JUMP_FRAC: f32 = 0.03;
    // Pixels near the ends of a row have no complete window and stay unmarked.
    for (column, window) in depth_m.windows(2 * EDGE_RADIUS_PX + 1).enumerate() {
        let a = window[0];
        let b = window[2 * EDGE_RADIUS_PX];
        is_edge[column + EDGE_RADIUS_PX] = (a - b).abs() > JUMP_FRAC * a.min(b);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn color_noise_matches_configuration() {
        let sensor = SensorConfig::default();
        for level in [40.0, 128.0, 200.0] {
            let colors = vec![level as f32; 3 * 100_000];
            let bytes = add_color_noise(&colors, &sensor, RandomStream::new(1, &[2]));
            let n = bytes.len() as f64;
            let mean = bytes.iter().map(|byte| f64::from(*byte)).sum::<f64>() / n;
            let variance = bytes
                .iter()
                .map(|byte| (f64::from(*byte) - mean).powi(2))
                .sum::<f64>()
                / n;
            // Rounding to bytes adds a variance of 1/12.
            let expected = noise_sigma(&sensor, level).powi(2) + 1.0 / 12.0;
            assert!(
                (variance / expected - 1.0).abs() < 0.03,
                "{level}: {variance} against {expected}"
            );
            assert!((mean - level).abs() < 0.05);
        }
        assert!((noise_sigma(&sensor, 128.0) - 2.0).abs() < 1e-12);
    }

    #[test]
    fn depth_noise_holes_and_limits_match_configuration() {
        let depth = DepthConfig::default();
        let plane = vec![1.0_f32; 640 * 480];
        let counts = depth_counts(&plane, 640, &depth, RandomStream::new(1, &[3]), false);
        let meters: Vec<f64> = counts
            .iter()
            .filter(|count| **count > 0)
            .map(|count| f64::from(*count) * 1e-4)
            .collect();
        let holes = 1.0 - meters.len() as f64 / plane.len() as f64;
        let sigma =
            (meters.iter().map(|z| (z - 1.0).powi(2)).sum::<f64>() / meters.len() as f64).sqrt();
        assert!((holes - 0.02).abs() < 0.003, "{holes}");
        assert!((sigma - 0.0015).abs() < 0.00005, "{sigma}");
        let near = depth_counts(
            &[0.05, 7.0, 0.5],
            3,
            &depth,
            RandomStream::new(1, &[3]),
            true,
        );
        assert_eq!(near, [0, 0, 5000]);
    }
}
