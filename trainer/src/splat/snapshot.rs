//! Snapshots of the training state, which is restored when a trial is rejected.

use super::buffers::SplatBuffers;
use super::schedule::Schedule;
use super::seed::Seeder;
use calibration::ParamSet;
use gpu::Buffer;

/// All state that training changes. A snapshot is only taken when every keyframe has been seeded.
#[derive(Debug)]
pub(crate) struct Snapshot {
    pub(super) splats: SplatBuffers,
    pub(super) cameras: (ParamSet, Buffer),
    pub(super) schedule: Schedule,
    pub(super) scene: ObservedScene,
}

/// Properties of the scene that are derived from the keyframes.
#[derive(Clone, Debug)]
pub(crate) struct ObservedScene {
    /// Seeded positions.
    pub(super) seeder: Seeder,
    /// Scale of the scene.
    pub(super) size_m: f64,
    /// Whether any keyframe has depth.
    pub(super) has_depth: bool,
}

impl Default for ObservedScene {
    fn default() -> Self {
        Self {
            seeder: Seeder::default(),
            size_m: 1.0,
            has_depth: false,
        }
    }
}
