//! Removes runs, but never files that a run has not written.

use super::list::{KeptRun, RunState, list};
use super::own_files::{foreign_entry, is_run, model_folders};
use crate::run_folder::LOCK;
use anyhow::Context;
use std::fs::File;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

/// A run that can be removed. Until then, its folder is locked against other processes.
#[derive(Debug)]
pub struct RemovableRun {
    /// The run.
    pub run: KeptRun,
    _locks: Vec<File>,
}

/// Why a run or folder is not removed, as a sentence without a period.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct Refused(String);

/// Selects runs by age and number. If both are given, a run must meet both conditions.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct OldRuns {
    /// Runs that have not changed for longer than this.
    pub older_than: Option<Duration>,
    /// Runs that are not among this number of newest runs.
    pub keep: Option<usize>,
}

impl RemovableRun {
    /// Checks and locks the run in a folder.
    ///
    /// # Errors
    ///
    /// If the folder is not a run, is in use, or contains other files.
    pub fn lock(folder: &Path) -> Result<Self, Refused> {
        let shown = folder.display();
        if folder.symlink_metadata().is_err() {
            return Err(Refused(format!("{shown} does not exist")));
        }
        if !is_run(folder) {
            return Err(Refused(format!(
                "{shown} is not the folder of a run: it contains no model, checkpoint, report or decision log"
            )));
        }
        let run = KeptRun::read(folder);
        let folders = model_folders(folder);
        let locks = folders
            .iter()
            .map(|folder| files::lock(&folder.join(LOCK)))
            .collect::<std::io::Result<Option<Vec<File>>>>()
            .map_err(|error| Refused(format!("cannot lock {shown}: {error}")))?;
        let Some(locks) = locks else {
            return Err(Refused(format!("{shown} is in use by another process")));
        };
        match foreign_entry(folder) {
            Ok(None) => Ok(Self { run, _locks: locks }),
            Ok(Some(entry)) => Err(Refused(format!(
                "{} was not written by a run: move or remove it first",
                entry.display()
            ))),
            Err(error) => Err(Refused(format!("cannot read {shown}: {error}"))),
        }
    }

    /// Removes the folder of the run.
    ///
    /// # Errors
    ///
    /// If a file cannot be removed.
    pub fn remove(self) -> anyhow::Result<()> {
        let folder = &self.run.folder;
        std::fs::remove_dir_all(folder)
            .with_context(|| format!("cannot remove {}", folder.display()))
    }
}

/// Checks and locks runs.
///
/// * `folder`: folder of the runs.
/// * `names`: names in this folder, or paths of runs.
///
/// # Errors
///
/// The first run that cannot be removed.
pub fn by_name(folder: &Path, names: &[PathBuf]) -> Result<Vec<RemovableRun>, Refused> {
    let mut folders: Vec<PathBuf> = Vec::new();
    for name in names {
        let path = path_of(folder, name);
        // A name may be given twice. Its second lock would look like one of another process.
        if !folders.contains(&path) {
            folders.push(path);
        }
    }
    folders
        .iter()
        .map(|path| RemovableRun::lock(path))
        .collect()
}

/// A name without a separator is one in the folder; anything else is a path.
fn path_of(folder: &Path, name: &Path) -> PathBuf {
    // Without a trailing separator, so that a link is not followed.
    let name: PathBuf = name.components().collect();
    match name.parent() {
        Some(parent) if parent.as_os_str().is_empty() => folder.join(name),
        _ => name,
    }
}

/// Checks and locks old runs, and returns why others are kept. Runs in use are kept without a
/// reason.
///
/// * `now`: the time for the age of runs.
///
/// # Errors
///
/// If the folder cannot be read.
pub fn by_age(
    folder: &Path,
    old: OldRuns,
    now: SystemTime,
) -> std::io::Result<(Vec<RemovableRun>, Vec<Refused>)> {
    let mut runs = list(folder)?;
    runs.retain(|run| run.state != RunState::Running);
    let mut removable = Vec::new();
    let mut refused = Vec::new();
    for run in select(&runs, old, now) {
        match RemovableRun::lock(&run.folder) {
            Ok(run) => removable.push(run),
            Err(reason) => refused.push(reason),
        }
    }
    Ok((removable, refused))
}

/// The runs that meet the conditions. `runs` is ordered from old to new.
fn select(runs: &[KeptRun], old: OldRuns, now: SystemTime) -> &[KeptRun] {
    let n_older = runs.len().saturating_sub(old.keep.unwrap_or(0));
    let is_old = |run: &KeptRun| {
        let changed = UNIX_EPOCH + Duration::from_secs(run.changed_unix_secs);
        let Some(min_age) = old.older_than else {
            return true;
        };
        // The clock may have been set back since the run. Such a run counts as new.
        now.duration_since(changed).is_ok_and(|age| age > min_age)
    };
    &runs[..runs
        .iter()
        .take(n_older)
        .take_while(|run| is_old(run))
        .count()]
}

#[cfg(test)]
mod tests {
    use super::super::list::tests::make;
    use super::*;

    const MODEL: &[(&str, &str)] = &[("splats.ply", "x"), (".lock", "")];

    fn names(runs: &[RemovableRun]) -> Vec<&str> {
        runs.iter().map(|run| &*run.run.name).collect()
    }

    #[test]
    fn old_runs_are_selected_by_age_and_number() {
        let folder = tempfile::tempdir().expect("a folder");
        for (name, secs) in [("a", 100), ("b", 200), ("c", 300), ("d", 400)] {
            make(folder.path(), name, MODEL, secs);
        }
        let now = UNIX_EPOCH + Duration::from_secs(450);
        for (older_than, keep, expected) in [
            (Some(200), None, &["a", "b"][..]),
            (None, Some(1), &["a", "b", "c"]),
            (Some(200), Some(3), &["a"]),
            (Some(200), Some(0), &["a", "b"]),
            (None, Some(9), &[]),
            (Some(1000), None, &[]),
        ] {
            let old = OldRuns {
                older_than: older_than.map(Duration::from_secs),
                keep,
            };
            let (runs, refused) = by_age(folder.path(), old, now).expect("readable");
            assert_eq!(
                (names(&runs), refused),
                (expected.to_vec(), vec![]),
                "{old:?}"
            );
        }
    }

    #[test]
    fn only_unused_runs_without_other_files_are_removed() {
        let folder = tempfile::tempdir().expect("a folder");
        let runs = folder.path();
        make(
            runs,
            "good",
            &[("splat/splats.ply", "x"), ("rig.toml", "")],
            100,
        );
        make(runs, "used", MODEL, 100);
        make(
            runs,
            "recorded",
            &[("splats.ply", "x"), ("scan.mcap", "x")],
            100,
        );
        make(runs, "photos", &[("a.png", "x")], 100);
        std::os::unix::fs::symlink(runs.join("good"), runs.join("link")).expect("space");
        let _lock = files::lock(&runs.join("used/.lock"))
            .expect("a file")
            .expect("free");
        for (name, reason) in [
            ("used", "is in use"),
            ("recorded", "scan.mcap was not written by a run"),
            ("photos", "is not the folder of a run"),
            ("link", "is not the folder of a run"),
            ("link/", "is not the folder of a run"),
            ("absent", "does not exist"),
        ] {
            let names = [PathBuf::from("good"), PathBuf::from(name)];
            let refused = by_name(runs, &names).expect_err(name).to_string();
            assert!(refused.contains(reason), "{name}: {refused}");
        }
        let all = OldRuns {
            older_than: None,
            keep: Some(0),
        };
        let now = UNIX_EPOCH + Duration::from_secs(450);
        let (removable, refused) = by_age(runs, all, now).expect("readable");
        assert_eq!((names(&removable), refused.len()), (vec!["good"], 1));
        drop(removable);
        // A path works as well as a name, and the same run may be named twice.
        let twice = [PathBuf::from("good"), runs.join("good")];
        for run in by_name(runs, &twice).expect("it is a run") {
            run.remove().expect("our own files");
        }
        assert!(!runs.join("good").exists() && runs.join("recorded/scan.mcap").exists());
    }
}
