//! Errors of the GPU.

use messages::Setting;

/// An error of the GPU, or of a kernel.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// No GPU adapter, real or software, was found.
    #[error(
        "no GPU adapter found: install a Vulkan driver (software: the package mesa-vulkan-drivers)"
    )]
    NoAdapter,
    /// The requested adapter does not exist.
    #[error("no GPU with index {ix}: found {n_adapters} adapters, numbered from 0")]
    NoSuchAdapter {
        /// Requested index, from 0.
        ix: usize,
        /// Number of adapters found.
        n_adapters: usize,
    },
    /// The adapter could not open a device.
    #[error("cannot open a device on GPU {adapter:?}")]
    NoDevice {
        /// Name of the adapter.
        adapter: String,
        /// Cause.
        source: wgpu::RequestDeviceError,
    },
    /// The GPU stopped answering.
    #[error("the GPU stopped answering: its driver reset or lost the device")]
    DeviceLost,
    /// The GPU has no memory left for a buffer or for commands. For commands, `label` is empty and
    /// `bytes` is 0.
    #[error(
        "the GPU ran out of memory{}; close other programs that use it, use smaller images, or train a smaller model ({} or {} of `fieldrig train` and `run`)",
        buffer_suffix(label, *bytes),
        Setting::MaxSplats,
        Setting::MaxBytes
    )]
    OutOfMemory {
        /// Name of the buffer.
        label: String,
        /// Requested size, bytes.
        bytes: u64,
    },
    /// The driver failed to execute a valid command.
    #[error("the GPU's driver failed: {0}")]
    DriverFailed(String),
    /// A bug: this program sent an invalid command to the GPU. Another device would not help, so
    /// this is not a [GPU error](Self::is_gpu_error).
    #[error("internal error: {0}; this is a bug in fieldrig, please report it")]
    Internal(String),
    /// A buffer exceeds the adapter's limit.
    #[error(
        "buffer {label}: {bytes} bytes are more than this GPU can bind ({limit_bytes} bytes); use smaller images, or train a smaller model ({} or {} of `fieldrig train` and `run`)",
        Setting::MaxSplats,
        Setting::MaxBytes
    )]
    BufferTooLarge {
        /// Name of the buffer.
        label: String,
        /// Requested size, bytes.
        bytes: u64,
        /// Maximum size, bytes.
        limit_bytes: u64,
    },
    /// A kernel needs more workgroup memory than the adapter has.
    #[error(
        "kernel {kernel}: {bytes} bytes of workgroup memory are more than this GPU has ({limit_bytes} bytes)"
    )]
    WorkgroupTooLarge {
        /// Name of the kernel.
        kernel: &'static str,
        /// Required size, bytes.
        bytes: u32,
        /// Available size, bytes.
        limit_bytes: u32,
    },
    /// A kernel imports an unknown source.
    #[error("kernel {kernel}: unknown import {import:?}")]
    UnknownImport {
        /// Name of the kernel.
        kernel: &'static str,
        /// The import.
        import: String,
    },
    /// A kernel does not parse or validate.
    #[error("kernel {kernel}: {message}")]
    Wgsl {
        /// Name of the kernel.
        kernel: &'static str,
        /// Message of naga.
        message: String,
    },
}

impl Error {
    /// An [`Error::Internal`]. `what` is a clause without a period.
    pub(crate) fn internal(what: &str) -> Self {
        Self::Internal(what.to_owned())
    }

    /// Whether the GPU caused the error. If so, the same work may succeed on another device.
    #[must_use]
    pub fn is_gpu_error(&self) -> bool {
        matches!(
            self,
            Self::DeviceLost | Self::OutOfMemory { .. } | Self::DriverFailed(_)
        )
    }

    /// Whether a buffer of the requested size could not be allocated.
    #[must_use]
    pub fn is_out_of_memory(&self) -> bool {
        matches!(self, Self::OutOfMemory { .. } | Self::BufferTooLarge { .. })
    }
}

fn buffer_suffix(label: &str, bytes: u64) -> String {
    if bytes == 0 {
        String::new()
    } else {
        format!(": buffer {label} needs {bytes} bytes")
    }
}
