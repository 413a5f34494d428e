//! Where alignment keeps something the keyframes are corrected and training begins anew: splats learned from wrong poses would
//! have to be unlearned.

use super::SplatTrainer;
use crate::Error;
use crate::align::{self, Alignment};
use crate::splat::buffers::SplatBuffers;
use crate::splat::camera_terms::{CameraTerms, TermSet};
use crate::splat::params::status;
use crate::splat::seed::Seeder;
use crate::splat::views::TrainView;

impl SplatTrainer {
    /// Steps that may be taken before alignment is due.
    pub(super) fn steps_to_alignment(&self) -> u64 {
        if self.aligning.is_done() { u64::MAX } else { self.aligned_at().saturating_sub(self.step).max(1) }
    }

    fn aligned_at(&self) -> u64 {
        align::taken_at(self.gpu.is_software(), self.options.n_planned_steps)
    }

    /// Begins alignment, or takes its result.
    pub(super) fn align_when_due(&mut self) -> Result<(), Error> {
        if self.aligning.is_asked() {
            let views = self.views.iter().map(|view| view.keyframe.clone());
            let held_back = self.trials.held_back.iter().map(|held_back| held_back.keyframe.clone());
            self.aligning.begin(views.chain(held_back).collect(), &self.options.align);
        }
        if self.step < self.aligned_at() || self.aligning.is_done() {
            return Ok(());
        }
        if self.aligning.finish()? {
            self.begin_anew()?;
        }
        Ok(())
    }

    /// Throws the splats away and starts from corrected keyframes.
    fn begin_anew(&mut self) -> Result<(), Error> {
        self.settle()?;
        log::info!("training begins anew with corrected cameras");
        let poses = TermSet { image_poses: true, ..TermSet::default() };
        if self.aligning.result().is_some_and(Alignment::has_image_poses) && self.trials.need_not_try(poses) {
            self.cameras.learn_also(poses); // Depth tells them to a few millimetres; the scene tells them better.
        }
        self.step_millis = 0.0;
        self.passes.forget_bindings();
        self.splats = SplatBuffers::new(&self.gpu, 1, self.options.sh_degree)?;
        self.tell_n();
        self.gpu.write(&self.learn_status, 4 * status::STEP as u64, &[0; 4]);
        self.cameras = CameraTerms::new(&self.gpu, self.cameras.set)?;
        self.seeder = Seeder::default();
        self.unseeded.clear();
        for held_back in &mut self.trials.held_back {
            held_back.keyframe = self.aligning.corrected(&held_back.keyframe);
        }
        self.pending = self.views.iter().map(|view| self.aligning.corrected(&view.keyframe)).collect();
        self.views = self.pending.iter().cloned().map(TrainView::new).collect();
        self.n_taken_back = self.n_taken_back.wrapping_add(self.step);
        (self.step, self.schedule_start, self.grown_at) = (0, 0, 0);
        self.begin_learning()
    }
}
