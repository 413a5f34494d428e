//! Where the files of a steering log are.

use messages::{BadInput, Setting};
use std::path::{Path, PathBuf};
use trainer::ModelKind;

/// Name of the log in the folder of a run.
pub(crate) const FILE: &str = "steering.jsonl.gz";
/// The older part of a long log.
pub(crate) const OLDER_FILE: &str = "steering.1.jsonl.gz";

/// The files of the steering log of a run, the older one first.
///
/// * `run`: folder of a run, or of one of its models, or a file of a steering log.
///
/// # Errors
///
/// If there is no steering log.
pub fn files_of(run: &Path) -> Result<Vec<PathBuf>, BadInput> {
    if run.is_file() {
        return Ok(vec![run.to_owned()]);
    }
    // A run of several methods has its log in the folder above those of the models.
    let is_model = ModelKind::ALL.iter().any(|kind| run.ends_with(kind.name()));
    let above = run.parent().filter(|_| is_model);
    for folder in [Some(run), above].into_iter().flatten() {
        let files = [OLDER_FILE, FILE].map(|name| folder.join(name));
        let files: Vec<PathBuf> = files.into_iter().filter(|file| file.is_file()).collect();
        if !files.is_empty() {
            return Ok(files);
        }
    }
    Err(BadInput(format!(
        "{} has no steering log ({FILE}): `fieldrig run RIG.toml {}` writes one when an operator takes control",
        run.display(),
        Setting::EnableMotion
    )))
}
