//! The GPU and the passes of the next submit.

use gpu::{Gpu, Passes};
use std::sync::Arc;

/// Records passes for the GPU.
#[derive(Debug)]
pub(super) struct Recorder {
    pub(super) gpu: Arc<Gpu>,
    pub(super) passes: Passes,
}

impl Recorder {
    pub(super) fn new(gpu: Arc<Gpu>) -> Self {
        Self {
            gpu,
            passes: Passes::default(),
        }
    }

    /// Submits the recorded passes.
    pub(super) fn submit(&mut self) {
        self.passes.submit(&self.gpu);
    }

    /// Submits the recorded passes and releases their buffers, which may then be replaced.
    pub(super) fn submit_and_release_buffers(&mut self) {
        self.submit();
        self.passes.clear_bindings();
    }
}
