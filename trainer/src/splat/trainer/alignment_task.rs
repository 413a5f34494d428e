//! Alignment of keyframes during training. If alignment finds corrections, training restarts from corrected
//! keyframes, because splats trained on wrong poses would have to be corrected, too.

use super::SplatTrainer;
use crate::Error;
use crate::splat::buffers::SplatBuffers;
use crate::splat::camera_params::CameraParams;
use crate::splat::params::status;
use crate::splat::seed::Seeder;
use crate::splat::views::TrainView;
use calibration::{Alignment, ParamSet, alignment_step};

impl SplatTrainer {
    /// Number of steps until alignment is due.
    pub(super) fn steps_to_alignment(&self) -> u64 {
        if self.alignment_task.is_done() { u64::MAX } else { self.alignment_step().saturating_sub(self.step).max(1) }
    }

    fn alignment_step(&self) -> u64 {
        alignment_step(self.gpu.is_software(), self.options.common.n_planned_steps)
    }

    /// Starts alignment, or applies its result when due.
    pub(super) fn align_when_due(&mut self) -> Result<(), Error> {
        if self.alignment_task.is_requested() {
            let views = self.views.iter().map(|view| view.keyframe.clone());
            let validation = self.trials.validation.iter().map(|validation| validation.keyframe.clone());
            self.alignment_task.begin(views.chain(validation).collect(), &self.options.common.align);
        }
        if self.step < self.alignment_step() || self.alignment_task.is_done() {
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
        let poses = ParamSet::IMAGE_POSES;
        if self.alignment_task.result().is_some_and(Alignment::has_image_poses) && self.trials.remove_candidate(poses) {
            self.cameras.enable(poses); // Depth gives image poses to a few millimeters; the splats refine them.
        }
        self.step_millis = 0.0;
        self.passes.clear_bindings();
        self.splats = SplatBuffers::new(&self.gpu, 1, self.options.specific.sh_degree)?;
        self.write_n_splats();
        self.gpu.write(&self.train_status, 4 * status::STEP as u64, &[0; 4]);
        self.cameras = CameraParams::new(&self.gpu, self.cameras.set)?;
        self.seeder = Seeder::default();
        self.unseeded.clear();
        for validation in &mut self.trials.validation {
            validation.keyframe = self.alignment_task.corrected(&validation.keyframe);
        }
        self.pending = self.views.iter().map(|view| self.alignment_task.corrected(&view.keyframe)).collect();
        self.views = self.pending.iter().cloned().map(TrainView::new).collect();
        self.n_reverted_steps = self.n_reverted_steps.wrapping_add(self.step);
        (self.step, self.schedule_start, self.last_growth_step) = (0, 0, 0);
        self.prepare_training()
    }
}
