//! Fusing depth images on the GPU.

use super::field_store::FieldStore;
use crate::Error;
use crate::tsdf::kernels::Pipelines;
use crate::tsdf::params::{DepthView, status};
use crate::tsdf::passes::{self, KeyframeSlot};
use gpu::{Gpu, Passes, Submits};
use keyframe::Keyframe;

/// Maximum number of keyframes per submit. Their images are on the GPU at the same time, so more
/// keyframes need more memory. With fewer keyframes, the GPU waits for the host more often.
pub(super) const KEYFRAMES_PER_SUBMIT: usize = 4;

/// Records and tracks submits of depth images.
#[derive(Debug)]
pub(super) struct Fusion {
    /// Buffers of the images of a submit.
    slots: Vec<KeyframeSlot>,
    pub(super) submits: Submits,
    /// Number of fused depth images when the GPU counters were last read.
    n_fused_on_gpu: u32,
    /// Number of readings whose surface is outside the range of block coordinates.
    pub(super) n_outside: u32,
}

impl Fusion {
    pub(super) fn new() -> Self {
        Self {
            slots: Vec::new(),
            submits: Submits::default(),
            n_fused_on_gpu: 0,
            n_outside: 0,
        }
    }

    /// Number of keyframes in a submit that stays within the time limit.
    pub(super) fn keyframes_per_submit(&self) -> usize {
        // Pictures wait for the running submit, so submits must be short while pictures are
        // requested. If no pictures are requested, a submit holds more images, so that less time is
        // lost between submits.
        match self.submits.n_steps_in_limit() {
            Some(n) if self.submits.is_watched() => usize::try_from(n)
                .unwrap_or(usize::MAX)
                .clamp(1, KEYFRAMES_PER_SUBMIT),
            _ => KEYFRAMES_PER_SUBMIT,
        }
    }

    /// Records the passes of a keyframe as step `slot_ix` of a submit.
    pub(super) fn record(
        &mut self,
        gpu: &Gpu,
        passes: &mut Passes,
        pipelines: &Pipelines,
        store: &FieldStore,
        keyframe: &Keyframe,
        slot_ix: usize,
    ) -> Result<(), Error> {
        let Some(depth_view) = DepthView::of(keyframe, &store.voxel_grid) else {
            return Ok(());
        };
        let [n_depth, n_color] = [depth_view.depth_size_px, depth_view.color_size_px]
            .map(|[width, height]| u64::from(width) * u64::from(height));
        if self
            .slots
            .get(slot_ix)
            .is_none_or(|slot| !slot.holds(n_depth, n_color))
        {
            passes.clear_bindings();
            let slot = KeyframeSlot::new(gpu, n_depth, n_color)?;
            // Later slots have the old size, too.
            self.slots.truncate(slot_ix);
            self.slots.push(slot);
        }
        let slot = &mut self.slots[slot_ix];
        slot.upload(gpu, keyframe, &depth_view);
        passes::fuse(gpu, passes, pipelines, &store.buffers, slot);
        Ok(())
    }

    /// Applies the counters of the GPU. Returns the number of keyframes fused since the last call.
    pub(super) fn apply_counters(&mut self, counters: &[u32]) -> u32 {
        let n_before = std::mem::replace(&mut self.n_fused_on_gpu, counters[status::N_FUSED]);
        self.n_outside = counters[status::N_OUTSIDE];
        self.n_fused_on_gpu.wrapping_sub(n_before)
    }
}
