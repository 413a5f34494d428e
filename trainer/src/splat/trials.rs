//! Whether a part of the model pays: tried on a copy of the model, judged by images not learned from.
//!
//! At the start the selection keyframes are held back. Each candidate gets as many steps as the model without it, from
//! the same state. Keyframes that arrive meanwhile reach both at the same step, or wait for the end of the trial.
//! What is added stays when the paired gain on the selection keyframes exceeds both a least gain and two
//! standard errors; what is left out stays out when that costs less than a least gain, half a standard error counted in,
//! and all of it together no more than [`MOST_SPENT_DB`]. When all is settled the selection keyframes are learned from, too.

use super::camera_terms::TermSet;
use super::trainer::State;
use crate::gain::{Gain, LEAST_GAIN_DB};
use crate::gpu::Buffer;
use crate::{Keyframe, Part};
use kinematics::Stamp;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

/// Step of the first trial: earlier the scene is too rough to tell.
pub(crate) const TRIAL_START: u64 = 500;
/// Steps of a trial of what all images share, and least of any.
const SHARED_STEPS: u64 = 250;
/// How often each image is looked at in a trial of terms of its own, and the most steps for it.
const ROUNDS: u64 = 4;
const MOST_STEPS: u64 = 1200;
/// A gain of twice the splats below this is none, dB.
const LEAST_GAIN_OF_DOUBLING_DB: f64 = 0.1;
/// All that is left out may cost this much together, dB.
const MOST_SPENT_DB: f64 = 0.15;
/// Fewer selection keyframes tell nothing.
const LEAST_IMAGES: usize = 4;
/// Maximum number of selection keyframes in a mean score.
pub(crate) const MAX_SCORED: usize = 24;
/// Fewer splats are not divided further.
const FEWEST_SPLATS: u32 = 1000;

/// Gains of images: what they bring is told by a sum over pixels, without learning them first.
const GAINS: TermSet = TermSet { image_gains: true, ..TermSet::NONE };

/// What is learned about cameras.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum CameraChoice {
    /// These terms, from the first step on.
    Given(TermSet),
    /// Each of these in turn, where it pays.
    Try(Vec<TermSet>),
}

impl Default for CameraChoice {
    fn default() -> Self {
        Self::Given(TermSet::default())
    }
}

/// How the number of splats is found.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum CountChoice {
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
    Cameras(TermSet),
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
    fn least_gain_db(self) -> f64 {
        match self {
            Self::Halved { .. } => LEAST_GAIN_OF_DOUBLING_DB,
            Self::Cameras(_) | Self::ShDegree { .. } => LEAST_GAIN_DB,
        }
    }

    fn is_smaller(self) -> bool {
        !matches!(self, Self::Cameras(_))
    }
}

impl std::fmt::Display for Candidate {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Cameras(terms) => terms.fmt(f),
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
    pub(crate) fn of(candidate: Candidate, without_db: &[f64], with_db: &[f64]) -> Self {
        let gains: Vec<f64> = without_db.iter().zip(with_db).map(|(without, with)| with - without).collect();
        let gain = Gain::of(&gains);
        let least_db = candidate.least_gain_db();
        let Gain { mean_db: gain_db, standard_error_db, n_images } = gain;
        // In doubt nothing is added, and nothing is left out.
        let pays = match candidate.is_smaller() {
            true => -gain_db + 0.5 * standard_error_db <= least_db,
            false => gain.pays(least_db),
        };
        Self { candidate, gain_db, standard_error_db, n_images, kept: n_images > 1 && pays }
    }

    /// The part of the model that was tried: what is added, or what would be left out.
    pub(crate) fn part(&self) -> Part {
        let (part, is_left_out) = match self.candidate {
            Candidate::Cameras(terms) => (terms.to_string(), false),
            Candidate::Halved { from, to } => (format!("{from} splats over {to}"), true),
            Candidate::ShDegree { from, to } => (format!("colors of degree {from} over {to}"), true),
        };
        Part {
            part,
            bought_db: if is_left_out { -self.gain_db } else { self.gain_db },
            standard_error_db: self.standard_error_db,
            n_images: self.n_images,
            kept: self.kept != is_left_out,
        }
    }

    fn tell(&self) {
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
pub(crate) struct HeldBack {
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
fn paired(without_db: &Scores, with_db: &Scores) -> (Vec<f64>, Vec<f64>) {
    without_db.iter().filter_map(|(id, without)| Some((*without, *with_db.get(id)?))).unzip()
}

/// A training keyframe that arrived during a trial, and the step of its arrival.
#[derive(Clone, Debug)]
pub(crate) struct Arrival {
    pub(crate) step: u64,
    pub(crate) keyframe: Arc<Keyframe>,
}

/// Whether the number of splats is settled.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) enum Count {
    /// Grows up to the cap.
    ToCap,
    /// Grows, to be tried once it is mature.
    Growing,
    /// Found to be too many: halved until half is not enough.
    Falling,
    /// Stays.
    Settled,
}

/// Where the trials stand.
#[derive(Debug)]
pub(crate) struct Trials {
    candidates: VecDeque<TermSet>,
    count: Count,
    /// Degree of the colors that is tried next, once the number of splats is settled.
    degree: u32,
    pub(crate) held_back: Vec<HeldBack>,
    pub(crate) ended: Vec<Trial>,
    phase: Phase,
}

#[derive(Debug)]
enum Phase {
    Waiting,
    Without(Running),
    With {
        trial: Running,
        without_db: Scores,
        /// Keyframes that wait for the end of the trial.
        deferred: Vec<Arc<Keyframe>>,
    },
    Settled,
}

/// A trial in progress.
#[derive(Debug)]
pub(crate) struct Running {
    pub(crate) candidate: Candidate,
    /// Last step of this half.
    pub(crate) until: u64,
    /// The state not in training: during the first half the start of the trial, during the second half the end of the first.
    pub(crate) other: Box<State>,
    /// The selection keyframes that both halves are scored on.
    pub(crate) scored: Vec<ImageId>,
    /// In the first half, the keyframes that arrived; in the second half, those that have yet to arrive again.
    pub(crate) arrivals: VecDeque<Arrival>,
}

/// What to do at the start of the second half of a trial.
pub(crate) struct Turned {
    /// The state to restore.
    pub(crate) from: State,
    /// The change to apply to it.
    pub(crate) candidate: Candidate,
    /// Keyframes to remove, because they arrive again.
    pub(crate) arrived: Vec<Arc<Keyframe>>,
}

/// What to do at the end of a trial.
pub(crate) struct Ended {
    /// The state to restore if the change is rejected.
    pub(crate) restored: Option<State>,
    /// Keyframes that already have splats in the restored state but are not views yet.
    pub(crate) seeded: Vec<Arc<Keyframe>>,
    /// Keyframes to add now.
    pub(crate) deferred: Vec<Arc<Keyframe>>,
}

/// A trial in progress, for a checkpoint; it is in its second half if it has scores of the first.
pub(crate) type UnderWay<'a> = (&'a Running, Option<&'a Scores>);

/// What is still to be tried.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Untried {
    is_settled: bool,
    terms: Vec<TermSet>,
    count: Count,
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
    Turn,
    /// Add a keyframe that arrived at this step of the first half.
    Arrival,
    /// Score; decide.
    End,
    /// Score with and without gains of images; decide.
    Gains,
    /// Learn from what was held back.
    Join,
}

/// The splats as they are when the trainer asks what is due.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Now {
    pub(crate) step: u64,
    pub(crate) n_splats: u32,
    /// Whether growth is over: earlier few splats do as well as many, which learn more slowly.
    pub(crate) is_mature: bool,
    /// Of their colors.
    pub(crate) sh_degree: u32,
}

impl Trials {
    pub(crate) fn new(cameras: &CameraChoice, count: CountChoice) -> Self {
        let candidates: VecDeque<TermSet> = match cameras {
            CameraChoice::Given(_) => VecDeque::new(),
            CameraChoice::Try(candidates) => candidates.iter().copied().collect(),
        };
        let count = match count {
            CountChoice::ToCap => Count::ToCap,
            CountChoice::Tested => Count::Growing,
        };
        let settled = candidates.is_empty() && count == Count::ToCap;
        let phase = if settled { Phase::Settled } else { Phase::Waiting };
        Self { candidates, count, degree: 0, held_back: Vec::new(), ended: Vec::new(), phase }
    }

    /// Whether selection keyframes are still held back.
    pub(crate) fn hold_back(&self) -> bool {
        !matches!(self.phase, Phase::Settled)
    }

    /// Whether there may be more splats.
    pub(crate) fn may_grow(&self) -> bool {
        let is_halving = matches!(self.under_way(), Some((Running { candidate: Candidate::Halved { .. }, .. }, _)));
        matches!(self.count, Count::ToCap | Count::Growing) && !is_halving
    }

    /// The trial in progress.
    pub(crate) fn under_way(&self) -> Option<UnderWay<'_>> {
        match &self.phase {
            Phase::Without(trial) => Some((trial, None)),
            Phase::With { trial, without_db, .. } => Some((trial, Some(without_db))),
            Phase::Waiting | Phase::Settled => None,
        }
    }

    pub(crate) fn due(&self, now: Now) -> Due {
        match &self.phase {
            Phase::Waiting => self.next(now),
            Phase::Without(trial) if now.step >= trial.until => Due::Turn,
            Phase::With { trial, .. } if trial.arrivals.front().is_some_and(|next| now.step >= next.step) => {
                Due::Arrival
            }
            Phase::With { trial, .. } if now.step >= trial.until => Due::End,
            Phase::Without(_) | Phase::With { .. } | Phase::Settled => Due::Nothing,
        }
    }

    fn next(&self, now: Now) -> Due {
        if now.step < TRIAL_START {
            return Due::Nothing;
        }
        if self.held_back.len() < LEAST_IMAGES {
            // More of them may come, but not for ever.
            return if now.step < 2 * TRIAL_START { Due::Nothing } else { Due::Join };
        }
        if let Some(terms) = self.candidates.front() {
            return if *terms == GAINS { Due::Gains } else { Due::Begin(Candidate::Cameras(*terms)) };
        }
        let halved = Candidate::Halved { from: now.n_splats, to: now.n_splats.div_ceil(2) };
        let lower = Candidate::ShDegree { from: now.sh_degree, to: self.degree };
        match self.count {
            Count::ToCap => Due::Join,
            Count::Settled if self.degree < now.sh_degree => Due::Begin(lower),
            Count::Settled => Due::Join,
            Count::Falling => Due::Begin(halved),
            Count::Growing if now.is_mature => Due::Begin(halved),
            Count::Growing => Due::Nothing,
        }
    }

    /// Steps that may be taken before something is due again.
    pub(crate) fn steps_left(&self, step: u64) -> u64 {
        match &self.phase {
            Phase::Waiting if step < TRIAL_START => TRIAL_START - step,
            Phase::Without(trial) => trial.until.saturating_sub(step).max(1),
            Phase::With { trial, .. } => {
                let arrives_at = trial.arrivals.front().map_or(u64::MAX, |next| next.step);
                trial.until.min(arrives_at).saturating_sub(step).max(1)
            }
            _ => u64::MAX,
        }
    }

    /// Records a training keyframe that arrives at this step; returns whether it has to wait for the end of a trial.
    pub(crate) fn defers(&mut self, keyframe: &Arc<Keyframe>, step: u64) -> bool {
        match &mut self.phase {
            Phase::Without(trial) => {
                trial.arrivals.push_back(Arrival { step, keyframe: keyframe.clone() });
                false
            }
            Phase::With { deferred, .. } => {
                deferred.push(keyframe.clone());
                true
            }
            Phase::Waiting | Phase::Settled => false,
        }
    }

    /// The keyframe that is due to arrive now in the second half of a trial.
    pub(crate) fn next_arrival(&mut self) -> Option<Arc<Keyframe>> {
        match &mut self.phase {
            Phase::With { trial, .. } => trial.arrivals.pop_front().map(|arrival| arrival.keyframe),
            _ => None,
        }
    }

    /// The selection keyframes to score: those of the trial in progress, otherwise some that are spread over all.
    pub(crate) fn scored(&self) -> Vec<ImageId> {
        let stride = self.held_back.len().div_ceil(MAX_SCORED).max(1);
        let spread = || self.held_back.iter().step_by(stride).map(|held_back| id_of(&held_back.keyframe)).collect();
        self.under_way().map_or_else(spread, |(trial, _)| trial.scored.clone())
    }

    /// A selection keyframe, unless it was evicted.
    pub(crate) fn held_back(&mut self, (camera, stamp): &ImageId) -> Option<&mut HeldBack> {
        let is_it =
            |held_back: &&mut HeldBack| held_back.keyframe.camera == *camera && held_back.keyframe.stamp == *stamp;
        self.held_back.iter_mut().find(is_it)
    }

    pub(crate) fn begin(&mut self, candidate: Candidate, from: State, n_views: usize) {
        let n_steps = match candidate {
            Candidate::Cameras(terms) if terms.image_poses || terms.image_gains => {
                (ROUNDS * n_views as u64).clamp(SHARED_STEPS, MOST_STEPS)
            }
            _ => SHARED_STEPS,
        };
        let until = from.step + n_steps;
        let scored = self.scored();
        self.phase =
            Phase::Without(Running { candidate, until, other: Box::new(from), scored, arrivals: VecDeque::new() });
    }

    /// Begins the second half.
    pub(crate) fn turn(&mut self, instead: State, without_db: Scores) -> Option<Turned> {
        match std::mem::replace(&mut self.phase, Phase::Settled) {
            Phase::Without(mut trial) => {
                let from = *std::mem::replace(&mut trial.other, Box::new(instead));
                let arrived = trial.arrivals.iter().map(|arrival| arrival.keyframe.clone()).collect();
                let candidate = trial.candidate;
                self.phase = Phase::With { trial, without_db, deferred: Vec::new() };
                Some(Turned { from, candidate, arrived })
            }
            other => {
                self.phase = other;
                None
            }
        }
    }

    /// Accepts or rejects the change.
    pub(crate) fn end(&mut self, with_db: &Scores) -> Option<Ended> {
        let Phase::With { trial, without_db, deferred } = std::mem::replace(&mut self.phase, Phase::Waiting) else {
            return None;
        };
        let (without_db, with_db) = paired(&without_db, with_db);
        let candidate = trial.candidate;
        let kept = self.judge(candidate, &without_db, &with_db);
        match candidate {
            Candidate::Cameras(_) => drop(self.candidates.pop_front()),
            Candidate::Halved { to, .. } if kept && to > FEWEST_SPLATS => self.count = Count::Falling,
            Candidate::Halved { .. } => self.count = Count::Settled,
            Candidate::ShDegree { from, to } => self.degree = if kept { from } else { to + 1 },
        }
        Some(Ended { restored: (!kept).then_some(*trial.other), seeded: Vec::new(), deferred })
    }

    /// Decides on gains of images: what is learned from now on, if they pay.
    pub(crate) fn end_gains(&mut self, without_db: &[f64], with_db: &[f64]) -> Option<TermSet> {
        self.candidates.retain(|terms| *terms != GAINS);
        self.judge(Candidate::Cameras(GAINS), without_db, with_db).then_some(GAINS)
    }

    fn judge(&mut self, candidate: Candidate, without_db: &[f64], with_db: &[f64]) -> bool {
        log::debug!("{candidate}: without {without_db:.3?}, with {with_db:.3?} dB");
        let mut trial = Trial::of(candidate, without_db, with_db);
        let smaller = self.ended.iter().filter(|ended| ended.kept && ended.candidate.is_smaller());
        let spent: f64 = smaller.map(|ended| (-ended.gain_db).max(0.0)).sum();
        trial.kept &= !candidate.is_smaller() || spent - trial.gain_db <= MOST_SPENT_DB;
        trial.tell();
        let kept = trial.kept;
        self.ended.push(trial);
        kept
    }

    /// Cancels the trial in progress; it is repeated if training continues.
    pub(crate) fn give_up(&mut self) -> Option<Ended> {
        match std::mem::replace(&mut self.phase, Phase::Waiting) {
            Phase::With { trial, deferred, .. } => Some(Ended {
                restored: Some(*trial.other),
                seeded: trial.arrivals.into_iter().map(|arrival| arrival.keyframe).collect(),
                deferred,
            }),
            other => {
                self.phase = other;
                None
            }
        }
    }

    /// What was held back, to be learned from.
    pub(crate) fn settle(&mut self) -> Vec<Arc<Keyframe>> {
        self.phase = Phase::Settled;
        std::mem::take(&mut self.held_back).into_iter().map(|held_back| held_back.keyframe).collect()
    }

    /// The state without the change, while one is being tried.
    pub(crate) fn instead(&self) -> Option<&State> {
        match &self.phase {
            Phase::With { trial, .. } => Some(&trial.other),
            _ => None,
        }
    }

    /// What a checkpoint has to hold besides a trial in progress.
    pub(crate) fn untried(&self) -> Untried {
        Untried {
            is_settled: !self.hold_back(),
            terms: self.candidates.iter().copied().collect(),
            count: self.count,
            degree: self.degree,
        }
    }

    /// Takes over what a checkpoint holds.
    pub(crate) fn restore(&mut self, untried: Untried, ended: Vec<Trial>) {
        self.phase = if untried.is_settled { Phase::Settled } else { Phase::Waiting };
        self.candidates = untried.terms.into();
        (self.count, self.degree, self.ended) = (untried.count, untried.degree, ended);
    }

    /// Continues a trial from a checkpoint; it is in its second half if there are scores of the first.
    pub(crate) fn restore_trial(&mut self, trial: Running, without_db: Option<Scores>) {
        self.phase = match without_db {
            Some(without_db) => Phase::With { trial, without_db, deferred: Vec::new() },
            None => Phase::Without(trial),
        };
    }

    /// Says whether these were to be tried; they were found to be needed in another way.
    pub(crate) fn need_not_try(&mut self, found: TermSet) -> bool {
        let n = self.candidates.len();
        self.candidates.retain(|candidate| *candidate != found);
        self.candidates.len() < n
    }

    /// Forgets a keyframe.
    pub(crate) fn remove(&mut self, gone: impl Fn(&Keyframe) -> bool) {
        self.held_back.retain(|held_back| !gone(&held_back.keyframe));
        match &mut self.phase {
            Phase::Without(trial) => trial.arrivals.retain(|arrival| !gone(&arrival.keyframe)),
            Phase::With { trial, deferred, .. } => {
                trial.arrivals.retain(|arrival| !gone(&arrival.keyframe));
                deferred.retain(|keyframe| !gone(keyframe));
            }
            Phase::Waiting | Phase::Settled => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const HALVED: Candidate = Candidate::Halved { from: 20_000, to: 10_000 };

    fn poses() -> TermSet {
        TermSet { image_poses: true, ..TermSet::default() }
    }

    #[test]
    fn a_gain_counts_when_it_is_larger_than_its_scatter() {
        let trial = |with: &[f64]| Trial::of(Candidate::Cameras(poses()), &[20.0, 22.0, 24.0, 21.0], with);
        assert!(trial(&[20.5, 22.4, 24.6, 21.5]).kept);
        assert!(!trial(&[20.03, 22.04, 24.02, 21.03]).kept, "too small, if sure");
        assert!(!trial(&[23.0, 20.5, 25.5, 19.5]).kept, "large, but not sure");
        assert!(!trial(&[19.0, 21.0, 23.0, 20.0]).kept);
        assert!(!Trial::of(Candidate::Cameras(poses()), &[20.0], &[25.0]).kept, "one image shows no scatter");
        let gain = trial(&[20.5, 22.5, 24.5, 21.5]);
        assert!((gain.gain_db - 0.5).abs() < 1e-12 && gain.standard_error_db < 1e-12);
    }

    #[test]
    fn what_costs_little_is_left_out() {
        let trial = |with: &[f64]| Trial::of(HALVED, &[20.0, 22.0, 24.0, 21.0], with);
        assert!(trial(&[19.94, 21.95, 23.93, 20.94]).kept);
        assert!(!trial(&[19.6, 22.1, 23.9, 21.1]).kept, "a mean of -0.075 dB, but it may be twice that");
        assert!(trial(&[20.5, 22.4, 24.6, 21.5]).kept, "fewer may even be better");
        assert!(!trial(&[19.8, 21.7, 23.8, 20.7]).kept);
        assert!(!Trial::of(HALVED, &[20.0], &[20.0]).kept, "one image tells nothing");
        let part = trial(&[19.8, 21.7, 23.8, 20.7]).part();
        assert!((part.bought_db - 0.25).abs() < 1e-12 && part.kept, "{part:?}");
        assert!(!trial(&[19.94, 21.95, 23.93, 20.94]).part().kept);
    }

    #[test]
    fn without_candidates_nothing_is_held_back() {
        let trials = Trials::new(&CameraChoice::default(), CountChoice::ToCap);
        assert!(!trials.hold_back() && trials.may_grow());
        assert_eq!(trials.due(Now { step: 10_000, n_splats: 5000, is_mature: true, sh_degree: 3 }), Due::Nothing);
    }

    #[test]
    fn too_few_images_join_in_time() {
        for count in [CountChoice::ToCap, CountChoice::Tested] {
            let trials = Trials::new(&CameraChoice::Try(vec![poses()]), count);
            assert!(trials.hold_back());
            let due = |step| trials.due(Now { step, n_splats: 5000, is_mature: false, sh_degree: 3 });
            assert_eq!(due(TRIAL_START), Due::Nothing);
            assert_eq!(due(2 * TRIAL_START), Due::Join);
        }
    }
}
