//! What can go wrong with a device.

use std::path::PathBuf;
use std::time::Duration;

/// Errors of devices, recordings and datasets.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A camera stayed silent.
    #[error("camera {camera:?}: no image within {waited:?}")]
    NoImage {
        /// Name in the rig file.
        camera: String,
        /// How long the call waited.
        waited: Duration,
    },
    /// A file cannot be opened.
    #[error("cannot open {path:?}")]
    Open {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
}
