//! Opens the GPU with the settings from environment variables.

use crate::allocator;
use gpu::{Gpu, GpuOptions};
use messages::BadInput;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Once};

/// Opens the GPU. `FIELDRIG_GPU` selects one of several GPUs. `FIELDRIG_GPU_FEATURES=none` disables
/// all optional features, and `no-matrices` disables only cooperative matrices.
pub(crate) fn open_gpu() -> anyhow::Result<Arc<Gpu>> {
    let features = std::env::var_os("FIELDRIG_GPU_FEATURES");
    let [optional_features, matrices] =
        ["none", "no-matrices"].map(|word| features.as_ref().is_none_or(|value| value != word));
    let adapter =
        match std::env::var("FIELDRIG_GPU") {
            Ok(text) => Some(text.parse().map_err(|_| {
                BadInput(format!("FIELDRIG_GPU: {text:?} is not the number of a GPU"))
            })?),
            Err(_) => None,
        };
    // The hook is installed before the GPU is used, because a lost device can be detected at any
    // time after that.
    hide_caught_panics();
    check_open_for_tests()?;
    // For tests: loses the GPU once, when a model reaches this step.
    if let Some(step) = std::env::var("FIELDRIG_TEST_LOSE_GPU_AT_STEP")
        .ok()
        .and_then(|text| text.parse().ok())
    {
        session::lose_gpu_at_step(step);
    }
    // For tests: limits GPU memory.
    let memory_limit_bytes = std::env::var("FIELDRIG_TEST_GPU_BYTES")
        .ok()
        .and_then(|text| text.parse().ok());
    let gpu = Gpu::open(&GpuOptions {
        optional_features,
        matrices,
        memory_limit_bytes,
        adapter,
        ..GpuOptions::default()
    })?;
    if gpu.is_software() {
        allocator::keep_images_out_of_heaps();
    }
    Ok(gpu)
}

/// Hides the message of one panic: wgpu panics if it detects a lost device while waiting, and
/// fieldrig catches this panic.
fn hide_caught_panics() {
    static IS_SET: Once = Once::new();
    IS_SET.call_once(|| {
        let before = std::panic::take_hook();
        std::panic::set_hook(Box::new(move |info| {
            if !info
                .payload_as_str()
                .is_some_and(|message| message.starts_with("Error in Device::poll"))
            {
                before(info);
            }
        }));
    });
}

/// For tests: with `FIELDRIG_TEST_OPEN_GPU_ONCE` set, the GPU can be opened only once.
fn check_open_for_tests() -> Result<(), gpu::Error> {
    static IS_OPENED: AtomicBool = AtomicBool::new(false);
    let was_opened = IS_OPENED.swap(true, Ordering::Relaxed);
    if was_opened && std::env::var_os("FIELDRIG_TEST_OPEN_GPU_ONCE").is_some() {
        return Err(gpu::Error::NoAdapter);
    }
    Ok(())
}
