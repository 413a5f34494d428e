//! Errors of the trainer.

use keyframe::Keyframe;
use std::path::PathBuf;
use std::sync::Arc;

/// An error of the trainer.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// Calibration failed.
    #[error(transparent)]
    Calibration(#[from] calibration::Error),
    /// A keyframe is inconsistent.
    #[error(transparent)]
    Keyframe(#[from] keyframe::Error),
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
    /// The GPU has no memory left for a buffer, or for commands; for commands, `label` is empty and
    /// `bytes` is 0.
    #[error(
        "the GPU ran out of memory{}; close other programs that use it, use smaller images, or train a smaller model (--max-splats or --max-bytes of `fieldrig train` and `run`)",
        buffer_suffix(label, *bytes)
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
    /// A bug in this program: its state contradicts itself, or it gave the GPU an invalid command.
    /// Another device would not help, so this is not a [GPU error](Self::is_gpu_error).
    #[error("internal error: {0}; this is a bug in fieldrig, please report it")]
    Internal(String),
    /// A buffer exceeds the adapter's limit.
    #[error(
        "buffer {label}: {bytes} bytes are more than this GPU can bind ({limit_bytes} bytes); use smaller images, or train a smaller model (--max-splats or --max-bytes of `fieldrig train` and `run`)"
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
    /// The memory budget is below the minimum of the method.
    #[error("max_bytes = {max_bytes}: the smallest {model} takes {min_bytes} bytes")]
    BudgetTooSmall {
        /// Name of the method's model.
        model: &'static str,
        /// Budget, bytes.
        max_bytes: u64,
        /// Minimum, bytes.
        min_bytes: u64,
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
    /// A picture does not have four bytes per pixel.
    #[error("{what} picture of {width}x{height} pixels: got {got} bytes, expected {expected}")]
    PictureBytes {
        /// Which picture: `rendered` or `true`.
        what: &'static str,
        /// Width, pixels.
        width: u32,
        /// Height, pixels.
        height: u32,
        /// Actual size, bytes.
        got: usize,
        /// Expected size, bytes.
        expected: usize,
    },
    /// A metric needs larger pictures.
    #[error("{metric} needs pictures of at least {min_px}x{min_px} pixels, got {width}x{height}")]
    PictureTooSmall {
        /// The metric.
        metric: &'static str,
        /// Minimum side length, pixels.
        min_px: u32,
        /// Width, pixels.
        width: u32,
        /// Height, pixels.
        height: u32,
    },
    /// Every pixel, or every window, is masked.
    #[error("nothing to compare: all pixels are masked")]
    AllPixelsMasked,
    /// Two depth images differ in size.
    #[error("rendered depth has {rendered} pixels, true depth {truth}")]
    DepthSizeMismatch {
        /// Number of pixels of the rendered image.
        rendered: usize,
        /// Number of pixels of the true image.
        truth: usize,
    },
    /// A file cannot be read.
    #[error("cannot read {path:?}")]
    Read {
        /// The file.
        path: PathBuf,
        /// Cause.
        source: std::io::Error,
    },
    /// A file cannot be written.
    #[error("cannot write {path:?}")]
    Write {
        /// The file.
        path: PathBuf,
        /// Cause.
        source: std::io::Error,
    },
    /// LPIPS was requested, but this program was built without it.
    #[error("this program was built without LPIPS (cargo feature `lpips`)")]
    LpipsNotBuilt,
    /// A file does not contain valid LPIPS weights.
    #[cfg(feature = "lpips")]
    #[error("{path:?} does not hold LPIPS weights for SqueezeNet: {source}")]
    LpipsWeights {
        /// The file.
        path: PathBuf,
        /// Cause.
        source: Box<candle_core::Error>,
    },
    /// The LPIPS network failed.
    #[cfg(feature = "lpips")]
    #[error("LPIPS network failed")]
    LpipsNetwork(#[source] Box<candle_core::Error>),
    /// A splat file or the metadata of a model is invalid.
    #[error("cannot parse {path:?}: {reason}")]
    SplatFile {
        /// The file.
        path: PathBuf,
        /// Description of the problem.
        reason: String,
    },
    /// A file is not a checkpoint, or it is incomplete, damaged or of another version.
    #[error("cannot read checkpoint {path:?}: {reason}")]
    Checkpoint {
        /// The file.
        path: PathBuf,
        /// Description of the problem.
        reason: String,
    },
    /// A complete checkpoint has an invalid or unknown state.
    #[error("invalid state in the checkpoint: {reason}")]
    CheckpointState {
        /// Description of the problem.
        reason: String,
    },
    /// A checkpoint belongs to different keyframes.
    #[error("the checkpoint belongs to different data: {0}")]
    CheckpointData(String),
    /// Keyframes that a checkpoint needs are missing.
    #[error(
        "the checkpoint belongs to different data: {} of its images {} missing, the first is image {} of camera {:?}",
        .placeholders.len(), if .placeholders.len() == 1 { "is" } else { "are" }, .placeholders[0].stamp.0, .placeholders[0].camera
    )]
    MissingKeyframes {
        /// Keyframes without pixels that stand for the missing ones, at least one.
        placeholders: Vec<Arc<Keyframe>>,
    },
    /// No registered method has this name.
    #[error("unknown method {name:?}")]
    UnknownMethod {
        /// The name.
        name: String,
    },
    /// The options of a model are invalid.
    #[error("invalid options for the method {method}: {reason}")]
    InvalidOptions {
        /// Name of the method.
        method: &'static str,
        /// Description of the problem.
        reason: String,
    },
    /// The `model.json` of a saved model is invalid.
    #[error("{} is damaged", path.display())]
    ModelMetadata {
        /// The file.
        path: PathBuf,
        /// Cause.
        source: serde_json::Error,
    },
    /// The method of a saved model cannot be determined.
    #[error("{} is not a model of a known method", path.display())]
    UnknownModel {
        /// Folder or file.
        path: PathBuf,
    },
    /// Splats cannot be read.
    #[error("cannot read splats from {}{hint}", path.display())]
    NoSplats {
        /// Folder or file.
        path: PathBuf,
        /// Suggested action, which completes the sentence.
        hint: &'static str,
        /// Cause.
        source: Box<Self>,
    },
    /// A mesh has no triangles left after simplification.
    #[error("no triangles are left at a cell width of {cell_m} m")]
    EmptyMesh {
        /// Width of a cell, meters.
        cell_m: f64,
    },
    /// A model has the maximum number of edits.
    #[error("a model has at most {max_edits} edits; undo one first")]
    TooManyEdits {
        /// The maximum.
        max_edits: usize,
    },
    /// An edit has values that kernels cannot compute with.
    #[error("invalid edit: {reason}")]
    InvalidEdit {
        /// Values found and expected.
        reason: String,
    },
    /// A model has no edit that could be undone.
    #[error("there is nothing to undo")]
    NothingToUndo,
    /// No part of a model is small and unconnected.
    #[error("no floaters found: every part of the model is connected to a large part")]
    NoFloaters,
    /// The method cannot find floaters.
    #[error("floaters can be removed only from splats and distance fields; erase a box instead")]
    CannotFindFloaters,
    /// Arrays of splats are inconsistent.
    #[error("splats: {0}")]
    SplatArrays(String),
}

impl Error {
    /// An [`Error::Internal`]; `what` is a clause without a period.
    pub(crate) fn internal(what: &str) -> Self {
        Self::Internal(what.to_owned())
    }

    /// Whether the GPU caused the error. If so, the same work may succeed on another device.
    pub fn is_gpu_error(&self) -> bool {
        matches!(
            self,
            Self::DeviceLost | Self::OutOfMemory { .. } | Self::DriverFailed(_)
        )
    }

    /// Whether a buffer of the requested size could not be allocated.
    pub(crate) fn is_out_of_memory(&self) -> bool {
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
