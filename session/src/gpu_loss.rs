//! Makes the GPU fail on purpose, to test recovery.

use gpu::Gpu;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, Ordering};

static AT_STEP: OnceLock<u64> = OnceLock::new();

/// Makes the device fail once, when a model of this process reaches the step. For tests.
pub fn lose_gpu_at_step(step: u64) {
    let _ = AT_STEP.set(step); // Only the first call has an effect.
}

/// Makes the device fail if [`lose_gpu_at_step`] requested it and the step is reached.
pub(crate) fn lose_when_due(gpu: &Gpu, step: u64) {
    static IS_LOST: AtomicBool = AtomicBool::new(false);
    if AT_STEP.get().is_some_and(|at_step| step >= *at_step)
        && !IS_LOST.swap(true, Ordering::Relaxed)
    {
        gpu.lose();
    }
}
