//! Whether a part of the model pays: tried on a copy of the model, judged by images not learned from.
//!
//! At the start the selection keyframes are held back. Each candidate gets as many steps as the model without it, from
//! the same state. Keyframes that arrive meanwhile reach both at the same step, or wait for the end of the trial.
//! What is added stays when the paired gain on the selection keyframes exceeds both a least gain and two
//! standard errors; what is left out stays out when that costs less than a least gain, half a standard error counted in,
//! and all of it together no more than [`MAX_TOTAL_LOSS_DB`]. When all is settled the selection keyframes are learned from, too.

use super::camera_params::ParamSet;
use super::trainer::Snapshot;
use crate::gain::{Gain, MIN_GAIN_DB};
use crate::gpu::Buffer;
use crate::{Keyframe, TrialReport};
use kinematics::Stamp;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

/// Step of the first trial: earlier the scene is too rough to tell.
pub(crate) const TRIAL_START: u64 = 500;
/// Steps of a trial of what all images share, and least of any.
const SHARED_STEPS: u64 = 250;
/// How often each image is looked at in a trial of terms of its own, and the most steps for it.
const STEPS_PER_IMAGE: u64 = 4;
const MAX_STEPS: u64 = 1200;
/// A gain of twice the splats below this is none, dB.
const MIN_GAIN_OF_DOUBLING_DB: f64 = 0.1;
/// All that is left out may cost this much together, dB.
const MAX_TOTAL_LOSS_DB: f64 = 0.15;
/// Fewer selection keyframes tell nothing.
const MIN_VALIDATION_IMAGES: usize = 4;
/// Maximum number of selection keyframes in a mean score.
pub(crate) const MAX_SCORED: usize = 24;
/// Fewer splats are not divided further.
const MIN_SPLATS: u32 = 1000;

/// Gains of images: what they bring is told by a sum over pixels, without learning them first.
const GAINS: ParamSet = ParamSet { image_gains: true, ..ParamSet::NONE };

/// What is learned about cameras.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum CameraRefinement {
    /// These terms, from the first step on.
    Always(ParamSet),
    /// Each of these in turn, where it pays.
    Try(Vec<ParamSet>),
}

impl Default for CameraRefinement {
    fn default() -> Self {
        Self::Always(ParamSet::default())
    }
}

/// How the number of splats is found.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum CountPolicy {
    /// Grown up to the cap.
    #[default]
    ToCap,
    /// Grown up to the cap, then halved as long as that costs less than 0.1 dB on held-back images.
    Tested,
}

/// A change of the model that is tried.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Candidate {
    /// These terms of cameras are learned, too.
    Cameras(ParamSet),
    /// The half of the splats that shows least goes.
    Halved {
        /// Splats before.
        from: u32,
        /// Splats after.
        to: u32,
    },
    /// Colors change less with the direction.
    ShDegree {
        /// Degree of spherical harmonics before.
        from: u32,
        /// Degree after.
        to: u32,
    },
}

impl Candidate {
    /// What a change of the model must bring, or may cost where it makes the model smaller, dB.
    fn min_gain_db(self) -> f64 {
        match self {
            Self::Halved { .. } => MIN_GAIN_OF_DOUBLING_DB,
            Self::Cameras(_) | Self::ShDegree { .. } => MIN_GAIN_DB,
        }
    }

    fn reduces_model(self) -> bool {
        !matches!(self, Self::Cameras(_))
    }
}

impl std::fmt::Display for Candidate {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Cameras(params) => params.fmt(f),
            Self::Halved { from, to } => write!(f, "{to} of {from} splats"),
            Self::ShDegree { from, to } => write!(f, "colors of degree {to} in place of {from}"),
        }
    }
}

/// How a trial ended.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Trial {
    /// What was tried.
    pub candidate: Candidate,
    /// Mean gain over the selection keyframes, dB.
    pub gain_db: f64,
    /// Its standard error, dB.
    pub standard_error_db: f64,
    /// Selection keyframes.
    pub n_images: usize,
    /// Whether the change stays.
    pub kept: bool,
}

impl Trial {
    /// Judges paired scores, dB.
    pub(crate) fn of(candidate: Candidate, baseline_db: &[f64], variant_db: &[f64]) -> Self {
        let gains: Vec<f64> =
            baseline_db.iter().zip(variant_db).map(|(baseline, variant)| variant - baseline).collect();
        let gain = Gain::of(&gains);
        let min_db = candidate.min_gain_db();
        let Gain { mean_db: gain_db, standard_error_db, n_images } = gain;
        // In doubt nothing is added, and nothing is left out.
        let is_significant = match candidate.reduces_model() {
            true => -gain_db + 0.5 * standard_error_db <= min_db,
            false => gain.is_significant(min_db),
        };
        Self { candidate, gain_db, standard_error_db, n_images, kept: n_images > 1 && is_significant }
    }

    /// The part of the model that was tried: what is added, or what would be left out.
    pub(crate) fn part(&self) -> TrialReport {
        let (part, is_reduction) = match self.candidate {
            Candidate::Cameras(params) => (params.to_string(), false),
            Candidate::Halved { from, to } => (format!("{from} splats over {to}"), true),
            Candidate::ShDegree { from, to } => (format!("colors of degree {from} over {to}"), true),
        };
        TrialReport {
            part,
            gain_db: if is_reduction { -self.gain_db } else { self.gain_db },
            standard_error_db: self.standard_error_db,
            n_images: self.n_images,
            kept: self.kept != is_reduction,
        }
    }

    fn log_result(&self) {
        let verdict = match (self.candidate, self.kept) {
            (Candidate::Cameras(_), true) => "learned from here on",
            (Candidate::Cameras(_), false) => "does not pay",
            (Candidate::Halved { .. } | Candidate::ShDegree { .. }, true) => "enough",
            (Candidate::Halved { .. } | Candidate::ShDegree { .. }, false) => "not enough",
        };
        log::info!(
            "{}: {:+.2} dB on {} held-back images (standard error {:.2}): {verdict}",
            self.candidate,
            self.gain_db,
            self.n_images,
            self.standard_error_db,
        );
    }
}

/// A selection keyframe, and its image on the GPU once it was compared with.
#[derive(Debug)]
pub(crate) struct ValidationImage {
    pub(crate) keyframe: Arc<Keyframe>,
    pub(crate) image: Option<Buffer>,
}

/// Camera and stamp of a keyframe.
pub(crate) type ImageId = (Arc<str>, Stamp);

/// PSNR of each selection keyframe, dB.
pub(crate) type Scores = BTreeMap<ImageId, f64>;

fn id_of(keyframe: &Keyframe) -> ImageId {
    (keyframe.camera.clone(), keyframe.stamp)
}

/// Scores of the images that are in both.
fn pair_scores(baseline_db: &Scores, variant_db: &Scores) -> (Vec<f64>, Vec<f64>) {
    baseline_db.iter().filter_map(|(id, baseline)| Some((*baseline, *variant_db.get(id)?))).unzip()
}

/// A training keyframe that arrived during a trial, and the step of its arrival.
#[derive(Clone, Debug)]
pub(crate) struct Arrival {
    pub(crate) step: u64,
    pub(crate) keyframe: Arc<Keyframe>,
}

/// Whether the number of splats is settled.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) enum CountState {
    /// Grows up to the cap.
    ToCap,
    /// Grows, to be tried once it is mature.
    Growing,
    /// Found to be too many: halved until half is not enough.
    Halving,
    /// Stays.
    Finished,
}

/// Where the trials stand.
#[derive(Debug)]
pub(crate) struct SplatTrials {
    candidates: VecDeque<ParamSet>,
    count: CountState,
    /// Degree of the colors that is tried next, once the number of splats is settled.
    degree: u32,
    pub(crate) validation: Vec<ValidationImage>,
    pub(crate) finished: Vec<Trial>,
    trial_phase: SplatTrialPhase,
}

#[derive(Debug)]
enum SplatTrialPhase {
    Waiting,
    Baseline(RunningTrial),
    Variant {
        trial: RunningTrial,
        baseline_db: Scores,
        /// Keyframes that wait for the end of the trial.
        deferred: Vec<Arc<Keyframe>>,
    },
    Finished,
}

/// A trial in progress.
#[derive(Debug)]
pub(crate) struct RunningTrial {
    pub(crate) candidate: Candidate,
    /// Last step of this half.
    pub(crate) until: u64,
    /// The state not in training: during the first half the start of the trial, during the second half the end of the first.
    pub(crate) other: Box<Snapshot>,
    /// The selection keyframes that both halves are scored on.
    pub(crate) scored: Vec<ImageId>,
    /// In the first half, the keyframes that arrived; in the second half, those that have yet to arrive again.
    pub(crate) arrivals: VecDeque<Arrival>,
}

/// What to do at the start of the second half of a trial.
pub(crate) struct SecondHalf {
    /// The state to restore.
    pub(crate) from: Snapshot,
    /// The change to apply to it.
    pub(crate) candidate: Candidate,
    /// Keyframes to remove, because they arrive again.
    pub(crate) arrived: Vec<Arc<Keyframe>>,
}

/// What to do at the end of a trial.
pub(crate) struct TrialEnd {
    /// The state to restore if the change is rejected.
    pub(crate) restored: Option<Snapshot>,
    /// Keyframes that already have splats in the restored state but are not views yet.
    pub(crate) seeded: Vec<Arc<Keyframe>>,
    /// Keyframes to add now.
    pub(crate) deferred: Vec<Arc<Keyframe>>,
}

/// A trial in progress, for a checkpoint; it is in its second half if it has scores of the first.
pub(crate) type RunningTrialRef<'a> = (&'a RunningTrial, Option<&'a Scores>);

/// What is still to be tried.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct RemainingTrials {
    is_finished: bool,
    params: Vec<ParamSet>,
    count: CountState,
    degree: u32,
}

/// What the trainer has to do at this step.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Due {
    /// Nothing.
    Nothing,
    /// Copy the state and go on.
    Begin(Candidate),
    /// Score; go back to the copy; change what is tried.
    BeginSecondHalf,
    /// Add a keyframe that arrived at this step of the first half.
    Arrival,
    /// Score; decide.
    End,
    /// Score with and without gains of images; decide.
    Gains,
    /// Learn from what was held back.
    ReleaseValidation,
}

/// The splats as they are when the trainer asks what is due.
#[derive(Clone, Copy, Debug)]
pub(crate) struct TrialContext {
    pub(crate) step: u64,
    pub(crate) n_splats: u32,
    /// Whether growth is over: earlier few splats do as well as many, which learn more slowly.
    pub(crate) is_mature: bool,
    /// Of their colors.
    pub(crate) sh_degree: u32,
}

impl SplatTrials {
    pub(crate) fn new(cameras: &CameraRefinement, count: CountPolicy) -> Self {
        let candidates: VecDeque<ParamSet> = match cameras {
            CameraRefinement::Always(_) => VecDeque::new(),
            CameraRefinement::Try(candidates) => candidates.iter().copied().collect(),
        };
        let count = match count {
            CountPolicy::ToCap => CountState::ToCap,
            CountPolicy::Tested => CountState::Growing,
        };
        let is_finished = candidates.is_empty() && count == CountState::ToCap;
        let trial_phase = if is_finished { SplatTrialPhase::Finished } else { SplatTrialPhase::Waiting };
        Self { candidates, count, degree: 0, validation: Vec::new(), finished: Vec::new(), trial_phase }
    }

    /// Whether selection keyframes are still held back.
    pub(crate) fn holds_validation(&self) -> bool {
        !matches!(self.trial_phase, SplatTrialPhase::Finished)
    }

    /// Whether there may be more splats.
    pub(crate) fn may_grow(&self) -> bool {
        let is_halving =
            matches!(self.running_trial(), Some((RunningTrial { candidate: Candidate::Halved { .. }, .. }, _)));
        matches!(self.count, CountState::ToCap | CountState::Growing) && !is_halving
    }

    /// The trial in progress.
    pub(crate) fn running_trial(&self) -> Option<RunningTrialRef<'_>> {
        match &self.trial_phase {
            SplatTrialPhase::Baseline(trial) => Some((trial, None)),
            SplatTrialPhase::Variant { trial, baseline_db, .. } => Some((trial, Some(baseline_db))),
            SplatTrialPhase::Waiting | SplatTrialPhase::Finished => None,
        }
    }

    pub(crate) fn due(&self, context: TrialContext) -> Due {
        match &self.trial_phase {
            SplatTrialPhase::Waiting => self.next_due(context),
            SplatTrialPhase::Baseline(trial) if context.step >= trial.until => Due::BeginSecondHalf,
            SplatTrialPhase::Variant { trial, .. }
                if trial.arrivals.front().is_some_and(|next_due| context.step >= next_due.step) =>
            {
                Due::Arrival
            }
            SplatTrialPhase::Variant { trial, .. } if context.step >= trial.until => Due::End,
            SplatTrialPhase::Baseline(_) | SplatTrialPhase::Variant { .. } | SplatTrialPhase::Finished => Due::Nothing,
        }
    }

    fn next_due(&self, context: TrialContext) -> Due {
        if context.step < TRIAL_START {
            return Due::Nothing;
        }
        if self.validation.len() < MIN_VALIDATION_IMAGES {
            // More of them may come, but not for ever.
            return if context.step < 2 * TRIAL_START { Due::Nothing } else { Due::ReleaseValidation };
        }
        if let Some(params) = self.candidates.front() {
            return if *params == GAINS { Due::Gains } else { Due::Begin(Candidate::Cameras(*params)) };
        }
        let halved = Candidate::Halved { from: context.n_splats, to: context.n_splats.div_ceil(2) };
        let lower = Candidate::ShDegree { from: context.sh_degree, to: self.degree };
        match self.count {
            CountState::ToCap => Due::ReleaseValidation,
            CountState::Finished if self.degree < context.sh_degree => Due::Begin(lower),
            CountState::Finished => Due::ReleaseValidation,
            CountState::Halving => Due::Begin(halved),
            CountState::Growing if context.is_mature => Due::Begin(halved),
            CountState::Growing => Due::Nothing,
        }
    }

    /// Steps that may be taken before something is due again.
    pub(crate) fn steps_left(&self, step: u64) -> u64 {
        match &self.trial_phase {
            SplatTrialPhase::Waiting if step < TRIAL_START => TRIAL_START - step,
            SplatTrialPhase::Baseline(trial) => trial.until.saturating_sub(step).max(1),
            SplatTrialPhase::Variant { trial, .. } => {
                let arrives_at = trial.arrivals.front().map_or(u64::MAX, |next_due| next_due.step);
                trial.until.min(arrives_at).saturating_sub(step).max(1)
            }
            _ => u64::MAX,
        }
    }

    /// Records a training keyframe that arrives at this step; returns whether it has to wait for the end of a trial.
    pub(crate) fn defer_arrival(&mut self, keyframe: &Arc<Keyframe>, step: u64) -> bool {
        match &mut self.trial_phase {
            SplatTrialPhase::Baseline(trial) => {
                trial.arrivals.push_back(Arrival { step, keyframe: keyframe.clone() });
                false
            }
            SplatTrialPhase::Variant { deferred, .. } => {
                deferred.push(keyframe.clone());
                true
            }
            SplatTrialPhase::Waiting | SplatTrialPhase::Finished => false,
        }
    }

    /// The keyframe that is due to arrive now in the second half of a trial.
    pub(crate) fn next_arrival(&mut self) -> Option<Arc<Keyframe>> {
        match &mut self.trial_phase {
            SplatTrialPhase::Variant { trial, .. } => trial.arrivals.pop_front().map(|arrival| arrival.keyframe),
            _ => None,
        }
    }

    /// The selection keyframes to score: those of the trial in progress, otherwise some that are spread over all.
    pub(crate) fn scored(&self) -> Vec<ImageId> {
        let stride = self.validation.len().div_ceil(MAX_SCORED).max(1);
        let spread = || self.validation.iter().step_by(stride).map(|validation| id_of(&validation.keyframe)).collect();
        self.running_trial().map_or_else(spread, |(trial, _)| trial.scored.clone())
    }

    /// A selection keyframe, unless it was evicted.
    pub(crate) fn validation(&mut self, (camera, stamp): &ImageId) -> Option<&mut ValidationImage> {
        let matches_id = |validation: &&mut ValidationImage| {
            validation.keyframe.camera == *camera && validation.keyframe.stamp == *stamp
        };
        self.validation.iter_mut().find(matches_id)
    }

    pub(crate) fn begin(&mut self, candidate: Candidate, from: Snapshot, n_views: usize) {
        let n_steps = match candidate {
            Candidate::Cameras(params) if params.image_poses || params.image_gains => {
                (STEPS_PER_IMAGE * n_views as u64).clamp(SHARED_STEPS, MAX_STEPS)
            }
            _ => SHARED_STEPS,
        };
        let until = from.step + n_steps;
        let scored = self.scored();
        self.trial_phase = SplatTrialPhase::Baseline(RunningTrial {
            candidate,
            until,
            other: Box::new(from),
            scored,
            arrivals: VecDeque::new(),
        });
    }

    /// Begins the second half.
    pub(crate) fn begin_second_half(&mut self, baseline: Snapshot, baseline_db: Scores) -> Option<SecondHalf> {
        match std::mem::replace(&mut self.trial_phase, SplatTrialPhase::Finished) {
            SplatTrialPhase::Baseline(mut trial) => {
                let from = *std::mem::replace(&mut trial.other, Box::new(baseline));
                let arrived = trial.arrivals.iter().map(|arrival| arrival.keyframe.clone()).collect();
                let candidate = trial.candidate;
                self.trial_phase = SplatTrialPhase::Variant { trial, baseline_db, deferred: Vec::new() };
                Some(SecondHalf { from, candidate, arrived })
            }
            other => {
                self.trial_phase = other;
                None
            }
        }
    }

    /// Accepts or rejects the change.
    pub(crate) fn end(&mut self, variant_db: &Scores) -> Option<TrialEnd> {
        let SplatTrialPhase::Variant { trial, baseline_db, deferred } =
            std::mem::replace(&mut self.trial_phase, SplatTrialPhase::Waiting)
        else {
            return None;
        };
        let (baseline_db, variant_db) = pair_scores(&baseline_db, variant_db);
        let candidate = trial.candidate;
        let kept = self.evaluate(candidate, &baseline_db, &variant_db);
        match candidate {
            Candidate::Cameras(_) => drop(self.candidates.pop_front()),
            Candidate::Halved { to, .. } if kept && to > MIN_SPLATS => self.count = CountState::Halving,
            Candidate::Halved { .. } => self.count = CountState::Finished,
            Candidate::ShDegree { from, to } => self.degree = if kept { from } else { to + 1 },
        }
        Some(TrialEnd { restored: (!kept).then_some(*trial.other), seeded: Vec::new(), deferred })
    }

    /// Decides on gains of images: what is learned from now on, if they pay.
    pub(crate) fn decide_gains(&mut self, baseline_db: &[f64], variant_db: &[f64]) -> Option<ParamSet> {
        self.candidates.retain(|params| *params != GAINS);
        self.evaluate(Candidate::Cameras(GAINS), baseline_db, variant_db).then_some(GAINS)
    }

    fn evaluate(&mut self, candidate: Candidate, baseline_db: &[f64], variant_db: &[f64]) -> bool {
        log::debug!("{candidate}: without {baseline_db:.3?}, with {variant_db:.3?} dB");
        let mut trial = Trial::of(candidate, baseline_db, variant_db);
        let reductions = self.finished.iter().filter(|finished| finished.kept && finished.candidate.reduces_model());
        let total_loss_db: f64 = reductions.map(|finished| (-finished.gain_db).max(0.0)).sum();
        trial.kept &= !candidate.reduces_model() || total_loss_db - trial.gain_db <= MAX_TOTAL_LOSS_DB;
        trial.log_result();
        let kept = trial.kept;
        self.finished.push(trial);
        kept
    }

    /// Cancels the trial in progress; it is repeated if training continues.
    pub(crate) fn cancel(&mut self) -> Option<TrialEnd> {
        match std::mem::replace(&mut self.trial_phase, SplatTrialPhase::Waiting) {
            SplatTrialPhase::Variant { trial, deferred, .. } => Some(TrialEnd {
                restored: Some(*trial.other),
                seeded: trial.arrivals.into_iter().map(|arrival| arrival.keyframe).collect(),
                deferred,
            }),
            other => {
                self.trial_phase = other;
                None
            }
        }
    }

    /// What was held back, to be learned from.
    pub(crate) fn finish(&mut self) -> Vec<Arc<Keyframe>> {
        self.trial_phase = SplatTrialPhase::Finished;
        std::mem::take(&mut self.validation).into_iter().map(|validation| validation.keyframe).collect()
    }

    /// The state without the change, while one is being tried.
    pub(crate) fn baseline(&self) -> Option<&Snapshot> {
        match &self.trial_phase {
            SplatTrialPhase::Variant { trial, .. } => Some(&trial.other),
            _ => None,
        }
    }

    /// What a checkpoint has to hold besides a trial in progress.
    pub(crate) fn remaining_trials(&self) -> RemainingTrials {
        RemainingTrials {
            is_finished: !self.holds_validation(),
            params: self.candidates.iter().copied().collect(),
            count: self.count,
            degree: self.degree,
        }
    }

    /// Takes over what a checkpoint holds.
    pub(crate) fn restore(&mut self, remaining_trials: RemainingTrials, finished: Vec<Trial>) {
        self.trial_phase =
            if remaining_trials.is_finished { SplatTrialPhase::Finished } else { SplatTrialPhase::Waiting };
        self.candidates = remaining_trials.params.into();
        (self.count, self.degree, self.finished) = (remaining_trials.count, remaining_trials.degree, finished);
    }

    /// Continues a trial from a checkpoint; it is in its second half if there are scores of the first.
    pub(crate) fn restore_trial(&mut self, trial: RunningTrial, baseline_db: Option<Scores>) {
        self.trial_phase = match baseline_db {
            Some(baseline_db) => SplatTrialPhase::Variant { trial, baseline_db, deferred: Vec::new() },
            None => SplatTrialPhase::Baseline(trial),
        };
    }

    /// Says whether these were to be tried; they were found to be needed in another way.
    pub(crate) fn remove_candidate(&mut self, found: ParamSet) -> bool {
        let n = self.candidates.len();
        self.candidates.retain(|candidate| *candidate != found);
        self.candidates.len() < n
    }

    /// Forgets a keyframe.
    pub(crate) fn remove(&mut self, is_removed: impl Fn(&Keyframe) -> bool) {
        self.validation.retain(|validation| !is_removed(&validation.keyframe));
        match &mut self.trial_phase {
            SplatTrialPhase::Baseline(trial) => trial.arrivals.retain(|arrival| !is_removed(&arrival.keyframe)),
            SplatTrialPhase::Variant { trial, deferred, .. } => {
                trial.arrivals.retain(|arrival| !is_removed(&arrival.keyframe));
                deferred.retain(|keyframe| !is_removed(keyframe));
            }
            SplatTrialPhase::Waiting | SplatTrialPhase::Finished => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const HALVED: Candidate = Candidate::Halved { from: 20_000, to: 10_000 };

    fn poses() -> ParamSet {
        ParamSet { image_poses: true, ..ParamSet::default() }
    }

    #[test]
    fn gain_must_exceed_its_standard_error() {
        let trial = |variant: &[f64]| Trial::of(Candidate::Cameras(poses()), &[20.0, 22.0, 24.0, 21.0], variant);
        assert!(trial(&[20.5, 22.4, 24.6, 21.5]).kept);
        assert!(!trial(&[20.03, 22.04, 24.02, 21.03]).kept, "too small, if sure");
        assert!(!trial(&[23.0, 20.5, 25.5, 19.5]).kept, "large, but not sure");
        assert!(!trial(&[19.0, 21.0, 23.0, 20.0]).kept);
        assert!(!Trial::of(Candidate::Cameras(poses()), &[20.0], &[25.0]).kept, "one image shows no scatter");
        let gain = trial(&[20.5, 22.5, 24.5, 21.5]);
        assert!((gain.gain_db - 0.5).abs() < 1e-12 && gain.standard_error_db < 1e-12);
    }

    #[test]
    fn reductions_with_small_loss_are_kept() {
        let trial = |variant: &[f64]| Trial::of(HALVED, &[20.0, 22.0, 24.0, 21.0], variant);
        assert!(trial(&[19.94, 21.95, 23.93, 20.94]).kept);
        assert!(!trial(&[19.6, 22.1, 23.9, 21.1]).kept, "a mean of -0.075 dB, but it may be twice that");
        assert!(trial(&[20.5, 22.4, 24.6, 21.5]).kept, "fewer may even be better");
        assert!(!trial(&[19.8, 21.7, 23.8, 20.7]).kept);
        assert!(!Trial::of(HALVED, &[20.0], &[20.0]).kept, "one image tells nothing");
        let part = trial(&[19.8, 21.7, 23.8, 20.7]).part();
        assert!((part.gain_db - 0.25).abs() < 1e-12 && part.kept, "{part:?}");
        assert!(!trial(&[19.94, 21.95, 23.93, 20.94]).part().kept);
    }

    #[test]
    fn no_validation_images_without_candidates() {
        let trials = SplatTrials::new(&CameraRefinement::default(), CountPolicy::ToCap);
        assert!(!trials.holds_validation() && trials.may_grow());
        assert_eq!(
            trials.due(TrialContext { step: 10_000, n_splats: 5000, is_mature: true, sh_degree: 3 }),
            Due::Nothing
        );
    }

    #[test]
    fn too_few_validation_images_are_released() {
        for count in [CountPolicy::ToCap, CountPolicy::Tested] {
            let trials = SplatTrials::new(&CameraRefinement::Try(vec![poses()]), count);
            assert!(trials.holds_validation());
            let due = |step| trials.due(TrialContext { step, n_splats: 5000, is_mature: false, sh_degree: 3 });
            assert_eq!(due(TRIAL_START), Due::Nothing);
            assert_eq!(due(2 * TRIAL_START), Due::ReleaseValidation);
        }
    }
}
