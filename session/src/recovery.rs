//! Data for recovering a model from a GPU failure, and messages that describe how to continue.

use crate::decisions::Settings;
use crate::error::is_gpu_error;
use crate::resume_command::ResumeCommand;
use crate::run_folder::CHECKPOINT;
use keyframe::Keyframe;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use trainer::ModelSpec;

/// Data with which a session continues on another device.
pub struct Recovery {
    /// Method and options of the model.
    pub model_spec: ModelSpec,
    /// Folder of the run.
    pub folder: PathBuf,
    /// Folder of the checkpoint that the run was resumed from; `None` for a new run.
    pub resumed: Option<PathBuf>,
    /// Keyframes that the resumed model was trained on.
    pub known: Vec<Arc<Keyframe>>,
    /// Settings for the decision log.
    pub settings: Settings,
    /// The command that continues the run.
    pub resume_command: ResumeCommand,
}

impl Recovery {
    /// Describes how to continue if the model cannot be saved, as a sentence without a period.
    pub fn describe_recoverable(&self, has_checkpoint: bool) -> String {
        let Self {
            folder,
            resume_command,
            ..
        } = self;
        // The newest checkpoint comes first, because an older one would lose more training.
        match (has_checkpoint, &self.resumed) {
            (true, _) => {
                format!(
                    "the newest checkpoint is {}: `{}` continues from it",
                    in_folder(folder),
                    resume_command.line(folder)
                )
            }
            (false, Some(resumed)) => {
                format!(
                    "no newer checkpoint was written: `{}` continues again from the older one",
                    resume_command.line(resumed)
                )
            }
            (false, None) => "no checkpoint was written yet: start the run again".to_owned(),
        }
    }
}

fn in_folder(folder: &Path) -> String {
    folder.join(CHECKPOINT).display().to_string()
}

/// Adds a description of how to continue to a GPU error.
pub fn with_recoverable(error: anyhow::Error, recoverable: &str) -> anyhow::Error {
    if is_gpu_error(&error) && !recoverable.is_empty() {
        error.context(format!(
            "the GPU failed at the end of the run; {recoverable}"
        ))
    } else {
        error
    }
}
