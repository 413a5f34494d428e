//! Ends training: saves and scores models, and writes their reports.

use super::Session;
use super::end_viewers::EndViewers;
use super::outcome::TrainingOutcome;
use super::persistence::Persistence;
use super::reporter::{Reporter, ScoredModel};
use super::scoreboard::Scoreboard;
use super::viewed_model::ViewedModel;
use crate::checkpoints::Snapshot;
use crate::error::is_io;
use crate::evaluate::Scores;
use crate::next_commands::{DataSource, SavedModel};
use crate::{camera_list, run_folder};
use background::Task;
use gpu::Gpu;
use keyframe::Keyframe;
use model_files::Edits;
use serde::Serialize;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;
use trainer::{AlignedModel, ModelKind};
use viz::StateProgress;

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
/// * `viewers`: they get pictures of all models between the saved files and the scored images.
pub fn finish(
    mut endings: Vec<EndingSession<impl Serialize>>,
    mut viewers: Option<&mut EndViewers>,
) -> anyhow::Result<Vec<FinishedModel>> {
    // The training time of all models ends before the first one is saved. Saving takes time, which
    // would otherwise count for the models that are saved later.
    let ended_secs: Vec<f64> = endings
        .iter_mut()
        .map(|ending| stop_training(&mut ending.session))
        .collect::<anyhow::Result<_>>()?;
    // All models are saved before scoring, so that a second Ctrl-C during scoring loses nothing.
    let mut errors = Errors::default();
    let saved = save_all(
        &mut endings,
        &ended_secs,
        &mut errors,
        viewers.as_deref_mut(),
    );
    // Checkpoints are written on other threads, so they are complete only after this wait.
    wait_for_checkpoints(&mut endings, &saved, &mut errors, viewers.as_deref_mut());
    let is_stopped = |ending: &EndingSession<_>| ending.session.stop.requested();
    if saved.iter().any(Option::is_some) && endings.iter().any(is_stopped) {
        log::info!("saved; scoring the test images (Ctrl-C again skips this)");
    }
    let mut scored = Vec::new();
    for (ix, (saved, seconds)) in saved.into_iter().zip(ended_secs).enumerate() {
        let outcome = saved
            .map(|saved| report_end(&mut endings, ix, &saved, seconds, viewers.as_deref_mut()));
        scored.push(outcome.transpose().unwrap_or_else(|error| {
            errors.record(error);
            None
        }));
    }
    if let Some(viewers) = viewers {
        viewers.finish_chunks();
    }
    let finished = endings.into_iter().zip(scored);
    let finished = finished
        .filter_map(|(ending, outcome)| Some(ending.into_finished(outcome?)))
        .collect();
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

/// Saves all models. The results have the order of the sessions. A model that cannot be saved has
/// no result.
fn save_all<P>(
    endings: &mut [EndingSession<P>],
    ended_secs: &[f64],
    errors: &mut Errors,
    mut viewers: Option<&mut EndViewers>,
) -> Vec<Option<Saved>> {
    let n_all = endings.len();
    let mut saved = Vec::new();
    for (ix, seconds) in ended_secs.iter().enumerate() {
        if let Some(viewers) = viewers.as_deref_mut() {
            let text = match n_all {
                1 => "writing the model".to_owned(),
                _ => format!("writing model {} of {n_all}", ix + 1),
            };
            viewers.show("saving", StateProgress::of_parts(text, ix, n_all));
            // A checkpoint in progress would make the next one wait.
            serve_while(viewers, endings, |endings| {
                endings[ix].session.persistence.is_writing()
            });
        }
        endings[ix].report_working(Some("saving the model"));
        let result = save(endings, ix, *seconds, viewers.as_deref_mut());
        endings[ix].report_working(None);
        // A model that cannot be saved does not prevent saving the others.
        saved.push(match result {
            Ok(mut saved) => {
                if let Some(error) = saved.failed.take() {
                    errors.record(error);
                }
                Some(saved)
            }
            Err(error) => {
                errors.record(error);
                None
            }
        });
    }
    saved
}

/// Saves one of the models, and lists its cameras. Viewers get pictures while its checksum is
/// computed.
fn save<P>(
    endings: &mut [EndingSession<P>],
    ix: usize,
    seconds: f64,
    viewers: Option<&mut EndViewers>,
) -> anyhow::Result<Saved> {
    let mut failed = endings[ix].save(seconds)?;
    let sha256 = match checksum(endings, ix, viewers) {
        // The folder may have been removed, or the disk may have failed, since the model was saved.
        Err(error) if failed.is_none() && is_io(&error) => {
            failed = Some(endings[ix].save_elsewhere(error)?);
            run_folder::checkpoint_sha256(&endings[ix].out)?
        }
        sha256 => sha256?,
    };
    endings[ix].write_cameras();
    Ok(Saved { sha256, failed })
}

/// Checksum of one of the models on disk. Viewers get pictures while it is computed.
fn checksum<P>(
    endings: &mut [EndingSession<P>],
    ix: usize,
    viewers: Option<&mut EndViewers>,
) -> anyhow::Result<String> {
    let folder = endings[ix].out.clone();
    let checksum = Task::start("checksum", move || run_folder::checkpoint_sha256(&folder));
    if let Some(viewers) = viewers {
        serve_while(viewers, endings, |_| !checksum.is_finished());
    }
    checksum
        .join()
        .unwrap_or_else(|panic| std::panic::resume_unwind(panic))
}

/// Waits until the last checkpoint of each saved model is on disk.
fn wait_for_checkpoints<P>(
    endings: &mut [EndingSession<P>],
    saved: &[Option<Saved>],
    errors: &mut Errors,
    viewers: Option<&mut EndViewers>,
) {
    if let Some(viewers) = viewers {
        let progress = StateProgress {
            text: "writing the last checkpoint".to_owned(),
            ..StateProgress::default()
        };
        viewers.show("saving", progress);
        serve_while(viewers, endings, |endings| {
            endings
                .iter()
                .any(|ending| ending.session.persistence.is_writing())
        });
    }
    for (ending, _) in endings
        .iter_mut()
        .zip(saved)
        .filter(|(_, saved)| saved.is_some())
    {
        ending.report_working(Some("writing the last checkpoint"));
        let written = ending.session.persistence.wait();
        ending.report_working(None);
        if let Err(error) = written {
            errors.record(error.context(format!(
                "the model was saved in {}, but not the last checkpoint",
                ending.out.display()
            )));
        }
    }
}

/// Serves viewers as long as work on another thread is in progress.
fn serve_while<P>(
    viewers: &mut EndViewers,
    endings: &mut [EndingSession<P>],
    is_in_progress: impl Fn(&[EndingSession<P>]) -> bool,
) {
    while is_in_progress(endings) {
        viewers.serve_waiting(&mut viewed(endings));
    }
}

/// The models of all sessions.
fn viewed<P>(endings: &mut [EndingSession<P>]) -> Vec<ViewedModel<'_>> {
    endings
        .iter_mut()
        .map(|ending| ending.session.viewed())
        .collect()
}

/// A model on disk.
struct Saved {
    /// Checksum of the model.
    sha256: String,
    /// Why the model could not be saved in the run folder, if it was saved elsewhere.
    failed: Option<anyhow::Error>,
}

impl Session {
    /// Scores the final model without saving it.
    pub fn score_without_saving(mut self) -> anyhow::Result<TrainingOutcome> {
        let seconds = stop_training(&mut self)?;
        let mut parts = ScoredSession::of(&mut self, Vec::new(), Vec::new(), None);
        score_at_end(&mut parts, seconds)
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

/// A session while its model is scored, and the viewers of all models.
struct ScoredSession<'a> {
    method: &'a mut AlignedModel,
    keyframes: &'a [Arc<Keyframe>],
    scoreboard: &'a Scoreboard,
    reporter: &'a mut Reporter,
    viewing: Viewing<'a>,
}

/// What drawing for viewers needs, besides the model that is being scored.
struct Viewing<'a> {
    kind: ModelKind,
    gpu: &'a Gpu,
    persistence: &'a mut Persistence,
    edits: &'a mut Arc<Edits>,
    /// The models before and after the scored one. Viewers can draw them, too.
    before: Vec<ViewedModel<'a>>,
    after: Vec<ViewedModel<'a>>,
    viewers: Option<&'a mut EndViewers>,
}

impl Viewing<'_> {
    /// Serves viewers between two renders of the scored model.
    fn serve(&mut self, method: &mut AlignedModel) {
        let Some(viewers) = self.viewers.as_deref_mut() else {
            return;
        };
        let mut models: Vec<ViewedModel<'_>> =
            self.before.iter_mut().map(ViewedModel::reborrow).collect();
        models.push(ViewedModel {
            kind: self.kind,
            method,
            gpu: self.gpu,
            persistence: &mut *self.persistence,
            edits: &mut *self.edits,
        });
        models.extend(self.after.iter_mut().map(ViewedModel::reborrow));
        viewers.serve(&mut models);
    }

    /// Shows viewers how many test images are scored.
    fn show_scored(&self, n_scored: usize, n_all: usize) {
        if let Some(viewers) = self.viewers.as_deref() {
            let is_only_model = self.before.is_empty() && self.after.is_empty();
            let model = if is_only_model {
                String::new()
            } else {
                format!(" of the model {}", self.kind.name())
            };
            let text = format!("{n_scored} of {n_all} test images{model}");
            viewers.show(
                &format!("scoring, {n_scored} of {n_all} images"),
                StateProgress::of_parts(text, n_scored, n_all),
            );
        }
    }

    /// Shows viewers that the report is being written.
    fn show_reporting(&self) {
        if let Some(viewers) = self.viewers.as_deref() {
            let progress = StateProgress {
                text: "writing the report".to_owned(),
                ..StateProgress::default()
            };
            viewers.show("saving", progress);
        }
    }
}

impl<'a> ScoredSession<'a> {
    /// The parts of a session.
    ///
    /// * `before`, `after`: the models of the other sessions, in order.
    fn of(
        session: &'a mut Session,
        before: Vec<ViewedModel<'a>>,
        after: Vec<ViewedModel<'a>>,
        viewers: Option<&'a mut EndViewers>,
    ) -> Self {
        let kind = session.kind();
        Self {
            method: &mut session.method,
            keyframes: &session.keyframes,
            scoreboard: &session.scoreboard,
            reporter: &mut session.reporter,
            viewing: Viewing {
                kind,
                gpu: &session.gpu,
                persistence: &mut session.persistence,
                edits: &mut session.edits,
                before,
                after,
                viewers,
            },
        }
    }
}

/// Scores the final model on all test images. Viewers get pictures meanwhile.
fn score_at_end(session: &mut ScoredSession<'_>, seconds: f64) -> anyhow::Result<TrainingOutcome> {
    let ScoredSession {
        method,
        scoreboard,
        reporter,
        viewing,
        ..
    } = session;
    viewing.gpu.wait()?;
    viewing.persistence.log_render();
    let n_all = scoreboard.tests().len();
    let mut n_reported = None;
    let per_image = scoreboard.score_all(method, |method, n_scored| {
        // This is called often, even without progress, so that viewers do not wait for the next
        // score.
        if n_reported.replace(n_scored) != Some(n_scored) {
            reporter.report_scoring(n_scored, n_all);
            viewing.show_scored(n_scored, n_all);
        }
        viewing.serve(method);
    })?;
    let progress = method.model().progress();
    Ok(TrainingOutcome {
        seconds,
        steps: progress.step,
        scores: Scores::mean(&per_image),
        primitives: progress.primitives,
        bytes: progress.bytes,
        evaluations: reporter.take_evaluations(),
        per_image,
    })
}

/// Scores one of the saved models, writes its report, and reports the end.
///
/// * `seconds`: training time.
fn report_end(
    endings: &mut [EndingSession<impl Serialize>],
    ix: usize,
    saved: &Saved,
    seconds: f64,
    viewers: Option<&mut EndViewers>,
) -> anyhow::Result<ModelOutcome> {
    let (before, rest) = endings.split_at_mut(ix);
    let (ending, after) = rest
        .split_first_mut()
        .expect("there is a session for each saved model");
    let adapter = ending.session.gpu.describe();
    let mut session =
        ScoredSession::of(&mut ending.session, viewed(before), viewed(after), viewers);
    let outcome = score_at_end(&mut session, seconds)?;
    let ScoredSession {
        method,
        keyframes,
        scoreboard,
        reporter,
        mut viewing,
    } = session;
    viewing.show_reporting();
    reporter.report_working(Some("drawing and writing the report"));
    // The pictures are rendered before profiling, because profiling trains the model further.
    let pictures = reporter.draw_pictures(
        method,
        keyframes,
        scoreboard.tests(),
        &outcome.per_image,
        |method| viewing.serve(method),
    );
    let passes = reporter.profile(method.model_mut())?;
    let reported = reporter.report_end(ScoredModel {
        out: &ending.out,
        checkpoint_sha256: &saved.sha256,
        outcome: &outcome,
        pictures,
        passes,
        cameras: method.model_mut().camera_corrections()?,
        alignment: method.alignment(),
        trials: method.model().report(),
        adapter,
        details: &ending.details,
    });
    reporter.report_working(None);
    reported?;
    viewing.serve(method);
    Ok(ModelOutcome {
        seconds,
        n_tests: outcome.per_image.len(),
        scores: outcome.scores,
    })
}

/// What is known about a model after it was scored.
struct ModelOutcome {
    /// Training time, seconds.
    seconds: f64,
    scores: Scores,
    n_tests: usize,
}

impl<P> EndingSession<P> {
    fn report_working(&mut self, work: Option<&'static str>) {
        self.session.reporter.report_working(work);
    }

    /// Saves the model. If `out` cannot be written, a temporary folder becomes `out`, and the
    /// reason is returned.
    ///
    /// * `seconds`: training time.
    fn save(&mut self, seconds: f64) -> anyhow::Result<Option<anyhow::Error>> {
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
        let saved = run_folder::save_model(&mut session.method, &session.edits, out);
        // The checkpoint is written after the model. If the disk has no space for both, the model
        // is more important.
        session.persistence.write_checkpoint(checkpoint);
        match saved {
            Ok(()) => Ok(None),
            // The disk may be full, or the folder read-only. Other errors, such as a lost GPU,
            // would also occur in another folder.
            Err(error) if is_io(&error) => self.save_elsewhere(error).map(Some),
            Err(error) => Err(error),
        }
    }

    /// Saves the model in a temporary folder, because its run folder could not be written. Returns
    /// the error to report.
    fn save_elsewhere(&mut self, save_error: anyhow::Error) -> anyhow::Result<anyhow::Error> {
        let Self { session, out, .. } = self;
        match save_in_fallback_folder(&mut session.method, &session.edits) {
            Ok(folder) => {
                let context = format!(
                    "cannot save the model in {}; it was saved in {}",
                    out.display(),
                    folder.display()
                );
                *out = folder;
                Ok(save_error.context(context))
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

    /// The finished model.
    fn into_finished(self, outcome: ModelOutcome) -> FinishedModel {
        let Self { session, out, .. } = self;
        FinishedModel {
            kind: session.kind(),
            method: session.method,
            edits: session.edits,
            folder: out,
            seconds: outcome.seconds,
            scores: outcome.scores,
            data: session.reporter.into_data(),
            n_tests: outcome.n_tests,
        }
    }
}

/// Saves a model in a new temporary folder, and returns the folder.
fn save_in_fallback_folder(method: &mut AlignedModel, edits: &Edits) -> anyhow::Result<PathBuf> {
    let folder = run_folder::make_fallback_folder()?;
    run_folder::save_model(method, edits, &folder)?;
    Ok(folder)
}
