//! Lists the runs in a folder.

use super::own_files::{is_run, model_folders};
use crate::run_folder::{self, CHECKPOINT, LOCK, holds_model};
use serde::Serialize;
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};
use trainer::ModelKind;

/// A run in a folder.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct KeptRun {
    /// Name of its folder.
    pub name: String,
    /// Its folder.
    pub folder: PathBuf,
    /// Time of the last change of a file, seconds since 1970.
    pub changed_unix_secs: u64,
    /// Name of the rig, or else of the data; `None` if the run has no report.
    pub rig: Option<String>,
    /// Its models.
    pub models: Vec<KeptModel>,
    /// Size of all files, bytes.
    pub bytes: u64,
    /// What has become of it.
    pub state: RunState,
}

/// A model of a run.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct KeptModel {
    /// The method.
    pub method: String,
    /// Mean PSNR of the test images, dB; `None` if the model was not scored.
    pub psnr: Option<f64>,
}

/// What has become of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum RunState {
    /// A process writes into its folder.
    Running,
    /// All models were saved and scored.
    Done,
    /// A model was saved, but not all were scored.
    NotScored,
    /// There is a checkpoint to continue from, but no model.
    Unfinished,
    /// There is neither a model nor a checkpoint.
    NoModel,
}

impl RunState {
    /// The state in words.
    #[must_use]
    pub fn words(self) -> &'static str {
        match self {
            Self::Running => "running",
            Self::Done => "done",
            Self::NotScored => "not scored",
            Self::Unfinished => "unfinished",
            Self::NoModel => "no model",
        }
    }
}

/// The runs in a folder, the oldest first. Folders that are not runs are left out.
///
/// # Errors
///
/// If the folder cannot be read.
pub fn list(folder: &Path) -> std::io::Result<Vec<KeptRun>> {
    let mut runs = Vec::new();
    for entry in std::fs::read_dir(folder)? {
        let path = entry?.path();
        if is_run(&path) {
            runs.push(KeptRun::read(&path));
        }
    }
    // Runs that changed in the same second are ordered by name, so that lists are reproducible.
    runs.sort_by(|a, b| (a.changed_unix_secs, &a.name).cmp(&(b.changed_unix_secs, &b.name)));
    Ok(runs)
}

impl KeptRun {
    /// Reads what is known about the run in a folder. Files that cannot be read count as missing.
    pub(super) fn read(folder: &Path) -> Self {
        let folders = model_folders(folder);
        let reports: Vec<Value> = folders.iter().filter_map(|folder| report(folder)).collect();
        let models: Vec<KeptModel> = folders
            .iter()
            .filter(|folder| holds_model(folder))
            .map(|folder| KeptModel::read(folder))
            .collect();
        let mut usage = Usage::default();
        usage.add(folder);
        let has_checkpoint = folders
            .iter()
            .any(|folder| folder.join(CHECKPOINT).is_file());
        let n_scored = reports.len();
        let state = if is_in_use(&folders) {
            RunState::Running
        } else if models.is_empty() {
            if has_checkpoint {
                RunState::Unfinished
            } else {
                RunState::NoModel
            }
        } else if n_scored < models.len() {
            RunState::NotScored
        } else {
            RunState::Done
        };
        Self {
            name: folder.file_name().map_or_else(
                || folder.display().to_string(),
                |name| name.to_string_lossy().into_owned(),
            ),
            folder: folder.to_owned(),
            changed_unix_secs: usage.changed_unix_secs,
            rig: reports.iter().find_map(rig),
            models,
            bytes: usage.bytes,
            state,
        }
    }
}

impl KeptModel {
    /// The model in a folder that holds one.
    fn read(folder: &Path) -> Self {
        let is_there = |file: &&str| folder.join(file).is_file();
        let kind = ModelKind::ALL
            .iter()
            .find(|kind| kind.entry().files.iter().any(is_there));
        let psnr = report(folder).and_then(|report| report["done"]["psnr"].as_f64());
        Self {
            method: kind.map_or("unknown", |kind| kind.name()).to_owned(),
            psnr,
        }
    }
}

/// The report in a folder.
fn report(folder: &Path) -> Option<Value> {
    Some(run_folder::report(folder)).filter(|report| !report.is_null())
}

/// Name of the rig, or file name of the data, in a report.
fn rig(report: &Value) -> Option<String> {
    if let Some(rig) = report["rig"].as_str() {
        return Some(rig.to_owned());
    }
    let data = Path::new(report["data"].as_str()?);
    Some(
        data.file_name()
            .unwrap_or(data.as_os_str())
            .to_string_lossy()
            .into_owned(),
    )
}

/// Whether a process has locked one of the folders.
pub(super) fn is_in_use(folders: &[PathBuf]) -> bool {
    // A missing lock file is not created, because listing runs changes nothing.
    let lock_files = folders.iter().map(|folder| folder.join(LOCK));
    lock_files
        .filter(|file| file.is_file())
        .any(|file| matches!(files::lock(&file), Ok(None)))
}

/// Size and last change of a folder.
#[derive(Default)]
struct Usage {
    bytes: u64,
    changed_unix_secs: u64,
}

impl Usage {
    /// Adds a file or folder. Links are not followed.
    fn add(&mut self, path: &Path) {
        let Ok(metadata) = path.symlink_metadata() else {
            return;
        };
        if metadata.is_dir() {
            let entries = std::fs::read_dir(path).into_iter().flatten().flatten();
            entries.for_each(|entry| self.add(&entry.path()));
        } else {
            self.bytes += metadata.len();
            let changed = metadata.modified().map_or(0, unix_secs);
            self.changed_unix_secs = self.changed_unix_secs.max(changed);
        }
    }
}

fn unix_secs(time: SystemTime) -> u64 {
    time.duration_since(UNIX_EPOCH)
        .unwrap_or_default()
        .as_secs()
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use std::fs;
    use std::time::Duration;

    /// Makes a run with a file of these bytes that was last changed at this time.
    pub(in crate::runs) fn make(runs: &Path, name: &str, files: &[(&str, &str)], secs: u64) {
        let folder = runs.join(name);
        for (file, text) in files {
            let path = folder.join(file);
            fs::create_dir_all(path.parent().expect("a folder")).expect("space");
            fs::write(&path, text).expect("space");
            let file = fs::File::options()
                .write(true)
                .open(&path)
                .expect("it exists");
            let changed = UNIX_EPOCH + Duration::from_secs(secs);
            file.set_modified(changed).expect("our own file");
        }
    }

    #[test]
    fn runs_are_listed_with_their_state() {
        let folder = tempfile::tempdir().expect("a folder");
        let runs = folder.path();
        let report = r#"{"done": {"psnr": 25.25}, "rig": "static-arm"}"#;
        let of_data = r#"{"done": {"psnr": null}, "data": "scans/kitchen"}"#;
        make(
            runs,
            "done",
            &[("splats.ply", "12345"), ("report.json", report)],
            300,
        );
        make(
            runs,
            "both",
            &[
                ("rig.toml", ""),
                ("splat/splats.ply", "1"),
                ("splat/report.json", of_data),
                ("tsdf/mesh.ply", "1"),
                ("tsdf/model.json", "{}"),
            ],
            200,
        );
        make(runs, "stopped", &[("training.ckpt", "x")], 100);
        make(
            runs,
            "failed",
            &[("decisions.jsonl", "x"), (".lock", "")],
            100,
        );
        make(runs, "photos", &[("a.png", "x")], 400);
        make(
            runs,
            "used",
            &[("decisions.jsonl", "x"), (".lock", "")],
            500,
        );
        let _lock = files::lock(&runs.join("used/.lock"))
            .expect("a file")
            .expect("free");
        let listed = list(runs).expect("readable");
        let described: Vec<_> = listed
            .iter()
            .map(|run| (&*run.name, run.state, run.rig.as_deref(), run.models.len()))
            .collect();
        assert_eq!(
            described,
            [
                ("failed", RunState::NoModel, None, 0),
                ("stopped", RunState::Unfinished, None, 0),
                ("both", RunState::NotScored, Some("kitchen"), 2),
                ("done", RunState::Done, Some("static-arm"), 1),
                ("used", RunState::Running, None, 0),
            ]
        );
        let done = &listed[3];
        assert_eq!(done.changed_unix_secs, 300);
        assert_eq!(done.bytes, 5 + report.len() as u64);
        let expected = KeptModel {
            method: "splat".into(),
            psnr: Some(25.25),
        };
        assert_eq!(done.models, [expected]);
        assert!(
            !runs.join("stopped/.lock").exists(),
            "listing changes nothing"
        );
        assert!(list(&runs.join("absent")).is_err());
    }
}
