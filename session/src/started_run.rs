//! A run that has begun: where its files are, and what is left if the program ends early.

use crate::run_folder::{CHECKPOINT, holds_model};
use parking_lot::Mutex;
use std::path::PathBuf;

/// The models of the run in progress.
static STARTED: Mutex<Vec<StartedRun>> = Mutex::new(Vec::new());

/// The folders of one model of a run that has begun.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct StartedRun {
    /// Folder of the run. If the run has several models, this is the parent of their folders.
    pub run_folder: PathBuf,
    /// Folder of the model and its checkpoint.
    pub model_folder: PathBuf,
    /// The command that continues from the newest checkpoint.
    pub resume_command: String,
}

impl StartedRun {
    /// Remembers a model of the run in progress, and forgets those of an earlier run.
    pub fn remember(&self) {
        let mut started = STARTED.lock();
        started.retain(|other| other.run_folder == self.run_folder);
        started.push(self.clone());
    }

    /// What is left of the run in progress if the program exits at once, one line for each model.
    #[must_use]
    pub fn lines_at_exit() -> Vec<String> {
        // The program must end even if another thread holds the lock.
        let started = STARTED
            .try_lock()
            .map_or_else(Vec::new, |started| started.clone());
        lines(&started)
    }

    /// Describes how to continue if the program ends now, as a sentence without a period.
    #[must_use]
    pub fn describe_left(&self) -> String {
        let folder = self.model_folder.display();
        if holds_model(&self.model_folder) {
            format!("the model was already saved in {folder}")
        } else if self.model_folder.join(CHECKPOINT).exists() {
            format!(
                "the model was not saved; `{}` continues from the newest checkpoint",
                self.resume_command
            )
        } else {
            format!("the model was not saved, and {folder} contains no checkpoint yet")
        }
    }
}

fn lines(started: &[StartedRun]) -> Vec<String> {
    if started.is_empty() {
        return vec!["exiting at once".to_owned()];
    }
    started
        .iter()
        .map(|run| format!("exiting at once: {}", run.describe_left()))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn early_end_names_what_can_be_continued() {
        let folder = tempfile::tempdir().expect("a folder");
        let run = StartedRun {
            run_folder: folder.path().to_owned(),
            model_folder: folder.path().to_owned(),
            resume_command: "fieldrig run rig.toml resume out".to_owned(),
        };
        assert!(run.describe_left().ends_with("contains no checkpoint yet"));
        std::fs::write(folder.path().join(CHECKPOINT), b"x").expect("disk space");
        let left = run.describe_left();
        assert!(
            left.contains("`fieldrig run rig.toml resume out`"),
            "{left}"
        );
        std::fs::write(folder.path().join("splats.ply"), b"x").expect("disk space");
        assert!(run.describe_left().contains("already saved in"));
    }

    #[test]
    fn each_model_has_a_line() {
        assert_eq!(lines(&[]), ["exiting at once"]);
        let folder = tempfile::tempdir().expect("a folder");
        let run = |name: &str| StartedRun {
            run_folder: folder.path().to_owned(),
            model_folder: folder.path().join(name),
            resume_command: String::new(),
        };
        let lines = lines(&[run("tsdf"), run("splat")]);
        assert!(
            lines[0].contains("tsdf contains no checkpoint"),
            "{lines:?}"
        );
        assert!(
            lines[1].contains("splat contains no checkpoint"),
            "{lines:?}"
        );
    }
}
