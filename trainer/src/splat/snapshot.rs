//! The state of training that a rejected trial restores.

use super::buffers::SplatBuffers;
use super::seed::Seeder;
use crate::gpu::Buffer;
use calibration::ParamSet;

/// The state that training changes, for restoring it later. No keyframe is waiting for its splats when it is taken.
#[derive(Debug)]
pub(crate) struct Snapshot {
    pub(super) splats: SplatBuffers,
    pub(super) cameras: (ParamSet, Buffer),
    pub(super) step: u64,
    pub(super) last_growth_step: u64,
    pub(super) seeding: Seeding,
}

/// State that an arriving keyframe changes: seeded positions, and the scale and schedule of training.
#[derive(Clone, Debug)]
pub(crate) struct Seeding {
    pub(super) seeder: Seeder,
    pub(super) scene_size_m: f64,
    pub(super) has_depth: bool,
    pub(super) schedule_start: u64,
}
