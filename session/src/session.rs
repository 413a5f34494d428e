//! A training session: one model in training, with scheduled evaluations and checkpoints.

mod end_viewers;
mod ending;
mod growth_log;
mod options;
mod outcome;
mod persistence;
mod profile;
mod reporter;
mod scoreboard;
mod training_time;
mod viewed_model;

pub use end_viewers::EndViewers;
pub use ending::{EndingSession, FinishedModel, finish};
pub use options::SessionOptions;
pub use outcome::TrainingOutcome;
pub use persistence::Persistence;
pub use scoreboard::{Evaluators, Scoreboard};
pub use training_time::{Limits, TrainingTime};

use crate::checkpoints::Snapshot;
use crate::evaluate::Evaluator;
use crate::gpu_loss;
use crate::next_commands::DataSource;
use crate::observer::Evaluation;
use crate::training_clock::Clock;
use calibration::{Alignment, CalibratedCamera, CameraCorrection};
use capture::Stop;
use gpu::Gpu;
use growth_log::GrowthLog;
use keyframe::Keyframe;
use kinematics::Stamp;
use model_files::{Edits, InitialPoints};
use reporter::Reporter;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Instant;
use trainer::{AlignedModel, FailedModel, ModelKind, Progress};
use viewed_model::ViewedModel;

/// Step time at which a live run pauses the growth of its model. Pictures take about as long as
/// steps.
///
/// Without this limit, a run of an hour on two cores grew to 400 k splats, made 0.6 steps per
/// second, and took 6 s per picture (`docs/benchmarks/2026-11-26-live.md`, section "Two cores").
pub(crate) const MAX_LIVE_STEP_MILLIS: f64 = 300.0;

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
    growth_log: GrowthLog,
}

impl Session {
    /// A session with a new model. Its clock does not run yet. Logs a warning if there are initial
    /// points, but the method does not use points.
    pub fn new(
        gpu: Arc<Gpu>,
        (kind, mut method): (ModelKind, AlignedModel),
        options: SessionOptions,
    ) -> Self {
        let SessionOptions {
            evaluators,
            limits,
            observer,
            stop,
            clock,
            previous_secs,
            previous_psnr,
            initial_points,
            edits,
            scores_stepwise,
            profiles,
            checkpoints,
            decisions,
            recovery,
            folders,
            data,
        } = options;
        if !set_initial_points(&mut method, initial_points.as_ref()) {
            log::warn!(
                "the method {} does not start from points: those of the dataset are not used",
                kind.name()
            );
        }
        let mut scoreboard =
            Scoreboard::new(evaluators, scores_stepwise).with_history(previous_psnr);
        if let Some(previous_secs) = previous_secs {
            scoreboard.skip_until(previous_secs);
        }
        Self {
            method,
            gpu,
            initial_points,
            keyframes: Vec::new(),
            learned: BTreeMap::new(),
            time: TrainingTime::new(limits, previous_secs.map_or(clock, Clock::with_elapsed)),
            scoreboard,
            persistence: Persistence::new(checkpoints, decisions, recovery, folders),
            reporter: Reporter::new(kind, observer, data, profiles),
            stop,
            edits: Arc::new(edits),
            growth_log: GrowthLog::default(),
        }
    }

    /// Sets the data source for the report and the next commands.
    pub fn with_data(mut self, data: DataSource) -> Self {
        self.reporter.set_data(data);
        self
    }

    /// The kind of model.
    pub fn kind(&self) -> ModelKind {
        self.reporter.kind()
    }

    /// Training time, and its limits.
    pub fn time(&self) -> &TrainingTime {
        &self.time
    }

    /// Training time, to be changed.
    pub(crate) fn time_mut(&mut self) -> &mut TrainingTime {
        &mut self.time
    }

    /// Scores of the test keyframes.
    pub fn scoreboard(&self) -> &Scoreboard {
        &self.scoreboard
    }

    /// Checkpoints, recovery data and folders of the run.
    pub fn persistence(&mut self) -> &mut Persistence {
        &mut self.persistence
    }

    /// The GPU.
    pub fn gpu(&self) -> &Gpu {
        &self.gpu
    }

    /// The model, for drawing and editing.
    pub(crate) fn viewed(&mut self) -> ViewedModel<'_> {
        ViewedModel {
            kind: self.reporter.kind(),
            method: &mut self.method,
            gpu: &self.gpu,
            persistence: &mut self.persistence,
            edits: &mut self.edits,
        }
    }

    /// Keyframes in the store, in order of arrival.
    pub fn keyframes(&self) -> &[Arc<Keyframe>] {
        &self.keyframes
    }

    /// Adds a keyframe to the model. Test keyframes are also kept for evaluation.
    pub fn push(&mut self, keyframe: &Arc<Keyframe>) -> anyhow::Result<()> {
        // The keyframe is held first. After a GPU failure in `push`, the restored model gets all
        // keyframes in the store, and this keyframe must be among them.
        self.hold(keyframe);
        self.method.push(keyframe.clone())?;
        self.persistence.log_push(&mut self.method, keyframe)
    }

    /// Replaces a keyframe with a version that has a more accurate pose.
    pub fn revise(&mut self, keyframe: &Arc<Keyframe>) -> anyhow::Result<()> {
        // After a GPU failure, the restored model gets the keyframes in the store, so the new
        // version must be among them.
        let removed = self.remove(&keyframe.camera, keyframe.stamp);
        self.persistence.store_again(keyframe);
        removed.and(self.push(keyframe))
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

    /// Erased space, for pictures that viewers request.
    pub fn edits(&self) -> &Arc<Edits> {
        &self.edits
    }

    /// Waits for queued work and returns the total number of updates, including those of trials.
    pub fn n_total_steps(&mut self) -> anyhow::Result<u64> {
        Ok(self.method.n_total_steps()?)
    }

    /// Whether a limit was reached.
    pub fn is_over(&self) -> bool {
        self.time.is_over(self.progress().step)
    }

    /// Whether the step limit was reached, so that the model no longer changes.
    pub fn has_finished_steps(&self) -> bool {
        self.time.has_finished_steps(self.progress().step)
    }

    /// Whether the model needs another keyframe before it can train further.
    pub fn is_idle(&self) -> bool {
        self.method.is_idle()
    }

    /// Trains for at most `max_steps` steps.
    pub fn train_steps(&mut self, max_steps: u64) -> anyhow::Result<u64> {
        let left = self.time.n_steps_remaining(self.progress().step);
        // The request is logged even if no step is made. It starts training on the keyframes so
        // far, which affects the model.
        self.persistence.log_step_request();
        let n = self.method.step(max_steps.min(left.unwrap_or(u64::MAX)))?;
        // Tests simulate a lost GPU at a given step.
        gpu_loss::lose_when_due(&self.gpu, self.progress().step);
        Ok(n)
    }

    /// Pauses or continues the growth of the model.
    pub(crate) fn pause_growth(&mut self, is_paused: bool) -> anyhow::Result<()> {
        if self.method.model_mut().pause_growth(is_paused)? {
            let Progress {
                primitives,
                step_millis,
                ..
            } = self.progress();
            self.growth_log
                .changed(is_paused, primitives, step_millis, Instant::now());
            self.persistence
                .log_growth_pause(&mut self.method, is_paused)?;
        }
        Ok(())
    }

    /// Applies the result of an alignment in the background if it is ready. If `wait` is set, waits
    /// for the result. Returns whether a result was applied.
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

    /// Corrections of cameras that were optimized with the scene. They apply after the corrections
    /// of [`Self::alignment`].
    pub fn camera_corrections(&mut self) -> anyhow::Result<BTreeMap<String, CameraCorrection>> {
        Ok(self.method.model_mut().camera_corrections()?)
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
        set_initial_points(&mut self.method, self.initial_points.as_ref());
        // The checkpoint may be older than the last step, so that steps are left to make.
        self.time.unmark_finished();
        // An evaluation in progress is dropped. All of its images must be scored on the same model
        // state, and this state is lost.
        self.scoreboard.take_pending();
        Ok(())
    }

    /// Writes a checkpoint, or the new keyframes, if they are due.
    pub(crate) fn write_checkpoint_when_due(&mut self) -> anyhow::Result<()> {
        // The folder must exist before a checkpoint is written into it.
        self.persistence.check_folders_when_due();
        let seconds = self.time.secs();
        self.persistence.write_checkpoint_when_due(Snapshot {
            method: &mut self.method,
            keyframes: &self.keyframes,
            edits: &self.edits,
            psnr_history: self.scoreboard.psnr_history(),
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
        if self.scoreboard.is_due(self.time.secs()) {
            // The evaluation scores the model after all steps queued so far.
            self.method.n_total_steps()?;
            self.scoreboard.begin(self.time.secs());
            self.reporter
                .report_working(Some("scoring test images during training"));
            while !self.scoreboard.is_stepwise() && self.scoreboard.is_scoring() {
                self.score_next()?;
            }
            self.reporter.report_working(None);
        }
        self.reporter
            .report_progress(self.time.secs(), self.progress(), self.scoreboard.psnr());
        Ok(())
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
            // Steps that are still queued are training time, so they are completed first.
            self.gpu.wait()?;
            self.persistence.log_render();
            let scoring_began = Instant::now();
            let scores = self.scoreboard.score(&mut self.method, &keyframe)?;
            // The time includes the work that scoring has queued on the GPU.
            self.gpu.wait()?;
            self.time.exclude(scoring_began.elapsed());
            evaluation.add(scores, before.elapsed());
        }
        if evaluation.is_complete() {
            self.scoreboard.add_spent(evaluation.spent());
            // The evaluation is reported with the time at which it was due, so that runs are
            // compared at equal times.
            let due_secs = evaluation.seconds;
            let images = evaluation.into_images();
            self.scoreboard.record(&images, self.time.secs());
            self.reporter
                .report_evaluation(due_secs, &images, self.progress());
        } else {
            self.scoreboard.continue_with(evaluation);
        }
        Ok(())
    }

    /// Scores the test keyframe with the oldest score, for the PSNR curve between scheduled
    /// evaluations. Counts as training time.
    pub fn refresh_psnr(&mut self) -> anyhow::Result<()> {
        let Some(oldest) = self.scoreboard.next_to_refresh() else {
            return Ok(());
        };
        self.persistence.log_render();
        let scores = Evaluator::psnr_only().score(&mut self.method, &oldest)?;
        self.scoreboard.record(&[scores], self.time.secs());
        Ok(())
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

/// Passes the initial points to a model. Returns false if there are some, but the model does not
/// use them.
fn set_initial_points(method: &mut AlignedModel, points: Option<&Arc<InitialPoints>>) -> bool {
    points.is_none_or(|points| method.model_mut().set_initial_points(points))
}

#[cfg(test)]
mod ending_tests;
#[cfg(test)]
mod tests;
