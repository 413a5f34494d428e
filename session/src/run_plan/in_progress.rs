//! A live run in progress: trains until a limit or the end of the input.

use super::RunPlan;
use super::no_model::no_model_reason;
use super::saving::{self, SavedRun};
use crate::error::{is_gpu_error, is_gpu_unrecoverable, is_rejection};
use crate::live_loop::{EndedLoop, LiveLoop};
use crate::run_folder::{self, CreatedFolders};
use crate::steering::SteeringThread;
use capture::config::Rig;
use capture::{InputResult, SampleUse, Stop};
use gpu::Gpu;
use keyframe::Split;
use std::path::PathBuf;
use std::sync::{Arc, OnceLock};

/// A run whose devices are being read.
pub struct RunInProgress {
    /// Trains, and draws pictures for viewers.
    pub live: LiveLoop,
    /// The GPU of the models.
    pub gpu: Arc<Gpu>,
    pub(super) plan: RunPlan,
    pub(super) stop: Stop,
    pub(super) rig: Rig,
    pub(super) folders: Vec<PathBuf>,
    /// Description of the damage in the played recording. It is set when playback reaches the
    /// damage.
    pub(super) damage: Arc<OnceLock<String>>,
    pub(super) created: CreatedFolders,
    /// Lets operators steer the arm, if they may.
    pub(super) steering: Option<SteeringThread>,
}

/// Results of a run that saves nothing.
pub struct DiscardedRun {
    /// Results of the input.
    pub input_result: InputResult,
    /// Descriptions of data that are missing.
    pub data_losses: Vec<String>,
    /// Why there was nothing to train on.
    pub no_model_reason: Option<String>,
    /// Whether a signal ended the run.
    pub is_interrupted: bool,
}

impl RunInProgress {
    /// Takes keyframes, trains for one slice, renders and publishes the status; returns `false`
    /// when the run is over or interrupted.
    pub fn run_time_slice(&mut self) -> anyhow::Result<bool> {
        if self.stop.requested() || self.live.is_over() {
            return Ok(false);
        }
        self.live.advance()?;
        Ok(true)
    }

    /// Runs until a limit, the end of the devices, or a request to stop. Then saves the models, as
    /// far as possible also after an error.
    pub fn run_to_end(mut self) -> anyhow::Result<SavedRun> {
        let result = self.train();
        // From here on, the results of the run are saved even after an error, so the folder must
        // not be removed.
        let has_keyframes = !self.live.keyframes().is_empty();
        if result.is_ok() && self.live.has_exhausted_input() {
            log::info!("the devices have ended and all their data is in the model");
        }
        // The arm and the devices are stopped before saving, which may take minutes.
        drop(self.steering.take());
        self.stop.request();
        let hub = self.live.hub();
        let Self {
            live,
            plan,
            rig,
            folders,
            damage,
            created,
            ..
        } = self;
        let saved = match result {
            Ok(()) => saving::save(live, &plan, &rig, folders, &damage),
            // Without a GPU, the model cannot be read back. Its last checkpoint and the input
            // remain.
            Err(error) if is_gpu_error(&error) || is_gpu_unrecoverable(&error) => {
                Err(keep_input(live, &folders, error))
            }
            Err(error) => {
                log::error!("training failed; saving the model so far: {error:#}");
                match saving::save(live, &plan, &rig, folders, &damage) {
                    Ok(mut saved) => {
                        saved.failure = Some(error);
                        Ok(saved)
                    }
                    Err(save_error) => {
                        log::error!("{save_error:#}");
                        Err(error)
                    }
                }
            }
        };
        match saved {
            Ok(mut saved) => {
                saved.created = created;
                saved.has_keyframes = has_keyframes;
                Ok(saved)
            }
            Err(error) => {
                saving::publish_failure(&hub, &error);
                // The folder of a run that failed before its first keyframe contains nothing of
                // use.
                created.keep_unless(!has_keyframes || is_rejection(&error));
                Err(error)
            }
        }
    }

    /// Trains until the end of the run.
    fn train(&mut self) -> anyhow::Result<()> {
        loop {
            while self.run_time_slice()? {}
            // After a GPU failure, the model was restored and may have fewer steps.
            let is_restored = self.live.wait()?;
            if !is_restored {
                return Ok(());
            }
        }
    }

    /// Closes the devices without saving anything.
    pub fn discard(mut self) -> anyhow::Result<DiscardedRun> {
        drop(self.steering.take());
        let is_interrupted = self.stop.signaled();
        self.stop.request();
        let keyframes = self.live.keyframes();
        let has_model = keyframes
            .iter()
            .any(|keyframe| keyframe.split == Split::Train);
        let n_keyframes = keyframes.len();
        let EndedLoop {
            mut sessions,
            input_result,
            ..
        } = self.live.finish();
        // The caller may remove the folders, so checkpoints in progress must finish first.
        sessions
            .iter_mut()
            .for_each(|session| session.persistence().wait_for_checkpoint());
        let input_result = input_result?;
        let counts = input_result.join.counts();
        let mut data_losses = counts.data_losses(SampleUse::ProcessedOnly);
        data_losses.extend(self.damage.get().cloned());
        let no_model_reason = (!has_model).then(|| no_model_reason(n_keyframes, counts, &self.rig));
        Ok(DiscardedRun {
            input_result,
            data_losses,
            no_model_reason,
            is_interrupted,
        })
    }
}

/// Closes the recording and writes the keyframe lists after a GPU failure. Returns the error with a
/// note of what was saved.
fn keep_input(mut live: LiveLoop, folders: &[PathBuf], error: anyhow::Error) -> anyhow::Error {
    // The description is made while the sessions still exist.
    let recoverable = live.describe_recoverable();
    let EndedLoop {
        sessions,
        input_result,
        ..
    } = live.finish();
    for (session, folder) in sessions.iter().zip(folders) {
        if let Err(error) =
            run_folder::write_keyframe_list(&folder.join("keyframes.txt"), session.keyframes())
        {
            log::error!("{error:#}");
        }
    }
    match input_result {
        Ok(input_result) => {
            log::info!("{}", input_result.join.counts());
            if let Some(error) = input_result.recording_error {
                log::error!("the recording is incomplete: {error:#}");
            }
        }
        Err(error) => log::error!("{error:#}"),
    }
    let is_already_reported = recoverable.is_empty() || is_gpu_unrecoverable(&error);
    if is_already_reported {
        error
    } else {
        error.context(format!("the run stopped early; {recoverable}"))
    }
}
