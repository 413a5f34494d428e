//! Alignment of keyframes during training. If alignment finds corrections, training restarts from corrected
//! keyframes, because splats trained on wrong poses would have to be corrected, too.

use super::SplatTrainer;
use crate::Error;
use crate::splat::params::status;
use crate::splat::schedule::Schedule;
use calibration::{Alignment, ParamSet, alignment_step};
use keyframe::Keyframe;
use std::sync::Arc;

impl SplatTrainer {
    /// Number of steps until alignment is due.
    pub(super) fn steps_to_alignment(&self) -> u64 {
        let is_done = self.alignment_task.is_done();
        if is_done { u64::MAX } else { self.alignment_step().saturating_sub(self.schedule.step).max(1) }
    }

    fn alignment_step(&self) -> u64 {
        alignment_step(self.recorder.gpu.is_software(), self.options.n_planned_steps)
    }

    /// Starts alignment, or applies its result when due.
    pub(super) fn align_when_due(&mut self) -> Result<(), Error> {
        if self.alignment_task.is_requested() {
            let validation = self.trials.validation.iter().map(|validation| &validation.keyframe);
            let keyframes = self.views.keyframes().chain(validation).cloned().collect();
            self.alignment_task.begin(keyframes, &self.options.align);
        }
        if self.schedule.step < self.alignment_step() || self.alignment_task.is_done() {
            return Ok(());
        }
        if self.alignment_task.finish()? {
            self.restart()?;
        }
        Ok(())
    }

    /// Discards the splats and restarts training from corrected keyframes.
    fn restart(&mut self) -> Result<(), Error> {
        self.finish_in_flight()?;
        log::info!("restarting training with corrected cameras");
        let poses = ParamSet { image_poses: true, ..ParamSet::default() };
        if self.alignment_task.result().is_some_and(Alignment::has_image_poses) && self.trials.remove_candidate(poses) {
            self.model.cameras.enable(poses); // Depth gives image poses to a few millimeters; the splats refine them.
        }
        self.optimizer.submits.reset_time();
        self.recorder.passes.clear_bindings();
        self.model.reset(&self.recorder.gpu, self.options.sh_degree)?;
        self.optimizer.write_counter(&self.recorder.gpu, status::STEP, 0);
        for validation in &mut self.trials.validation {
            validation.keyframe = self.alignment_task.corrected(&validation.keyframe);
        }
        let corrected: Vec<Arc<Keyframe>> =
            self.views.keyframes().map(|keyframe| self.alignment_task.corrected(keyframe)).collect();
        self.views.replace(corrected.iter().cloned());
        self.seeding.restart(corrected);
        self.trials.n_reverted_steps = self.trials.n_reverted_steps.wrapping_add(self.schedule.step);
        self.schedule = Schedule::new(self.options.n_planned_steps);
        self.prepare_training()
    }
}
