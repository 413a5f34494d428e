//! A run that another run continues: its checkpoint, and the flags in it.

use crate::session::Limits;
use crate::{checkpoints, run_folder};
use model_files::checkpoint::Checkpoint;
use std::path::{Path, PathBuf};

/// Names of the limits among the flags in checkpoints.
const SECONDS: &str = "seconds";
const STEPS: &str = "steps";

/// A run to continue.
pub(crate) struct PreviousRun {
    pub(crate) folder: PathBuf,
    pub(crate) checkpoint: Checkpoint,
}

/// A run that has reached its limits and saved its model, so that there is nothing to continue.
#[derive(Clone, Debug)]
pub struct FinishedRun {
    /// Folder of the run.
    pub folder: PathBuf,
    /// Training time, seconds.
    pub seconds: f64,
    /// The limits of the run.
    pub limits: Limits,
}

impl PreviousRun {
    /// Reads the checkpoint in the folder of a run.
    pub(crate) fn read(folder: &Path) -> anyhow::Result<Self> {
        Ok(Self {
            folder: folder.to_owned(),
            checkpoint: checkpoints::read(folder)?,
        })
    }

    /// Name of the checkpoint in messages.
    pub(crate) fn subject(&self) -> String {
        format!("the checkpoint in {}", self.folder.display())
    }

    /// The value of a flag of the previous run.
    pub(crate) fn flag(&self, name: &str) -> Option<&str> {
        self.checkpoint.flags.get(name).map(String::as_str)
    }

    /// The limits of the previous run.
    fn limits(&self) -> Limits {
        Limits {
            seconds: self.flag(SECONDS).and_then(|text| text.parse().ok()),
            steps: self.flag(STEPS).and_then(|text| text.parse().ok()),
        }
    }

    /// The given limits, or the limits of the previous run if none is given. A single given limit
    /// replaces both previous limits. Otherwise, a new step limit could not continue a run that had
    /// reached its time limit.
    pub(crate) fn limits_or_previous(&self, given: Limits) -> Limits {
        if given.seconds.is_some() || given.steps.is_some() {
            given
        } else {
            self.limits()
        }
    }

    /// Rejects a time limit that the previous run has already reached.
    pub(crate) fn check_not_passed(&self, limits: Limits) -> anyhow::Result<()> {
        checkpoints::check_limit_not_passed(limits.seconds, &self.checkpoint, &self.subject())
    }

    /// Whether the previous run has reached its limits and saved its model.
    pub(crate) fn is_finished(&self) -> bool {
        let has_model = || run_folder::check_no_model(&self.folder).is_err();
        self.checkpoint.is_finished && has_model()
    }

    /// Description of the previous run if nothing is left to do.
    pub(crate) fn finished(&self) -> FinishedRun {
        FinishedRun {
            folder: self.folder.clone(),
            seconds: self.checkpoint.seconds,
            limits: self.limits(),
        }
    }
}

/// Names and values of the limits, for checkpoints.
pub(crate) fn limit_flags(limits: Limits) -> [(&'static str, Option<String>); 2] {
    [
        (SECONDS, limits.seconds.map(|seconds| seconds.to_string())),
        (STEPS, limits.steps.map(|steps| steps.to_string())),
    ]
}

/// The folder of a run. This is the given folder, if there is one. Otherwise, an unfinished run
/// continues in its previous folder.
pub(crate) fn out_folder<'a>(out: Option<&'a Path>, resume: Option<&'a Path>) -> Option<&'a Path> {
    // The results of a finished run are not overwritten.
    out.or_else(|| resume.filter(|folder| run_folder::check_no_model(folder).is_ok()))
}
