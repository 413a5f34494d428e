//! Ends training: saves and scores models, and writes their reports.

use super::Session;
use super::outcome::TrainingOutcome;
use super::reporter::ScoredModel;
use crate::checkpoints::Snapshot;
use crate::evaluate::Scores;
use crate::next_commands::{DataSource, SavedModel};
use crate::{camera_list, run_folder, viewer};
use serde::Serialize;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use trainer::{Edits, Method, ModelKind};
use viz::Hub;

/// A trained model that has been saved and scored and is still in GPU memory.
pub struct FinishedModel {
    /// The method.
    pub kind: ModelKind,
    /// The model.
    pub method: Box<dyn Method>,
    /// Erased space.
    pub edits: Arc<Edits>,
    /// Folder of the saved model.
    pub folder: PathBuf,
    /// Training time, seconds.
    pub seconds: f64,
    /// Scores of the saved model on the test images.
    pub scores: Scores,
    data: DataSource,
    n_tests: usize,
}

impl FinishedModel {
    /// The saved model, for commands that use it.
    #[must_use]
    pub fn saved(&self) -> SavedModel<'_> {
        SavedModel {
            kind: self.kind,
            folder: &self.folder,
            data: &self.data,
            n_tests: self.n_tests,
        }
    }
}

/// A session to finish, with its output folder and the command-specific entries of its report.
pub struct EndingSession<P> {
    /// The session.
    pub session: Session,
    /// Folder for the model and its report.
    pub out: PathBuf,
    /// Command-specific entries of the report.
    pub details: P,
}

/// Saves all models, then scores each one and writes its report. Returns the models so that they
/// can be viewed.
///
/// * `hub`: its clients get pictures of each model while it is scored.
pub fn finish(
    mut endings: Vec<EndingSession<impl Serialize>>,
    hub: Option<&Hub>,
) -> crate::Result<Vec<FinishedModel>> {
    // All models are saved before scoring, so that a second Ctrl-C during scoring loses nothing.
    let ended_secs: Vec<f64> = endings
        .iter_mut()
        .map(|ending| ending.session.stop_training())
        .collect::<crate::Result<_>>()?;
    let mut saved = Vec::new();
    // The first error is returned, all others are logged.
    let mut failed = Ok(());
    let mut record_error = |error: crate::Error| match failed {
        Ok(()) => failed = Err(error),
        Err(_) => log::error!("{error:#}"),
    };
    for (mut ending, seconds) in endings.into_iter().zip(ended_secs) {
        // A model that cannot be saved does not prevent saving the others.
        match ending.session.save(&ending.out, seconds) {
            Ok(Saved {
                folder,
                sha256,
                failed: error,
            }) => {
                ending.out = folder;
                ending.session.write_cameras(&ending.out);
                error.into_iter().for_each(&mut record_error);
                saved.push((ending, seconds, sha256));
            }
            Err(error) => record_error(error),
        }
    }
    for (ending, ..) in &mut saved {
        if let Err(error) = ending.session.persistence.wait() {
            record_error(error.with_context(format!(
                "the model was saved in {}, but not the last checkpoint",
                ending.out.display()
            )));
        }
    }
    if saved
        .iter()
        .any(|(ending, ..)| ending.session.stop.requested())
    {
        log::info!("saved; scoring the test images (Ctrl-C again skips this)");
    }
    let mut finished = Vec::new();
    for (
        EndingSession {
            session,
            out,
            details,
        },
        seconds,
        sha256,
    ) in saved
    {
        match session.report_end(&out, seconds, &sha256, &details, hub) {
            Ok(model) => finished.push(model),
            Err(error) => record_error(error),
        }
    }
    failed.map(|()| finished)
}

/// A model on disk.
struct Saved {
    folder: PathBuf,
    sha256: String,
    /// Why the model could not be saved in the run folder, if it was saved elsewhere.
    failed: Option<crate::Error>,
}

impl Session {
    /// Scores the final model without saving it.
    pub fn score_without_saving(mut self) -> crate::Result<TrainingOutcome> {
        let seconds = self.stop_training()?;
        self.score_at_end(seconds, None)
    }

    /// Waits for queued work and returns the training time in seconds.
    fn stop_training(&mut self) -> crate::Result<f64> {
        self.gpu.wait()?;
        let seconds = self.time.end_secs();
        self.reporter.report_training_ended();
        Ok(seconds)
    }

    /// Saves the model, in a temporary folder if `out` cannot be written. `seconds`: training time.
    fn save(&mut self, out: &Path, seconds: f64) -> crate::Result<Saved> {
        self.persistence.check_folders();
        self.persistence.end_decisions(self.method.as_mut())?;
        let progress = self.method.progress();
        if progress.step > 0 && progress.primitives == 0 {
            log::warn!("the model is empty: no observation could be used");
        }
        // Saving ends a trial in progress. The checkpoint is taken before that, so that a resumed
        // run completes the trial. An idle live run is not finished, because it may receive more
        // keyframes after it is resumed.
        let is_live = self.persistence.keeps_keyframes();
        let is_finished = self.is_over() || (self.is_idle() && !is_live);
        let (method, keyframes, edits) = (self.method.as_mut(), &self.keyframes[..], &*self.edits);
        let snapshot = Snapshot {
            method,
            keyframes,
            edits,
            seconds,
            is_finished,
        };
        let checkpoint = self.persistence.take_last_checkpoint(snapshot);
        let saved = run_folder::save_model(self.method.as_mut(), &self.edits, out)
            .and_then(|()| run_folder::checkpoint_sha256(out));
        self.persistence.write_checkpoint(checkpoint);
        match saved {
            Ok(sha256) => Ok(Saved {
                folder: out.to_owned(),
                sha256,
                failed: None,
            }),
            Err(error) if error.is_io() => self.save_elsewhere(out, error),
            Err(error) => Err(error),
        }
    }

    /// Saves the model in a temporary folder, because its run folder could not be written.
    fn save_elsewhere(&mut self, out: &Path, save_error: crate::Error) -> crate::Result<Saved> {
        let edits = &self.edits;
        let save = |method: &mut dyn Method| {
            let folder = run_folder::make_fallback_folder()?;
            run_folder::save_model(method, edits, &folder)?;
            let sha256 = run_folder::checkpoint_sha256(&folder)?;
            Ok((folder, sha256))
        };
        match save(self.method.as_mut()) {
            Ok((folder, sha256)) => {
                let context = format!(
                    "cannot save the model in {}; it was saved in {}",
                    out.display(),
                    folder.display()
                );
                Ok(Saved {
                    folder,
                    sha256,
                    failed: Some(save_error.with_context(context)),
                })
            }
            Err(error) => {
                let error: crate::Error = error;
                log::error!("cannot save the model in a temporary folder either: {error:#}");
                Err(save_error.with_context(format!(
                    "cannot save the model in {}; {}",
                    out.display(),
                    self.persistence.describe_unsaved()
                )))
            }
        }
    }

    /// Writes the list of camera poses with the model's corrections. Without this list, a viewer
    /// starts with an outside view of the model.
    fn write_cameras(&mut self, out: &Path) {
        let cameras = camera_list::of_model(self.method.as_mut(), &self.keyframes);
        if let Err(error) = camera_list::write(out, &cameras) {
            log::warn!("{} was not written: {error:#}", camera_list::FILE);
        }
    }

    /// Scores the saved model, writes the report, and reports the end.
    fn report_end(
        mut self,
        out: &Path,
        seconds: f64,
        checkpoint_sha256: &str,
        details: &impl Serialize,
        hub: Option<&Hub>,
    ) -> crate::Result<FinishedModel> {
        let outcome = self.score_at_end(seconds, hub)?;
        let method = self.method.as_mut();
        // Rendered before profiling, because profiling trains the model further.
        let comparisons =
            self.reporter
                .compare(method, self.scoreboard.tests(), &outcome.per_image);
        let passes = self.reporter.profile(method)?;
        self.reporter.report_end(ScoredModel {
            out,
            checkpoint_sha256,
            outcome: &outcome,
            comparisons,
            passes,
            cameras: method.camera_corrections()?,
            alignment: method.alignment(),
            trials: method.report(),
            adapter: self.gpu.describe(),
            details,
        })?;
        Ok(FinishedModel {
            kind: self.kind(),
            method: self.method,
            edits: self.edits,
            folder: out.to_owned(),
            seconds,
            scores: outcome.scores,
            data: self.reporter.into_data(),
            n_tests: outcome.per_image.len(),
        })
    }

    fn score_at_end(&mut self, seconds: f64, hub: Option<&Hub>) -> crate::Result<TrainingOutcome> {
        self.gpu.wait()?;
        self.persistence.log_render();
        let (n_all, kind) = (self.scoreboard.tests().len(), self.reporter.kind());
        let (reporter, edits) = (&mut self.reporter, &self.edits);
        let mut n_reported = None;
        let meanwhile = |method: &mut dyn Method, n_scored: usize| {
            if n_reported.replace(n_scored) != Some(n_scored) {
                reporter.report_scoring(n_scored, n_all);
                if let Some(hub) = hub {
                    hub.set_state(&format!("scoring, {n_scored} of {n_all} images"));
                }
            }
            if let Some(pending) = hub.and_then(Hub::next_request) {
                let other = pending
                    .method()
                    .filter(|name| *name != kind.name())
                    .map(str::to_owned);
                match other {
                    Some(other) => {
                        pending.fail(&format!(
                            "cannot render {other} while {} is scored; try again later",
                            kind.name()
                        ));
                    }
                    None => viewer::answer(pending, method, edits),
                }
            }
        };
        let per_image = self.scoreboard.score_all(self.method.as_mut(), meanwhile)?;
        let progress = self.method.progress();
        Ok(TrainingOutcome {
            seconds,
            steps: progress.step,
            scores: Scores::mean(&per_image),
            primitives: progress.primitives,
            bytes: progress.bytes,
            evaluations: self.reporter.take_evaluations(),
            per_image,
        })
    }
}
