//! Options of a distance field.

use crate::model_options::MethodOptions;
use serde::{Deserialize, Serialize};

/// Options specific to a [`super::TsdfModel`]. Of the common options, only the maximum number of
/// bytes and the alignment are used. The seed has no effect, because nothing is random.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TsdfOptions {
    /// Edge of a voxel, meters. With `None`, it is chosen from the first depth image. See
    /// [`super::VoxelGrid::choose`].
    pub voxel_m: Option<f64>,
    /// Minimum truncation distance, meters. `None` selects four voxels.
    pub truncation_m: Option<f64>,
    /// Standard deviation of depth at 1 m, meters. The standard deviation grows with the square of
    /// depth. With `None`, it is estimated from the first depth image.
    pub noise_per_m2: Option<f64>,
    /// Readings beyond this depth are ignored, meters.
    pub max_depth_m: f64,
    /// Maximum weight of a voxel, up to 255. One observation from a distance of 1 m has a weight of
    /// 1. With a smaller maximum, moved objects fade sooner.
    pub max_weight: f64,
}

impl MethodOptions for TsdfOptions {
    const METHOD: &'static str = "tsdf";
}

impl Default for TsdfOptions {
    fn default() -> Self {
        Self {
            voxel_m: None,
            truncation_m: None,
            noise_per_m2: None,
            max_depth_m: 10.0,
            max_weight: 64.0,
        }
    }
}
