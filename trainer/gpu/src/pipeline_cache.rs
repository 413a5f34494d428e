//! Compiled kernels, and the cache of a device.

use crate::Error;
use crate::wgsl::Binding;
use parking_lot::Mutex;
use std::collections::HashMap;
use std::sync::Arc;

/// A compiled kernel. Clones share the same pipeline on the GPU.
#[derive(Clone, Debug)]
pub struct Pipeline {
    pub(super) id: u64,
    pub(super) name: &'static str,
    pub(super) raw: wgpu::ComputePipeline,
    pub(super) layout: wgpu::BindGroupLayout,
    pub(super) bindings: Arc<[Binding]>,
}

/// Everything that distinguishes one pipeline from another on the same device.
#[derive(Debug, PartialEq, Eq, Hash)]
pub(super) struct Key {
    /// WGSL with all imports.
    text: String,
    /// Names and bits of the `override`s.
    overrides: Vec<(String, u64)>,
}

impl Key {
    pub(super) fn new(text: String, overrides: &[(&str, f64)]) -> Self {
        // The key contains the bits, because f64 has no `Eq`.
        let bits = overrides
            .iter()
            .map(|(name, value)| ((*name).to_owned(), value.to_bits()));
        Self {
            text,
            overrides: bits.collect(),
        }
    }
}

/// The pipelines of one device. Each is compiled once, on first use, and kept as long as the
/// device. A second model, or a model that is loaded again, therefore starts in milliseconds
/// instead of seconds.
#[derive(Debug, Default)]
pub(super) struct PipelineCache(Mutex<HashMap<Key, Arc<Mutex<Option<Pipeline>>>>>);

impl PipelineCache {
    /// The pipeline with this key. Compiles the pipeline if it is missing. Callers with the same
    /// key wait for each other. Callers with different keys do not wait.
    pub(super) fn get_or_compile(
        &self,
        key: Key,
        compile: impl FnOnce() -> Result<Pipeline, Error>,
    ) -> Result<Pipeline, Error> {
        // The map is locked only to find the slot. The slot is locked while compiling. Other
        // kernels can therefore be compiled at the same time, and the same kernel is not compiled
        // twice.
        let slot = Arc::clone(self.0.lock().entry(key).or_default());
        let mut slot = slot.lock();
        if let Some(compiled) = &*slot {
            return Ok(compiled.clone());
        }
        // If this fails, the slot stays empty. The next caller then gets the same error.
        let compiled = compile()?;
        Ok(slot.insert(compiled).clone())
    }

    /// Number of compiled pipelines.
    #[cfg(test)]
    pub(super) fn len(&self) -> usize {
        self.0
            .lock()
            .values()
            .filter(|slot| slot.lock().is_some())
            .count()
    }
}
