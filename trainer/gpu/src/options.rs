//! Options for opening a GPU.

/// Selects the adapter to open, and limits the use of its features and memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct GpuOptions {
    /// Whether optional features of the adapter may be used.
    pub optional_features: bool,
    /// Whether cooperative matrices may be used.
    pub matrices: bool,
    /// Lowers the maximum size of a binding, bytes. This is for tests of buffer limits.
    pub max_binding_bytes: Option<u64>,
    /// Maximum total size of all storage buffers, bytes. This is for tests of running out of
    /// memory.
    pub memory_limit_bytes: Option<u64>,
    /// Index into [`Gpu::adapters`](crate::Gpu::adapters). `None` selects the fastest adapter.
    pub adapter: Option<usize>,
}

impl Default for GpuOptions {
    fn default() -> Self {
        Self {
            optional_features: true,
            matrices: true,
            max_binding_bytes: None,
            memory_limit_bytes: None,
            adapter: None,
        }
    }
}
