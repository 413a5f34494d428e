//! Poses of images, learned with the field: whether that pays, and where images were after all.
//!
//! At a fixed step the field goes on for some steps with them, is put back, and goes on for as many without. They stay where they
//! foretell images that were held back until then, each from the corrections of those before and after it in time.

use super::NerfModel;
use crate::checkpoint::Array;
use crate::nerf::extent::Extent;
use crate::nerf::rays::{self, Draw, RayImage};
use crate::splat::{CameraChoice, CameraFix, drift_share};
use crate::{Error, Keyframe, Part};
use kinematics::Transform;
use nalgebra::{Translation3, UnitQuaternion, Vector3};
use std::collections::BTreeMap;

/// The step from which poses are learned (before, nothing is known to look for), the one at which a trial begins, and the steps that
/// it takes with and without: one of so many of the planned steps.
const FROM_SHARE: u64 = 32;
const TRIAL_AT_SHARE: u64 = 8;
const TRIAL_SHARE: u64 = 16;
/// The fewest images held back that can decide.
const LEAST_JUDGES: usize = 4;
/// Batches of rays that judge: some hundred rays an image.
const JUDGING_BATCHES: u64 = 8;
/// Seed of what they look at.
const JUDGING_SEED: u64 = 0x6a75_6467;
/// Less is not worth having, dB; nor is what two standard errors leave open.
const LEAST_GAIN_DB: f64 = 0.05;
const SURE: f64 = 2.0;

/// The field at some step, in host memory.
#[derive(Debug)]
pub(super) struct Saved {
    pub(super) arrays: Vec<Array>,
    pub(super) step: u64,
}

/// Whether poses of images are worth learning.
#[derive(Debug, Default)]
pub(super) enum Trial {
    /// Nobody asked, or it is decided.
    #[default]
    Over,
    /// It begins at its step.
    Waiting,
    With {
        before: Saved,
    },
    Without {
        before: Saved,
        with: Saved,
        /// Mean squared error of each image held back, with poses learned.
        errors_with: Vec<f64>,
    },
}

impl Trial {
    pub(super) fn of(choice: &CameraChoice) -> Self {
        match choice {
            CameraChoice::Try(candidates) if candidates.iter().any(|set| set.image_poses) => Self::Waiting,
            CameraChoice::Try(_) | CameraChoice::Given(_) => Self::Over,
        }
    }

    pub(super) fn is_over(&self) -> bool {
        matches!(self, Self::Over)
    }
}

impl NerfModel {
    /// Whether the next step learns the poses of images.
    pub(super) fn moves_images(&self) -> bool {
        self.learns_poses && self.step >= self.options.n_planned_steps / FROM_SHARE
    }

    fn trial_at(&self) -> u64 {
        (self.options.n_planned_steps / TRIAL_AT_SHARE).max(1)
    }

    fn trial_end(&self) -> u64 {
        self.trial_at() + (self.options.n_planned_steps / TRIAL_SHARE).max(1)
    }

    /// Steps until a trial has something to do.
    pub(super) fn steps_to_trial(&self) -> u64 {
        match self.trial {
            Trial::Over => u64::MAX,
            Trial::Waiting => self.trial_at().saturating_sub(self.step).max(1),
            Trial::With { .. } | Trial::Without { .. } => self.trial_end().saturating_sub(self.step).max(1),
        }
    }

    /// Begins a trial, puts the field back, or decides.
    pub(super) fn try_when_due(&mut self) -> Result<(), Error> {
        let is_due = match self.trial {
            Trial::Over => false,
            Trial::Waiting => self.step >= self.trial_at(),
            Trial::With { .. } | Trial::Without { .. } => self.step >= self.trial_end(),
        };
        if !is_due {
            return Ok(());
        }
        self.settle()?;
        match std::mem::take(&mut self.trial) {
            Trial::Over => {}
            Trial::Waiting if self.held_back.len() < LEAST_JUDGES => {
                log::info!("poses of images: {} images held back are too few to judge by", self.held_back.len());
                self.join_held_back();
            }
            Trial::Waiting => {
                let before = self.saved()?;
                self.learns_poses = true;
                self.trial = Trial::With { before };
            }
            Trial::With { before } => {
                let errors_with = self.judge()?;
                let with = self.saved()?;
                self.n_taken_back += self.step - before.step;
                self.put_back(&before)?;
                self.learns_poses = false;
                self.trial = Trial::Without { before, with, errors_with };
            }
            Trial::Without { before, with, errors_with } => {
                let errors_without = self.judge()?;
                let part = bought(&errors_with, &errors_without);
                log::info!(
                    "poses of images: {:+.2} dB on {} held-back images (standard error {:.2}): {}",
                    part.bought_db,
                    part.n_images,
                    part.standard_error_db,
                    if part.kept { "learned from here on" } else { "does not pay" },
                );
                if part.kept {
                    self.n_taken_back += self.step - before.step;
                    self.learns_poses = true;
                    self.put_back(&with)?;
                }
                self.part = Some(part);
                self.join_held_back();
            }
        }
        Ok(())
    }

    /// A field that begins anew in the midst of a trial, or loses an image, has nothing to compare with what was saved.
    pub(super) fn give_up_trial(&mut self) {
        if matches!(self.trial, Trial::With { .. } | Trial::Without { .. }) {
            self.trial = Trial::Over;
            self.learns_poses = false;
            if let Some((_, learner)) = &mut self.field {
                learner.forget_poses();
            }
            self.join_held_back();
        }
    }

    /// What was held back is learned from.
    fn join_held_back(&mut self) {
        self.images.append(&mut self.held_back);
        self.is_extent_due = true;
    }

    /// Mean squared error of color of each image held back, from where those before and after it say it was.
    fn judge(&mut self) -> Result<Vec<f64>, Error> {
        let fixes = self.learned_fixes()?;
        let moved = |image: &RayImage| match fixes.get(image.keyframe.camera.as_ref()) {
            Some(fix) => RayImage::new(fix.corrected(&image.keyframe).into()),
            None => image.clone(),
        };
        let images: Vec<RayImage> = self.held_back.iter().map(moved).collect();
        let Some((extent, learner)) = &mut self.field else { return Ok(Vec::new()) };
        let mut sums = vec![(0.0, 0.0); images.len()];
        for batch in 0..JUDGING_BATCHES {
            let n_rays = learner.sizes.effort.n_rays;
            let draw = Draw { seed: JUDGING_SEED, step: batch, n_rays, begin: super::BEGIN };
            let rays = rays::draw(&images, extent, &draw);
            for (ray, error) in rays.iter().zip(learner.errors(&self.gpu, &self.options, &rays)?) {
                let is_seen = ray.target_rgb >> 24 > 0;
                if is_seen && error.is_finite() {
                    let sum = &mut sums[ray.code as usize];
                    *sum = (sum.0 + f64::from(error), sum.1 + 1.0);
                }
            }
        }
        Ok(sums.into_iter().map(|(sum, n)| sum / f64::max(n, 1.0)).collect())
    }

    /// What was learned about each camera; empty where nothing is. What was sent must be done.
    pub(super) fn learned_fixes(&self) -> Result<BTreeMap<String, CameraFix>, Error> {
        let Some((extent, learner)) = &self.field else { return Ok(BTreeMap::new()) };
        let poses = learner.image_poses(&self.gpu, self.images.len())?;
        let mut fixes: BTreeMap<String, CameraFix> = BTreeMap::new();
        for (image, pose) in self.images.iter().zip(&poses) {
            let fix = fixes.entry(image.keyframe.camera.to_string()).or_default();
            fix.drift.insert(image.keyframe.stamp.0, drift_of(&image.keyframe, pose, extent));
        }
        for fix in fixes.values_mut() {
            fix.drift_share = drift_share(&fix.drift, extent.radius_m);
        }
        Ok(fixes)
    }
}

/// Turn and shift after `camera_from_world`, in the camera's axes, of those that a field has: about the camera and in world.
fn drift_of(keyframe: &Keyframe, [a, b, c, x, y, z]: &[f64; 6], extent: &Extent) -> [f64; 6] {
    let given = &keyframe.world_from_camera;
    let turn = UnitQuaternion::from_scaled_axis(Vector3::new(*a, *b, *c));
    let shift_m = Vector3::new(*x, *y, *z) * extent.radius_m;
    let found = Transform::from_parts(Translation3::from(given.translation.vector + shift_m), turn * given.rotation);
    let drift = found.inverse() * given;
    let (turn_rad, shift_m) = (drift.rotation.scaled_axis(), drift.translation.vector);
    [turn_rad.x, turn_rad.y, turn_rad.z, shift_m.x, shift_m.y, shift_m.z]
}

/// What poses of images bought, from the mean squared errors of the same images with and without.
fn bought(with: &[f64], without: &[f64]) -> Part {
    let gains: Vec<f64> = with
        .iter()
        .zip(without)
        .filter(|(with, without)| **with > 0.0 && **without > 0.0)
        .map(|(with, without)| 10.0 * (without / with).log10())
        .collect();
    let n = gains.len().max(1) as f64;
    let mean = gains.iter().sum::<f64>() / n;
    let variance = gains.iter().map(|gain| (gain - mean).powi(2)).sum::<f64>() / f64::max(n - 1.0, 1.0);
    let standard_error = (variance / n).sqrt();
    Part {
        part: "poses of images".to_owned(),
        bought_db: mean,
        standard_error_db: standard_error,
        n_images: gains.len(),
        kept: gains.len() >= LEAST_JUDGES && mean > f64::max(LEAST_GAIN_DB, SURE * standard_error),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_scenes as scenes;

    #[test]
    fn the_drift_of_an_image_moves_its_camera_as_the_field_does() {
        let keyframe = scenes::ring(&[scenes::floor()], nalgebra::Point3::origin(), 3)[1].clone();
        let extent = Extent { center_m: [0.1, 0.2, 0.3], radius_m: 2.5 };
        let pose = [0.02, -0.03, 0.01, 0.004, -0.002, 0.006];
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
        assert!(bought(&without.map(|error| 0.8 * error), &without).kept);
        assert!(!bought(&without, &without).kept);
        assert!(!bought(&without.map(|error| 0.999 * error), &without).kept, "less than is worth having");
        let mixed = [0.5e-3, 2e-3, 0.5e-3, 2e-3, 0.5e-3, 1.2e-3];
        assert!(!bought(&mixed, &without).kept, "chance");
        assert!(!bought(&[0.5e-3; 3], &[1e-3; 3]).kept, "too few");
    }
}
