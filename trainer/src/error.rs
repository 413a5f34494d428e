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
    /// A file of a model is invalid or cannot be accessed, or an edit is not allowed.
    #[error(transparent)]
    ModelFile(#[from] model_files::Error),
    /// The GPU, or a kernel, failed.
    #[error(transparent)]
    Gpu(#[from] gpu::Error),
    /// A bug in this program. Its state contradicts itself. Another device would not help, so this
    /// is not a [GPU error](Self::is_gpu_error).
    #[error("internal error: {0}; this is a bug in fieldrig, please report it")]
    Internal(String),
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
    /// A picture does not have four bytes per pixel.
    #[error("{what} picture of {width}x{height} pixels: got {got} bytes, expected {expected}")]
    PictureBytes {
        /// The picture, which is `rendered` or `true`.
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
    /// The metadata of a model is invalid.
    #[error("cannot parse {path:?}: {reason}")]
    SplatFile {
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
        /// Keyframes without pixels that stand for the missing keyframes. The list is not empty.
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
    /// A mesh has no triangles left after simplification.
    #[error("no triangles are left at a cell width of {cell_m} m")]
    EmptyMesh {
        /// Width of a cell, meters.
        cell_m: f64,
    },
    /// No part of a model is small and unconnected.
    #[error("no floaters found: every part of the model is connected to a large part")]
    NoFloaters,
    /// The method cannot find floaters.
    #[error("floaters can be removed only from splats and distance fields; erase a box instead")]
    CannotFindFloaters,
}

impl Error {
    /// An [`Error::Internal`]. `what` is a clause without a period.
    pub(crate) fn internal(what: &str) -> Self {
        Self::Internal(what.to_owned())
    }

    /// Whether the GPU caused the error. If so, the same work may succeed on another device.
    pub fn is_gpu_error(&self) -> bool {
        matches!(self, Self::Gpu(error) if error.is_gpu_error())
    }

    /// Whether a buffer of the requested size could not be allocated.
    pub(crate) fn is_out_of_memory(&self) -> bool {
        matches!(self, Self::Gpu(error) if error.is_out_of_memory())
    }
}
