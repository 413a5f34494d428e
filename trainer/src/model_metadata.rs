//! Camera corrections and background in the `model.json` of a saved model.

use crate::Error;
use calibration::{Alignment, CameraCorrection};
use std::collections::BTreeMap;
use std::path::Path;

/// File that describes a saved model, in the model's folder.
pub(crate) const METADATA_FILE: &str = "model.json";

/// Camera corrections, alignment and background of a saved model.
#[derive(Default, serde::Deserialize)]
#[serde(default)]
pub(crate) struct ModelMetadata {
    pub(crate) cameras: BTreeMap<String, CameraCorrection>,
    pub(crate) alignment: Option<Alignment>,
    /// See [`crate::Method::background_srgb`].
    pub(crate) background_srgb: [f32; 3],
}

/// Reads the camera corrections of a saved model in a folder; empty if the file does not exist or lacks them.
///
/// # Errors
///
/// Fails if the file cannot be read or parsed.
pub(crate) fn read_metadata(folder: &Path) -> Result<ModelMetadata, Error> {
    let path = folder.join(METADATA_FILE);
    let invalid_file = |reason: String| Error::SplatFile { path: path.clone(), reason };
    match files::read(&path, files::MAX_TEXT_BYTES) {
        Ok(bytes) => serde_json::from_slice(&bytes).map_err(|error| invalid_file(error.to_string())),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(ModelMetadata::default()),
        Err(error) => Err(invalid_file(error.to_string())),
    }
}
