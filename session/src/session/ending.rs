//! Ends training: saves and scores models, and writes their reports.

use super::Session;
use super::outcome::TrainingOutcome;
use super::reporter::{Reporter, ScoredModel};
use crate::checkpoints::Snapshot;
use crate::error::is_io;
use crate::evaluate::Scores;
use crate::next_commands::{DataSource, SavedModel};
use crate::{camera_list, run_folder, viewer};
use model_files::Edits;
use serde::Serialize;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;
use trainer::{AlignedModel, ModelKind};
use viz::Hub;

/// A trained model that has been saved and scored and is still in GPU memory.
pub struct FinishedModel {
    /// The method.
    pub kind: ModelKind,
    /// The model.
    pub method: AlignedModel,
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

    /// Number of test images.
    pub(crate) fn n_tests(&self) -> usize {
        self.n_tests
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
) -> anyhow::Result<Vec<FinishedModel>> {
    // The training time of all models ends before the first one is saved. Saving takes time, which
    // would otherwise count for the models that are saved later.
    let ended_secs: Vec<f64> = endings
        .iter_mut()
        .map(|ending| stop_training(&mut ending.session))
        .collect::<anyhow::Result<_>>()?;
    // All models are saved before scoring, so that a second Ctrl-C during scoring loses nothing.
    let mut errors = Errors::default();
    let mut saved = save_all(endings, ended_secs, &mut errors);
    // Checkpoints are written on other threads, so they are complete only after this wait.
    wait_for_checkpoints(&mut saved, &mut errors);
    if saved
        .iter()
        .any(|saved| saved.ending.session.stop.requested())
    {
        log::info!("saved; scoring the test images (Ctrl-C again skips this)");
    }
    let mut finished = Vec::new();
    for saved in saved {
        match saved.report_end(hub) {
            Ok(model) => finished.push(model),
            Err(error) => errors.record(error),
        }
    }
    errors.into_result().map(|()| finished)
}

/// Errors of several models. The first one is returned, all others are logged.
#[derive(Default)]
struct Errors {
    first: Option<anyhow::Error>,
}

impl Errors {
    /// Keeps the first error, and logs an error after it.
    fn record(&mut self, error: anyhow::Error) {
        if self.first.is_none() {
            self.first = Some(error);
        } else {
            log::error!("{error:#}");
        }
    }

    /// Returns the first error, if there was one.
    fn into_result(self) -> anyhow::Result<()> {
        self.first.map_or(Ok(()), Err)
    }
}

/// A session whose model is saved.
struct SavedSession<P> {
    /// The session, with the folder in which its model was saved.
    ending: EndingSession<P>,
    /// Training time, seconds.
    seconds: f64,
    /// Checksum of the saved model.
    sha256: String,
}

/// Saves all models. Those that cannot be saved are left out.
fn save_all<P>(
    endings: Vec<EndingSession<P>>,
    ended_secs: Vec<f64>,
    errors: &mut Errors,
) -> Vec<SavedSession<P>> {
    let mut saved = Vec::new();
    for (mut ending, seconds) in endings.into_iter().zip(ended_secs) {
        // A model that cannot be saved does not prevent saving the others.
        match ending.save(seconds) {
            Ok(Saved {
                folder,
                sha256,
                failed,
            }) => {
                ending.out = folder;
                ending.write_cameras();
                if let Some(error) = failed {
                    errors.record(error);
                }
                saved.push(SavedSession {
                    ending,
                    seconds,
                    sha256,
                });
            }
            Err(error) => errors.record(error),
        }
    }
    saved
}

/// Waits until the last checkpoint of each saved model is on disk.
fn wait_for_checkpoints<P>(saved: &mut [SavedSession<P>], errors: &mut Errors) {
    for SavedSession { ending, .. } in saved {
        if let Err(error) = ending.session.persistence.wait() {
            errors.record(error.context(format!(
                "the model was saved in {}, but not the last checkpoint",
                ending.out.display()
            )));
        }
    }
}

/// A model on disk.
struct Saved {
    folder: PathBuf,
    sha256: String,
    /// Why the model could not be saved in the run folder, if it was saved elsewhere.
    failed: Option<anyhow::Error>,
}

impl Session {
    /// Scores the final model without saving it.
    pub fn score_without_saving(mut self) -> anyhow::Result<TrainingOutcome> {
        let seconds = stop_training(&mut self)?;
        score_at_end(&mut self, seconds, None)
    }
}

/// Waits for queued work and returns the training time in seconds.
fn stop_training(session: &mut Session) -> anyhow::Result<f64> {
    // Queued steps count as training time, so the time is read after them.
    session.gpu.wait()?;
    let seconds = session.time.end_secs();
    session.reporter.report_training_ended();
    if let Some(summary) = session.growth_log.summary(Instant::now()) {
        log::info!("{summary}");
    }
    Ok(seconds)
}

/// Scores the final model on all test images. Clients of `hub` get pictures meanwhile.
fn score_at_end(
    session: &mut Session,
    seconds: f64,
    hub: Option<&Hub>,
) -> anyhow::Result<TrainingOutcome> {
    session.gpu.wait()?;
    session.persistence.log_render();
    let mut work = WorkDuringScoring {
        n_all: session.scoreboard.tests().len(),
        n_reported: None,
        reporter: &mut session.reporter,
        edits: &session.edits,
        hub,
    };
    let per_image = session
        .scoreboard
        .score_all(&mut session.method, |method, n_scored| {
            work.advance(method, n_scored);
        })?;
    let progress = session.progress();
    Ok(TrainingOutcome {
        seconds,
        steps: progress.step,
        scores: Scores::mean(&per_image),
        primitives: progress.primitives,
        bytes: progress.bytes,
        evaluations: session.reporter.take_evaluations(),
        per_image,
    })
}

impl<P> EndingSession<P> {
    /// Saves the model, in a temporary folder if `out` cannot be written. `seconds`: training time.
    fn save(&mut self, seconds: f64) -> anyhow::Result<Saved> {
        let Self { session, out, .. } = self;
        session.persistence.check_folders();
        session.persistence.end_decisions(&mut session.method)?;
        let progress = session.progress();
        if progress.step > 0 && progress.primitives == 0 {
            log::warn!("the model is empty: no observation could be used");
        }
        // Saving ends a trial in progress. The checkpoint is taken before that, so that a resumed
        // run completes the trial. An idle live run is not finished, because it may receive more
        // keyframes after it is resumed.
        let is_live = session.persistence.keeps_keyframes();
        let is_finished = session.is_over() || (session.is_idle() && !is_live);
        let checkpoint = session.persistence.take_last_checkpoint(Snapshot {
            method: &mut session.method,
            keyframes: &session.keyframes,
            edits: &session.edits,
            psnr_history: session.scoreboard.psnr_history(),
            seconds,
            is_finished,
        });
        let saved = run_folder::save_model(&mut session.method, &session.edits, out)
            .and_then(|()| run_folder::checkpoint_sha256(out));
        // The checkpoint is written after the model: if the disk has no space for both, the model
        // is the more important one.
        session.persistence.write_checkpoint(checkpoint);
        match saved {
            Ok(sha256) => Ok(Saved {
                folder: out.clone(),
                sha256,
                failed: None,
            }),
            // The disk may be full, or the folder read-only. Other errors, such as a lost GPU,
            // would also occur in another folder.
            Err(error) if is_io(&error) => self.save_elsewhere(error),
            Err(error) => Err(error),
        }
    }

    /// Saves the model in a temporary folder, because its run folder could not be written.
    fn save_elsewhere(&mut self, save_error: anyhow::Error) -> anyhow::Result<Saved> {
        let Self { session, out, .. } = self;
        match save_in_fallback_folder(&mut session.method, &session.edits) {
            Ok((folder, sha256)) => {
                let context = format!(
                    "cannot save the model in {}; it was saved in {}",
                    out.display(),
                    folder.display()
                );
                Ok(Saved {
                    folder,
                    sha256,
                    failed: Some(save_error.context(context)),
                })
            }
            Err(error) => {
                log::error!("cannot save the model in a temporary folder either: {error:#}");
                // The user can act on the first error, which concerns the requested folder.
                Err(save_error.context(format!(
                    "cannot save the model in {}; {}",
                    out.display(),
                    session.persistence.describe_unsaved()
                )))
            }
        }
    }

    /// Writes the list of camera poses with the model's corrections. Without this list, a viewer
    /// starts with an outside view of the model.
    fn write_cameras(&mut self) {
        let Self { session, out, .. } = self;
        let cameras = camera_list::of_model(&mut session.method, &session.keyframes);
        if let Err(error) = camera_list::write(out, &cameras) {
            log::warn!("{} was not written: {error:#}", camera_list::FILE);
        }
    }
}

impl<P: Serialize> SavedSession<P> {
    /// Scores the saved model, writes the report, and reports the end.
    fn report_end(self, hub: Option<&Hub>) -> anyhow::Result<FinishedModel> {
        let Self {
            ending:
                EndingSession {
                    mut session,
                    out,
                    details,
                },
            seconds,
            sha256,
        } = self;
        let outcome = score_at_end(&mut session, seconds, hub)?;
        let method = &mut session.method;
        // Rendered before profiling, because profiling trains the model further.
        let pictures = session.reporter.draw_pictures(
            method,
            &session.keyframes,
            session.scoreboard.tests(),
            &outcome.per_image,
        );
        let passes = session.reporter.profile(method.model_mut())?;
        session.reporter.report_end(ScoredModel {
            out: &out,
            checkpoint_sha256: &sha256,
            outcome: &outcome,
            pictures,
            passes,
            cameras: method.model_mut().camera_corrections()?,
            alignment: method.alignment(),
            trials: method.model().report(),
            adapter: session.gpu.describe(),
            details: &details,
        })?;
        Ok(FinishedModel {
            kind: session.kind(),
            method: session.method,
            edits: session.edits,
            folder: out,
            seconds,
            scores: outcome.scores,
            data: session.reporter.into_data(),
            n_tests: outcome.per_image.len(),
        })
    }
}

/// Saves a model in a new temporary folder. Returns the folder and the checksum of the model.
fn save_in_fallback_folder(
    method: &mut AlignedModel,
    edits: &Edits,
) -> anyhow::Result<(PathBuf, String)> {
    let folder = run_folder::make_fallback_folder()?;
    run_folder::save_model(method, edits, &folder)?;
    let sha256 = run_folder::checkpoint_sha256(&folder)?;
    Ok((folder, sha256))
}

/// What happens while a model is scored: progress is reported, and viewers get pictures.
struct WorkDuringScoring<'a> {
    /// Number of test images.
    n_all: usize,
    /// The progress that was last reported.
    n_reported: Option<usize>,
    reporter: &'a mut Reporter,
    edits: &'a Arc<Edits>,
    hub: Option<&'a Hub>,
}

impl WorkDuringScoring<'_> {
    /// Reports that `n_scored` images are scored, and draws at most one picture.
    fn advance(&mut self, method: &mut AlignedModel, n_scored: usize) {
        // Called often, also without progress, so that viewers do not wait for the next score.
        if self.n_reported.replace(n_scored) != Some(n_scored) {
            let n_all = self.n_all;
            self.reporter.report_scoring(n_scored, n_all);
            if let Some(hub) = self.hub {
                hub.set_state(&format!("scoring, {n_scored} of {n_all} images"));
            }
        }
        if let Some(pending) = self.hub.and_then(|hub| hub.pictures().next_request()) {
            let scored_method = self.reporter.kind().name();
            let other = pending
                .method()
                .filter(|name| *name != scored_method)
                .map(str::to_owned);
            match other {
                // Only the model that is scored is available here. A viewer repeats its request.
                Some(other) => {
                    pending.fail(&format!(
                        "cannot render {other} while {scored_method} is scored; try again later"
                    ));
                }
                None => viewer::answer(pending, method.model_mut(), self.edits),
            }
        }
    }
}
