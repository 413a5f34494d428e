//! A/B trials that decide whether a change of the model is kept. Each change is tested on a copy of
//! the model and evaluated on validation images, which are excluded from training.
//!
//! The baseline and the variant with the change are trained from the same state for the same number
//! of steps. Keyframes that arrive during the first half of a trial are added to both at the same
//! step. Keyframes that arrive later wait for the end of the trial. [`Trial::of`] determines
//! whether the mean gain over the validation keyframes is significant. The total loss of all
//! reductions is at most [`MAX_TOTAL_LOSS_DB`]. After the last trial, the validation keyframes
//! become training keyframes.

use super::arrival_gains::ArrivalGains;
use super::buffers::SplatBuffers;
use super::snapshot::Snapshot;
use super::trial_steps::TrialSteps;
use crate::Error;
use calibration::{CameraRefinement, Candidate, MIN_VALIDATION_IMAGES, ParamSet, Trial};
use gpu::{Buffer, Gpu};
use keyframe::Keyframe;
use kinematics::Stamp;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

/// Maximum total loss of the accepted reductions, dB.
///
/// Each halving may lose up to 0.1 dB. Without a limit on the sum, several accepted halvings could
/// add up to a visible loss. A larger value gives smaller models that look worse.
const MAX_TOTAL_LOSS_DB: f64 = 0.15;
/// Maximum number of validation keyframes that are scored.
///
/// Each trial renders all of them twice at full resolution. More keyframes give a smaller standard
/// error, but delay training.
pub(crate) const MAX_SCORED: usize = 24;
/// Halving ends once the number of splats is at most this value, where a smaller model saves hardly
/// any time or memory.
const MIN_SPLATS: u32 = 1000;

/// Per-image gains. Their trial needs no training, because their effect follows from sums over
/// pixels.
const GAINS: ParamSet = ParamSet::IMAGE_GAINS;

/// How the number of splats is chosen.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum CountPolicy {
    /// Grows up to the limit.
    #[default]
    ToCap,
    /// The model grows up to the limit, or to fewer splats if there are few images. The number of
    /// splats is then halved repeatedly, as long as the loss on validation images is below 0.1 dB.
    // Runs of earlier versions also had `TestedGrowth`, which ended with the same halvings.
    #[serde(alias = "TestedGrowth")]
    Tested,
}

/// A validation keyframe, and its image on the GPU after the first comparison.
#[derive(Debug)]
pub(crate) struct ValidationImage {
    pub(crate) keyframe: Arc<Keyframe>,
    pub(crate) image: Option<Buffer>,
}

impl ValidationImage {
    /// The image on the GPU, uploaded on first use.
    pub(crate) fn uploaded(&mut self, gpu: &Gpu) -> Result<&Buffer, Error> {
        // This uses `take` and `insert` instead of `get_or_insert_with`, because the upload can
        // fail.
        let image = match self.image.take() {
            Some(image) => image,
            None => gpu.storage_with("splat.validation", &self.keyframe.rgba_srgb)?,
        };
        Ok(self.image.insert(image))
    }
}

/// Camera and stamp of a keyframe.
pub(crate) type ImageId = (Arc<str>, Stamp);

/// PSNR of each validation keyframe, dB.
pub(crate) type Scores = BTreeMap<ImageId, f64>;

fn id_of(keyframe: &Keyframe) -> ImageId {
    (keyframe.camera.clone(), keyframe.stamp)
}

/// Scores of the images that both maps contain.
fn pair_scores(baseline_db: &Scores, variant_db: &Scores) -> (Vec<f64>, Vec<f64>) {
    // A validation keyframe can be removed between the two scores. In that case, its difference is
    // unknown.
    baseline_db
        .iter()
        .filter_map(|(id, baseline)| Some((*baseline, *variant_db.get(id)?)))
        .unzip()
}

/// A training keyframe that arrived during a trial, and the step of its arrival.
#[derive(Clone, Debug)]
pub(crate) struct Arrival {
    pub(crate) step: u64,
    pub(crate) keyframe: Arc<Keyframe>,
}

/// Progress of the search for the number of splats.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) enum CountState {
    /// Grows up to the limit without trials.
    ToCap,
    /// The model grows. Trials that halve the number of splats start after growth has ended.
    Growing,
    /// Trials halve the number until one of them is rejected.
    Halving,
    /// The number of splats is final.
    Finished,
}

/// State of the trials.
#[derive(Debug)]
pub(crate) struct SplatTrials {
    pub(crate) steps: TrialSteps,
    candidates: VecDeque<ParamSet>,
    count: CountState,
    /// SH degree to try next, once the number of splats is final.
    degree: u32,
    pub(crate) validation: Vec<ValidationImage>,
    pub(crate) finished: Vec<Trial>,
    /// Optimizer updates that were reverted.
    pub(crate) n_reverted_steps: u64,
    /// The detector of image gains. It is present until arriving keyframes show that gains are
    /// needed, and only if gains are watched for.
    arrival_gains: Option<ArrivalGains>,
    trial_phase: SplatTrialPhase,
}

#[derive(Debug)]
enum SplatTrialPhase {
    Waiting,
    Running(RunningTrial),
    Finished,
}

/// A trial in progress.
#[derive(Debug)]
pub(crate) struct RunningTrial {
    pub(crate) candidate: Candidate,
    /// Last step of this half.
    pub(crate) until: u64,
    /// The state that is not in training. In the first half of a trial, this is the state at the
    /// start of the trial. In the second half, it is the state at the end of the first half.
    pub(crate) other: Box<Snapshot>,
    /// The validation keyframes on which both halves are scored.
    pub(crate) scored: Vec<ImageId>,
    /// Keyframes that arrived in the first half. The second half takes them from this queue at the
    /// same steps.
    pub(crate) arrivals: VecDeque<Arrival>,
    /// Scores at the end of the first half, which trains the baseline.
    pub(crate) baseline_db: Option<Scores>,
    /// Keyframes that arrived in the second half. They are added after the trial.
    pub(crate) deferred: Vec<Arc<Keyframe>>,
}

/// Work to do at the start of the second half of a trial.
pub(crate) struct SecondHalf {
    /// The state to restore.
    pub(crate) from: Snapshot,
    /// The change to apply to the restored state.
    pub(crate) candidate: Candidate,
    /// Keyframes to remove, because the second half adds them again.
    pub(crate) arrived: Vec<Arc<Keyframe>>,
}

/// Work to do at the end of a trial.
pub(crate) struct TrialEnd {
    /// The state to restore if the change is rejected.
    pub(crate) restored: Option<Snapshot>,
    /// Keyframes that already have splats in the restored state but are not views yet.
    pub(crate) seeded: Vec<Arc<Keyframe>>,
    /// Keyframes to add now.
    pub(crate) deferred: Vec<Arc<Keyframe>>,
}

/// The remaining candidates, for a checkpoint.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct RemainingTrials {
    is_finished: bool,
    params: Vec<ParamSet>,
    count: CountState,
    degree: u32,
    #[serde(default)]
    arrival_gains: Option<ArrivalGains>,
}

/// Work that is due at a step.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Due {
    Nothing,
    /// Copy the state and start the trial.
    Begin(Candidate),
    /// Score the baseline, restore the copy and apply the change.
    BeginSecondHalf,
    /// In the second half, add a keyframe that arrived at this step of the first half.
    Arrival,
    /// Score the variant and decide.
    End,
    /// Score with and without per-image gains and decide.
    Gains,
    /// Start training on the validation keyframes.
    ReleaseValidation,
}

/// State of the model that determines which work is due.
#[derive(Clone, Copy, Debug)]
pub(crate) struct TrialContext {
    pub(crate) step: u64,
    pub(crate) n_splats: u32,
    /// Whether growth has ended. Before growth has ended, a small model may score as well as a
    /// large model only because it converges faster.
    pub(crate) is_mature: bool,
    /// SH degree.
    pub(crate) sh_degree: u32,
}

impl RunningTrial {
    /// Whether the variant is in training.
    fn is_second_half(&self) -> bool {
        self.baseline_db.is_some()
    }

    /// Step at which the second half adds the next keyframe that arrived in the first half.
    fn next_arrival_step(&self) -> u64 {
        self.arrivals
            .front()
            .filter(|_| self.is_second_half())
            .map_or(u64::MAX, |next_due| next_due.step)
    }

    fn due(&self, step: u64) -> Due {
        // Arrivals come first, because a keyframe that arrived at the last step of the first half
        // must also be added to the variant before the variant is scored.
        match (step >= self.until, self.is_second_half()) {
            _ if step >= self.next_arrival_step() => Due::Arrival,
            (false, _) => Due::Nothing,
            (true, false) => Due::BeginSecondHalf,
            (true, true) => Due::End,
        }
    }
}

impl SplatTrials {
    pub(crate) fn new(cameras: &CameraRefinement, count: CountPolicy, steps: TrialSteps) -> Self {
        let candidates: VecDeque<ParamSet> = cameras.candidates().iter().copied().collect();
        let count = match count {
            CountPolicy::ToCap => CountState::ToCap,
            CountPolicy::Tested => CountState::Growing,
        };
        // If there is nothing to test, the validation keyframes are training keyframes from the
        // first step on.
        let is_finished = candidates.is_empty() && count == CountState::ToCap;
        let trial_phase = if is_finished {
            SplatTrialPhase::Finished
        } else {
            SplatTrialPhase::Waiting
        };
        Self {
            steps,
            candidates,
            count,
            degree: 0,
            validation: Vec::new(),
            finished: Vec::new(),
            n_reverted_steps: 0,
            arrival_gains: cameras
                .watched()
                .contains(GAINS)
                .then(ArrivalGains::default),
            trial_phase,
        }
    }

    /// Whether validation keyframes are still excluded from training.
    pub(crate) fn holds_validation(&self) -> bool {
        !matches!(self.trial_phase, SplatTrialPhase::Finished)
    }

    /// Number of validation images. Images that arrive during a trial do not count before its end,
    /// because both halves must have the same number at each step.
    pub(crate) fn n_validation(&self) -> usize {
        self.running_trial()
            .map_or(self.validation.len(), |trial| trial.scored.len())
    }

    /// Whether densification may add splats.
    pub(crate) fn may_grow(&self) -> bool {
        // During the first halving, `count` is still `Growing`. Densification would undo the
        // halving in the variant, and enlarge the baseline.
        let is_halving = matches!(
            self.running_trial(),
            Some(RunningTrial {
                candidate: Candidate::Halved { .. },
                ..
            })
        );
        matches!(self.count, CountState::ToCap | CountState::Growing) && !is_halving
    }

    /// The trial in progress.
    pub(crate) fn running_trial(&self) -> Option<&RunningTrial> {
        if let SplatTrialPhase::Running(trial) = &self.trial_phase {
            Some(trial)
        } else {
            None
        }
    }

    pub(crate) fn due(&self, context: TrialContext) -> Due {
        match &self.trial_phase {
            SplatTrialPhase::Waiting => self.next_due(context),
            SplatTrialPhase::Running(trial) => trial.due(context.step),
            SplatTrialPhase::Finished => Due::Nothing,
        }
    }

    fn next_due(&self, context: TrialContext) -> Due {
        if context.step < self.steps.first_trial {
            return Due::Nothing;
        }
        if self.validation.len() < MIN_VALIDATION_IMAGES {
            // Wait for more images, but not indefinitely. If there are no trials, validation images
            // are more useful for training.
            return if context.step < 2 * self.steps.first_trial {
                Due::Nothing
            } else {
                Due::ReleaseValidation
            };
        }
        // Cameras come before the size, because with wrong cameras, more splats may only fit the
        // errors of the poses.
        if let Some(params) = self.candidates.front() {
            return if *params == GAINS {
                Due::Gains
            } else {
                Due::Begin(Candidate::Cameras(*params))
            };
        }
        let halved = Candidate::Halved {
            from: context.n_splats,
            to: context.n_splats.div_ceil(2),
        };
        let lower = Candidate::ShDegree {
            from: context.sh_degree,
            to: self.degree,
        };
        // The degree is reduced last, at the final number of splats. The details that colors of a
        // higher degree add depend on the number of splats.
        match self.count {
            CountState::ToCap => Due::ReleaseValidation,
            CountState::Finished if self.degree < context.sh_degree => Due::Begin(lower),
            CountState::Finished => Due::ReleaseValidation,
            CountState::Halving => Due::Begin(halved),
            CountState::Growing if context.is_mature => Due::Begin(halved),
            CountState::Growing => Due::Nothing,
        }
    }

    /// Number of steps until work may be due again.
    pub(crate) fn steps_left(&self, step: u64) -> u64 {
        match &self.trial_phase {
            SplatTrialPhase::Waiting if step < self.steps.first_trial => {
                self.steps.first_trial - step
            }
            // The result is at least 1, because a submit of zero steps would make no progress.
            SplatTrialPhase::Running(trial) => trial
                .until
                .min(trial.next_arrival_step())
                .saturating_sub(step)
                .max(1),
            _ => u64::MAX,
        }
    }

    /// Records a training keyframe that arrives at this step. Returns whether it must wait for the
    /// end of a trial.
    pub(crate) fn defer_arrival(&mut self, keyframe: &Arc<Keyframe>, step: u64) -> bool {
        let SplatTrialPhase::Running(trial) = &mut self.trial_phase else {
            return false;
        };
        // In the second half, the baseline has already been trained and scored. Only the variant
        // could still train on a new keyframe, which would not be a fair comparison.
        let is_deferred = trial.is_second_half();
        if is_deferred {
            trial.deferred.push(keyframe.clone());
        } else {
            trial.arrivals.push_back(Arrival {
                step,
                keyframe: keyframe.clone(),
            });
        }
        is_deferred
    }

    /// Next keyframe to add in the second half of a trial.
    pub(crate) fn next_arrival(&mut self) -> Option<Arc<Keyframe>> {
        let SplatTrialPhase::Running(trial) = &mut self.trial_phase else {
            return None;
        };
        trial.arrivals.pop_front().map(|arrival| arrival.keyframe)
    }

    /// The validation keyframes to score. During a trial, they are the keyframes of the trial.
    /// Otherwise, they are an evenly spaced subset.
    pub(crate) fn scored(&self) -> Vec<ImageId> {
        // Both halves are scored on the same keyframes, even if more have arrived since.
        self.running_trial()
            .map_or_else(|| self.evenly_spaced(), |trial| trial.scored.clone())
    }

    /// At most [`MAX_SCORED`] of the validation keyframes.
    fn evenly_spaced(&self) -> Vec<ImageId> {
        // Neighbors in time show nearly the same view, so every n-th keyframe represents the scene
        // better than the first or the last keyframes.
        let stride = self.validation.len().div_ceil(MAX_SCORED).max(1);
        self.validation
            .iter()
            .step_by(stride)
            .map(|validation| id_of(&validation.keyframe))
            .collect()
    }

    /// A validation keyframe, unless it was removed.
    pub(crate) fn validation(&mut self, (camera, stamp): &ImageId) -> Option<&mut ValidationImage> {
        let matches_id = |validation: &&mut ValidationImage| {
            validation.keyframe.camera == *camera && validation.keyframe.stamp == *stamp
        };
        self.validation.iter_mut().find(matches_id)
    }

    pub(crate) fn begin(&mut self, candidate: Candidate, from: Snapshot, n_views: usize) {
        let n_steps = match candidate {
            // A step changes the parameters of one image only, so the number of steps must grow
            // with the number of images.
            Candidate::Cameras(params)
                if params.intersects(ParamSet::IMAGE_POSES | ParamSet::IMAGE_GAINS) =>
            {
                (self.steps.per_image * n_views as u64)
                    .clamp(self.steps.trial_half, self.steps.max_trial_half)
            }
            _ => self.steps.trial_half,
        };
        let until = from.schedule.step + n_steps;
        // `scored` is called before the phase changes, because it returns the list of the running
        // trial during a trial.
        let scored = self.scored();
        self.trial_phase = SplatTrialPhase::Running(RunningTrial {
            candidate,
            until,
            other: Box::new(from),
            scored,
            arrivals: VecDeque::new(),
            baseline_db: None,
            deferred: Vec::new(),
        });
    }

    /// Starts the second half.
    pub(crate) fn begin_second_half(
        &mut self,
        baseline: Snapshot,
        baseline_db: Scores,
    ) -> Option<SecondHalf> {
        let SplatTrialPhase::Running(trial) = &mut self.trial_phase else {
            return None;
        };
        trial.baseline_db = Some(baseline_db);
        Some(SecondHalf {
            from: std::mem::replace(&mut *trial.other, baseline),
            candidate: trial.candidate,
            arrived: trial
                .arrivals
                .iter()
                .map(|arrival| arrival.keyframe.clone())
                .collect(),
        })
    }

    /// Accepts or rejects the change.
    pub(crate) fn end(&mut self, variant_db: &Scores) -> Option<TrialEnd> {
        let RunningTrial {
            candidate,
            other,
            baseline_db,
            deferred,
            ..
        } = self.take_second_half()?;
        let (baseline_db, variant_db) = pair_scores(&baseline_db?, variant_db);
        let kept = self.evaluate(candidate, &baseline_db, &variant_db);
        // Each result determines the next trial.
        match candidate {
            Candidate::Cameras(_) => drop(self.candidates.pop_front()),
            Candidate::Halved { to, .. } if kept && to > MIN_SPLATS => {
                self.count = CountState::Halving
            }
            Candidate::Halved { .. } => self.count = CountState::Finished,
            // The lowest acceptable degree is searched upward from 0, so the first accepted degree
            // is the result. The search ends, because the next degree is set to `from`, which is
            // above the new degree of the model.
            Candidate::ShDegree { from, to } => self.degree = if kept { from } else { to + 1 },
        }
        Some(TrialEnd {
            restored: (!kept).then_some(*other),
            seeded: Vec::new(),
            deferred,
        })
    }

    /// Decides on per-image gains. Returns them if they are significant.
    pub(crate) fn decide_gains(
        &mut self,
        baseline_db: &[f64],
        variant_db: &[f64],
    ) -> Option<ParamSet> {
        self.candidates.retain(|params| *params != GAINS);
        self.evaluate(Candidate::Cameras(GAINS), baseline_db, variant_db)
            .then_some(GAINS)
    }

    /// Whether arriving keyframes must be compared with pictures, see [`Self::add_arrival_gains`].
    pub(crate) fn watches_gains(&self) -> bool {
        self.arrival_gains.is_some()
    }

    /// Adds a keyframe that was compared with a picture before training on it. See
    /// [`ArrivalGains::add`]. Returns the image gains if they are needed.
    pub(crate) fn add_arrival_gains(
        &mut self,
        keyframe: &Keyframe,
        log_gains: [f64; 3],
        psnr: impl Fn([f64; 3]) -> Option<f64>,
    ) -> Option<ParamSet> {
        let trial = self
            .arrival_gains
            .as_mut()?
            .add(&keyframe.camera, log_gains, psnr)?;
        trial.log_result();
        self.finished.push(trial);
        // Gains stay enabled, so there is nothing left to watch for.
        self.arrival_gains = None;
        Some(GAINS)
    }

    fn evaluate(&mut self, candidate: Candidate, baseline_db: &[f64], variant_db: &[f64]) -> bool {
        log::debug!(
            "{candidate}: PSNR without the change {baseline_db:.3?} dB, with it {variant_db:.3?} dB"
        );
        let mut trial = Trial::of(candidate, baseline_db, variant_db);
        // Gains of earlier reductions do not compensate later losses, because they may be noise.
        let total_loss_db: f64 = self
            .finished
            .iter()
            .filter(|finished| finished.kept && finished.candidate.reduces_model())
            .map(|finished| (-finished.gain_db).max(0.0))
            .sum();
        trial.kept &=
            !candidate.reduces_model() || total_loss_db - trial.gain_db <= MAX_TOTAL_LOSS_DB;
        trial.log_result();
        let kept = trial.kept;
        self.finished.push(trial);
        kept
    }

    /// Cancels a trial that is in its second half. The trial is repeated if training continues.
    pub(crate) fn cancel(&mut self) -> Option<TrialEnd> {
        let RunningTrial {
            other,
            arrivals,
            deferred,
            ..
        } = self.take_second_half()?;
        let seeded = arrivals
            .into_iter()
            .map(|arrival| arrival.keyframe)
            .collect();
        Some(TrialEnd {
            restored: Some(*other),
            seeded,
            deferred,
        })
    }

    /// Ends the trial in progress, in either half. The trial is repeated later.
    pub(crate) fn abort(&mut self) -> Option<TrialEnd> {
        let canceled = self.cancel();
        if self.running_trial().is_some() {
            // The first half trains the baseline, so nothing must be restored.
            self.trial_phase = SplatTrialPhase::Waiting;
        }
        canceled
    }

    /// Ends a trial in its second half.
    fn take_second_half(&mut self) -> Option<RunningTrial> {
        match std::mem::replace(&mut self.trial_phase, SplatTrialPhase::Waiting) {
            SplatTrialPhase::Running(trial) if trial.is_second_half() => Some(trial),
            // The trial is not in its second half, so the phase is restored.
            other => {
                self.trial_phase = other;
                None
            }
        }
    }

    /// Ends all trials and returns the validation keyframes, which become training keyframes.
    pub(crate) fn finish(&mut self) -> Vec<Arc<Keyframe>> {
        self.trial_phase = SplatTrialPhase::Finished;
        std::mem::take(&mut self.validation)
            .into_iter()
            .map(|validation| validation.keyframe)
            .collect()
    }

    /// The state without the change, during the second half of a trial.
    pub(crate) fn baseline(&self) -> Option<&Snapshot> {
        self.running_trial()
            .filter(|trial| trial.is_second_half())
            .map(|trial| &*trial.other)
    }

    /// The splats to display. During a trial, these are the splats without the change.
    pub(crate) fn displayed<'a>(&'a self, in_training: &'a SplatBuffers) -> &'a SplatBuffers {
        self.baseline()
            .map_or(in_training, |snapshot| &snapshot.splats)
    }

    /// State for a checkpoint, without the running trial.
    pub(crate) fn remaining_trials(&self) -> RemainingTrials {
        RemainingTrials {
            is_finished: !self.holds_validation(),
            params: self.candidates.iter().copied().collect(),
            count: self.count,
            degree: self.degree,
            arrival_gains: self.arrival_gains.clone(),
        }
    }

    /// Restores the state from a checkpoint.
    pub(crate) fn restore(&mut self, remaining_trials: RemainingTrials, finished: Vec<Trial>) {
        self.trial_phase = if remaining_trials.is_finished {
            SplatTrialPhase::Finished
        } else {
            SplatTrialPhase::Waiting
        };
        self.candidates = remaining_trials.params.into();
        self.arrival_gains = remaining_trials.arrival_gains;
        self.count = remaining_trials.count;
        self.degree = remaining_trials.degree;
        self.finished = finished;
    }

    /// Restores a trial from a checkpoint.
    pub(crate) fn restore_trial(&mut self, trial: RunningTrial) {
        self.trial_phase = SplatTrialPhase::Running(trial);
    }

    /// Removes a candidate that was accepted without a trial. Returns whether it was in the list.
    pub(crate) fn remove_candidate(&mut self, found: ParamSet) -> bool {
        let n = self.candidates.len();
        self.candidates.retain(|candidate| *candidate != found);
        self.candidates.len() < n
    }

    /// Removes a keyframe.
    pub(crate) fn remove(&mut self, is_removed: impl Fn(&Keyframe) -> bool) {
        self.validation
            .retain(|validation| !is_removed(&validation.keyframe));
        // A removed keyframe must not be added again at the same step of the second half or at the
        // end of the trial.
        if let SplatTrialPhase::Running(trial) = &mut self.trial_phase {
            trial
                .arrivals
                .retain(|arrival| !is_removed(&arrival.keyframe));
            trial.deferred.retain(|keyframe| !is_removed(keyframe));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const HALVED: Candidate = Candidate::Halved {
        from: 20_000,
        to: 10_000,
    };
    const CONTEXT: TrialContext = TrialContext {
        step: 0,
        n_splats: 5000,
        is_mature: false,
        sh_degree: 3,
    };

    fn poses() -> ParamSet {
        ParamSet::IMAGE_POSES
    }

    #[test]
    fn gain_must_exceed_its_standard_error() {
        let trial = |variant: &[f64]| {
            Trial::of(
                Candidate::Cameras(poses()),
                &[20.0, 22.0, 24.0, 21.0],
                variant,
            )
        };
        assert!(trial(&[20.5, 22.4, 24.6, 21.5]).kept);
        assert!(
            !trial(&[20.03, 22.04, 24.02, 21.03]).kept,
            "significant, but too small"
        );
        assert!(
            !trial(&[23.0, 20.5, 25.5, 19.5]).kept,
            "large, but not significant"
        );
        assert!(!trial(&[19.0, 21.0, 23.0, 20.0]).kept);
        assert!(
            !Trial::of(Candidate::Cameras(poses()), &[20.0], &[25.0]).kept,
            "one image has no standard error"
        );
        let gain = trial(&[20.5, 22.5, 24.5, 21.5]);
        assert!((gain.gain_db - 0.5).abs() < 1e-12 && gain.standard_error_db < 1e-12);
    }

    #[test]
    fn reductions_with_small_loss_are_kept() {
        let trial = |variant: &[f64]| Trial::of(HALVED, &[20.0, 22.0, 24.0, 21.0], variant);
        assert!(trial(&[19.94, 21.95, 23.93, 20.94]).kept);
        assert!(
            !trial(&[19.6, 22.1, 23.9, 21.1]).kept,
            "the mean is -0.075 dB, but the loss may be twice as large"
        );
        assert!(
            trial(&[20.5, 22.4, 24.6, 21.5]).kept,
            "a reduction may even improve the score"
        );
        assert!(!trial(&[19.8, 21.7, 23.8, 20.7]).kept);
        assert!(
            !Trial::of(HALVED, &[20.0], &[20.0]).kept,
            "one image is not sufficient"
        );
        let report = trial(&[19.8, 21.7, 23.8, 20.7]).report();
        assert!(
            (report.gain_db - 0.25).abs() < 1e-12 && report.kept,
            "{report:?}"
        );
        assert!(!trial(&[19.94, 21.95, 23.93, 20.94]).report().kept);
    }

    #[test]
    fn no_trials_without_candidates() {
        let trials = SplatTrials::new(
            &CameraRefinement::default(),
            CountPolicy::ToCap,
            TrialSteps::default(),
        );
        assert!(!trials.holds_validation() && trials.may_grow());
        assert_eq!(
            trials.due(TrialContext {
                step: 10_000,
                is_mature: true,
                ..CONTEXT
            }),
            Due::Nothing
        );
    }

    #[test]
    fn too_few_validation_images_are_released() {
        for count in [CountPolicy::ToCap, CountPolicy::Tested] {
            let trials = SplatTrials::new(
                &CameraRefinement::Try(vec![poses()]),
                count,
                TrialSteps::default(),
            );
            assert!(trials.holds_validation());
            let due = |step| trials.due(TrialContext { step, ..CONTEXT });
            assert_eq!(due(TrialSteps::default().first_trial), Due::Nothing);
            assert_eq!(
                due(2 * TrialSteps::default().first_trial),
                Due::ReleaseValidation
            );
        }
    }

    #[test]
    fn arriving_keyframes_are_watched_only_for_gains() {
        let watches = |cameras: CameraRefinement| {
            SplatTrials::new(&cameras, CountPolicy::ToCap, TrialSteps::default()).watches_gains()
        };
        assert!(watches(CameraRefinement::AlwaysAndWatch(poses(), GAINS)));
        assert!(
            !watches(CameraRefinement::AlwaysAndWatch(GAINS, poses()))
                && !watches(CameraRefinement::default())
        );
    }
}
