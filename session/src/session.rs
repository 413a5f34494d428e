//! A training session: one model in training, with scheduled evaluations and checkpoints.

mod ending;
mod outcome;
mod persistence;
mod profile;
mod reporter;
mod scoreboard;
mod training_time;

pub use ending::{EndingSession, FinishedModel, finish};
pub use outcome::TrainingOutcome;
pub use scoreboard::Evaluators;
pub use training_time::Limits;

use crate::checkpoints::{Checkpoints, Snapshot};
use crate::chunk_publisher::ChunkPublisher;
use crate::decisions::DecisionLog;
use crate::editing::{self, Editor};
use crate::evaluate::Evaluator;
use crate::gpu_loss;
use crate::kept_folder::KeptFolder;
use crate::next_commands::DataSource;
use crate::observer::{Evaluation, Observer};
use crate::recovery::Recovery;
use crate::training_clock::Clock;
use calibration::{Alignment, CalibratedCamera, CameraCorrection};
use capture::Stop;
use gpu::Gpu;
use keyframe::Keyframe;
use kinematics::Stamp;
use model_files::{Edits, InitialPoints};
use persistence::Persistence;
use reporter::Reporter;
use scoreboard::Scoreboard;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};
use trainer::floaters::Floaters;
use trainer::{
    AlignedModel, FailedModel, ModelKind, Packing, Picture, Progress, QueuedPicture, RenderRequest,
    Rendered,
};
use training_time::TrainingTime;
use viz::EditRequest;

/// Approximate duration of a slice.
///
/// The device is idle for a moment at the end of each slice, so shorter slices train less. Longer
/// slices delay new keyframes, the other models, and the status, which are handled between slices.
const TIME_SLICE: Duration = Duration::from_millis(40);
/// Step time at which a live run pauses the growth of its model. Pictures take about as long as
/// steps.
///
/// Without this limit, a run of an hour on two cores grew to 400 k splats, made 0.6 steps per
/// second, and took 6 s per picture (`docs/benchmarks/2026-11-26-live.md`, section "Two cores").
const MAX_LIVE_STEP_MILLIS: f64 = 300.0;

/// A model in training.
pub struct Session {
    method: AlignedModel,
    gpu: Arc<Gpu>,
    /// Points from which a new model without depth starts.
    initial_points: Option<Arc<InitialPoints>>,
    /// Keyframes in the store, in order of arrival.
    keyframes: Vec<Arc<Keyframe>>,
    /// Corrections optimized with the scene, as last read.
    learned: BTreeMap<String, CameraCorrection>,
    time: TrainingTime,
    scoreboard: Scoreboard,
    persistence: Persistence,
    reporter: Reporter,
    /// A stop request aborts an evaluation in progress.
    stop: Stop,
    /// Erased space, which is not drawn for viewers. Training and scores ignore it.
    edits: Arc<Edits>,
}

impl Session {
    /// A session with a new model. Its clock does not run until [`Self::start_clock`].
    pub fn new(
        gpu: Arc<Gpu>,
        (kind, method): (ModelKind, AlignedModel),
        evaluators: Evaluators,
        limits: Limits,
        observer: Box<dyn Observer>,
    ) -> Self {
        Self {
            method,
            gpu,
            initial_points: None,
            keyframes: Vec::new(),
            learned: BTreeMap::new(),
            time: TrainingTime::new(limits),
            scoreboard: Scoreboard::new(evaluators),
            persistence: Persistence::default(),
            reporter: Reporter::new(kind, observer),
            stop: Stop::default(),
            edits: Arc::default(),
        }
    }

    /// Starts at these points if no keyframe has depth. Logs a warning if the method does not use
    /// points.
    pub fn with_initial_points(mut self, points: Option<Arc<InitialPoints>>) -> Self {
        self.initial_points = points;
        if !self.set_initial_points() {
            let method = self.kind().name();
            log::warn!(
                "the method {method} does not start from points: those of the dataset are not used"
            );
        }
        self
    }

    /// Passes the initial points to the model. Returns false if there are some, but the model does
    /// not use them.
    fn set_initial_points(&mut self) -> bool {
        let Self {
            method,
            initial_points,
            ..
        } = self;
        initial_points
            .as_ref()
            .is_none_or(|points| method.model_mut().set_initial_points(points))
    }

    /// Enables checkpoints.
    pub fn with_checkpoints(mut self, checkpoints: Option<Checkpoints>) -> Self {
        self.persistence.set_checkpoints(checkpoints);
        self
    }

    /// Aborts an evaluation, without reporting it, when `stop` is requested.
    pub fn with_stop(self, stop: &Stop) -> Self {
        Self {
            stop: stop.clone(),
            ..self
        }
    }

    /// Leaves scoring to [`Self::score_next`], so that the caller can draw pictures in between. The
    /// caller must neither train nor push keyframes while [`Self::is_scoring`], so that all images
    /// of an evaluation are scored on the same model state.
    pub fn with_stepwise_scoring(mut self) -> Self {
        self.scoreboard.set_stepwise();
        self
    }

    /// Reports the GPU time of each pass at the end, if `profiles` is set.
    pub fn with_profile(mut self, profiles: bool) -> Self {
        self.reporter.set_profiles(profiles);
        self
    }

    /// Continues with the edits of an earlier run.
    pub fn with_edits(self, edits: Edits) -> Self {
        Self {
            edits: Arc::new(edits),
            ..self
        }
    }

    /// Enables the log of timing-dependent decisions.
    pub fn with_decisions(mut self, decisions: DecisionLog) -> Self {
        self.persistence.set_decisions(decisions);
        self
    }

    /// Sets the data source for the report and the next commands.
    pub fn with_data(mut self, data: DataSource) -> Self {
        self.reporter.set_data(data);
        self
    }

    /// Sets the folders of the run that are created again if they are removed or renamed.
    #[must_use]
    pub fn with_folders(mut self, folders: Vec<KeptFolder>) -> Self {
        self.persistence.set_folders(folders);
        self
    }

    /// Makes the folders of the run again if they have disappeared.
    pub fn check_folders(&mut self) {
        self.persistence.check_folders();
    }

    /// Enables recovery on another device if the GPU fails.
    pub fn with_recovery(mut self, recovery: Recovery) -> Self {
        self.persistence.set_recovery(recovery);
        self
    }

    /// Continues from the training time of earlier runs, without repeating their evaluations.
    pub fn with_elapsed_secs(mut self, previous_secs: f64) -> Self {
        self.time.set_clock(Clock::with_elapsed(previous_secs));
        self.scoreboard.skip_until(previous_secs);
        self
    }

    /// Shares a clock with other sessions.
    #[must_use]
    pub fn with_shared_clock(mut self, clock: Clock) -> Self {
        self.time.set_clock(clock);
        self
    }

    /// The kind of model.
    pub fn kind(&self) -> ModelKind {
        self.reporter.kind()
    }

    /// Starts the clock unless it is already running.
    pub fn start_clock(&mut self, at: Instant) {
        self.time.start(at);
    }

    /// Time at which the clock was started; `None` if it is not running.
    pub fn clock_started(&self) -> Option<Instant> {
        self.time.started()
    }

    /// Keyframes in the store, in order of arrival.
    pub fn keyframes(&self) -> &[Arc<Keyframe>] {
        &self.keyframes
    }

    /// Training time so far, seconds.
    pub fn secs(&self) -> f64 {
        self.time.secs()
    }

    /// Adds a keyframe to the model. Test keyframes are also kept for evaluation.
    pub fn push(&mut self, keyframe: &Arc<Keyframe>) -> anyhow::Result<()> {
        // Held first: after a GPU failure in `push`, the restored model gets all keyframes in the
        // store, and this one must be among them.
        self.hold(keyframe);
        self.method.push(keyframe.clone())?;
        self.persistence.log_push(&mut self.method, keyframe)
    }

    /// Adds a keyframe without pushing it to the model, such as one that a resumed model was
    /// already trained on.
    pub fn hold(&mut self, keyframe: &Arc<Keyframe>) {
        self.scoreboard.hold(keyframe);
        self.keyframes.push(keyframe.clone());
    }

    /// Removes a keyframe.
    pub fn remove(&mut self, camera: &str, stamp: Stamp) -> anyhow::Result<()> {
        let is_other = |held: &Arc<Keyframe>| held.camera.as_ref() != camera || held.stamp != stamp;
        // The newest checkpoint may contain this keyframe. Resuming from it after a GPU failure
        // needs its description.
        self.keyframes
            .iter()
            .filter(|held| !is_other(held))
            .for_each(|keyframe| self.persistence.evict(keyframe));
        self.keyframes.retain(is_other);
        self.scoreboard.remove(camera, stamp);
        self.method.remove(camera, stamp)?;
        self.persistence
            .log_removal(&mut self.method, camera, stamp)
    }

    /// Creates splats for the keyframes so far.
    pub fn seed(&mut self) -> anyhow::Result<()> {
        self.persistence.log_render();
        Ok(self.method.model_mut().seed()?)
    }

    /// Draws a picture.
    pub fn render(&mut self, request: &RenderRequest) -> Result<Picture, trainer::Error> {
        self.persistence.log_render();
        self.method.model_mut().render(request)
    }

    /// Starts to render a picture, packed if `packing` is given; see
    /// [`trainer::Method::queue_packed`].
    pub fn queue_picture(
        &mut self,
        request: &RenderRequest,
        packing: Option<Packing>,
    ) -> Result<QueuedPicture, trainer::Error> {
        self.persistence.log_render();
        let model = self.method.model_mut();
        match packing {
            Some(packing) => model.queue_packed(request, packing),
            None => model
                .render(request)
                .map(|picture| QueuedPicture::ready(picture.into())),
        }
    }

    /// Waits for the picture of a request.
    pub fn finish_picture(
        &mut self,
        queued: QueuedPicture,
        request: &RenderRequest,
        packing: Option<Packing>,
    ) -> Result<Rendered, trainer::Error> {
        let model = self.method.model_mut();
        match (queued.finish(&self.gpu)?, packing) {
            (Some(rendered), _) => Ok(rendered),
            // A buffer was too small for the queued picture. Rendering it again, with waiting,
            // grows the buffer.
            (None, Some(packing)) => model.render_packed(request, packing),
            (None, None) => model.render(request).map(Rendered::Picture),
        }
    }

    /// Publishes the chunks of the model if they are due. Returns the time spent.
    pub(crate) fn publish_chunks(&mut self, publisher: &mut ChunkPublisher) -> Duration {
        publisher.publish(self.kind(), self.method.model_mut(), &self.edits)
    }

    /// Erased space, for pictures that viewers request.
    pub fn edits(&self) -> &Arc<Edits> {
        &self.edits
    }

    /// Changes the edits; see [`Editor::apply`].
    pub(crate) fn edit(
        &mut self,
        editor: &mut Editor,
        request: &EditRequest,
    ) -> Result<Option<String>, String> {
        editor.apply(
            request,
            request.action(),
            &mut self.edits,
            self.method.model_mut(),
        )
    }

    /// Erases floaters; see [`editing::erase_floaters`].
    pub(crate) fn erase_floaters(&mut self, floaters: Floaters) -> Result<String, String> {
        editing::erase_floaters(&mut self.edits, floaters)
    }

    /// Waits for queued work and returns the total number of updates, including those of trials.
    pub fn n_total_steps(&mut self) -> anyhow::Result<u64> {
        Ok(self.method.n_total_steps()?)
    }

    /// Whether a limit was reached.
    pub fn is_over(&self) -> bool {
        self.time.is_over(self.progress().step)
    }

    /// Number of steps left until the step limit; `None` without a step limit.
    pub fn n_steps_remaining(&self) -> Option<u64> {
        self.time.n_steps_remaining(self.progress().step)
    }

    /// Whether the step limit was reached, so that the model no longer changes.
    pub fn has_finished_steps(&self) -> bool {
        self.time.has_finished_steps(self.progress().step)
    }

    /// Whether the model needs another keyframe before it can train further.
    pub fn is_idle(&self) -> bool {
        self.method.is_idle()
    }

    /// Trains for at most `max_steps` steps, and evaluates if an evaluation is due.
    pub fn step(&mut self, max_steps: u64) -> anyhow::Result<u64> {
        let n = self.train_steps(max_steps)?;
        self.evaluate_when_due()?;
        Ok(n)
    }

    /// Trains for at most `max_steps` steps.
    pub fn train_steps(&mut self, max_steps: u64) -> anyhow::Result<u64> {
        let left = self.n_steps_remaining().unwrap_or(u64::MAX);
        // Logged even if no step is made: the request alone starts training on the keyframes so
        // far, which affects the model.
        self.persistence.log_step_request();
        let n = self.method.step(max_steps.min(left))?;
        // Tests simulate a lost GPU at a given step.
        gpu_loss::lose_when_due(&self.gpu, self.progress().step);
        Ok(n)
    }

    /// Pauses the growth of the model while its steps take too long for a live run. A larger model
    /// would be trained and drawn even more slowly, so that an operator would see less.
    pub(crate) fn pause_growth_when_slow(&mut self) -> anyhow::Result<()> {
        // Growth continues at half of the limit only. With a single limit, each change of the load
        // of the machine near it would pause and continue growth, and log this.
        match self.progress().step_millis {
            millis if millis > MAX_LIVE_STEP_MILLIS => self.pause_growth(true),
            millis if millis < 0.5 * MAX_LIVE_STEP_MILLIS => self.pause_growth(false),
            _ => Ok(()),
        }
    }

    /// Pauses or continues the growth of the model.
    pub(crate) fn pause_growth(&mut self, is_paused: bool) -> anyhow::Result<()> {
        if self.method.model_mut().pause_growth(is_paused)? {
            let Progress {
                primitives,
                step_millis,
                ..
            } = self.progress();
            let change = if is_paused { "is paused" } else { "continues" };
            log::info!(
                "growth {change} at {primitives} splats: a step takes {step_millis:.0} ms, limit {MAX_LIVE_STEP_MILLIS} ms"
            );
            self.persistence
                .log_growth_pause(&mut self.method, is_paused)?;
        }
        Ok(())
    }

    /// Applies the result of an alignment in the background if it is ready, or waits for it if
    /// `wait`. Returns whether a result was applied.
    pub fn poll_alignment(&mut self, wait: bool) -> anyhow::Result<bool> {
        let is_applied = self.method.poll_alignment(wait)?;
        if is_applied {
            self.refresh_corrections()?;
            self.persistence.log_alignment(&mut self.method)?;
        }
        Ok(is_applied)
    }

    /// Camera of a keyframe with the corrections of alignment and those that
    /// [`Self::refresh_corrections`] has read.
    pub fn camera_of(&self, keyframe: &Keyframe) -> CalibratedCamera {
        let learned = self.learned.get(&*keyframe.camera);
        self.method
            .alignment()
            .unwrap_or(&Alignment::default())
            .camera(keyframe, learned)
    }

    /// Reads the corrections that are optimized with the scene, for [`Self::camera_of`]. Waits for
    /// queued work.
    pub fn refresh_corrections(&mut self) -> anyhow::Result<()> {
        self.learned = self.camera_corrections()?;
        Ok(())
    }

    /// Corrections of cameras that were optimized with the scene; they follow those of
    /// [`Self::alignment`].
    pub fn camera_corrections(&mut self) -> anyhow::Result<BTreeMap<String, CameraCorrection>> {
        Ok(self.method.model_mut().camera_corrections()?)
    }

    /// Trains for one time slice on a shared device, at most `max_steps` steps. Queued work is
    /// complete when this returns.
    ///
    /// `is_render_pending` returns whether a picture is requested, which ends the slice; called
    /// after each submit.
    pub fn run_time_slice(
        &mut self,
        max_steps: impl Fn(&Self) -> u64,
        is_render_pending: impl Fn() -> bool,
    ) -> anyhow::Result<()> {
        let started = Instant::now();
        let mut n_steps = 0;
        loop {
            let n = self.train_steps(max_steps(self))?;
            n_steps += n;
            // In lockstep, 0 means that the next keyframe is due before the next step.
            let is_at_end = self.is_over() || self.is_idle() || max_steps(self) == 0;
            if n == 0 || is_at_end || started.elapsed() >= TIME_SLICE || is_render_pending() {
                break;
            }
        }
        // Waits for the queued steps. Otherwise, the next session would be charged for their time.
        self.method.n_total_steps()?;
        // A session that cannot train is charged a full slice, so that it is not selected every
        // time.
        self.time.add_device_time(if n_steps == 0 {
            TIME_SLICE
        } else {
            started.elapsed()
        });
        if self.has_finished_steps() {
            self.mark_finished();
        }
        Ok(())
    }

    /// Time for which this session has used a shared device.
    pub fn device_time(&self) -> Duration {
        self.time.device_time()
    }

    /// Raises the device time to at least `device_time`, so that an idle session does not catch up
    /// later.
    pub fn raise_device_time(&mut self, device_time: Duration) {
        self.time.raise_device_time(device_time);
    }

    /// Marks the session as finished at the current training time.
    pub fn mark_finished(&mut self) {
        self.time.mark_finished();
    }

    /// Whether the adapter runs on the CPU.
    pub fn is_software(&self) -> bool {
        self.gpu.is_software()
    }

    /// Returns an error if the GPU failed.
    pub fn check_gpu(&self) -> anyhow::Result<()> {
        Ok(self.gpu.check()?)
    }

    /// Waits for queued work.
    pub fn wait(&self) -> anyhow::Result<()> {
        Ok(self.gpu.wait()?)
    }

    /// Waits until no checkpoint is being written.
    pub fn wait_for_checkpoint(&mut self) {
        if let Err(error) = self.persistence.wait() {
            log::debug!("the last checkpoint was not written: {error:#}");
        }
    }

    /// Describes how to continue if the run fails now, as a sentence without a period; `None`
    /// without recovery.
    pub fn describe_recoverable(&mut self) -> Option<String> {
        self.persistence.describe_recoverable()
    }

    /// Excludes a duration from the training time.
    pub fn exclude(&self, spent: Duration) {
        self.time.exclude(spent);
    }

    /// Whether [`Self::restart_on`] can continue on another device.
    pub fn can_restart(&self) -> bool {
        self.persistence.can_restore()
    }

    /// Drops the model on a failed device; [`Self::restart_on`] makes a new one.
    pub fn drop_model(&mut self) {
        self.method = AlignedModel::unaligned(Box::new(FailedModel));
    }

    /// Restores the model on another device from the newest checkpoint or else from scratch.
    pub fn restart_on(&mut self, gpu: &Arc<Gpu>) -> anyhow::Result<()> {
        self.method = self.persistence.restore(gpu, &self.keyframes)?;
        self.gpu = gpu.clone();
        // Checkpoints do not contain the initial points.
        self.set_initial_points();
        // The checkpoint may be older than the last step, so that steps are left to make.
        self.time.unmark_finished();
        // Drops an evaluation in progress: all of its images must be scored on the same model
        // state, which is lost.
        self.scoreboard.take_pending();
        Ok(())
    }

    /// Makes the next checkpoint due now. Returns false if the run writes no checkpoints.
    pub(crate) fn request_checkpoint(&mut self) -> bool {
        self.persistence.request_checkpoint()
    }

    /// Writes a checkpoint, or the new keyframes, if they are due.
    pub(crate) fn write_checkpoint_when_due(&mut self) -> anyhow::Result<()> {
        // The folder must exist before a checkpoint is written into it.
        self.persistence.check_folders_when_due();
        let seconds = self.secs();
        self.persistence.write_checkpoint_when_due(Snapshot {
            method: &mut self.method,
            keyframes: &self.keyframes,
            edits: &self.edits,
            seconds,
            is_finished: false,
        })
    }

    /// Writes a checkpoint if one is due, and evaluates if an evaluation is due. A finished session
    /// does neither.
    pub fn evaluate_when_due(&mut self) -> anyhow::Result<()> {
        if self.time.is_finished() {
            return Ok(());
        }
        self.write_checkpoint_when_due()?;
        if self.scoreboard.is_due(self.secs()) {
            // The evaluation scores the model after all steps queued so far.
            self.method.n_total_steps()?;
            self.scoreboard.begin(self.secs());
            while !self.scoreboard.is_stepwise() && self.is_scoring() {
                self.score_next()?;
            }
        }
        self.reporter
            .report_progress(self.secs(), self.progress(), self.psnr());
        Ok(())
    }

    /// Whether an evaluation is in progress.
    pub fn is_scoring(&self) -> bool {
        self.scoreboard.is_scoring()
    }

    /// Scores one more test image of the evaluation in progress, and reports the evaluation after
    /// its last image.
    pub fn score_next(&mut self) -> anyhow::Result<()> {
        let Some(mut evaluation) = self.scoreboard.take_pending() else {
            return Ok(());
        };
        // The evaluation is dropped: the model is saved and scored again at the end of the run.
        if self.stop.requested() {
            return Ok(());
        }
        if let Some(keyframe) = evaluation.take_next() {
            let before = Instant::now();
            let scores =
                self.without_clock(|scoreboard, method| scoreboard.score(method, &keyframe))?;
            evaluation.add(scores, before.elapsed());
        }
        if evaluation.is_complete() {
            self.scoreboard.add_spent(evaluation.spent());
            // Reported with the time at which it was due, so that runs are compared at equal times.
            let due_secs = evaluation.seconds;
            let images = evaluation.into_images();
            self.scoreboard.record(&images, self.secs());
            self.reporter
                .report_evaluation(due_secs, &images, self.progress());
        } else {
            self.scoreboard.continue_with(evaluation);
        }
        Ok(())
    }

    /// Runs work that does not count as training time.
    fn without_clock<T>(
        &mut self,
        work: impl FnOnce(&Scoreboard, &mut AlignedModel) -> anyhow::Result<T>,
    ) -> anyhow::Result<T> {
        // Steps that are still queued are training time, so they are completed first.
        self.gpu.wait()?;
        self.persistence.log_render();
        let before = Instant::now();
        let done = work(&self.scoreboard, &mut self.method)?;
        // Work that `work` has queued is completed before its time is taken.
        self.gpu.wait()?;
        self.time.exclude(before.elapsed());
        Ok(done)
    }

    /// Sets whether pictures are requested during training. If so, submits are shorter.
    pub fn set_watched(&mut self, watched: bool) {
        self.method.model_mut().set_watched(watched);
    }

    /// Scores the test keyframe with the oldest score, for the PSNR curve between scheduled
    /// evaluations. Counts as training time.
    pub fn refresh_psnr(&mut self) -> anyhow::Result<()> {
        let Some(oldest) = self.scoreboard.next_to_refresh() else {
            return Ok(());
        };
        self.persistence.log_render();
        let scores = Evaluator::psnr_only().score(&mut self.method, &oldest)?;
        self.scoreboard.record(&[scores], self.secs());
        Ok(())
    }

    /// Mean of the latest PSNR of all test keyframes, dB.
    pub fn psnr(&self) -> Option<f64> {
        self.scoreboard.psnr()
    }

    /// The history of [`Self::psnr`]: training seconds and dB.
    pub fn psnr_history(&self) -> &[(f64, f64)] {
        self.scoreboard.psnr_history()
    }

    /// The scheduled evaluations so far.
    pub fn evaluations(&self) -> &[Evaluation] {
        self.reporter.evaluations()
    }

    /// The result of keyframe alignment, once it is available.
    pub fn alignment(&self) -> Option<&Alignment> {
        self.method.alignment()
    }

    /// The training progress.
    pub fn progress(&self) -> Progress {
        self.method.model().progress()
    }
}

#[cfg(test)]
mod tests;
