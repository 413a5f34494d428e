//! The fused and the pending keyframes of a field.

use crate::keyframe_signature::KeyframeSignature;
use keyframe::Keyframe;
use kinematics::Stamp;
use std::collections::VecDeque;
use std::sync::Arc;

/// Keyframes in the order in which they are fused.
#[derive(Debug, Default)]
pub(super) struct KeyframeQueue {
    /// Keyframes that are not confirmed as fused yet, in order. The first of them may be in flight.
    pub(super) pending: VecDeque<Arc<Keyframe>>,
    /// Keyframes that were fused or skipped, and not removed afterwards.
    pub(super) fused: Vec<KeyframeSignature>,
    /// Number of keyframes that were removed after they had been fused.
    pub(super) n_removed: u64,
    /// Pending keyframes of a loaded checkpoint that were not provided.
    pub(super) unmatched: Vec<KeyframeSignature>,
    /// Number of keyframes that were skipped because they observe more blocks than fit into memory.
    pub(super) n_skipped: u64,
}

impl KeyframeQueue {
    /// Number of keyframes that were fused or skipped.
    pub(super) fn step(&self) -> u64 {
        self.fused.len() as u64 + self.n_removed
    }

    /// Removes a keyframe. If it was fused, its effect on the field stays, but resuming does not
    /// need the keyframe.
    pub(super) fn remove(&mut self, camera: &str, stamp: Stamp) {
        self.pending
            .retain(|keyframe| keyframe.camera.as_ref() != camera || keyframe.stamp != stamp);
        let n_before = self.fused.len();
        self.fused
            .retain(|signature| !signature.is_of(camera, stamp));
        // Removed keyframes still count as steps, because the field contains them.
        self.n_removed += (n_before - self.fused.len()) as u64;
    }

    /// Marks the first pending keyframe as fused.
    pub(super) fn complete_first(&mut self) {
        self.fused.extend(
            self.pending
                .pop_front()
                .map(|keyframe| KeyframeSignature::of(&keyframe)),
        );
    }

    /// Skips the first pending keyframe, which observes more than the `max_blocks` voxel blocks
    /// that fit into memory.
    pub(super) fn skip_first(&mut self, max_blocks: u32) {
        self.n_skipped += 1;
        log::warn!(
            "tsdf: skipped an image that observes more than the {max_blocks} voxel blocks that fit into memory"
        );
        self.complete_first();
    }
}
