//! Voxel size and related settings of a field. They are given or chosen from the first depth image.

use super::block::WEIGHT_ONE;
use super::capacity::BYTES_PER_BLOCK;
use super::options::TsdfOptions;
use keyframe::DepthMap;
use kinematics::Transform;
use nalgebra::{Matrix4, Translation3, UnitQuaternion};
use numbers::quantile::{Rank, quantile};
use serde::{Deserialize, Serialize};

/// Range of automatically chosen voxel sizes, meters. It protects against a first image that is not
/// typical of the scene, such as one that is almost covered by a near object.
const VOXEL_RANGE_M: [f64; 2] = [0.001, 0.2];
/// Minimum truncation in voxels. With fewer voxels, interpolation lacks observed voxels on both
/// sides of slanted surfaces. With more voxels, the two sides of thicker objects share voxels.
const TRUNCATION_VOXELS: f64 = 4.0;
/// Maximum factor by which depth noise increases the truncation. A stored distance has 16 bits for
/// the range up to the largest truncation, so a larger factor makes its resolution coarser.
const MAX_TRUNCATION_FACTOR: f64 = 4.0;
/// Fraction of `max_bytes` that the surface in one image may take when the voxel size is chosen.
/// The scene is larger than one image. A smaller fraction makes voxels coarser than necessary. With
/// a larger fraction, more blocks have to be moved to host memory.
const ONE_IMAGE_FRAC: f64 = 0.1;

/// Voxel size and related settings of a field.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct VoxelGrid {
    /// Edge of a voxel, meters.
    pub voxel_m: f64,
    /// Minimum truncation, meters.
    pub truncation_m: f64,
    /// Maximum truncation, meters. This is also the distance that the largest stored number
    /// represents.
    pub scale_m: f64,
    /// Standard deviation of depth at 1 m, meters.
    pub noise_per_m2: f64,
    /// Readings beyond this depth are ignored, meters.
    pub max_depth_m: f64,
    /// Maximum weight of a voxel, in 256ths.
    pub max_weight: u32,
    /// Origin of the field's coordinates, in world coordinates, meters. It is near the first
    /// camera, where f32 is precise.
    pub anchor_m: [f64; 3],
}

impl VoxelGrid {
    /// Chooses the settings that the options leave open, based on the first depth image. Returns
    /// `None` if the image has no valid readings.
    ///
    /// The voxel size is the largest of three sizes: the size of a pixel at the median depth, the
    /// noise at this depth, and the size at which the surface in this image takes a tenth of
    /// `max_bytes`. The noise is the deviation of depth from a plane through its neighbors. It is
    /// estimated as the 90th percentile of `|z[-1] - 2 z[0] + z[1]|`, divided by `1.6449 sqrt(6)`.
    /// The median would be 0 for sensors that report depth in discrete steps.
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "a weight is clamped to 16 bits"
    )]
    pub fn choose(options: &TsdfOptions, max_bytes: Option<u64>, depth: &DepthMap) -> Option<Self> {
        let mut depths: Vec<f64> = valid_depths(options, depth).map(|(_, z)| z).collect();
        let n_valid = depths.len();
        let median_m = quantile(&mut depths, 0.5, Rank::Upper)?;
        let noise_per_m2 =
            positive(options.noise_per_m2).unwrap_or_else(|| noise_per_m2(options, depth));
        let px_m = median_m / (0.5 * (depth.focal_px[0] + depth.focal_px[1]));
        let by_noise_m = noise_per_m2 * median_m * median_m;
        // A surface of n pixels has n (px / voxel)^2 voxels, and its truncation band has about a
        // 16th as many blocks.
        let area_m2 = n_valid as f64 * px_m * px_m;
        let by_bytes_m = max_bytes.map_or(0.0, |bytes| {
            let n_blocks = ONE_IMAGE_FRAC * bytes as f64 / BYTES_PER_BLOCK as f64;
            (area_m2 / (16.0 * n_blocks.max(1.0))).sqrt()
        });
        // The coarsest of the three sizes is used, because voxels that are finer than a pixel or
        // than the noise store no additional detail.
        let chosen_grid = px_m
            .max(by_noise_m)
            .max(by_bytes_m)
            .clamp(VOXEL_RANGE_M[0], VOXEL_RANGE_M[1]);
        // The size is rounded up to a multiple of 0.5 mm, so that nearly equal first images give
        // the same grid.
        let voxel_m = positive(options.voxel_m).unwrap_or_else(|| (chosen_grid * 2e3).ceil() / 2e3);
        let truncation_m = positive(options.truncation_m)
            .unwrap_or(TRUNCATION_VOXELS * voxel_m)
            // Weights fall off between one voxel behind the surface and the truncation, so the
            // truncation must be larger than a voxel.
            .max(2.0 * voxel_m);
        // The anchor is a multiple of the width of a chunk (8 blocks of 8 voxels). Fields with the
        // same voxel size then have the same chunks, wherever they begin.
        let chunk_m = 64.0 * voxel_m;
        let anchor = depth
            .world_from_camera
            .translation
            .vector
            .map(|along| (along / chunk_m).round() * chunk_m);
        let voxel_grid = Self {
            voxel_m,
            truncation_m,
            scale_m: MAX_TRUNCATION_FACTOR * truncation_m,
            noise_per_m2,
            max_depth_m: options.max_depth_m,
            max_weight: (options.max_weight * WEIGHT_ONE).clamp(1.0, 65_535.0) as u32,
            anchor_m: anchor.into(),
        };
        log::info!(
            "tsdf: voxels of {:.1} mm, truncation {:.1} mm, depth noise {:.2} mm at 1 m (median depth {median_m:.2} m)",
            1e3 * voxel_m,
            1e3 * truncation_m,
            1e3 * noise_per_m2
        );
        Some(voxel_grid)
    }

    /// Transform to meters from the anchor along the world's axes.
    pub fn field_from_world(&self) -> Transform {
        let [x, y, z] = self.anchor_m;
        Transform::from_parts(Translation3::new(-x, -y, -z), UnitQuaternion::identity())
    }

    /// Maps positions in voxels from the anchor to world coordinates in meters.
    pub(crate) fn world_from_voxels(&self) -> Matrix4<f64> {
        Matrix4::new_translation(&self.anchor_m.into()) * Matrix4::new_scaling(self.voxel_m)
    }
}

fn positive(given: Option<f64>) -> Option<f64> {
    given.filter(|value| value.is_finite() && *value > 0.0)
}

/// Index and depth of the valid pixels.
fn valid_depths<'a>(
    options: &'a TsdfOptions,
    depth: &'a DepthMap,
) -> impl Iterator<Item = (usize, f64)> + 'a {
    let depths = depth.depth_m.iter().map(|z| f64::from(*z)).enumerate();
    depths.filter(|(_, z)| *z > 0.01 && *z <= options.max_depth_m)
}

/// Depth at an index. `None` outside the image or if the reading is invalid.
fn valid_depth(options: &TsdfOptions, depth: &DepthMap, ix: usize) -> Option<f64> {
    depth
        .depth_m
        .get(ix)
        .map(|z| f64::from(*z))
        .filter(|z| *z > 0.01 && *z <= options.max_depth_m)
}

/// Standard deviation of depth at 1 m, estimated from second differences along rows. See
/// [`VoxelGrid::choose`].
fn noise_per_m2(options: &TsdfOptions, depth: &DepthMap) -> f64 {
    let width = depth.size_px[0] as usize;
    let at = |ix: usize| valid_depth(options, depth, ix);
    // Neighbors must be in the same row. Noise of depth cameras grows with the square of depth, so
    // dividing by the square makes all readings comparable.
    let mut second_differences: Vec<f64> = valid_depths(options, depth)
        .filter(|(ix, _)| ix % width > 0 && ix % width + 1 < width)
        .filter_map(|(ix, z)| Some((at(ix - 1)? - 2.0 * z + at(ix + 1)?).abs() / (z * z)))
        .collect();
    // 1.6449 is the 90th percentile of the absolute value of a standard normal variable. The
    // coefficients 1, -2 and 1 have a sum of squares of 6.
    quantile(&mut second_differences, 0.9, Rank::Upper).unwrap_or(0.0) / (1.6449 * 6.0f64.sqrt())
}
