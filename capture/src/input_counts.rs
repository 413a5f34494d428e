//! Counts of a running input, which the run reads while the input thread runs.

use crate::join::{Join, StoreUse};

/// What happened to the images of an input so far, and how full its store of keyframes is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct InputCounts {
    /// Color images that arrived.
    pub images: u64,
    /// Color images dropped by devices or queues. They did not arrive.
    pub dropped: u64,
    /// Images that became keyframes.
    pub accepted: u64,
    /// Keyframes evicted from the full store.
    pub evicted: u64,
    /// The store of keyframes.
    pub store: StoreUse,
}

impl InputCounts {
    pub(crate) fn of(join: &Join) -> Self {
        let counts = join.counts();
        Self {
            images: counts.images,
            dropped: counts.color_skipped,
            accepted: counts.accepted,
            evicted: counts.evicted,
            store: join.store_use(),
        }
    }
}
