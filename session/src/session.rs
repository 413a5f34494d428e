//! A training session: one model with its keyframes, clock, evaluation schedule and reports.

use crate::checkpoints::{self, Checkpoints, Snapshot};
use crate::clock::Clock;
use crate::decisions::DecisionLog;
use crate::error::Context;
use crate::evaluate::{Evaluator, ImageScores, Scores};
use crate::evaluation_schedule::EvaluationSchedule;
use crate::next_commands::{self, DataSource, SavedModel};
use crate::observer::{DoneEvent, Evaluation, FinishedReport, Observer, ProfileEvent, SessionEvent, SessionProgress};
use crate::pending_evaluation::PendingEvaluation;
use crate::recovery::Recovery;
use crate::{camera_list, gpu_loss, report, run_folder};
use calibration::{Alignment, CalibratedCamera, TrialReport};
use capture::Stop;
use keyframe::{DepthMap, Keyframe, Split, split_name};
use kinematics::quantile::median;
use serde::Serialize;
use std::collections::{BTreeMap, VecDeque};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};
use trainer::checkpoint::Checkpoint;
use trainer::gpu::{Gpu, PassTiming};
use trainer::{FailedModel, Method, ModelKind, Picture, Progress, RenderRequest};

/// Approximate duration of a slice. The device is idle for a moment at the end of each slice.
pub(crate) const TIME_SLICE: Duration = Duration::from_millis(40);
/// Number of steps in a profile, which reports medians.
const N_PROFILED: usize = 21;
/// Drivers are slow for a while after large buffers have been freed.
const PROFILE_WARM_UP: Duration = Duration::from_millis(700);
/// Maximum number of points of the PSNR curve. When it is reached, every other point is removed.
const MAX_HISTORY: usize = 512;

/// When to stop training.
#[derive(Clone, Copy, Debug, Default)]
pub struct Limits {
    /// Seconds on the session's clock.
    pub seconds: Option<f64>,
    /// Number of optimizer updates.
    pub steps: Option<u64>,
}

impl Limits {
    /// The limits as text, such as `8 s` or `500 steps`.
    pub fn describe(self) -> String {
        let parts =
            [self.seconds.map(|seconds| format!("{seconds} s")), self.steps.map(|steps| format!("{steps} steps"))];
        parts.into_iter().flatten().collect::<Vec<_>>().join(" or ")
    }
}

/// How a session is evaluated.
#[derive(Clone)]
pub struct Evaluators {
    /// Evaluator for scheduled evaluations: thorough in `train`, quick in a live run.
    pub during_training: Evaluator,
    /// Maximum number of test keyframes in a scheduled evaluation, spread evenly over all. All are scored at the end.
    pub max_images_during_training: usize,
    /// Evaluator for the end of training.
    pub at_end: Evaluator,
}

/// A model in training.
pub struct Session {
    kind: ModelKind,
    method: Box<dyn Method>,
    checkpoints: Option<Checkpoints>,
    decisions: Option<DecisionLog>,
    data: DataSource,
    recovery: Option<Recovery>,
    /// Evicted keyframes, without pixels, that the newest checkpoint may contain. The first `n_evicted_before_last` of
    /// them were evicted before the last checkpoint.
    evicted: Vec<Arc<Keyframe>>,
    n_evicted_before_last: usize,
    gpu: Arc<Gpu>,
    /// For scheduled evaluations.
    evaluator: Evaluator,
    max_images_during_training: usize,
    /// For the end of training.
    final_evaluator: Evaluator,
    /// Keyframes in the store, in order of arrival.
    keyframes: Vec<Arc<Keyframe>>,
    tests: VecDeque<Arc<Keyframe>>,
    limits: Limits,
    clock: Clock,
    /// Time that this session has used a shared device.
    device_time: Duration,
    /// Training time at which this session was finished while others continued, seconds.
    finished_secs: Option<f64>,
    schedule: EvaluationSchedule,
    /// An evaluation that is due or in progress.
    pending_evaluation: Option<PendingEvaluation>,
    /// Whether the caller scores an evaluation image by image.
    scores_stepwise: bool,
    reported: Vec<Evaluation>,
    history: Vec<(f64, f64)>,
    /// Latest PSNR of each test keyframe, by camera and stamp.
    newest_psnr: BTreeMap<(String, i64), f64>,
    observer: Box<dyn Observer>,
    /// Whether a stop was requested; an evaluation is then aborted.
    stop: Stop,
    profiles: bool,
}

/// Result of training.
pub struct TrainingOutcome {
    /// Training time, seconds.
    pub seconds: f64,
    /// Number of optimizer steps.
    pub steps: u64,
    /// Mean scores of the test images.
    pub scores: Scores,
    /// Number of primitives of the model, such as splats.
    pub primitives: u64,
    /// Size of the model, bytes.
    pub bytes: u64,
    /// The scheduled evaluations.
    pub evaluations: Vec<Evaluation>,
    per_image: Vec<ImageScores>,
}

/// The content of `report.json`.
#[derive(Debug, Serialize)]
struct Report<'a, T: Serialize> {
    done: &'a DoneEvent<'a>,
    adapter: String,
    #[serde(flatten)]
    details: &'a T,
    /// Results of A/B trials.
    trials: Vec<TrialReport>,
    /// GPU time of each pass of a step in milliseconds, if profiling was requested.
    passes: Vec<(&'static str, f64)>,
    evaluations: &'a [Evaluation],
    per_image: Vec<NamedScores<'a>>,
}

/// Scores of one test image with its name.
#[derive(Debug, Serialize)]
struct NamedScores<'a> {
    name: String,
    #[serde(flatten)]
    scores: &'a ImageScores,
}

/// A trained model that has been saved and scored and is still in GPU memory.
pub struct FinishedModel {
    /// The method.
    pub kind: ModelKind,
    /// The model.
    pub method: Box<dyn Method>,
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
        SavedModel { kind: self.kind, folder: &self.folder, data: &self.data, n_tests: self.n_tests }
    }
}

/// One of several sessions that end together, with its output folder and the report details specific to the command.
pub struct EndingSession<P> {
    /// The session.
    pub session: Session,
    /// Folder for the model and its report.
    pub out: PathBuf,
    /// Entries of the report besides scores.
    pub details: P,
}

/// Saves the models, then scores each one, writes its report, and reports the end. Returns the models so that they can
/// be shown.
pub fn finish(mut endings: Vec<EndingSession<impl Serialize>>) -> crate::Result<Vec<FinishedModel>> {
    // All models are saved before scoring, so that a second Ctrl-C during scoring loses nothing.
    let ended_secs: Vec<f64> =
        endings.iter_mut().map(|ending| ending.session.stop_training()).collect::<crate::Result<_>>()?;
    let mut saved = Vec::new();
    // The first error is returned, the others are logged.
    let mut failed = Ok(());
    let mut record_error = |error: crate::Error| match failed {
        Ok(()) => failed = Err(error),
        Err(_) => log::error!("{error:#}"),
    };
    for (mut ending, seconds) in endings.into_iter().zip(ended_secs) {
        // If one model cannot be saved, the others still are.
        match ending.session.save(&ending.out, seconds) {
            Ok(Saved { folder, sha256, failed: error }) => {
                ending.out = folder;
                ending.session.write_cameras(&ending.out);
                error.into_iter().for_each(&mut record_error);
                saved.push((ending, seconds, sha256));
            }
            Err(error) => record_error(error),
        }
    }
    for (ending, ..) in &mut saved {
        if let Some(Err(error)) = ending.session.checkpoints.as_mut().map(Checkpoints::wait) {
            record_error(
                error.with_context(format!(
                    "the model was saved in {}, but not the last checkpoint",
                    ending.out.display()
                )),
            );
        }
    }
    if saved.iter().any(|(ending, ..)| ending.session.stop.requested()) {
        log::info!("saved; scoring the test images, Ctrl-C again skips this");
    }
    let mut finished = Vec::new();
    for (EndingSession { session, out, details }, seconds, sha256) in saved {
        match session.report_end(&out, seconds, &sha256, &details) {
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
    /// Error of saving in the run folder, if the model was saved elsewhere.
    failed: Option<crate::Error>,
}

impl Session {
    /// A session with a new model. Its clock does not run until [`Self::start_clock`].
    pub fn new(
        gpu: Arc<Gpu>,
        (kind, method): (ModelKind, Box<dyn Method>),
        evaluators: Evaluators,
        limits: Limits,
        observer: Box<dyn Observer>,
    ) -> Self {
        Self {
            kind,
            method,
            checkpoints: None,
            decisions: None,
            data: DataSource::default(),
            recovery: None,
            evicted: Vec::new(),
            n_evicted_before_last: 0,
            gpu,
            evaluator: evaluators.during_training,
            max_images_during_training: evaluators.max_images_during_training,
            final_evaluator: evaluators.at_end,
            keyframes: Vec::new(),
            tests: VecDeque::new(),
            limits,
            clock: Clock::default(),
            device_time: Duration::ZERO,
            finished_secs: None,
            schedule: EvaluationSchedule::default(),
            pending_evaluation: None,
            scores_stepwise: false,
            reported: Vec::new(),
            history: Vec::new(),
            newest_psnr: BTreeMap::new(),
            observer,
            stop: Stop::default(),
            profiles: false,
        }
    }

    /// Enables checkpoints.
    pub fn with_checkpoints(self, checkpoints: Option<Checkpoints>) -> Self {
        Self { checkpoints, ..self }
    }

    /// Aborts an evaluation without a report if a stop is requested.
    pub fn with_stop(self, stop: &Stop) -> Self {
        Self { stop: stop.clone(), ..self }
    }

    /// Leaves scoring to [`Self::score_next`], so that the caller can draw pictures in between. The caller must neither
    /// train nor push keyframes while [`Self::is_scoring`], so that all images of an evaluation are scored on the same
    /// model state.
    pub fn with_stepwise_scoring(self) -> Self {
        Self { scores_stepwise: true, ..self }
    }

    /// Reports the GPU time of each pass at the end, if `profiles` is set.
    pub fn with_profile(self, profiles: bool) -> Self {
        Self { profiles, ..self }
    }

    /// Enables the log of timing-dependent decisions.
    pub fn with_decisions(self, decisions: DecisionLog) -> Self {
        Self { decisions: Some(decisions), ..self }
    }

    /// Sets the data source for the report and the next commands.
    pub fn with_data(self, data: DataSource) -> Self {
        Self { data, ..self }
    }

    /// Enables recovery on another device if the GPU fails.
    pub fn with_recovery(self, recovery: Recovery) -> Self {
        Self { recovery: Some(recovery), ..self }
    }

    /// Continues from the training time of earlier runs, without repeating their evaluations.
    pub fn with_elapsed_secs(mut self, previous_secs: f64) -> Self {
        self.clock = Clock::with_elapsed(previous_secs);
        self.schedule.reached(previous_secs);
        self
    }

    /// Makes this one of several sessions with a common clock.
    #[must_use]
    pub fn with_shared_clock(self, clock: Clock) -> Self {
        Self { clock, ..self }
    }

    /// The kind of model.
    pub fn kind(&self) -> ModelKind {
        self.kind
    }

    /// Starts the clock unless it is already running.
    pub fn start_clock(&mut self, at: Instant) {
        self.clock.start(at);
    }

    /// Time at which the clock was started, if it was.
    pub fn clock_started(&self) -> Option<Instant> {
        self.clock.started()
    }

    /// Keyframes in the store, in order of arrival.
    pub fn keyframes(&self) -> &[Arc<Keyframe>] {
        &self.keyframes
    }

    /// Training time so far, seconds.
    pub fn secs(&self) -> f64 {
        self.clock.secs()
    }

    /// Adds a keyframe to the model. Test keyframes are also kept for evaluation.
    pub fn push(&mut self, keyframe: &Arc<Keyframe>) -> crate::Result<()> {
        self.hold(keyframe);
        self.method.push(keyframe.clone())?;
        if let Some(decisions) = &mut self.decisions {
            decisions.pushed(self.method.n_total_steps()?, keyframe);
        }
        Ok(())
    }

    /// Adds a keyframe that the model was already trained on in the resumed run.
    pub fn hold(&mut self, keyframe: &Arc<Keyframe>) {
        if keyframe.split == Split::Test {
            if keyframe.rgba_srgb.chunks_exact(4).any(|pixel| pixel[3] > 0) {
                self.tests.push_back(keyframe.clone());
            } else {
                let Keyframe { camera, stamp, .. } = &**keyframe;
                log::warn!("the test image of {camera} at {} ns is not scored: all of its pixels are masked", stamp.0);
            }
        }
        self.keyframes.push(keyframe.clone());
    }

    /// Removes a keyframe.
    pub fn remove(&mut self, camera: &str, stamp: kinematics::Stamp) -> crate::Result<()> {
        let is_other = |held: &Arc<Keyframe>| held.camera.as_ref() != camera || held.stamp != stamp;
        if self.recovery.is_some() {
            let evicted = self.keyframes.iter().filter(|held| !is_other(held));
            self.evicted.extend(evicted.map(|keyframe| Arc::new(without_pixels(keyframe))));
        }
        self.keyframes.retain(is_other);
        self.tests.retain(is_other);
        self.newest_psnr.retain(|(of, nanos), _| of != camera || *nanos != stamp.0);
        self.method.remove(camera, stamp)?;
        if let Some(decisions) = &mut self.decisions {
            decisions.removed(self.method.n_total_steps()?, camera, stamp);
        }
        Ok(())
    }

    /// Creates splats for the keyframes so far.
    pub fn seed(&mut self) -> crate::Result<()> {
        self.note_render();
        Ok(self.method.seed()?)
    }

    /// Draws a picture.
    pub fn render(&mut self, request: &RenderRequest) -> Result<Picture, trainer::Error> {
        self.note_render();
        self.method.render(request)
    }

    /// Waits for queued work and returns the total number of updates, including trials.
    pub fn n_total_steps(&mut self) -> crate::Result<u64> {
        Ok(self.method.n_total_steps()?)
    }

    /// Whether a limit was reached.
    pub fn is_over(&self) -> bool {
        self.limits.seconds.is_some_and(|secs| self.secs() >= secs) || self.has_finished_steps()
    }

    /// Number of steps left until the step limit; `None` without a step limit.
    pub fn n_steps_remaining(&self) -> Option<u64> {
        Some(self.limits.steps?.saturating_sub(self.method.progress().step))
    }

    /// Whether the step limit was reached, so that the model no longer changes.
    pub fn has_finished_steps(&self) -> bool {
        self.limits.steps.is_some_and(|steps| self.method.progress().step >= steps)
    }

    /// Whether the model needs another keyframe before it can train further.
    pub fn is_idle(&self) -> bool {
        self.method.is_idle()
    }

    /// Trains for at most `max_steps` steps, and evaluates if an evaluation is due.
    pub fn step(&mut self, max_steps: u64) -> crate::Result<u64> {
        let n = self.train_steps(max_steps)?;
        self.evaluate_when_due()?;
        Ok(n)
    }

    /// Trains for at most `max_steps` steps.
    pub fn train_steps(&mut self, max_steps: u64) -> crate::Result<u64> {
        let left = self.limits.steps.map_or(u64::MAX, |steps| steps.saturating_sub(self.method.progress().step));
        if let Some(decisions) = &mut self.decisions {
            decisions.step_requested();
        }
        let n = self.method.step(max_steps.min(left))?;
        gpu_loss::lose_when_due(&self.gpu, self.method.progress().step);
        Ok(n)
    }

    /// Returns an error if the GPU failed.
    pub fn check_gpu(&self) -> crate::Result<()> {
        Ok(self.gpu.check()?)
    }

    /// Waits for queued work.
    pub fn wait(&self) -> crate::Result<()> {
        Ok(self.gpu.wait()?)
    }

    /// What is needed to continue on another device, if anything is.
    pub fn recovery(&self) -> Option<&Recovery> {
        self.recovery.as_ref()
    }

    /// Waits until no checkpoint is being written.
    pub fn wait_for_checkpoint(&mut self) {
        if let Some(Err(error)) = self.checkpoints.as_mut().map(Checkpoints::wait) {
            log::debug!("the last checkpoint was not written: {error:#}");
        }
    }

    /// Whether this run has written a checkpoint.
    pub fn has_checkpoint(&mut self) -> bool {
        self.checkpoints.as_mut().is_some_and(|checkpoints| checkpoints.newest().is_some())
    }

    /// Excludes this much from the training time.
    pub fn exclude(&self, spent: Duration) {
        self.clock.exclude(spent);
    }

    /// Drops the model on a failed device; [`Self::restart_on`] makes a new one.
    pub fn drop_model(&mut self) {
        self.method = Box::new(FailedModel);
    }

    /// Restores the model on another device from the newest checkpoint or, without one, from the start.
    pub fn restart_on(&mut self, gpu: &Arc<Gpu>) -> crate::Result<()> {
        let Some(recovery) = &self.recovery else { keyframe::bail!("this run cannot continue on another device") };
        let written = self.checkpoints.as_mut().and_then(Checkpoints::newest).map(Path::to_owned);
        let checkpoint = match (written, &recovery.resumed) {
            (Some(path), _) => Some(Checkpoint::read(&path).map_err(crate::Error::from)),
            (None, Some(folder)) => Some(checkpoints::read(folder)),
            (None, None) => None,
        };
        let held: Vec<Arc<Keyframe>> = recovery.known.iter().chain(&self.keyframes).cloned().collect();
        let all = [&held[..], &self.evicted[..]].concat();
        let resumed = checkpoint
            .map(|checkpoint| Ok::<_, crate::Error>(trainer::resume(gpu.clone(), &checkpoint?, &all)?))
            .transpose();
        let resumed = resumed.or_else(|error| {
            if error.is_gpu_error() {
                return Err(error);
            }
            log::warn!("cannot resume from the newest checkpoint: {error:#}");
            Ok(None)
        })?;
        let is_resumed = resumed.is_some();
        let (mut method, untrained) = match resumed {
            Some(resumed) => (resumed.method, resumed.untrained),
            None => (recovery.model_spec.start(gpu.clone())?, held.clone()),
        };
        method.prepare()?;
        let is_in = |keyframes: &[Arc<Keyframe>], keyframe_ref: &Arc<Keyframe>| {
            keyframes.iter().any(|other| Arc::ptr_eq(other, keyframe_ref))
        };
        for keyframe in self.evicted.iter().filter(|keyframe| !is_in(&untrained, keyframe)) {
            method.remove(&keyframe.camera, keyframe.stamp)?;
        }
        let from_step = method.n_total_steps()?;
        // The current log belongs to a run that ended here. A new log begins, possibly in the same file.
        if let Some(decisions) = self.decisions.take() {
            decisions.close_unfinished();
        }
        let settings = recovery.settings.continued_from(is_resumed.then_some(from_step));
        let mut decisions = DecisionLog::create(&recovery.folder, settings)?;
        held.iter()
            .filter(|keyframe| !is_in(&untrained, keyframe))
            .for_each(|keyframe| decisions.restored(from_step, keyframe));
        for keyframe in untrained.iter().filter(|keyframe| is_in(&held, keyframe)) {
            method.push(keyframe.clone())?;
            decisions.pushed(method.n_total_steps()?, keyframe);
        }
        log::info!(
            "reopened the GPU: training continues from {}",
            if is_resumed { format!("the checkpoint of step {from_step}") } else { "the start".to_owned() }
        );
        (self.method, self.gpu, self.decisions) = (method, gpu.clone(), Some(decisions));
        // All images of an evaluation must be scored on the same model state, which is lost.
        (self.finished_secs, self.pending_evaluation) = (None, None);
        Ok(())
    }

    /// Trains for one time slice on a shared device, at most `max_steps` steps. Queued work is complete when this
    /// returns.
    ///
    /// `is_render_pending`: whether a picture waits for the end of the slice; called after each submit.
    pub fn run_time_slice(
        &mut self,
        max_steps: impl Fn(&Self) -> u64,
        is_render_pending: impl Fn() -> bool,
    ) -> crate::Result<()> {
        let started = Instant::now();
        let mut n_steps = 0;
        loop {
            let n = self.train_steps(max_steps(self))?;
            n_steps += n;
            let is_at_end = self.is_over() || self.is_idle() || max_steps(self) == 0;
            if n == 0 || is_at_end || started.elapsed() >= TIME_SLICE || is_render_pending() {
                break;
            }
        }
        self.method.n_total_steps()?;
        // A session that cannot train is charged a full slice, so that it is not selected every time.
        self.device_time += if n_steps == 0 { TIME_SLICE } else { started.elapsed() };
        if self.has_finished_steps() {
            self.mark_finished();
        }
        Ok(())
    }

    /// Time that this session has used a shared device.
    pub fn device_time(&self) -> Duration {
        self.device_time
    }

    /// Raises the device time to at least this, so that an idle session does not catch up later.
    pub fn raise_device_time(&mut self, device_time: Duration) {
        self.device_time = self.device_time.max(device_time);
    }

    /// Marks the session as finished at the current training time.
    pub fn mark_finished(&mut self) {
        let secs = self.secs();
        self.finished_secs.get_or_insert(secs);
    }

    /// Writes a checkpoint if one is due, and evaluates if an evaluation is due. A finished session does neither.
    pub fn evaluate_when_due(&mut self) -> crate::Result<()> {
        if self.finished_secs.is_some() {
            return Ok(());
        }
        let seconds = self.secs();
        if let Some(checkpoints) = &mut self.checkpoints
            && checkpoints.write_when_due(Snapshot {
                method: self.method.as_mut(),
                keyframes: &self.keyframes,
                seconds,
                is_finished: false,
            })?
        {
            if let Some(decisions) = &mut self.decisions {
                decisions.checkpoint(self.method.n_total_steps()?);
            }
            // Until this checkpoint is written, the previous one is the newest, and it contains no keyframe that was
            // evicted before it.
            self.evicted.drain(..self.n_evicted_before_last);
            self.n_evicted_before_last = self.evicted.len();
        }
        if self.pending_evaluation.is_none() && self.schedule.reached(self.secs()) {
            self.begin_evaluation()?;
            while !self.scores_stepwise && self.is_scoring() {
                self.score_next()?;
            }
        }
        self.report_progress();
        Ok(())
    }

    /// Whether an evaluation is in progress.
    pub fn is_scoring(&self) -> bool {
        self.pending_evaluation.is_some()
    }

    /// Scores one more test image of the evaluation in progress, and reports the evaluation after its last image.
    pub fn score_next(&mut self) -> crate::Result<()> {
        let Some(mut evaluation) = self.pending_evaluation.take() else { return Ok(()) };
        if self.stop.requested() {
            return Ok(());
        }
        if let Some(keyframe) = evaluation.take_next() {
            let before = Instant::now();
            let score = |session: &mut Self| session.evaluator.score_named(session.method.as_mut(), &keyframe);
            let scores = self.without_clock(score)?;
            evaluation.add(scores, before.elapsed());
        }
        if evaluation.is_complete() {
            return self.report_evaluation(evaluation);
        }
        self.pending_evaluation = Some(evaluation);
        Ok(())
    }

    /// Sets whether pictures are requested during training; submits are shorter then.
    pub fn set_watched(&mut self, watched: bool) {
        self.method.set_watched(watched);
    }

    /// Scores the test keyframe whose score is oldest, for the curve between scheduled evaluations; counts as training
    /// time.
    pub fn refresh_psnr(&mut self) -> crate::Result<()> {
        let Some(oldest) = self.tests.pop_front() else { return Ok(()) };
        self.tests.push_back(oldest.clone());
        self.note_render();
        let quick = Evaluator::psnr_only();
        let scores = quick.score(self.method.as_mut(), &oldest)?;
        self.newest_psnr.insert((scores.camera, scores.stamp_nanos), scores.psnr);
        self.note_psnr();
        Ok(())
    }

    /// Mean of the latest PSNR of all test keyframes, dB.
    pub fn psnr(&self) -> Option<f64> {
        let n = self.newest_psnr.len();
        (n > 0).then(|| self.newest_psnr.values().sum::<f64>() / n as f64)
    }

    /// The history of [`Self::psnr`]: training seconds and dB.
    pub fn psnr_history(&self) -> &[(f64, f64)] {
        &self.history
    }

    /// The scheduled evaluations so far.
    pub fn evaluations(&self) -> &[Evaluation] {
        &self.reported
    }

    /// The result of keyframe alignment, once it is decided.
    pub fn alignment(&self) -> Option<&Alignment> {
        self.method.alignment()
    }

    /// The training progress.
    pub fn progress(&self) -> Progress {
        self.method.progress()
    }

    /// Saves the model after this many seconds of training. If its folder cannot be written, saves it in a temporary
    /// folder.
    fn save(&mut self, out: &Path, seconds: f64) -> crate::Result<Saved> {
        if let Some(decisions) = self.decisions.take()
            && let Err(error) = decisions.end(self.method.n_total_steps()?)
        {
            log::warn!("{error:#}");
        }
        let progress = self.method.progress();
        if progress.step > 0 && progress.primitives == 0 {
            log::warn!("the model is empty: no observation could be used");
        }
        // Saving ends a trial in progress. The checkpoint holds the state before that, so that a resumed run ends the
        // trial when it is due. A live run without new keyframes is not finished, because more may come after it is
        // resumed.
        let is_live = self.checkpoints.as_ref().is_some_and(Checkpoints::keeps_keyframes);
        let is_finished = self.is_over() || (self.is_idle() && !is_live);
        let (method, keyframes) = (self.method.as_mut(), &self.keyframes[..]);
        let snapshot = Snapshot { method, keyframes, seconds, is_finished };
        let checkpoint = match self.checkpoints.as_mut().map(|checkpoints| checkpoints.take(snapshot)).transpose() {
            Ok(checkpoint) => checkpoint,
            Err(error) => {
                log::warn!("cannot write a checkpoint of the last state: {error:#}"); // Still save the model.
                None
            }
        };
        let saved = run_folder::save_model(self.method.as_mut(), out).and_then(|()| run_folder::checkpoint_sha256(out));
        if let (Some(checkpoints), Some(checkpoint)) = (&mut self.checkpoints, checkpoint) {
            checkpoints.write(checkpoint);
        }
        match saved {
            Ok(sha256) => Ok(Saved { folder: out.to_owned(), sha256, failed: None }),
            Err(error) if error.is_io() => self.save_elsewhere(out, error),
            Err(error) => Err(error),
        }
    }

    /// Saves the model in a temporary folder, because the folder of its run could not be written.
    fn save_elsewhere(&mut self, out: &Path, save_error: crate::Error) -> crate::Result<Saved> {
        let save = |method: &mut dyn Method| {
            let folder = run_folder::make_fallback_folder()?;
            run_folder::save_model(method, &folder)?;
            let sha256 = run_folder::checkpoint_sha256(&folder)?;
            Ok((folder, sha256))
        };
        match save(self.method.as_mut()) {
            Ok((folder, sha256)) => {
                let context =
                    format!("cannot save the model in {}; it was saved in {}", out.display(), folder.display());
                Ok(Saved { folder, sha256, failed: Some(save_error.with_context(context)) })
            }
            Err(error) => {
                let error: crate::Error = error;
                log::error!("cannot save the model in a temporary folder either: {error:#}");
                Err(save_error.with_context(format!(
                    "cannot save the model in {}; {}",
                    out.display(),
                    self.describe_recoverable()
                )))
            }
        }
    }

    /// What to continue from if the model could not be saved, as a clause for an error message.
    fn describe_recoverable(&mut self) -> String {
        let has_checkpoint = self.has_checkpoint();
        let Some(recovery) = &self.recovery else { return "there is no checkpoint either".to_owned() };
        let left = recovery.describe_recoverable(has_checkpoint);
        if has_checkpoint { format!("{left}; use --out to save the model in another folder") } else { left }
    }

    /// Scores the saved model, writes the report, and reports the end.
    fn report_end(
        mut self,
        out: &Path,
        seconds: f64,
        checkpoint_sha256: &str,
        details: &impl Serialize,
    ) -> crate::Result<FinishedModel> {
        let outcome = self.score_at_end(seconds)?;
        let done = DoneEvent {
            event: "done",
            method: self.kind.name(),
            seconds,
            steps: outcome.steps,
            scores: outcome.scores,
            primitives: outcome.primitives,
            bytes: outcome.bytes,
            out,
            checkpoint_sha256,
        };
        // Done before profiling, which takes more steps.
        let comparisons = self.compare(&outcome.per_image);
        let passes = if self.profiles { self.profile()? } else { Vec::new() };
        let report = Report {
            done: &done,
            adapter: self.gpu.describe(),
            details,
            trials: self.method.report(),
            passes,
            evaluations: &outcome.evaluations,
            per_image: self.named(&outcome.per_image),
        };
        let written = run_folder::write_json(&out.join("report.json"), &report);
        let page = comparisons.and_then(|comparisons| self.write_page(out, &report, &comparisons));
        if let Err(error) = &page {
            log::warn!("{} was not written: {error:#}", report::FILE);
        }
        let passes = &report.passes;
        let profile = self.profiles.then(|| ProfileEvent { event: "profile", method: self.kind.name(), passes });
        let primitive = self.kind.entry().primitive;
        let finished = FinishedReport { done: &done, profile, primitive, has_page: page.is_ok() };
        self.observer.on_event(&SessionEvent::Finished(&finished));
        written.with_context(|| format!("the model was saved in {}, but its report was not", out.display()))?;
        Ok(self.finished(out, (seconds, done.scores), outcome.per_image.len()))
    }

    fn finished(self, out: &Path, (seconds, scores): (f64, Scores), n_tests: usize) -> FinishedModel {
        let Self { kind, method, data, .. } = self;
        FinishedModel { kind, method, folder: out.to_owned(), seconds, scores, data, n_tests }
    }

    fn named<'a>(&self, images: &'a [ImageScores]) -> Vec<NamedScores<'a>> {
        let name = |scores: &ImageScores| self.data.image_name(&scores.camera, scores.stamp_nanos);
        images.iter().map(|scores| NamedScores { name: name(scores), scores }).collect()
    }

    /// Renders test images for the report. `scores` belong to the test images, in the same order.
    fn compare(&mut self, scores: &[ImageScores]) -> crate::Result<Vec<report::Comparison>> {
        let name = |scores: &ImageScores| self.data.image_name(&scores.camera, scores.stamp_nanos);
        let scored = self.tests.iter().zip(scores).map(|(keyframe, scores)| report::Scored {
            keyframe,
            name: name(scores),
            psnr: scores.psnr,
            ssim: scores.ssim,
        });
        report::compare(self.method.as_mut(), &scored.collect::<Vec<_>>())
    }

    /// Writes the HTML page of the report.
    fn write_page(
        &self,
        out: &Path,
        report: &Report<'_, impl Serialize>,
        comparisons: &[report::Comparison],
    ) -> crate::Result<()> {
        let n_tests = report.per_image.len();
        let model = SavedModel { kind: self.kind, folder: out, data: &self.data, n_tests };
        let page = report::Page {
            folder: out,
            report: &serde_json::to_value(report)?,
            primitive: self.kind.entry().primitive,
            comparisons,
            next: &next_commands::for_models(&[model]),
            settings: report::settings_in(out),
            command: next_commands::this_command(),
        };
        page.write()
    }

    /// Writes the list of camera poses with the model's corrections. Without it, a viewer starts with an outside view
    /// of the model.
    fn write_cameras(&mut self, out: &Path) {
        let mut cameras = Vec::new();
        for keyframe in &self.keyframes {
            let lens = self.method.calibrated_camera(keyframe).unwrap_or_else(|error| {
                log::debug!("listing a camera without its learned correction: {error}");
                CalibratedCamera::of(keyframe)
            });
            cameras.push(camera_list::PosedCamera {
                camera: keyframe.camera.to_string(),
                stamp_nanos: keyframe.stamp.0,
                split: split_name(keyframe.split).to_owned(),
                size_px: keyframe.size_px,
                focal_px: lens.focal_px,
                principal_px: lens.principal_px,
                world_from_camera: camera_list::row_major(&lens.world_from_camera),
            });
        }
        if let Err(error) = camera_list::write(out, &cameras) {
            log::warn!("{} was not written: {error:#}", camera_list::FILE);
        }
    }

    /// GPU time of each kernel in a step in milliseconds: medians over [`N_PROFILED`] steps, in order of first
    /// execution.
    fn profile(&mut self) -> crate::Result<Vec<(&'static str, f64)>> {
        let mut names: Vec<&'static str> = Vec::new();
        let mut by_name: BTreeMap<&'static str, Vec<f64>> = BTreeMap::new();
        let began = Instant::now();
        while began.elapsed() < PROFILE_WARM_UP {
            self.method.profile_step()?;
        }
        for _ in 0..N_PROFILED {
            let mut sums: BTreeMap<&'static str, f64> = BTreeMap::new();
            for PassTiming { name, millis } in self.method.profile_step()? {
                *sums.entry(name).or_default() += millis;
                if !names.contains(&name) {
                    names.push(name);
                }
            }
            sums.into_iter().for_each(|(name, millis)| by_name.entry(name).or_default().push(millis));
        }
        Ok(names.into_iter().filter_map(|name| Some((name, median(by_name.get(name)?)?))).collect())
    }

    /// Scores the final model without saving it.
    pub fn score_without_saving(mut self) -> crate::Result<TrainingOutcome> {
        let seconds = self.stop_training()?;
        self.score_at_end(seconds)
    }

    /// Waits for queued work and returns the training time in seconds.
    fn stop_training(&mut self) -> crate::Result<f64> {
        self.gpu.wait()?;
        let seconds = self.finished_secs.unwrap_or_else(|| self.secs());
        self.observer.on_event(&SessionEvent::TrainingEnded);
        Ok(seconds)
    }

    fn score_at_end(&mut self, seconds: f64) -> crate::Result<TrainingOutcome> {
        std::mem::swap(&mut self.evaluator, &mut self.final_evaluator);
        let per_image = self.without_clock(Self::score_all)?;
        let progress = self.method.progress();
        Ok(TrainingOutcome {
            seconds,
            steps: progress.step,
            scores: Scores::mean(&per_image),
            primitives: progress.primitives,
            bytes: progress.bytes,
            evaluations: std::mem::take(&mut self.reported),
            per_image,
        })
    }

    /// Scores all test keyframes.
    fn score_all(&mut self) -> crate::Result<Vec<ImageScores>> {
        let tests: Vec<Arc<Keyframe>> = self.tests.iter().cloned().collect();
        self.evaluator.score_all(self.method.as_mut(), tests.iter())
    }

    /// Runs work that does not count as training time.
    fn without_clock<T>(&mut self, work: impl FnOnce(&mut Self) -> crate::Result<T>) -> crate::Result<T> {
        self.gpu.wait()?;
        self.note_render();
        let before = Instant::now();
        let done = work(self)?;
        self.gpu.wait()?;
        self.clock.exclude(before.elapsed());
        Ok(done)
    }

    /// Begins the evaluation that is due. It scores the model after all steps queued so far.
    fn begin_evaluation(&mut self) -> crate::Result<()> {
        self.method.n_total_steps()?;
        self.pending_evaluation =
            Some(PendingEvaluation::new(self.secs(), self.tests.iter(), self.max_images_during_training));
        Ok(())
    }

    /// Reports a completed evaluation.
    fn report_evaluation(&mut self, evaluation: PendingEvaluation) -> crate::Result<()> {
        let seconds = evaluation.seconds;
        let images = evaluation.into_images();
        for image in &images {
            self.newest_psnr.insert((image.camera.clone(), image.stamp_nanos), image.psnr);
        }
        self.note_psnr();
        let progress = self.method.progress();
        let eval = Evaluation {
            event: "eval",
            method: self.kind.name(),
            seconds,
            step: progress.step,
            scores: Scores::mean(&images),
            n_images: images.len(),
            primitives: progress.primitives,
            bytes: progress.bytes,
            step_millis: (progress.step > 0).then_some(progress.step_millis),
            primitive: self.kind.entry().primitive,
        };
        self.observer.on_event(&SessionEvent::Evaluated(&eval));
        self.reported.push(eval);
        Ok(())
    }

    /// Logs that a picture is drawn, because drawing creates splats for new keyframes.
    fn note_render(&mut self) {
        if let Some(decisions) = &mut self.decisions {
            decisions.seeded();
        }
    }

    fn note_psnr(&mut self) {
        let Some(psnr) = self.psnr() else { return };
        self.history.push((self.secs(), psnr));
        if self.history.len() > MAX_HISTORY {
            let mut keep = false;
            self.history.retain(|_| {
                keep = !keep;
                keep
            });
        }
    }

    fn report_progress(&mut self) {
        let progress = SessionProgress {
            primitive: self.kind.entry().primitive,
            seconds: self.secs(),
            progress: self.method.progress(),
            psnr: self.psnr(),
        };
        self.observer.on_event(&SessionEvent::Progress(&progress));
    }
}

/// A keyframe without pixels, with all the data by which a checkpoint identifies it.
fn without_pixels(keyframe: &Keyframe) -> Keyframe {
    let depth = keyframe.depth.as_ref().map(|depth| DepthMap { depth_m: [].into(), ..depth.clone() });
    Keyframe { rgba_srgb: [].into(), depth, truth: None, ..keyframe.clone() }
}

#[cfg(test)]
mod tests;
