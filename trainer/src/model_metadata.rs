//! The `model.json` of a saved model. It contains camera corrections, the background, and facts
//! that are compared with the model's files.

use crate::Error;
use calibration::{Alignment, CameraCorrection};
use std::collections::BTreeMap;
use std::path::Path;

/// File that describes a saved model, in the model's folder.
pub(crate) const METADATA_FILE: &str = "model.json";

/// Fields that are written for users and other programs, but not read.
const INFORMATION: [&str; 11] = [
    "steps",
    "seed",
    "trials",
    "blocks",
    "vertices",
    "triangles",
    "skipped_keyframes",
    "voxel_grid",
    "entries",
    "levels",
    "extent",
];

/// The fields of `model.json` that are used.
#[derive(Default, serde::Deserialize)]
#[serde(default)]
pub(crate) struct ModelMetadata {
    /// Name of the method, which [`crate::ModelKind::of_saved`] reads.
    #[serde(rename = "method")]
    _method: Option<String>,
    pub(crate) cameras: BTreeMap<String, CameraCorrection>,
    pub(crate) alignment: Option<Alignment>,
    /// See [`crate::Method::background_srgb`].
    pub(crate) background_srgb: [f32; 3],
    /// Number of splats, to be compared with their file.
    pub(crate) splats: Option<u64>,
    /// Degree of the splats' spherical harmonics, which is compared with the file of the splats.
    pub(crate) sh_degree: Option<u64>,
    #[serde(flatten)]
    others: BTreeMap<String, serde_json::Value>,
}

impl ModelMetadata {
    /// Differences between the file and the splats of the model, as sentences without a period. The
    /// values of the splats are used.
    pub(crate) fn differences(&self, n_splats: u64, sh_degree: u32) -> Vec<String> {
        let of_splats = difference("splats", self.splats, n_splats);
        of_splats
            .into_iter()
            .chain(difference("sh_degree", self.sh_degree, sh_degree.into()))
            .collect()
    }

    /// Names of fields that this version neither writes nor reads.
    pub(crate) fn unknown(&self) -> Vec<&str> {
        self.others
            .keys()
            .map(String::as_str)
            .filter(|key| !INFORMATION.contains(key))
            .collect()
    }
}

/// Describes the difference between a stated number and the actual number. `None` if they are
/// equal, or if no number is stated.
fn difference(what: &str, stated: Option<u64>, actual: u64) -> Option<String> {
    let stated = stated.filter(|stated| *stated != actual)?;
    Some(format!(
        "{what} is {stated} in {METADATA_FILE}, but {actual} in the file of splats, which is used"
    ))
}

/// Reads the file in the folder of a saved model. If the file does not exist, all fields are empty.
///
/// # Errors
///
/// Fails if the file cannot be read or parsed, or if a value is not allowed.
pub(crate) fn read_metadata(folder: &Path) -> Result<ModelMetadata, Error> {
    let path = folder.join(METADATA_FILE);
    let invalid_file = |reason: String| Error::SplatFile {
        path: path.clone(),
        reason,
    };
    // Splat files of other programs come without metadata.
    let bytes = match files::read(&path, files::Budget::TEXT) {
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => {
            return Ok(ModelMetadata::default());
        }
        read => read.map_err(|error| invalid_file(error.to_string()))?,
    };
    parse(&bytes).map_err(invalid_file)
}

fn parse(bytes: &[u8]) -> Result<ModelMetadata, String> {
    let metadata: ModelMetadata =
        serde_json::from_slice(bytes).map_err(|error| error.to_string())?;
    // The condition is written so that a NaN is refused.
    let background = metadata.background_srgb;
    if background
        .iter()
        .any(|channel| !(0.0..=1.0).contains(channel))
    {
        return Err(format!(
            "background_srgb is {background:?}, allowed: three numbers from 0 to 1"
        ));
    }
    Ok(metadata)
}

#[cfg(test)]
mod tests {
    use super::{INFORMATION, ModelMetadata, parse};
    use serde_json::{Value, json};
    use std::collections::BTreeSet;

    fn parsed(key: &str, value: Value) -> Result<ModelMetadata, String> {
        parse(&serde_json::to_vec(&json!({ key: value })).expect("JSON"))
    }

    /// Every field in the table of `docs/reference/files.md` is read, compared or listed in
    /// `INFORMATION`.
    #[test]
    fn every_documented_field_is_read_or_named() {
        let page = include_str!("../../docs/reference/files.md");
        let section = page
            .split("### `model.json`")
            .nth(1)
            .and_then(|rest| rest.split("\n##").next())
            .expect("a section");
        let rows = section.lines().filter(|line| line.starts_with("| `"));
        let documented: BTreeSet<&str> = rows
            .flat_map(|row| {
                row.split('|')
                    .nth(1)
                    .expect("a cell")
                    .split('`')
                    .skip(1)
                    .step_by(2)
            })
            .collect();
        let used = [
            "method",
            "cameras",
            "alignment",
            "background_srgb",
            "splats",
            "sh_degree",
        ];
        assert_eq!(documented, used.into_iter().chain(INFORMATION).collect());
        for key in INFORMATION {
            assert!(
                parsed(key, json!([1])).is_ok_and(|metadata| metadata.unknown().is_empty()),
                "{key}"
            );
        }
        for key in used {
            assert!(
                parsed(key, json!([1, "wrong"])).is_err(),
                "{key} is read, so a wrong value is refused"
            );
        }
        assert_eq!(
            parsed("backgruond_srgb", json!([1]))
                .expect("valid")
                .unknown(),
            ["backgruond_srgb"]
        );
    }

    #[test]
    fn values_that_cannot_be_true_are_refused() {
        for background in [[1e5, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1e30]] {
            let error = parsed("background_srgb", json!(background))
                .err()
                .expect("refused");
            assert!(error.contains("background_srgb"), "{error}");
        }
        let error = parsed("cameras", json!({ "wrist": { "rotation_deg": [1, 2, 3] } }))
            .err()
            .expect("refused");
        assert!(error.contains("rotation_deg"), "{error}");
        let metadata = parsed("splats", json!(7)).expect("valid");
        assert_eq!(metadata.differences(7, 3), [""; 0]);
        assert_eq!(
            metadata.differences(8, 3),
            ["splats is 7 in model.json, but 8 in the file of splats, which is used"]
        );
        assert_eq!(
            parsed("sh_degree", json!(2))
                .expect("valid")
                .differences(8, 3)
                .len(),
            1
        );
    }
}
