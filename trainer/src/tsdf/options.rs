//! How a distance field is built.

use serde::{Deserialize, Serialize};

/// Settings of a [`super::TsdfModel`]. Nothing is random, so there is no seed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TsdfOptions {
    /// Edge of a voxel, metres; `None`: from the first depth image, see [`super::VoxelGrid::choose`].
    pub voxel_m: Option<f64>,
    /// Least distance from a surface that is kept, metres; `None`: four voxels.
    pub truncation_m: Option<f64>,
    /// Standard deviation of depth at 1 m, metres; it grows with the square. `None`: from the first depth image.
    pub noise_per_m2: Option<f64>,
    /// Depth beyond this is not believed, metres.
    pub max_depth_m: f64,
    /// Most weight a voxel has, in looks from 1 m; the smaller, the sooner moved things fade. Up to 255.
    pub max_weight: f64,
    /// Most bytes of GPU memory that blocks and the table that finds them may take; past them blocks furthest from the camera wait in
    /// host memory. (What the table grows by once all room is taken comes on top.)
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
