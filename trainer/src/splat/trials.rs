//! Whether learning something about the cameras pays: tried on a copy of the model, judged by images not learned from.
//!
//! At the start the selection keyframes are held back. Each candidate gets as many steps as the model without it, from
//! the same state; it stays when the paired gain on the selection keyframes exceeds both [`LEAST_GAIN_DB`] and two
//! standard errors. When all are settled the selection keyframes are learned from, too.

use super::camera_terms::TermSet;
use super::trainer::State;
use crate::Keyframe;
use std::collections::VecDeque;
use std::sync::Arc;

/// Step of the first trial: earlier the scene is too rough to tell.
pub(crate) const TRIAL_START: u64 = 500;
/// Steps of a trial of terms that all images share, and least of any.
const SHARED_STEPS: u64 = 250;
/// How often each image is looked at in a trial of terms of its own, and the most steps for it.
const ROUNDS: u64 = 4;
const MOST_STEPS: u64 = 1200;
/// A gain below this is none, dB.
const LEAST_GAIN_DB: f64 = 0.05;
/// Fewer selection keyframes tell nothing.
const LEAST_IMAGES: usize = 4;

/// What is learned about cameras.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
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

/// How a trial ended.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Trial {
    /// What was tried.
    pub terms: TermSet,
    /// Mean gain over the selection keyframes, dB.
    pub gain_db: f64,
    /// Its standard error, dB.
    pub standard_error_db: f64,
    /// Selection keyframes.
    pub n_images: usize,
    /// Whether the terms stay.
    pub kept: bool,
}

impl Trial {
    /// Judges paired scores, dB.
    pub(crate) fn of(terms: TermSet, without_db: &[f64], with_db: &[f64]) -> Self {
        let n = without_db.len().min(with_db.len());
        let gains: Vec<f64> = without_db.iter().zip(with_db).map(|(without, with)| with - without).collect();
        let mean = gains.iter().sum::<f64>() / n.max(1) as f64;
        let variance = gains.iter().map(|gain| (gain - mean).powi(2)).sum::<f64>() / n.saturating_sub(1).max(1) as f64;
        let standard_error_db = (variance / n.max(1) as f64).sqrt();
        let kept = n > 1 && mean > LEAST_GAIN_DB.max(2.0 * standard_error_db);
        Self { terms, gain_db: mean, standard_error_db, n_images: n, kept }
    }
}

/// Where the trials stand.
#[derive(Debug)]
pub(crate) struct Trials {
    candidates: VecDeque<TermSet>,
    pub(crate) held_back: Vec<Arc<Keyframe>>,
    pub(crate) ended: Vec<Trial>,
    phase: Phase,
}

#[derive(Debug)]
enum Phase {
    Waiting,
    Without { from: Box<State>, until: u64 },
    With { instead: Box<State>, without_db: Vec<f64>, until: u64 },
    Settled,
}

/// What the trainer has to do at this step.
pub(crate) enum Due {
    /// Nothing.
    Nothing,
    /// Copy the state and go on.
    Begin,
    /// Score; go back to the copy; learn the candidate.
    Turn,
    /// Score; decide.
    End,
    /// Learn from what was held back.
    Join,
}

impl Trials {
    pub(crate) fn new(choice: &CameraChoice) -> Self {
        let candidates: VecDeque<TermSet> = match choice {
            CameraChoice::Given(_) => VecDeque::new(),
            CameraChoice::Try(candidates) => candidates.iter().copied().collect(),
        };
        let phase = if candidates.is_empty() { Phase::Settled } else { Phase::Waiting };
        Self { candidates, held_back: Vec::new(), ended: Vec::new(), phase }
    }

    /// Whether selection keyframes are still held back.
    pub(crate) fn hold_back(&self) -> bool {
        !matches!(self.phase, Phase::Settled)
    }

    pub(crate) fn due(&self, step: u64) -> Due {
        match &self.phase {
            Phase::Waiting if step < TRIAL_START => Due::Nothing,
            Phase::Waiting if self.held_back.len() >= LEAST_IMAGES && !self.candidates.is_empty() => Due::Begin,
            Phase::Waiting if self.candidates.is_empty() || step >= 2 * TRIAL_START => Due::Join,
            Phase::Without { until, .. } if step >= *until => Due::Turn,
            Phase::With { until, .. } if step >= *until => Due::End,
            _ => Due::Nothing,
        }
    }

    /// Steps that may be taken before something is due again.
    pub(crate) fn steps_left(&self, step: u64) -> u64 {
        match &self.phase {
            Phase::Waiting if step < TRIAL_START => TRIAL_START - step,
            Phase::Without { until, .. } | Phase::With { until, .. } => until.saturating_sub(step).max(1),
            _ => u64::MAX,
        }
    }

    pub(crate) fn begin(&mut self, from: State, step: u64, n_views: usize) {
        let own = self.candidates.front().is_some_and(|terms| terms.image_poses || terms.image_gains);
        let n_steps = if own { (ROUNDS * n_views as u64).clamp(SHARED_STEPS, MOST_STEPS) } else { SHARED_STEPS };
        self.phase = Phase::Without { from: Box::new(from), until: step + n_steps };
    }

    /// The state to go back to, and what to learn from there.
    pub(crate) fn turn(&mut self, instead: State, without_db: Vec<f64>) -> Option<(State, TermSet)> {
        let terms = *self.candidates.front()?;
        match std::mem::replace(&mut self.phase, Phase::Settled) {
            Phase::Without { from, until } => {
                self.phase = Phase::With { instead: Box::new(instead), without_db, until };
                Some((*from, terms))
            }
            other => {
                self.phase = other;
                None
            }
        }
    }

    /// The state to go on from, where the candidate does not stay.
    pub(crate) fn end(&mut self, with_db: &[f64]) -> Option<State> {
        let terms = self.candidates.pop_front()?;
        let Phase::With { instead, without_db, .. } = std::mem::replace(&mut self.phase, Phase::Waiting) else {
            return None;
        };
        log::debug!("without {without_db:.3?}, with {with_db:.3?} dB");
        let trial = Trial::of(terms, &without_db, with_db);
        log::info!(
            "{}: {:+.2} dB on {} held-back images (standard error {:.2}): {}",
            terms,
            trial.gain_db,
            trial.n_images,
            trial.standard_error_db,
            if trial.kept { "learned from here on" } else { "does not pay" }
        );
        let kept = trial.kept;
        self.ended.push(trial);
        (!kept).then_some(*instead)
    }

    /// Gives up a candidate that is being learned: the state to go back to. It is tried again where training goes on.
    pub(crate) fn give_up(&mut self) -> Option<State> {
        match std::mem::replace(&mut self.phase, Phase::Waiting) {
            Phase::With { instead, .. } => Some(*instead),
            other => {
                self.phase = other;
                None
            }
        }
    }

    pub(crate) fn settle(&mut self) -> Vec<Arc<Keyframe>> {
        self.phase = Phase::Settled;
        std::mem::take(&mut self.held_back)
    }

    /// The state without the candidate, while one is being learned.
    pub(crate) fn instead(&self) -> Option<&State> {
        match &self.phase {
            Phase::With { instead, .. } => Some(instead),
            _ => None,
        }
    }

    /// What is still to be tried; nothing once all is settled.
    pub(crate) fn untried(&self) -> Vec<TermSet> {
        if self.hold_back() { self.candidates.iter().copied().collect() } else { Vec::new() }
    }

    /// Takes over what a checkpoint holds.
    pub(crate) fn restore(&mut self, untried: Vec<TermSet>, ended: Vec<Trial>) {
        self.phase = if untried.is_empty() { Phase::Settled } else { Phase::Waiting };
        self.candidates = untried.into();
        self.ended = ended;
    }

    /// Forgets a keyframe.
    pub(crate) fn remove(&mut self, gone: impl Fn(&Keyframe) -> bool) {
        self.held_back.retain(|keyframe| !gone(keyframe));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn poses() -> TermSet {
        TermSet { image_poses: true, ..TermSet::default() }
    }

    #[test]
    fn a_gain_counts_when_it_is_larger_than_its_scatter() {
        let trial = |with: &[f64]| Trial::of(poses(), &[20.0, 22.0, 24.0, 21.0], with);
        assert!(trial(&[20.5, 22.4, 24.6, 21.5]).kept);
        assert!(!trial(&[20.03, 22.04, 24.02, 21.03]).kept, "too small, if sure");
        assert!(!trial(&[23.0, 20.5, 25.5, 19.5]).kept, "large, but not sure");
        assert!(!trial(&[19.0, 21.0, 23.0, 20.0]).kept);
        assert!(!Trial::of(poses(), &[20.0], &[25.0]).kept, "one image shows no scatter");
        let gain = trial(&[20.5, 22.5, 24.5, 21.5]);
        assert!((gain.gain_db - 0.5).abs() < 1e-12 && gain.standard_error_db < 1e-12);
    }

    #[test]
    fn without_candidates_nothing_is_held_back() {
        let trials = Trials::new(&CameraChoice::default());
        assert!(!trials.hold_back());
        assert!(matches!(trials.due(10_000), Due::Nothing));
    }

    #[test]
    fn too_few_images_join_in_time() {
        let trials = Trials::new(&CameraChoice::Try(vec![poses()]));
        assert!(trials.hold_back());
        assert!(matches!(trials.due(TRIAL_START), Due::Nothing));
        assert!(matches!(trials.due(2 * TRIAL_START), Due::Join));
    }
}
