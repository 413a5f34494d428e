//! A scene model, and the alignment of its cameras while it trains.
//!
//! Alignment runs in parallel with training, once or repeatedly as keyframes arrive. Its result is
//! applied a fixed number of steps after alignment began, so that the same seed gives the same
//! model. In real time, the result is applied when the caller polls for it
//! ([`AlignedModel::poll_alignment`]), so that training never waits. A single alignment from
//! features, without depth, takes only seconds and precedes the first step. If a result changes the
//! corrections, the keyframes are replaced. The model then moves with its keyframes or restarts,
//! see [`Method::recalibrate`].

use crate::corrected_keyframe::{CorrectedKeyframe, id_of};
use crate::model_metadata::{METADATA_FILE, read_metadata};
use crate::model_options::{AlignTiming, CommonOptions};
use crate::pending::PendingCheckpoint;
use crate::{Error, Method};
use calibration::{
    Alignment, AlignmentTask, CalibratedCamera, CameraRefinement, MOVEMENT_WINDOW, MovementTask,
    alignment_step,
};
use keyframe::{Keyframe, Split};
use kinematics::Stamp;
use model_files::checkpoint::Checkpoint;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::borrow::Cow;
use std::collections::{BTreeMap, HashMap};
use std::path::Path;
use std::sync::Arc;

/// Key of the alignment state in a checkpoint. [`METADATA_KEY`] is the key of the alignment in
/// `model.json`.
const STATE_KEY: &str = "aligned";
const METADATA_KEY: &str = "alignment";

/// Number of keyframes at which a live run is aligned for the first time. About four of them are
/// validation images, which is the smallest number with which alignment accepts a parameter. With
/// fewer keyframes, alignment would have no effect. With more keyframes, the model would be trained
/// longer on wrong cameras.
const FIRST_LIVE_ALIGNMENT: usize = 25;
/// Factor by which the number of keyframes grows between two alignments of a live run. Because it
/// is a factor, a long run is aligned only a logarithmic number of times. A smaller factor corrects
/// cameras sooner, but needs more CPU time and restarts more models.
const LIVE_ALIGNMENT_GROWTH: f64 = std::f64::consts::SQRT_2;

/// A resumed model, and the keyframes that it was not trained on.
pub type ResumedModel<M = Box<dyn Method>> = (M, Vec<Arc<Keyframe>>);

/// A scene model, and the alignment of its keyframes' cameras if that is requested.
///
/// This type has the functions that involve alignment. All other functions are called on the model
/// ([`Self::model_mut`]).
pub struct AlignedModel {
    model: Box<dyn Method>,
    alignment_task: AlignmentTask,
    /// The uncorrected keyframes in order of arrival, kept until alignment is done.
    original_keyframes: Vec<Arc<Keyframe>>,
    /// Detection of movements. It has begun if `state.n_references` is given.
    movement_task: Option<MovementTask>,
    state: AlignedState,
}

/// The alignment state in a checkpoint.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct AlignedState {
    choice: CameraRefinement,
    /// Number of steps from the start of alignment until its result is applied.
    alignment_steps: u64,
    /// Step at which the result of the running alignment is due.
    due_step: Option<u64>,
    timing: AlignTiming,
    /// Number of keyframes at which the next alignment begins.
    begins_at: usize,
    /// Steps of the model before its last restart.
    n_steps_before_restart: u64,
    /// Whether movements of cameras are detected after the first alignment of a live run.
    #[serde(default)]
    detects_movements: bool,
    /// Stamp of the first keyframe, which may have been evicted since, nanoseconds.
    first_nanos: Option<i64>,
    /// Number of original keyframes that are references of movement detection. `None` before it
    /// begins.
    n_references: Option<usize>,
    /// Number of original keyframes when alignment began. `None` before that.
    n_begun: Option<usize>,
    /// Whether the alignment task is done. This field and the next two are set only in checkpoints.
    is_aligned: bool,
    /// Result of the alignment task.
    alignment: Option<Alignment>,
    /// Camera and stamp of the original keyframes.
    keyframes: Vec<(String, i64)>,
}

impl AlignedModel {
    /// An untrained model, with the alignment that the options request. If alignment runs only
    /// once, its result is applied early in the planned steps.
    pub fn new(model: Box<dyn Method>, common: &CommonOptions, is_software: bool) -> Self {
        let is_live = common.align_timing != AlignTiming::Once;
        Self {
            model,
            alignment_task: AlignmentTask::new(&common.align),
            original_keyframes: Vec::new(),
            movement_task: None,
            state: AlignedState {
                choice: common.align.clone(),
                alignment_steps: alignment_step(is_software, common.n_planned_steps),
                timing: common.align_timing,
                begins_at: if is_live { FIRST_LIVE_ALIGNMENT } else { 0 },
                detects_movements: common.detects_movements && is_live,
                ..AlignedState::default()
            },
        }
    }

    /// A model without alignment.
    pub fn unaligned(model: Box<dyn Method>) -> Self {
        Self::new(model, &CommonOptions::default(), false)
    }

    /// A saved model, with the alignment stored in its folder.
    pub fn load(model: Box<dyn Method>, folder: &Path) -> Result<Self, Error> {
        if !folder.join(METADATA_FILE).exists() {
            log::warn!(
                "{} has no {METADATA_FILE}: the corrections of the cameras and the background of the model are unknown",
                folder.display()
            );
        }
        let metadata = read_metadata(folder)?;
        let unknown = metadata.unknown();
        if !unknown.is_empty() {
            log::warn!(
                "{METADATA_FILE} of {} has unknown fields, which are ignored: {}",
                folder.display(),
                unknown.join(", ")
            );
        }
        Ok(Self {
            alignment_task: AlignmentTask::done(metadata.alignment),
            ..Self::unaligned(model)
        })
    }

    /// Resumes from a checkpoint. `resume` receives the corrected keyframes, and returns the model
    /// and the keyframes that it was not trained on.
    ///
    /// * `placeholders`: keyframes without pixels that replace missing keyframes. Their poses are
    ///   corrected. The caller must remove them from the resumed model.
    pub fn resume(
        checkpoint: &Checkpoint,
        keyframes: &[Arc<Keyframe>],
        placeholders: &[Arc<Keyframe>],
        resume: impl FnOnce(&Checkpoint, &[Arc<Keyframe>]) -> Result<ResumedModel, Error>,
    ) -> Result<ResumedModel<Self>, Error> {
        // The model does not know the state of the alignment, so this state is removed from the
        // checkpoint first. A checkpoint without this state was written by a model that is not
        // aligned.
        let mut own_checkpoint = checkpoint.clone();
        let Some(state) = own_checkpoint
            .state
            .as_object_mut()
            .and_then(|state| state.remove(STATE_KEY))
        else {
            let (model, untrained) = resume(checkpoint, &[keyframes, placeholders].concat())?;
            return Ok((Self::unaligned(model), untrained));
        };
        let mut state: AlignedState = serde_json::from_value(state).map_err(invalid_state)?;
        let ids = std::mem::take(&mut state.keyframes);
        // Checkpoints do not contain a running alignment. It starts again from the same keyframes,
        // and its result is due at the same step, so the resumed run gives the same model.
        let mut alignment_task = AlignmentTask::done(state.alignment.take());
        if !state.is_aligned {
            alignment_task.request_again();
        }

        // The model was trained on corrected keyframes. It verifies that it receives the same
        // keyframes.
        let corrected = keyframes
            .iter()
            .map(|keyframe| alignment_task.corrected(keyframe));
        let corrected: Vec<_> = corrected.chain(placeholders.iter().cloned()).collect();
        let (model, untrained) = resume(&own_checkpoint, &corrected)?;

        // Alignment needs the originals in the order in which they arrived. Their numbers must also
        // be the same as before, because alignment and the references of movements each use a
        // prefix of the list.
        let mut originals: BTreeMap<_, &Arc<Keyframe>> = BTreeMap::new();
        for keyframe in keyframes {
            let original = originals.entry(id_of(keyframe)).or_insert(keyframe);
            // After recovery, the earlier version of a revised keyframe is there without pixels.
            if original.rgba_srgb.is_empty() {
                *original = keyframe;
            }
        }
        let original = |id: (&str, i64)| originals.get(&id).map(|keyframe| Arc::clone(keyframe));
        // After recovery, evicted keyframes have no pixels. They are removed from the model, like
        // missing keyframes.
        let with_pixels = |(camera, nanos): &(String, i64)| {
            original((camera, *nanos))
                .filter(|keyframe: &Arc<Keyframe>| !keyframe.rgba_srgb.is_empty())
        };
        let n_with_pixels = |n: usize| ids.iter().take(n).filter_map(with_pixels).count();
        state.n_begun = state.n_begun.map(n_with_pixels);
        state.n_references = state.n_references.map(n_with_pixels);
        let original_keyframes: Vec<_> = ids.iter().filter_map(with_pixels).collect();

        // These keyframes are not corrected here, because `push` corrects them.
        let ixs: HashMap<_, usize> = corrected
            .iter()
            .enumerate()
            .map(|(ix, keyframe)| (Arc::as_ptr(keyframe), ix))
            .collect();
        let untrained = untrained
            .iter()
            .filter_map(|keyframe| keyframes.get(*ixs.get(&Arc::as_ptr(keyframe))?).cloned())
            .collect();
        let mut aligned = Self {
            model,
            alignment_task,
            original_keyframes,
            movement_task: None,
            state,
        };
        if let Some(n_references) = aligned.state.n_references {
            aligned.detect_movements(n_references);
        }
        Ok((aligned, untrained))
    }

    /// The model, for functions that do not involve alignment.
    pub fn model(&self) -> &dyn Method {
        self.model.as_ref()
    }

    /// The model, for functions that do not involve alignment. Train it only with [`Self::step`],
    /// and add keyframes only with [`Self::push`].
    pub fn model_mut(&mut self) -> &mut dyn Method {
        self.model.as_mut()
    }

    /// Adds a keyframe. See [`Method::push`]. It may begin or end an alignment.
    pub fn push(&mut self, keyframe: Arc<Keyframe>) -> Result<(), Error> {
        // Test keyframes must not influence the cameras. If alignment runs only once and is done,
        // it needs no more keyframes. In live runs, the task is always requested again.
        let is_used =
            !self.alignment_task.is_done() && keyframe.split != Split::Test && keyframe.is_finite();
        // Validation keyframes are pushed again after resuming.
        let is_new = is_used
            && !self
                .original_keyframes
                .iter()
                .any(|known| id_of(known) == id_of(&keyframe));
        // In lockstep, the test of the previous keyframe must end before this keyframe is
        // corrected. Otherwise, its correction would depend on the speed of the test.
        if is_new && self.state.timing == AlignTiming::Lockstep {
            self.poll_movement(true)?;
        }
        let corrected = self.alignment_task.corrected(&keyframe);
        self.model.push(corrected.clone())?;
        if is_new {
            self.state.first_nanos.get_or_insert(keyframe.stamp.0);
            self.original_keyframes.push(keyframe);
            if let Some(task) = &mut self.movement_task {
                task.push(corrected);
            }
        }
        Ok(())
    }

    /// Removes a keyframe. See [`Method::remove`].
    pub fn remove(&mut self, camera: &str, stamp: Stamp) -> Result<(), Error> {
        if let Some(ix) = self
            .original_keyframes
            .iter()
            .position(|keyframe| id_of(keyframe) == (camera, stamp.0))
        {
            self.original_keyframes.remove(ix);
            // Both numbers are lengths of a prefix of the list, which has just become shorter.
            for n in [&mut self.state.n_begun, &mut self.state.n_references] {
                *n = n.map(|n| n - usize::from(ix < n));
            }
        }
        self.model.remove(camera, stamp)
    }

    /// Queues up to `n` optimizer updates. See [`Method::step`]. Also begins an alignment or
    /// applies its result, if this is due.
    pub fn step(&mut self, n: u64) -> Result<u64, Error> {
        if self.precedes_training() {
            self.begin_alignment();
            self.finish_alignment()?;
        }
        // The result is applied exactly at its due step, so a batch of steps must end there.
        self.finish_alignment_when_due()?;
        let n_steps = self.model.step(n.min(self.steps_to_alignment()))?;
        if n_steps > 0 {
            // Alignment begins after the first step, because the first step also needs much CPU
            // time.
            self.begin_alignment();
            if let (Some(task), None) = (&mut self.movement_task, self.state.n_begun) {
                task.begin();
            }
        }
        Ok(n_steps)
    }

    /// Whether further steps have no effect until a keyframe arrives.
    pub fn is_idle(&self) -> bool {
        // While alignment is awaited, the model is not idle, because the caller must continue to
        // call `step`, which applies the result. Before the first step, there are no keyframes to
        // train on, so waiting would never end.
        self.model.is_idle() && (!self.is_awaited() || self.model.progress().step == 0)
    }

    /// In a live run, applies the result of the alignment in the background if it is ready. With
    /// `wait`, waits for the result. Returns whether a result was applied. Without `wait`, this
    /// depends on timing.
    pub fn poll_alignment(&mut self, wait: bool) -> Result<bool, Error> {
        if self.state.timing != AlignTiming::RealTime {
            return Ok(false);
        }
        // No alignment is running, so a movement may be found instead.
        if self.state.n_begun.is_none() {
            return self.poll_movement(wait);
        }
        let is_ready = wait || self.alignment_task.has_result();
        if is_ready {
            self.begin_alignment(); // A resumed model has not started it.
            self.finish_alignment()?;
        }
        Ok(is_ready)
    }

    /// Waits for queued updates and returns the total number of updates, including updates before a
    /// restart and updates of rejected trials. Unlike [`Progress::step`](crate::Progress::step), it
    /// never decreases.
    pub fn n_total_steps(&mut self) -> Result<u64, Error> {
        Ok(self.state.n_steps_before_restart + self.model.n_total_steps()?)
    }

    /// The camera of a keyframe with the corrections of alignment, followed by the corrections that
    /// the model learned for this camera. Corrections of single images are not applied.
    pub fn calibrated_camera(&mut self, keyframe: &Keyframe) -> Result<CalibratedCamera, Error> {
        let learned = self.model.camera_corrections()?;
        Ok(self
            .alignment_task
            .calibrated_camera(keyframe, learned.get(&*keyframe.camera)))
    }

    /// A keyframe with the mask of the robot as its corrected camera sees it, for comparisons with
    /// the model. Its calibration stays the same.
    pub fn remasked<'a>(&self, keyframe: &'a Keyframe) -> Cow<'a, Keyframe> {
        match self.alignment() {
            Some(alignment) => alignment.remasked(keyframe),
            None => Cow::Borrowed(keyframe),
        }
    }

    /// Result of keyframe alignment. `None` until alignment has finished. Also `None` if alignment
    /// was not requested or not possible.
    pub fn alignment(&self) -> Option<&Alignment> {
        self.alignment_task.result()
    }

    /// Writes the model and its alignment into an existing folder. See [`Method::save`].
    pub fn save(&mut self, folder: &Path) -> Result<(), Error> {
        // The model writes its own metadata. The alignment is added to the same file afterwards.
        self.model.save(folder)?;
        let Some(alignment) = self.alignment_task.result() else {
            return Ok(());
        };
        let path = folder.join(METADATA_FILE);
        let invalid_file = |error: serde_json::Error| Error::SplatFile {
            path: path.clone(),
            reason: error.to_string(),
        };
        let bytes = files::read(&path, files::Budget::TEXT).map_err(|source| Error::Read {
            path: path.clone(),
            source,
        })?;
        let mut metadata: serde_json::Map<String, serde_json::Value> =
            serde_json::from_slice(&bytes).map_err(invalid_file)?;
        metadata.insert(
            METADATA_KEY.to_owned(),
            serde_json::to_value(alignment).map_err(invalid_file)?,
        );
        let text = format!("{:#}\n", serde_json::Value::Object(metadata));
        files::write(&path, text).map_err(|source| Error::Write {
            path: path.clone(),
            source,
        })
    }

    /// Takes a checkpoint of the model and its alignment. See [`Method::checkpoint`].
    pub fn checkpoint(&mut self) -> Result<PendingCheckpoint, Error> {
        // Without alignment, the checkpoint of the model is sufficient.
        if self.state.choice == CameraRefinement::default() && self.alignment().is_none() {
            return self.model.checkpoint();
        }
        let state = AlignedState {
            is_aligned: self.alignment_task.is_done(),
            alignment: self.alignment_task.result().cloned(),
            keyframes: self
                .original_keyframes
                .iter()
                .map(|keyframe| (keyframe.camera.to_string(), keyframe.stamp.0))
                .collect(),
            ..self.state.clone()
        };
        // The state of the alignment is captured now, with the state of the model. Only reading the
        // GPU buffers is deferred.
        let state = serde_json::to_value(state).map_err(invalid_state)?;
        let pending = self.model.checkpoint()?;
        Ok(PendingCheckpoint::new(move || {
            let mut checkpoint = pending.finish()?;
            if let Some(all) = checkpoint.state.as_object_mut() {
                all.insert(STATE_KEY.to_owned(), state);
            }
            Ok(checkpoint)
        }))
    }

    /// Starts alignment if it is requested and there are enough keyframes.
    fn begin_alignment(&mut self) {
        let n_keyframes = self.original_keyframes.len();
        // If a checkpoint was written while alignment ran, the resumed run must start alignment
        // again, even if keyframes were removed since then.
        let has_enough = self.state.n_begun.is_some() || n_keyframes >= self.state.begins_at;
        if !self.alignment_task.is_requested() || !has_enough {
            return;
        }
        // A resumed alignment must not use keyframes that arrived after it began.
        let n_begun = *self.state.n_begun.get_or_insert(n_keyframes);
        // The due step of a single alignment counts from the start of training, because all its
        // keyframes are pushed before the first step.
        let from = if self.state.timing == AlignTiming::Once {
            0
        } else {
            self.model.progress().step
        };
        // In real time, no step is due, because the caller polls for the result.
        if self.state.timing != AlignTiming::RealTime {
            self.state
                .due_step
                .get_or_insert(from + self.state.alignment_steps);
        }
        self.alignment_task
            .begin(&self.original_keyframes[..n_begun], &self.state.choice);
    }

    /// Applies the result of alignment at a fixed step, or when the model is idle.
    fn finish_alignment_when_due(&mut self) -> Result<(), Error> {
        let step = self.model.progress().step;
        // An idle model may never reach the due step. For example, a distance field has no steps
        // left once it has fused all keyframes. In this case, the result is applied at once.
        let is_idle = step > 0 && self.model.is_idle() && self.is_awaited();
        let is_due = is_idle || self.state.due_step.is_some_and(|due_step| step >= due_step);
        if self.alignment_task.is_done() || !is_due {
            return Ok(());
        }
        self.begin_alignment(); // A model that was resumed at this step has not started it.
        self.finish_alignment()
    }

    /// Waits for the result of alignment and applies it.
    fn finish_alignment(&mut self) -> Result<(), Error> {
        // `finish` replaces the result, but the keyframes of the model are corrected with the
        // previous result.
        let previous = AlignmentTask::done(self.alignment_task.result().cloned());
        let is_changed = self.alignment_task.finish(&self.original_keyframes)?;
        let n_begun = self.state.n_begun.take();
        self.state.due_step = None;
        // Live runs request the next alignment at once. It begins when enough keyframes have
        // arrived.
        if self.state.timing != AlignTiming::Once {
            self.state.begins_at = next_live_alignment(self.original_keyframes.len());
            self.alignment_task.request_again();
        }
        if is_changed {
            self.recalibrate(&previous)?;
        }
        if self.state.detects_movements && self.alignment_task.result().is_some() {
            match (self.state.n_references, n_begun) {
                // The first alignment counts as correct. Movements are measured relative to the
                // keyframes that it used.
                (None, Some(n_begun)) => self.detect_movements(n_begun),
                (Some(n_references), _) if is_changed => {
                    // The latest keyframes are tested again with the new corrections.
                    let n_older =
                        first_recent(&self.original_keyframes, MOVEMENT_WINDOW).max(n_references);
                    self.detect_movements(n_older);
                }
                _ => {}
            }
        }
        self.alignment_task.forget_redrawn();
        // After a single alignment, nothing reads the original keyframes. They are dropped because
        // they hold all pixels.
        if self.state.timing == AlignTiming::Once {
            self.original_keyframes.clear();
        }
        Ok(())
    }

    /// Replaces the keyframes with their newly corrected versions.
    fn recalibrate(&mut self, previous: &AlignmentTask) -> Result<(), Error> {
        let Some(alignment) = self.alignment_task.result() else {
            return Ok(());
        };
        // Masks of the robot that were not drawn in the background take a few milliseconds each.
        let keyframes: Vec<_> = self
            .original_keyframes
            .par_iter()
            .map(|original| CorrectedKeyframe {
                before: previous.moved(original),
                after: self.alignment_task.corrected(original),
            })
            .collect();
        // A model that cannot move with its keyframes starts again from step 0. Its earlier steps
        // remain part of the total number of steps, which limits and schedules of the session use.
        let n_steps = self.model.n_total_steps()?;
        self.model.recalibrate(&keyframes, alignment)?;
        let n_forgotten = n_steps.wrapping_sub(self.model.n_total_steps()?);
        if n_forgotten > 0 {
            log::info!("training restarted with corrected cameras");
        }
        self.state.n_steps_before_restart += n_forgotten;
        Ok(())
    }

    /// Detects movements from now on. The first `n_references` keyframes are references, and later
    /// keyframes are tested.
    fn detect_movements(&mut self, n_references: usize) {
        let corrected = |keyframe: &Arc<Keyframe>| self.alignment_task.corrected(keyframe);
        let corrected: Vec<_> = self.original_keyframes.par_iter().map(corrected).collect();
        let (references, later) = corrected.split_at(n_references);
        let mut task = MovementTask::new(references.to_vec());
        later
            .iter()
            .for_each(|keyframe| task.push(keyframe.clone()));
        self.movement_task = Some(task);
        self.state.n_references = Some(n_references);
    }

    /// Applies a movement if one was found. With `wait`, tests all keyframes first. Returns whether
    /// a movement was applied. During an alignment, no keyframes are tested.
    fn poll_movement(&mut self, wait: bool) -> Result<bool, Error> {
        // A running alignment may change the corrections of the task's keyframes. Detection starts
        // again after the alignment.
        let (Some(task), None) = (&mut self.movement_task, self.state.n_begun) else {
            return Ok(false);
        };
        let Some(movement) = task.poll(wait)? else {
            return Ok(false);
        };
        // Reports give the time since the first keyframe of the run.
        let first = Stamp(self.state.first_nanos.unwrap_or(movement.since_nanos));
        let previous = AlignmentTask::done(self.alignment_task.result().cloned());
        self.alignment_task.add_movement(movement, first);
        if let Some(movement) = self
            .alignment_task
            .result()
            .and_then(|alignment| alignment.movements.last())
        {
            log::warn!("{movement}");
        }
        self.recalibrate(&previous)?;
        // The next alignment begins now, because it also uses the images since the movement.
        let n_keyframes = self.original_keyframes.len();
        self.state.begins_at = n_keyframes;
        // All keyframes are corrected now, so all of them can be references for the next movement.
        self.detect_movements(n_keyframes);
        Ok(true)
    }

    /// Whether the model must wait for an alignment before its result is final.
    fn is_awaited(&self) -> bool {
        match self.state.timing {
            AlignTiming::Once => !self.alignment_task.is_done(),
            AlignTiming::Lockstep => self.state.n_begun.is_some(),
            AlignTiming::RealTime => false,
        }
    }

    /// Whether alignment must end before the first step.
    fn precedes_training(&self) -> bool {
        // Alignment from features precedes training, because it takes only seconds. Undoing the
        // effect of training on wrong cameras would take longer. Registration with depth takes
        // longer and runs in parallel with training.
        self.state.timing == AlignTiming::Once
            && self.model.progress().step == 0
            && self.alignment_task.is_requested()
            && self
                .original_keyframes
                .iter()
                .all(|keyframe| keyframe.depth.is_none())
    }

    /// Steps until the result of alignment is due.
    fn steps_to_alignment(&self) -> u64 {
        let step = self.model.progress().step;
        match self.state.due_step {
            Some(due_step) if !self.alignment_task.is_done() => due_step.saturating_sub(step),
            _ => u64::MAX,
        }
    }
}

fn invalid_state(error: serde_json::Error) -> Error {
    Error::CheckpointState {
        reason: error.to_string(),
    }
}

/// Index of the first keyframe that is among the last `n` of its camera.
fn first_recent(keyframes: &[Arc<Keyframe>], n: usize) -> usize {
    // Keyframes of each camera are counted backwards from the newest keyframe. Cameras have
    // different rates, so the last keyframes of a slow camera may be far from the end of the list.
    let mut n_later = BTreeMap::<&str, usize>::new();
    let mut first = keyframes.len();
    for (ix, keyframe) in keyframes.iter().enumerate().rev() {
        let n_of_camera = n_later.entry(&keyframe.camera).or_default();
        *n_of_camera += 1;
        if *n_of_camera <= n {
            first = ix;
        }
    }
    first
}

/// Number of keyframes at which the next alignment of a live run begins, if the previous alignment
/// used `n` keyframes.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "a number of keyframes"
)]
fn next_live_alignment(n: usize) -> usize {
    (n as f64 * LIVE_ALIGNMENT_GROWTH).ceil() as usize
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mean_color::MeanColor;
    use crate::method_entry::boxed;
    use crate::model_options::ModelOptions;
    use crate::nerf::{NerfBudget, NerfModel, NerfOptions};
    use crate::registry::ModelKind;
    use crate::splat::SplatTrainer;
    use crate::test_scenes as scenes;
    use crate::tsdf::TsdfModel;
    use calibration::ParamSet;
    use calibration::scenes::{Miscalibration, capture, remaining, wrong_extrinsics};
    use gpu::Gpu;
    use gpu::testing::test_gpu;
    use kinematics::Transform;
    use nalgebra::Vector3;

    /// Step at which the alignment result is applied.
    const ALIGNMENT_STEP: u64 = 6;

    fn tsdf(gpu: &Arc<Gpu>) -> TsdfModel {
        TsdfModel::new(gpu.clone(), ModelOptions::default()).unwrap()
    }

    fn nerf(gpu: &Arc<Gpu>) -> NerfModel {
        let nerf_budget = NerfBudget {
            n_rays: 64,
            n_samples: 1 << 10,
            n_cells: 32,
            max_log2_entries: 10,
            ..NerfBudget::SMALL
        };
        let options = ModelOptions {
            common: CommonOptions {
                n_planned_steps: 4 * ALIGNMENT_STEP,
                ..CommonOptions::default()
            },
            specific: NerfOptions {
                nerf_budget: Some(nerf_budget),
                ..NerfOptions::default()
            },
        };
        NerfModel::new(gpu.clone(), options).unwrap()
    }

    /// A model that is aligned once, at [`ALIGNMENT_STEP`].
    fn aligned(model: impl Method + 'static, align: CameraRefinement) -> AlignedModel {
        let common = CommonOptions {
            align,
            n_planned_steps: 4 * ALIGNMENT_STEP,
            ..CommonOptions::default()
        };
        AlignedModel::new(Box::new(model), &common, true)
    }

    fn mean_color() -> MeanColor {
        MeanColor::new(ModelOptions::default())
    }

    fn step_of(model: &AlignedModel) -> u64 {
        model.model().progress().step
    }

    fn train(model: &mut AlignedModel, n_steps: u64) {
        for _ in 0..n_steps {
            model.step(1).unwrap();
        }
    }

    #[test]
    fn models_get_corrected_cameras_and_resume_exactly() {
        /// Number of steps after the first step with corrected keyframes.
        const RESTARTED: u64 = 1;
        let gpu = test_gpu();
        check_correction(&gpu, "tsdf", tsdf(&gpu), RESTARTED);
        check_correction(&gpu, "nerf", nerf(&gpu), ALIGNMENT_STEP + 1);
        check_correction(&gpu, "mean-color", mean_color(), RESTARTED);
    }

    fn check_correction(
        gpu: &Arc<Gpu>,
        method: &str,
        model: impl Method + 'static,
        n_steps_after_correction: u64,
    ) {
        let entry = ModelKind::from_name(method).unwrap().entry();
        let miscalibration = Miscalibration {
            extrinsics: wrong_extrinsics(),
            ..Miscalibration::none()
        };
        let keyframes = capture(&miscalibration);
        let test = keyframes
            .iter()
            .find(|keyframe| keyframe.split == Split::Test)
            .unwrap();
        let mut uninterrupted = aligned(model, CameraRefinement::Always(ParamSet::EXTRINSICS));
        keyframes
            .iter()
            .for_each(|keyframe| uninterrupted.push(keyframe.clone()).unwrap());
        train(&mut uninterrupted, ALIGNMENT_STEP - 2);
        let early = uninterrupted.checkpoint().unwrap().finish().unwrap();
        train(&mut uninterrupted, 2);
        assert!(uninterrupted.alignment().is_none() && step_of(&uninterrupted) == ALIGNMENT_STEP);
        let due = uninterrupted.checkpoint().unwrap().finish().unwrap();
        train(&mut uninterrupted, 1);
        assert_eq!(
            (
                step_of(&uninterrupted),
                uninterrupted.n_total_steps().unwrap()
            ),
            (n_steps_after_correction, ALIGNMENT_STEP + 1)
        );
        let correction = uninterrupted.alignment().unwrap().corrections["wrist"].clone();
        let (degrees, mm) = remaining(&correction, &miscalibration.extrinsics);
        assert!(degrees < 0.05 && mm < 0.5, "{degrees} degrees, {mm} mm");
        assert_eq!(
            uninterrupted.calibrated_camera(test).unwrap(),
            correction.apply(test)
        );
        train(&mut uninterrupted, 2);

        let resumed = |checkpoint: &Checkpoint| {
            AlignedModel::resume(checkpoint, &keyframes, &[], |own_checkpoint, keyframes| {
                (entry.resume)(gpu.clone(), own_checkpoint, keyframes)
            })
            .unwrap()
        };
        let (mut interrupted, untrained) = resumed(&early);
        let is_original = |keyframe: &Arc<Keyframe>| {
            keyframes
                .iter()
                .any(|original_keyframes| Arc::ptr_eq(original_keyframes, keyframe))
        };
        assert!(!untrained.is_empty() && untrained.iter().all(is_original));
        untrained
            .into_iter()
            .for_each(|keyframe| interrupted.push(keyframe).unwrap());
        train(&mut interrupted, 3);
        let (mut interrupted, untrained) =
            resumed(&interrupted.checkpoint().unwrap().finish().unwrap());
        untrained
            .into_iter()
            .for_each(|keyframe| interrupted.push(keyframe).unwrap());
        train(&mut interrupted, 2);
        let [uninterrupted_end, interrupted_end] = [&mut uninterrupted, &mut interrupted]
            .map(|model| model.checkpoint().unwrap().finish().unwrap());
        assert_eq!(uninterrupted_end, interrupted_end);

        let (mut interrupted, untrained) = resumed(&due);
        untrained
            .into_iter()
            .for_each(|keyframe| interrupted.push(keyframe).unwrap());
        train(&mut interrupted, 3);
        assert_eq!(
            interrupted.checkpoint().unwrap().finish().unwrap(),
            uninterrupted_end,
            "must also match if resumed at the step at which alignment is due"
        );

        let folder = tempfile::tempdir().unwrap();
        uninterrupted.save(folder.path()).unwrap();
        let loaded = || {
            let model = (entry.load)(gpu.clone(), folder.path()).unwrap();
            AlignedModel::load(model, folder.path()).unwrap()
        };
        assert_eq!(
            loaded().calibrated_camera(test).unwrap(),
            correction.apply(test)
        );
        std::fs::remove_file(folder.path().join(METADATA_FILE)).unwrap();
        assert_eq!(
            loaded().calibrated_camera(test).unwrap(),
            CalibratedCamera::of(test),
            "there must be no corrections without the file"
        );
    }

    #[test]
    fn more_keyframes_change_the_corrections() {
        let miscalibration = Miscalibration {
            extrinsics: wrong_extrinsics(),
            ..Miscalibration::none()
        };
        let mut keyframes = capture(&miscalibration);
        keyframes.retain(|keyframe| keyframe.split != Split::Test);
        let n_first = 2 * keyframes.len() / 3;
        for timing in [AlignTiming::Lockstep, AlignTiming::RealTime] {
            let choice = CameraRefinement::Always(ParamSet::EXTRINSICS);
            let mut model = aligned(mean_color(), choice);
            model.state.timing = timing;
            model.state.begins_at = n_first;
            let correction =
                |model: &AlignedModel| model.alignment().unwrap().corrections["wrist"].clone();
            let remaining_after =
                |model: &AlignedModel| remaining(&correction(model), &miscalibration.extrinsics);
            let is_real_time = timing == AlignTiming::RealTime;
            keyframes[..n_first - 1]
                .iter()
                .for_each(|keyframe| model.push(keyframe.clone()).unwrap());
            train(&mut model, ALIGNMENT_STEP + 3);
            assert!(
                model.alignment().is_none() && !model.poll_alignment(true).unwrap(),
                "there are too few keyframes"
            );
            model.push(keyframes[n_first - 1].clone()).unwrap();
            train(&mut model, ALIGNMENT_STEP + 2);
            assert_eq!(
                model.alignment().is_none(),
                is_real_time,
                "in real time, results are applied on request"
            );
            assert_eq!(model.poll_alignment(true).unwrap(), is_real_time);
            assert!(
                step_of(&model) < ALIGNMENT_STEP,
                "the model must have restarted"
            );
            let (degrees, mm) = remaining_after(&model);
            assert!(degrees < 0.1 && mm < 1.0, "{degrees} degrees, {mm} mm");
            let step = step_of(&model);
            keyframes[n_first..]
                .iter()
                .for_each(|keyframe| model.push(keyframe.clone()).unwrap());
            let before = correction(&model);
            train(&mut model, ALIGNMENT_STEP + 2);
            assert_eq!(model.poll_alignment(true).unwrap(), is_real_time);
            let has_restarted = step_of(&model) < step + ALIGNMENT_STEP + 2;
            assert_eq!(
                has_restarted,
                correction(&model) != before,
                "it restarts only for other corrections"
            );
            let (degrees, mm) = remaining_after(&model);
            assert!(degrees < 0.05 && mm < 0.5, "{degrees} degrees, {mm} mm");
            train(&mut model, 3 * ALIGNMENT_STEP);
            assert!(step_of(&model) > 2 * ALIGNMENT_STEP, "no further alignment");
            assert!(!model.poll_alignment(true).unwrap());
        }
    }

    /// A model without steps before its first alignment with `n` keyframes, which detects
    /// movements.
    fn detecting(timing: AlignTiming, n: usize) -> AlignedModel {
        let choice = CameraRefinement::Always(ParamSet::EXTRINSICS);
        let mut model = aligned(mean_color(), choice);
        model.state.timing = timing;
        model.state.begins_at = n;
        model.state.detects_movements = true;
        model
    }

    #[test]
    fn movement_of_a_camera_corrects_the_images_since_then() {
        const N_FIRST: usize = 17;
        const MOVED_AT: usize = 22;
        let motion = Transform::new(
            Vector3::new(-0.004, 0.003, 0.004),
            Vector3::new(0.02, -0.025, 0.018),
        );
        let error = wrong_extrinsics();
        let scan = |extrinsics: Transform| {
            let mut keyframes = capture(&Miscalibration {
                extrinsics,
                ..Miscalibration::none()
            });
            keyframes.retain(|keyframe| keyframe.split != Split::Test);
            keyframes
        };
        let [before, after, right] =
            [error, motion.inverse() * error, Transform::identity()].map(scan);
        let keyframes = [&before[..MOVED_AT], &after[MOVED_AT..]].concat();
        let train_on = |model: &mut AlignedModel, keyframes: &[Arc<Keyframe>]| {
            for keyframe in keyframes {
                model.push(keyframe.clone()).unwrap();
                train(model, 2);
                model.poll_alignment(true).unwrap();
            }
        };
        let start = |timing: AlignTiming| {
            let mut model = detecting(timing, N_FIRST);
            keyframes[..N_FIRST]
                .iter()
                .for_each(|keyframe| model.push(keyframe.clone()).unwrap());
            train(&mut model, ALIGNMENT_STEP + 2);
            model.poll_alignment(true).unwrap();
            assert!(model.alignment().unwrap().has_corrections());
            model
        };
        for timing in [AlignTiming::Lockstep, AlignTiming::RealTime] {
            let mut model = start(timing);
            train_on(&mut model, &keyframes[N_FIRST..]);
            train(&mut model, 3 * ALIGNMENT_STEP);
            model.poll_alignment(true).unwrap();
            let movements = &model.alignment().unwrap().movements;
            assert_eq!(movements.len(), 1, "{movements:?}");
            assert_eq!(
                (&*movements[0].camera, movements[0].since_nanos),
                ("wrist", keyframes[MOVED_AT].stamp.0)
            );
            let text = movements[0].to_string();
            assert!(text.contains("moved by 2.1 degrees and 6 mm"), "{text}");
            for (ix, (keyframe, right)) in keyframes.iter().zip(&right).enumerate() {
                let camera = model.calibrated_camera(keyframe).unwrap();
                let left = right.world_from_camera.inverse() * camera.world_from_camera;
                let degrees = left.rotation.angle().to_degrees();
                let mm = 1e3 * left.translation.vector.norm();
                assert!(
                    degrees < 0.06 && mm < 0.8,
                    "image {ix}: {degrees} degrees, {mm} mm"
                );
            }
        }

        // A resumed run finds the same movement at the same step.
        let mut uninterrupted = start(AlignTiming::Lockstep);
        let n_before = MOVED_AT + 2;
        train_on(&mut uninterrupted, &keyframes[N_FIRST..n_before]);
        let checkpoint = uninterrupted.checkpoint().unwrap().finish().unwrap();
        let resume = |own: &Checkpoint, keyframes: &[Arc<Keyframe>]| {
            MeanColor::resume(own, keyframes).map(boxed)
        };
        let (mut resumed, untrained) =
            AlignedModel::resume(&checkpoint, &keyframes[..n_before], &[], resume).unwrap();
        untrained
            .into_iter()
            .for_each(|keyframe| resumed.push(keyframe).unwrap());
        let ends = [&mut uninterrupted, &mut resumed].map(|model| {
            train_on(model, &keyframes[n_before..]);
            model.checkpoint().unwrap().finish().unwrap()
        });
        assert_eq!(ends[0], ends[1]);
        assert_eq!(uninterrupted.alignment().unwrap().movements.len(), 1);

        // After recovery, a reference and a later keyframe that were evicted have no pixels.
        let evicted = [2, N_FIRST + 2];
        let mut restored = keyframes[..n_before].to_vec();
        for ix in evicted {
            restored[ix] = Arc::new(Keyframe {
                rgba_srgb: [].into(),
                ..restored[ix].as_ref().clone()
            });
        }
        let (mut recovered, _) = AlignedModel::resume(&checkpoint, &restored, &[], resume).unwrap();
        evicted
            .iter()
            .for_each(|ix| recovered.remove("wrist", keyframes[*ix].stamp).unwrap());
        train_on(&mut recovered, &keyframes[n_before..]);
        assert_eq!(recovered.alignment().unwrap().movements.len(), 1);
    }

    #[test]
    fn cameras_without_depth_are_corrected_before_the_first_step() {
        let miscalibration = Miscalibration {
            extrinsics: wrong_extrinsics(),
            ..Miscalibration::none()
        };
        let without_depth = |keyframe: &Arc<Keyframe>| {
            Arc::new(Keyframe {
                depth: None,
                ..(**keyframe).clone()
            })
        };
        let keyframes: Vec<_> = capture(&miscalibration).iter().map(without_depth).collect();
        let choice = CameraRefinement::Try(vec![ParamSet::EXTRINSICS]);
        let gpu = test_gpu();
        let splats = SplatTrainer::new(gpu, ModelOptions::default()).unwrap();
        let mut model = aligned(splats, choice);
        keyframes
            .iter()
            .for_each(|keyframe| model.push(keyframe.clone()).unwrap());
        assert!(model.alignment().is_none());
        train(&mut model, 1);
        let correction = model.alignment().unwrap().corrections["wrist"].clone();
        let (degrees, mm) = remaining(&correction, &miscalibration.extrinsics);
        assert!(degrees < 0.15 && mm < 4.0, "{degrees} degrees, {mm} mm");
        assert_eq!(step_of(&model), 1, "no step was discarded");
        let test = keyframes
            .iter()
            .find(|keyframe| keyframe.split == Split::Test)
            .unwrap();
        assert_eq!(
            model.calibrated_camera(test).unwrap(),
            correction.apply(test)
        );
    }

    #[test]
    fn empty_model_is_idle_and_failed_alignment_does_not_stop_training() {
        let gpu = test_gpu();
        check_training_continues(tsdf(&gpu));
        check_training_continues(nerf(&gpu));
        check_training_continues(mean_color());
    }

    fn check_training_continues(model: impl Method + 'static) {
        let mut model = aligned(model, CameraRefinement::Always(ParamSet::EXTRINSICS));
        assert!(model.is_idle());
        for keyframe in scenes::ring(&[scenes::floor()], nalgebra::Point3::origin(), 2) {
            model.push(keyframe).unwrap();
        }
        while !model.is_idle() && step_of(&model) < ALIGNMENT_STEP + 2 {
            model.step(1).unwrap();
        }
        assert!(
            model
                .alignment()
                .is_none_or(|alignment| !alignment.has_corrections())
        );
        assert!(step_of(&model) > 0);
    }
}
