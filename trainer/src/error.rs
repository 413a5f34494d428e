//! What can go wrong in training.

use std::path::PathBuf;

/// Errors of the trainer.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// Our own bug: the thread that aligned keyframes ended early.
    #[error("the alignment of keyframes did not end")]
    AlignmentPanicked,
    /// No GPU, real or software, answers.
    #[error("no GPU adapter found: install a Vulkan driver (software: the package mesa-vulkan-drivers)")]
    NoAdapter,
    /// The adapter that was asked for is not there.
    #[error("there is no GPU {ix}: {n_adapters} are there, counted from 0")]
    NoSuchAdapter {
        /// Counted from 0.
        ix: usize,
        /// How many there are.
        n_adapters: usize,
    },
    /// The adapter is there but refuses a device.
    #[error("GPU {adapter:?} refuses a device")]
    NoDevice {
        /// Name of the adapter.
        adapter: String,
        /// Why.
        source: wgpu::RequestDeviceError,
    },
    /// The GPU stopped answering.
    #[error("the GPU stopped answering: its driver reset or lost the device")]
    DeviceLost,
    /// The GPU has no memory left for a buffer, or for commands or a transfer; these have no name and no size.
    #[error(
        "the GPU ran out of memory{}; close other programs that use it, or lower --max-splats, --max-bytes or the image size",
        buffer_suffix(label, *bytes)
    )]
    OutOfMemory {
        /// Name of the buffer.
        label: String,
        /// Requested size, bytes.
        bytes: u64,
    },
    /// The GPU rejected a command, because of a bug in this program or in the driver.
    #[error("the GPU rejected a command: {0}")]
    Rejected(String),
    /// A buffer past the adapter's limit.
    #[error(
        "buffer {label}: {bytes} bytes are more than this GPU can bind ({limit_bytes} bytes); lower --max-splats, --max-bytes or the image size"
    )]
    BufferTooLarge {
        /// Name of the buffer.
        label: String,
        /// Bytes wanted.
        bytes: u64,
        /// Bytes allowed.
        limit_bytes: u64,
    },
    /// A kernel needs more memory of a workgroup than the adapter has.
    #[error("kernel {kernel}: {bytes} bytes of workgroup memory are more than this GPU has ({limit_bytes} bytes)")]
    WorkgroupTooLarge {
        /// Name of the kernel.
        kernel: &'static str,
        /// Bytes wanted.
        bytes: u32,
        /// Bytes there are.
        limit_bytes: u32,
    },
    /// Less memory than the smallest model of the method takes.
    #[error("max_bytes = {max_bytes}: the smallest {model} takes {min_bytes} bytes")]
    BudgetTooSmall {
        /// The method's model, in words.
        model: &'static str,
        /// Bytes allowed.
        max_bytes: u64,
        /// Bytes needed.
        min_bytes: u64,
    },
    /// A kernel imports what is not there.
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
        /// What naga says.
        message: String,
    },
    /// A picture does not hold four bytes a pixel.
    #[error("{what} picture of {width}x{height} pixels: got {got} bytes, expected {expected}")]
    PictureBytes {
        /// Which of the two.
        what: &'static str,
        /// Width, pixels.
        width: u32,
        /// Height, pixels.
        height: u32,
        /// Bytes it holds.
        got: usize,
        /// Bytes it should hold.
        expected: usize,
    },
    /// A metric needs larger pictures.
    #[error("{metric} needs pictures of at least {min_px}x{min_px} pixels, got {width}x{height}")]
    PictureTooSmall {
        /// The metric.
        metric: &'static str,
        /// Shortest side it takes, pixels.
        min_px: u32,
        /// Width, pixels.
        width: u32,
        /// Height, pixels.
        height: u32,
    },
    /// Every pixel, or every window, is masked.
    #[error("nothing to compare: the mask leaves no pixel")]
    AllPixelsMasked,
    /// Two depth images differ in size.
    #[error("rendered depth has {rendered} pixels, true depth {truth}")]
    DepthSizeMismatch {
        /// Pixels of the rendered one.
        rendered: usize,
        /// Pixels of the true one.
        truth: usize,
    },
    /// A file cannot be read.
    #[error("cannot read {path:?}")]
    Read {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// A file cannot be written.
    #[error("cannot write {path:?}")]
    Write {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// A file does not hold the weights of LPIPS.
    #[error("{path:?} does not hold LPIPS weights for SqueezeNet: {source}")]
    LpipsWeights {
        /// The file.
        path: PathBuf,
        /// What is missing or wrong.
        source: candle_core::Error,
    },
    /// The network of LPIPS failed.
    #[error("LPIPS network failed")]
    LpipsNetwork(#[source] candle_core::Error),
    /// A file of splats is not what it should be.
    #[error("{path:?} is not a splat file we read: {reason}")]
    SplatFile {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// A file is no checkpoint, not a whole one, or of another version.
    #[error("{path:?} is no checkpoint to go on from: {reason}")]
    Checkpoint {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// A whole checkpoint holds a state that this program does not know.
    #[error("the checkpoint holds no state to go on from: {reason}")]
    CheckpointState {
        /// What is wrong.
        reason: String,
    },
    /// A checkpoint belongs to other keyframes.
    #[error("the checkpoint is of other data: {0}")]
    CheckpointData(String),
    /// Arrays of splats do not fit together.
    #[error("splats: {0}")]
    SplatArrays(String),
}

impl Error {
    /// Whether the GPU caused the error: on another device the same work may succeed.
    pub fn is_gpu_error(&self) -> bool {
        matches!(self, Self::DeviceLost | Self::OutOfMemory { .. } | Self::Rejected(_))
    }

    /// Whether there is no memory for a buffer of the requested size.
    pub(crate) fn is_out_of_memory(&self) -> bool {
        matches!(self, Self::OutOfMemory { .. } | Self::BufferTooLarge { .. })
    }
}

fn buffer_suffix(label: &str, bytes: u64) -> String {
    if bytes == 0 { String::new() } else { format!(": buffer {label} needs {bytes} bytes") }
}
