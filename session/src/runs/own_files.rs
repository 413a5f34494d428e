//! Tells the files that a run writes from other files in its folder.

use crate::decisions;
use crate::run_folder::{CHECKPOINT, KEYFRAMES, LOCK, LOG, MODEL, OLDER_LOG, REPORT, holds_model};
use crate::run_plan::CORRECTED_RIG;
use crate::steering::steering_log;
use crate::{camera_list, report};
use drivers::recording::{RIG_FILE, URDF_FILE};
use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use trainer::ModelKind;

/// Names of files that runs write, besides those of models and decision logs.
const FILES: [&str; 13] = [
    LOCK,
    LOG,
    OLDER_LOG,
    CHECKPOINT,
    REPORT,
    report::FILE,
    camera_list::FILE,
    "edits.json",
    "keyframes.txt",
    RIG_FILE,
    URDF_FILE,
    steering_log::FILE,
    steering_log::OLDER_FILE,
];

/// Whether a run has written into a folder. A folder with a rig file alone is not a run.
pub(super) fn is_run(folder: &Path) -> bool {
    // A link may lead to any folder, for example to the data of a run.
    let is_folder = folder
        .symlink_metadata()
        .is_ok_and(|metadata| metadata.is_dir());
    is_folder
        && model_folders(folder)
            .iter()
            .any(|folder| holds_training(folder))
}

/// The folder of a run, and its subfolders for several methods as far as they exist.
pub(super) fn model_folders(folder: &Path) -> Vec<PathBuf> {
    let subfolders = ModelKind::ALL
        .iter()
        .map(|kind| folder.join(kind.name()))
        .filter(|subfolder| {
            subfolder
                .symlink_metadata()
                .is_ok_and(|metadata| metadata.is_dir())
        });
    std::iter::once(folder.to_owned())
        .chain(subfolders)
        .collect()
}

/// Whether a folder contains what only training writes.
fn holds_training(folder: &Path) -> bool {
    let is_there = |name: &str| folder.join(name).is_file();
    holds_model(folder) || is_there(CHECKPOINT) || is_there(REPORT) || is_there(decisions::FILE)
}

/// The first entry of a run folder, in alphabetical order, that no run writes; `None` if there is
/// none.
pub(super) fn foreign_entry(folder: &Path) -> std::io::Result<Option<PathBuf>> {
    let mut entries: Vec<_> = std::fs::read_dir(folder)?.collect::<Result<_, _>>()?;
    entries.sort_by_key(std::fs::DirEntry::file_name);
    for entry in entries {
        let name = entry.file_name();
        let is_method = ModelKind::ALL.iter().any(|kind| name == kind.name());
        if is_method && entry.file_type()?.is_dir() {
            if let Some(foreign) = foreign_entry(&entry.path())? {
                return Ok(Some(foreign));
            }
        } else if !is_own(&name) {
            return Ok(Some(entry.path()));
        }
    }
    Ok(None)
}

/// Whether a run writes a file or folder with this name, or a temporary one for it.
fn is_own(name: &OsStr) -> bool {
    let files = FILES.into_iter().chain([CORRECTED_RIG, KEYFRAMES, MODEL]);
    let mut files = files.chain(ModelKind::model_files());
    let is_name = |own: &str| {
        name == own || files::partial::path_of(Path::new(own)).file_name() == Some(name)
    };
    files.any(is_name) || name.to_str().is_some_and(decisions::is_log)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_of_runs_and_of_users_are_told_apart() {
        for own in [
            "log.txt",
            "splats.ply",
            "decisions.jsonl",
            "decisions-from-130.jsonl",
            ".training.ckpt.fieldrig.part",
            ".model.fieldrig.part",
            "keyframes",
        ] {
            assert!(is_own(OsStr::new(own)), "{own}");
        }
        for foreign in [
            "scan.mcap",
            "notes.txt",
            "splats-edited.ply",
            "decisions-from-x.jsonl",
        ] {
            assert!(!is_own(OsStr::new(foreign)), "{foreign}");
        }
    }

    #[test]
    fn foreign_files_are_found_in_subfolders() {
        let folder = tempfile::tempdir().expect("a folder");
        let splat = folder.path().join("splat");
        std::fs::create_dir(&splat).expect("space");
        std::fs::write(folder.path().join(RIG_FILE), "").expect("space");
        assert!(!is_run(folder.path()), "only a rig file");
        std::fs::write(splat.join("splats.ply"), "").expect("space");
        assert!(is_run(folder.path()));
        assert_eq!(foreign_entry(folder.path()).expect("readable"), None);
        let notes = splat.join("notes.txt");
        std::fs::write(&notes, "").expect("space");
        assert_eq!(foreign_entry(folder.path()).expect("readable"), Some(notes));
        std::os::unix::fs::symlink(&splat, folder.path().join("link")).expect("space");
        assert!(!is_run(&folder.path().join("link")));
    }
}
