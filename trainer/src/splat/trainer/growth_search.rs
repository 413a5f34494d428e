//! Runs the cross-validation that limits the number of splats if there are few images.

use super::SplatTrainer;
use super::renderer::DrawnView;
use super::scoring::corrected_camera;
use super::{products, view_set};
use crate::eval::depth_rmse_m;
use crate::packing::Output;
use crate::splat::buffers::SplatBuffers;
use crate::splat::growth_search::{
    FEW_IMAGES, FoldModels, FoldPhase, GrowthLimit, GrowthSearch, HeldOutScore, doubling_trial,
    folds, n_folds, n_steps_of_first_round,
};
use crate::splat::kernels::TrainPipelines;
use crate::splat::schedule::Schedule;
use crate::splat::snapshot::{ObservedScene, Snapshot};
use crate::splat::trials::ImageId;
use crate::splat::views::Level;
use crate::view::depth_in_color_view;
use crate::{Error, Method};
use calibration::{CameraCorrection, Candidate, MIN_VALIDATION_IMAGES};
use messages::Setting;
use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

/// What the scores of all views of a fold have in common.
struct ScoringContext {
    learn: Arc<TrainPipelines>,
    corrections: BTreeMap<String, CameraCorrection>,
    background_srgb: [f32; 3],
}

impl SplatTrainer {
    /// Adapts the search to a change of the images, unless a trial is running, whose halves must be
    /// trained alike.
    pub(super) fn update_growth_search(&mut self) {
        if self.trials.running_trial().is_none() {
            self.trials.restart_growth(self.n_images());
            self.growth_search
                .postpone(self.schedule.step, &self.trials.steps);
            self.growth_search.set_n_images(self.n_images());
        }
    }

    /// Number of training and validation images. During a trial, validation images that arrive do
    /// not count, because both halves must have the same number at each step.
    pub(super) fn n_images(&self) -> usize {
        let n_validation = match self.trials.running_trial() {
            Some(trial) => trial.scored.len(),
            None => self.trials.validation.len(),
        };
        self.views.len() + n_validation
    }

    /// Whether the search must start or a phase of it has ended.
    pub(super) fn is_growth_search_due(&self) -> bool {
        match &self.growth_search {
            GrowthSearch::Running(models) => self.schedule.step >= models.until,
            GrowthSearch::Waiting { not_before } => {
                // Two images are the minimum for two folds. A mature model, and one at the limit,
                // cannot grow anyway.
                self.schedule.step >= self.trials.steps.search.max(*not_before)
                    && self.views.len() >= 2
                    && !self.schedule.is_mature()
                    && self.trials.running_trial().is_none()
                    && self.model.splats.n_splats < self.options.cap()
                    && (2..FEW_IMAGES).contains(&self.n_images())
            }
            GrowthSearch::Off | GrowthSearch::Finished(_) => false,
        }
    }

    /// Starts the search or its next phase. If GPU memory is insufficient, the search ends without
    /// a limit.
    pub(super) fn advance_growth_search(&mut self) -> Result<(), Error> {
        let advanced = match self.growth_search.running().map(|models| models.phase) {
            None => self.begin_growth_search(),
            Some(FoldPhase::WarmUp) => self.begin_fold_baseline(),
            Some(FoldPhase::Baseline) => self.begin_fold_variant(),
            Some(FoldPhase::Variant) => self.end_fold_variant(),
        };
        // The search holds several models at once, so memory can be too small for it even if it
        // suffices for training.
        match advanced {
            Err(error) if error.is_out_of_memory() => {
                log::warn!(
                    "cross-validation stopped, so the number of splats is limited only by {}: {error}",
                    Setting::MaxSplats
                );
                self.abort_growth_search()?;
                self.growth_search = GrowthSearch::Off;
                Ok(())
            }
            other => other,
        }
    }

    /// See [`Method::n_steps_for_size_search`].
    pub(super) fn n_steps_for_growth_search(&self) -> u64 {
        let step = self.schedule.step;
        match self.growth_search.running() {
            // After the search, training on all images must continue for as many steps as the
            // search has taken. Otherwise, the time is better spent on training.
            Some(models) => {
                let (n_left, n_total) = models.n_steps(step, &self.trials.steps);
                n_left + n_total
            }
            // Twice: once for the search, and once for the training after it.
            None if self.is_growth_search_due() => {
                2 * n_steps_of_first_round(step, n_folds(self.n_images()), &self.trials.steps)
            }
            None => 0,
        }
    }

    /// Ends a search that is due or running. Growth ends at the last accepted number of splats, or
    /// at the current one.
    pub(super) fn end_growth_search(&mut self) -> Result<bool, Error> {
        self.finish_in_flight()?; // A failed submit may reduce the step count.
        // Accepted rounds of an unfinished search remain valid.
        let n_splats = if let Some(models) = self.growth_search.running_mut() {
            self.trials.finished.append(&mut models.trials);
            models.n_splats
        } else if self.is_growth_search_due() {
            self.model.splats.n_splats
        } else {
            return Ok(false);
        };
        log::info!(
            "too little training time is left to test more splats; their number is limited to {n_splats}"
        );
        self.abort_growth_search()?;
        self.growth_search = GrowthSearch::Finished(GrowthLimit {
            n_splats,
            n_images: self.n_images(),
        });
        Ok(true)
    }

    /// Restores the model that is trained on all images, if a search is running. The search is
    /// repeated.
    pub(super) fn abort_growth_search(&mut self) -> Result<(), Error> {
        let Some(models) = self.growth_search.abort() else {
            return Ok(());
        };
        self.views.hold_out(&[]);
        // The memory limit that a doubled model reached does not apply to the smaller main model.
        self.model.set_full(models.is_main_full);
        self.restore_snapshot(models.main)
    }

    fn begin_growth_search(&mut self) -> Result<(), Error> {
        if self.trials.validation.len() < MIN_VALIDATION_IMAGES && self.trials.holds_validation() {
            self.release_validation()?; // Too few for trials, but useful for training.
        }
        let folds = folds(
            self.views
                .keyframes()
                .map(|keyframe| (keyframe.camera.clone(), keyframe.stamp))
                .collect(),
        );
        // The main model is moved out, not copied: it is not trained during the search.
        let n_splats = self.model.splats.n_splats;
        let until = self.schedule.step;
        let main = self.take_state()?;
        self.growth_search = GrowthSearch::Running(Box::new(FoldModels {
            main,
            folds,
            fold_ix: 0,
            phase: FoldPhase::WarmUp,
            until,
            n_splats,
            is_main_full: self.model.is_full(),
            fork: None,
            previous: VecDeque::new(),
            doubled: VecDeque::new(),
            baseline: Vec::new(),
            variant: Vec::new(),
            trials: Vec::new(),
        }));
        self.begin_fold()
    }

    /// Starts the model of the current fold, or continues the model of the previous round.
    fn begin_fold(&mut self) -> Result<(), Error> {
        let Some(models) = self.growth_search.running_mut() else {
            return Ok(());
        };
        self.views.hold_out(&models.folds[models.fold_ix]);
        // After an accepted round, its doubled models are the baselines of the next one.
        if let Some(previous) = models.previous.pop_front() {
            self.restore_snapshot(previous)?;
            return self.begin_fold_baseline();
        }
        // As many steps as the main model, so that the comparison is made at the same stage of
        // training.
        models.phase = FoldPhase::WarmUp;
        models.until = models
            .main
            .schedule
            .step
            .min(self.trials.steps.max_warm_up());
        // Camera parameters are kept, although they were estimated with the images of the fold:
        // scores would otherwise measure errors of the poses.
        let (set, params) = &models.main.cameras;
        let gpu = &self.recorder.gpu;
        let copy = gpu.storage("splat.camera_params", params.bytes())?;
        gpu.copy((params, 0), (&copy, 0), params.bytes());
        // Splats and seeds start anew, because those of the main model were fitted to the images of
        // the fold.
        let untrained = Snapshot {
            splats: SplatBuffers::new(gpu, 1, models.main.splats.sh_degree)?,
            cameras: (*set, copy),
            schedule: Schedule::new(self.schedule.n_planned_steps),
            scene: ObservedScene::default(),
        };
        self.restore_snapshot(untrained)?;
        self.views
            .active_keyframes()
            .cloned()
            .for_each(|keyframe| self.seeding.push(keyframe));
        self.prepare_training()
    }

    /// Trains the model of the current fold with the same number of splats.
    fn begin_fold_baseline(&mut self) -> Result<(), Error> {
        let fork = self.snapshot()?;
        let step = self.schedule.step;
        if let Some(models) = self.growth_search.running_mut() {
            models.fork = Some(fork);
            models.phase = FoldPhase::Baseline;
            models.until = step + self.trials.steps.comparison;
        }
        Ok(())
    }

    /// Scores the model of the current fold, and trains it with twice the number of splats.
    fn begin_fold_variant(&mut self) -> Result<(), Error> {
        let scores = self.score_held_out()?;
        let Some(models) = self.growth_search.running_mut() else {
            return Ok(());
        };
        models.baseline.extend(scores);
        // `until` stays: restoring the fork sets the step back to the start of the comparison.
        models.phase = FoldPhase::Variant;
        if let Some(fork) = models.fork.take() {
            self.restore_snapshot(fork)?;
        }
        self.grow_to(
            self.model
                .splats
                .n_splats
                .saturating_mul(2)
                .min(self.options.cap()),
        )
    }

    /// Scores the model with twice the number of splats. Continues with the next fold, or decides.
    fn end_fold_variant(&mut self) -> Result<(), Error> {
        let scores = self.score_held_out()?;
        let state = self.take_state()?;
        let Some(models) = self.growth_search.running_mut() else {
            return Ok(());
        };
        models.variant.extend(scores);
        models.doubled.push_back(state);
        models.fold_ix += 1;
        if models.fold_ix < models.folds.len() {
            return self.begin_fold();
        }
        // All folds are scored. The candidate names the splats of the main model. The models of
        // folds have other numbers, but are doubled as well.
        let cap = self.options.cap();
        let to = models.n_splats.saturating_mul(2).min(cap);
        let candidate = Candidate::Doubled {
            from: models.n_splats,
            to,
        };
        let trial = doubling_trial(candidate, &models.baseline, &models.variant);
        trial.log_result();
        if trial.kept {
            models.n_splats = to;
        }
        let continues = trial.kept && to < cap;
        models.trials.push(trial);
        if continues {
            models.fold_ix = 0;
            models.previous = std::mem::take(&mut models.doubled);
            models.baseline.clear();
            models.variant.clear();
            return self.begin_fold();
        }
        self.trials.finished.append(&mut models.trials);
        let limit = GrowthLimit {
            n_splats: models.n_splats,
            n_images: self.n_images(),
        };
        self.abort_growth_search()?;
        self.growth_search = GrowthSearch::Finished(limit);
        Ok(())
    }

    /// Moves the current state out. It must be replaced before training continues.
    fn take_state(&mut self) -> Result<Snapshot, Error> {
        self.recorder.passes.clear_bindings();
        let gpu = &self.recorder.gpu;
        let empty = SplatBuffers::new(gpu, 1, self.model.splats.sh_degree)?;
        let cameras = (self.model.cameras.set, self.model.cameras.copy(gpu)?);
        Ok(Snapshot {
            splats: std::mem::replace(&mut self.model.splats, empty),
            cameras,
            schedule: self.schedule,
            scene: self.seeding.scene.clone(),
        })
    }

    /// Scores the images of the current fold.
    fn score_held_out(&mut self) -> Result<Vec<HeldOutScore>, Error> {
        let held_out: Vec<ImageId> = self
            .growth_search
            .running()
            .map(|models| models.folds[models.fold_ix].clone())
            .unwrap_or_default();
        let view_ixs: Vec<usize> = held_out
            .iter()
            .filter_map(|image| self.views.position(image))
            .collect();
        let context = ScoringContext {
            learn: self.learn()?,
            corrections: self.learned_corrections()?,
            background_srgb: self.background_srgb(),
        };
        let mut scores = Vec::new();
        for chunk in view_ixs.chunks(view_set::VIEWS_AT_ONCE) {
            let places = chunk.iter().map(|view_ix| (*view_ix, 0)).collect();
            self.views
                .upload(&mut self.recorder, &places, self.schedule.step)?;
            for view_ix in chunk {
                scores.push(self.score_view(*view_ix, &context)?);
            }
        }
        Ok(scores)
    }

    /// Scores one view, whose image must be uploaded at full resolution.
    fn score_view(
        &mut self,
        view_ix: usize,
        context: &ScoringContext,
    ) -> Result<HeldOutScore, Error> {
        let keyframe = self.views.keyframe(view_ix).clone();
        let camera = corrected_camera(&context.corrections, &keyframe);
        let (_, Level { image, .. }) = self.views.ready_level((view_ix, 0))?;
        let drawn = DrawnView {
            splats: &self.model.splats,
            camera: &camera,
            background_srgb: context.background_srgb,
        };
        let products =
            self.renderer
                .compare(&mut self.recorder, drawn, &context.learn.score, image)?;
        let measured_m = depth_in_color_view(&keyframe);
        let depth_rmse_m = if measured_m.is_empty() {
            None
        } else {
            let picture =
                self.renderer
                    .picture(&mut self.recorder, drawn, Output::picture(true))?;
            let picture = picture
                .ok_or_else(|| Error::internal("a picture was not read back"))?
                .into_picture()?;
            depth_rmse_m(&picture.depth_m, &measured_m)?
        };
        Ok(HeldOutScore {
            psnr_db: products::psnr_with_gains(&products, [1.0; 3]),
            depth_rmse_m,
        })
    }

    /// The state to display: during a search or trial, the model without the tested change.
    pub(super) fn displayed_state(&self) -> Option<&Snapshot> {
        self.growth_search
            .running()
            .map(|models| &models.main)
            .or_else(|| self.trials.baseline())
    }

    /// Training step of the model to display.
    pub(super) fn displayed_step(&self) -> u64 {
        self.growth_search
            .running()
            .map_or(self.schedule.step, |models| models.main.schedule.step)
    }

    #[cfg(test)]
    pub(in crate::splat) fn growth_limit(&self) -> Option<u32> {
        (self.growth_search.limit() < u32::MAX).then(|| self.growth_search.limit())
    }

    #[cfg(test)]
    pub(in crate::splat) fn n_active_views(&self) -> usize {
        self.views.n_active()
    }

    #[cfg(test)]
    pub(in crate::splat) fn n_finished_rounds(&self) -> Option<usize> {
        self.growth_search
            .running()
            .map(|models| models.trials.len())
    }

    #[cfg(test)]
    pub(in crate::splat) fn is_growth_search_running(&self) -> bool {
        self.growth_search.running().is_some()
    }
}
