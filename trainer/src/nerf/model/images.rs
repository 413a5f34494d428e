//! What is learned about images with the field: their poses and their codes (light and exposure), whether that pays, and what it says
//! about images that were not learned from.
//!
//! From a fixed step on one after the other is tried, unless it is plain that it brings nothing: the field goes on for some steps with it,
//! is put back, and goes on for as many without. It stays where it foretells images that were held back until then, each from what is
//! known of those before and after it in time.

use super::NerfModel;
use crate::checkpoint::Array;
use crate::gain::{Gain, LEAST_GAIN_DB};
use crate::nerf::extent::Extent;
use crate::nerf::learner::Look;
use crate::nerf::params::{CODE, TERM_STRIDE};
use crate::nerf::rays::{self, Draw, RayImage};
use crate::splat::{CameraChoice, CameraFix, N_CODE, TermSet, between, drift_share};
use crate::{Error, Keyframe, Part};
use kinematics::{Stamp, Transform};
use nalgebra::{Translation3, UnitQuaternion, Vector3};
use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

/// The step from which anything is learned about images (before, nothing is known to look for), the one at which trials begin, and the
/// steps that each takes with and without: one of so many of the planned steps.
const FROM_SHARE: u64 = 32;
const TRIAL_AT_SHARE: u64 = 8;
const TRIAL_SHARE: u64 = 16;
/// The fewest images held back that can decide.
const LEAST_JUDGES: usize = 4;
/// Batches of rays that judge: some hundred rays an image.
const JUDGING_BATCHES: u64 = 8;
/// Seed of what they look at.
const JUDGING_SEED: u64 = 0x6a75_6467;

/// The field at some step, in host memory.
#[derive(Debug)]
pub(super) struct Saved {
    pub(super) arrays: Vec<Array>,
    pub(super) step: u64,
    /// Number of images whose hints the field has.
    pub(super) n_hinted: usize,
    pub(super) learned: TermSet,
}

/// What may be worth learning of images.
#[derive(Debug, Default)]
pub(super) struct Trials {
    /// In the order in which they are tried; the first is on trial unless trials wait.
    left: VecDeque<TermSet>,
    pub(super) ended: Vec<Part>,
    phase: Phase,
}

#[derive(Debug, Default)]
enum Phase {
    /// The next one begins at its step.
    #[default]
    Waiting,
    With {
        before: Saved,
    },
    Without {
        before: Saved,
        with: Saved,
        /// Mean squared error of each image held back, with it.
        errors_with: Vec<f64>,
    },
}

/// Of all terms those that a field learns.
fn of_images(set: TermSet) -> TermSet {
    TermSet { image_poses: set.image_poses, image_gains: set.image_gains, ..TermSet::NONE }
}

/// What is learned without a trial.
pub(super) fn given(choice: &CameraChoice) -> TermSet {
    match choice {
        CameraChoice::Given(set) => of_images(*set),
        CameraChoice::Try(_) => TermSet::NONE,
    }
}

impl Trials {
    pub(super) fn of(choice: &CameraChoice) -> Self {
        let left = match choice {
            CameraChoice::Try(candidates) => {
                candidates.iter().map(|set| of_images(*set)).filter(|set| set.any()).collect()
            }
            CameraChoice::Given(_) => VecDeque::new(),
        };
        Self { left, ended: Vec::new(), phase: Phase::Waiting }
    }

    /// Those left after some have ended.
    #[must_use]
    pub(super) fn after(mut self, ended: Vec<Part>, are_over: bool) -> Self {
        self.left.drain(..if are_over { self.left.len() } else { ended.len().min(self.left.len()) });
        Self { ended, ..self }
    }

    pub(super) fn are_over(&self) -> bool {
        self.left.is_empty()
    }

    /// In the midst of a trial the field from before it.
    pub(super) fn before(&self) -> Option<&Saved> {
        match &self.phase {
            Phase::Waiting => None,
            Phase::With { before } | Phase::Without { before, .. } => Some(before),
        }
    }
}

impl NerfModel {
    /// What the next step learns of images.
    pub(super) fn learned_now(&self) -> TermSet {
        if self.step >= self.options.n_planned_steps / FROM_SHARE { self.learned } else { TermSet::NONE }
    }

    /// The step at which trials have something to do.
    fn due_at(&self) -> Option<u64> {
        let share = |of: u64| (self.options.n_planned_steps / of).max(1);
        let at = match &self.trials.phase {
            Phase::Waiting => share(TRIAL_AT_SHARE),
            Phase::With { before } | Phase::Without { before, .. } => before.step + share(TRIAL_SHARE),
        };
        (!self.trials.are_over()).then_some(at)
    }

    /// Steps until trials have something to do.
    pub(super) fn steps_to_trial(&self) -> u64 {
        self.due_at().map_or(u64::MAX, |at| at.saturating_sub(self.step).max(1))
    }

    /// Begins a trial, puts the field back, or decides.
    pub(super) fn try_when_due(&mut self) -> Result<(), Error> {
        while self.due_at().is_some_and(|at| self.step >= at) {
            self.settle()?;
            self.turn()?;
        }
        Ok(())
    }

    fn turn(&mut self) -> Result<(), Error> {
        let Some(candidate) = self.trials.left.front().copied() else { return Ok(()) };
        match std::mem::take(&mut self.trials.phase) {
            Phase::Waiting if self.held_back.len() < LEAST_JUDGES => {
                log::info!("{candidate}: {} images held back are too few to judge by", self.held_back.len());
                self.end_trials();
            }
            Phase::Waiting => match self.speaks_against(candidate)? {
                Some(part) => self.end_trial(part),
                None => {
                    let before = self.saved()?;
                    self.learned = self.learned.and(candidate);
                    self.trials.phase = Phase::With { before };
                }
            },
            Phase::With { before } => {
                let errors_with = self.judge()?;
                let with = self.saved()?;
                self.n_taken_back += self.step - before.step;
                self.put_back(&before)?;
                self.trials.phase = Phase::Without { before, with, errors_with };
            }
            Phase::Without { before, with, errors_with } => {
                let errors_without = self.judge()?;
                let part = bought(candidate, &errors_with, &errors_without);
                if part.kept {
                    self.n_taken_back += self.step - before.step;
                    self.put_back(&with)?;
                }
                self.end_trial(part);
            }
        }
        Ok(())
    }

    fn end_trial(&mut self, part: Part) {
        log::info!(
            "{}: {:+.2} dB on {} held-back images (standard error {:.2}): {}",
            part.part,
            part.bought_db,
            part.n_images,
            part.standard_error_db,
            if part.kept { "learned from here on" } else { "does not pay" },
        );
        self.trials.ended.push(part);
        self.trials.left.pop_front();
        if self.trials.are_over() {
            self.end_trials();
        }
    }

    /// A field that begins anew in the midst of a trial, or loses an image, has nothing to compare with what was saved.
    pub(super) fn give_up_trials(&mut self) -> Result<(), Error> {
        let Some(before) = self.trials.before() else { return Ok(()) };
        self.learned = before.learned;
        if let Some((_, learner)) = &mut self.field {
            learner.forget_terms_but(&self.gpu, self.learned)?;
        }
        self.end_trials();
        Ok(())
    }

    /// What was held back is learned from.
    fn end_trials(&mut self) {
        self.trials.left.clear();
        self.trials.phase = Phase::Waiting;
        self.images.append(&mut self.held_back);
        self.is_extent_due = true;
    }

    /// What a candidate would buy, where that can be told without learning it and is nothing: other light, where pictures multiplied by
    /// what the images before and after them ask for come no nearer to images held back.
    fn speaks_against(&mut self, candidate: TermSet) -> Result<Option<Part>, Error> {
        if !candidate.image_gains {
            return Ok(None);
        }
        let (learned_from, held_back) = (self.images.clone(), self.held_back.clone());
        let own = self.compare(&learned_from, &[])?;
        let log_gains: Vec<f64> = own.iter().map(Comparison::log_gain).collect();
        // What all images ask for is the brightness of the field.
        let mean = log_gains.iter().sum::<f64>() / log_gains.len().max(1) as f64;
        let mut known: BTreeMap<&str, BTreeMap<i64, [f64; 1]>> = BTreeMap::new();
        for (image, log_gain) in learned_from.iter().zip(log_gains) {
            let of_camera = known.entry(&image.keyframe.camera).or_default();
            of_camera.insert(image.keyframe.stamp.0, [log_gain - mean]);
        }
        let foretold = |image: &RayImage| between(known.get(image.keyframe.camera.as_ref())?, image.keyframe.stamp);
        let compared = self.compare(&held_back, &[])?;
        let with = held_back.iter().zip(&compared).map(|(image, own)| {
            let [log_gain] = foretold(image).unwrap_or_default();
            own.error_with(log_gain.exp())
        });
        let without = compared.iter().map(|own| own.error_with(1.0));
        let part = bought(candidate, &with.collect::<Vec<_>>(), &without.collect::<Vec<_>>());
        log::info!(
            "{}: multiplying pictures would bring {:+.2} dB on {} held-back images (standard error {:.2})",
            part.part,
            part.bought_db,
            part.n_images,
            part.standard_error_db
        );
        Ok((!part.kept).then_some(part))
    }

    /// Mean squared error of color of each image held back, from where and in what light those before and after it say it was taken.
    fn judge(&mut self) -> Result<Vec<f64>, Error> {
        let fixes = self.learned_fixes()?;
        let fix_of = |image: &RayImage| fixes.get(image.keyframe.camera.as_ref());
        let moved = |image: &RayImage| match fix_of(image) {
            Some(fix) => RayImage::new(fix.corrected(&image.keyframe).into()),
            None => image.clone(),
        };
        let code = |image: &RayImage| between(&fix_of(image)?.codes, image.keyframe.stamp);
        let images: Vec<RayImage> = self.held_back.iter().map(moved).collect();
        let codes: Vec<_> = self.held_back.iter().map(|image| code(image).unwrap_or_default()).collect();
        let compared = self.compare(&images, &codes)?;
        Ok(compared.iter().map(|own| own.error / f64::max(own.n_rays, 1.0)).collect())
    }

    /// What the field shows of images with these codes (none where there are none), beside what they show.
    fn compare(&mut self, images: &[RayImage], codes: &[[f64; N_CODE]]) -> Result<Vec<Comparison>, Error> {
        let mut sums = vec![Comparison::default(); images.len()];
        let Some((extent, learner)) = &mut self.field else { return Ok(sums) };
        for batch in 0..JUDGING_BATCHES {
            let n_rays = learner.sizes.effort.n_rays;
            let draw = Draw { seed: JUDGING_SEED, step: batch, n_rays, begin: super::BEGIN };
            let rays = rays::draw(images, extent, &draw);
            for (ray, look) in rays.iter().zip(learner.look(&self.gpu, &self.options, &rays, codes)?) {
                let [rgb @ .., alpha] = ray.target_rgb.to_le_bytes();
                if alpha > 0 && look.error.is_finite() {
                    sums[ray.code as usize].add(&look, rgb.map(|value| f64::from(value) / 255.0));
                }
            }
        }
        Ok(sums)
    }

    /// What was learned about each camera; empty where nothing is. What was sent must be done.
    pub(super) fn learned_fixes(&self) -> Result<BTreeMap<String, CameraFix>, Error> {
        let Some((extent, learner)) = &self.field else { return Ok(BTreeMap::new()) };
        let terms = learner.image_terms(&self.gpu, self.images.len())?;
        let mut fixes: BTreeMap<String, CameraFix> = BTreeMap::new();
        // Nothing is known yet of images that the field was not told of.
        for (image, terms) in self.images.iter().zip(&terms).take(self.n_hinted) {
            let fix = fixes.entry(image.keyframe.camera.to_string()).or_default();
            if self.learned.image_poses {
                fix.drift.insert(image.keyframe.stamp.0, drift_of(&image.keyframe, terms, extent));
            }
            if self.learned.image_gains {
                fix.codes.insert(image.keyframe.stamp.0, std::array::from_fn(|ix| terms[CODE + ix]));
            }
        }
        for fix in fixes.values_mut().filter(|_| self.learned.image_poses) {
            fix.drift_share = drift_share(&fix.drift, extent.radius_m);
        }
        Ok(fixes)
    }

    /// New images begin with the codes of those before and after them.
    pub(super) fn begin_codes(&mut self) -> Result<(), Error> {
        if !self.learned.image_gains || self.n_hinted == self.images.len() {
            return Ok(());
        }
        self.settle()?;
        let fixes = self.learned_fixes()?;
        let learned = self.learned_now();
        let Some((_, learner)) = &mut self.field else { return Ok(()) };
        let foretold =
            |image: &RayImage| between(&fixes.get(image.keyframe.camera.as_ref())?.codes, image.keyframe.stamp);
        let codes: Vec<_> =
            self.images[self.n_hinted..].iter().map(|image| foretold(image).unwrap_or_default()).collect();
        if learner.images.is_some() {
            learner.hold_images(&self.gpu, self.images.len(), learned)?;
            learner.begin_images(&self.gpu, self.n_hinted, &codes);
        }
        Ok(())
    }

    /// The code of an image of a camera at some time, from those before and after it; else the mean of all.
    pub(super) fn code_of(&mut self, image: Option<&(Arc<str>, Stamp)>) -> Result<[f64; N_CODE], Error> {
        let fixes = self.camera_fixes()?;
        let of_image = image.and_then(|(camera, stamp)| between(&fixes.get(camera.as_ref())?.codes, *stamp));
        let all = || fixes.values().flat_map(|fix| fix.codes.values());
        let n = all().count().max(1) as f64;
        Ok(of_image.unwrap_or_else(|| std::array::from_fn(|ix| all().map(|code| code[ix]).sum::<f64>() / n)))
    }
}

/// Turn and shift after `camera_from_world`, in the camera's axes, of those that a field has: about the camera and in world.
fn drift_of(keyframe: &Keyframe, [a, b, c, x, y, z, ..]: &[f64; TERM_STRIDE], extent: &Extent) -> [f64; 6] {
    let given = &keyframe.world_from_camera;
    let turn = UnitQuaternion::from_scaled_axis(Vector3::new(*a, *b, *c));
    let shift_m = Vector3::new(*x, *y, *z) * extent.radius_m;
    let found = Transform::from_parts(Translation3::from(given.translation.vector + shift_m), turn * given.rotation);
    let drift = found.inverse() * given;
    let (turn_rad, shift_m) = (drift.rotation.scaled_axis(), drift.translation.vector);
    [turn_rad.x, turn_rad.y, turn_rad.z, shift_m.x, shift_m.y, shift_m.z]
}

/// Sums over the rays of an image, and over colors where pictures (seen) and images (shown) are multiplied.
#[derive(Clone, Copy, Debug, Default)]
struct Comparison {
    error: f64,
    n_rays: f64,
    seen_seen: f64,
    seen_shown: f64,
    shown_shown: f64,
}

impl Comparison {
    fn add(&mut self, look: &Look, shown: [f64; 3]) {
        self.error += look.error;
        self.n_rays += 1.0;
        for (seen, shown) in look.rgb.into_iter().zip(shown) {
            self.seen_seen += seen * seen;
            self.seen_shown += seen * shown;
            self.shown_shown += shown * shown;
        }
    }

    /// Logarithm of the gain that brings the picture nearest to the image.
    fn log_gain(&self) -> f64 {
        let gain = self.seen_shown / self.seen_seen;
        if gain > 0.0 && gain.is_finite() { gain.ln() } else { 0.0 }
    }

    /// Sum of squared differences where the picture is multiplied.
    fn error_with(&self, gain: f64) -> f64 {
        gain * gain * self.seen_seen - 2.0 * gain * self.seen_shown + self.shown_shown
    }
}

/// What something learned of images bought, from the mean squared errors of the same images with and without.
fn bought(candidate: TermSet, with: &[f64], without: &[f64]) -> Part {
    let gains: Vec<f64> = with
        .iter()
        .zip(without)
        .filter(|(with, without)| **with > 0.0 && **without > 0.0)
        .map(|(with, without)| 10.0 * (without / with).log10())
        .collect();
    let gain = Gain::of(&gains);
    Part {
        part: candidate.to_string(),
        bought_db: gain.mean_db,
        standard_error_db: gain.standard_error_db,
        n_images: gain.n_images,
        kept: gain.n_images >= LEAST_JUDGES && gain.pays(LEAST_GAIN_DB),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_scenes as scenes;

    const POSES: TermSet = TermSet { image_poses: true, ..TermSet::NONE };

    #[test]
    fn the_drift_of_an_image_moves_its_camera_as_the_field_does() {
        let keyframe = scenes::ring(&[scenes::floor()], nalgebra::Point3::origin(), 3)[1].clone();
        let extent = Extent { center_m: [0.1, 0.2, 0.3], radius_m: 2.5 };
        let pose = [0.02, -0.03, 0.01, 0.004, -0.002, 0.006, 0.5, 0.0, 0.0];
        let drift = BTreeMap::from([(keyframe.stamp.0, drift_of(&keyframe, &pose, &extent))]);
        let lens = CameraFix { drift, ..CameraFix::default() }.apply(&keyframe);
        let given = &keyframe.world_from_camera;
        let turn = UnitQuaternion::from_scaled_axis(Vector3::new(0.02, -0.03, 0.01));
        let at: Vector3<f64> = given.translation.vector + 2.5 * Vector3::new(0.004, -0.002, 0.006);
        assert!((lens.world_from_camera.translation.vector - at).norm() < 1e-12);
        assert!(lens.world_from_camera.rotation.angle_to(&(turn * given.rotation)) < 1e-12);
    }

    #[test]
    fn only_what_pays_beyond_chance_is_kept() {
        let without = [1e-3; 6];
        assert!(bought(POSES, &without.map(|error| 0.8 * error), &without).kept);
        assert!(!bought(POSES, &without, &without).kept);
        assert!(!bought(POSES, &without.map(|error| 0.999 * error), &without).kept, "less than is worth having");
        let mixed = [0.5e-3, 2e-3, 0.5e-3, 2e-3, 0.5e-3, 1.2e-3];
        assert!(!bought(POSES, &mixed, &without).kept, "chance");
        assert!(!bought(POSES, &[0.5e-3; 3], &[1e-3; 3]).kept, "too few");
    }
}
