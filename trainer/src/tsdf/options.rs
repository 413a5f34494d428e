//! Options of a distance field.

use serde::{Deserialize, Serialize};

/// Settings of a [`super::TsdfModel`]. Nothing is random, so there is no seed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TsdfOptions {
    /// Edge of a voxel, meters; `None`: chosen from the first depth image, see [`super::VoxelGrid::choose`].
    pub voxel_m: Option<f64>,
    /// Minimum truncation distance, meters; `None`: four voxels.
    pub truncation_m: Option<f64>,
    /// Standard deviation of depth at 1 m, meters; it grows with the square of depth. `None`: estimated from the first
    /// depth image.
    pub noise_per_m2: Option<f64>,
    /// Readings beyond this depth are ignored, meters.
    pub max_depth_m: f64,
    /// Maximum weight of a voxel, in observations from 1 m; up to 255. With a smaller maximum, moved objects fade
    /// sooner.
    pub max_weight: f64,
    /// Maximum GPU memory for blocks and their table, in bytes. When it is used up, the blocks farthest from the camera
    /// move to host memory. (Growth of the table after that point is added on top.)
    pub max_bytes: Option<u64>,
}

impl Default for TsdfOptions {
    fn default() -> Self {
        Self {
            voxel_m: None,
            truncation_m: None,
            noise_per_m2: None,
            max_depth_m: 10.0,
            max_weight: 64.0,
            max_bytes: None,
        }
    }
}
