//! The state of training that a rejected trial restores.

use super::buffers::SplatBuffers;
use super::schedule::Schedule;
use super::seed::Seeder;
use crate::gpu::Buffer;
use calibration::ParamSet;

/// The state that training changes, for restoring it later. No keyframe is waiting for its splats when it is taken.
#[derive(Debug)]
pub(crate) struct Snapshot {
    pub(super) splats: SplatBuffers,
    pub(super) cameras: (ParamSet, Buffer),
    pub(super) schedule: Schedule,
    pub(super) scene: ObservedScene,
}

/// What the keyframes so far show of the scene.
#[derive(Clone, Debug)]
pub(crate) struct ObservedScene {
    /// Positions that have splats.
    pub(super) seeder: Seeder,
    /// Scale of the scene.
    pub(super) size_m: f64,
    /// Whether any keyframe has depth.
    pub(super) has_depth: bool,
}

impl Default for ObservedScene {
    fn default() -> Self {
        Self { seeder: Seeder::default(), size_m: 1.0, has_depth: false }
    }
}
