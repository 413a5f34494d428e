//! Errors of keyframes.

use messages::{ErrorClass, Setting};
use std::path::PathBuf;

/// An error of a keyframe or of a selection of keyframes.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// An image does not have four bytes per pixel.
    #[error("keyframe image of {width}x{height} pixels: got {got} bytes, expected {expected}")]
    ImageBytes {
        /// Width, pixels.
        width: u32,
        /// Height, pixels.
        height: u32,
        /// Actual size, bytes.
        got: usize,
        /// Expected size, bytes.
        expected: usize,
    },
    /// A depth image does not have one value per pixel.
    #[error("keyframe depth of {width}x{height} pixels: got {got} values, expected {expected}")]
    DepthPixels {
        /// Width, pixels.
        width: u32,
        /// Height, pixels.
        height: u32,
        /// Actual number of values.
        got: usize,
        /// Expected number of values.
        expected: usize,
    },
    /// A file that selects keyframes cannot be read.
    #[error("cannot read {path:?}: {reason}")]
    Read {
        /// The file.
        path: PathBuf,
        /// Message of the operating system.
        reason: String,
    },
    /// A list of keyframes is invalid.
    #[error("the keyframe list {path:?}: {reason}")]
    List {
        /// The file.
        path: PathBuf,
        /// Description of the problem, including the invalid line.
        reason: String,
    },
    /// A list of keyframes has no keyframe in common with the data.
    #[error(
        "the keyframe list matches nothing in the data: it lists {listed}, the data has {found}"
    )]
    NoListedKeyframe {
        /// Camera and stamp of a listed keyframe.
        listed: String,
        /// Camera and stamp of an image in the data.
        found: String,
    },
    /// Test images cannot be selected as requested.
    #[error("{} {request}: {reason}", Setting::Holdout)]
    Holdout {
        /// The requested number, file or name.
        request: String,
        /// Description of the problem.
        reason: String,
    },
}

impl Error {
    /// Class of the error, for the exit code.
    #[must_use]
    pub fn class(&self) -> ErrorClass {
        match self {
            Self::Holdout { .. } => ErrorClass::BadInput,
            Self::NoListedKeyframe { .. } => ErrorClass::InsufficientData,
            Self::ImageBytes { .. }
            | Self::DepthPixels { .. }
            | Self::Read { .. }
            | Self::List { .. } => ErrorClass::Failed,
        }
    }
}
