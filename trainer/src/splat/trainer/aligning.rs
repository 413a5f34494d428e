//! Alignment beside training: begun with the first step on a thread of its own, taken at a fixed step.
//!
//! Where it keeps something the keyframes are corrected and training begins anew: splats learned from wrong poses would
//! have to be unlearned.

use super::SplatTrainer;
use crate::align::{self, Alignment};
use crate::splat::buffers::SplatBuffers;
use crate::splat::camera_terms::{CameraFix, CameraTerms, PosedLens, TermSet};
use crate::splat::params::status;
use crate::splat::seed::Seeder;
use crate::splat::trials::CameraChoice;
use crate::splat::views::TrainView;
use crate::{Error, Keyframe};
use std::sync::Arc;
use std::thread::JoinHandle;

/// The step at which the result is taken, waiting for it where needed: on a processor steps are as dear as alignment.
const TAKEN_AT: u64 = 400;
const TAKEN_AT_ON_SOFTWARE: u64 = 50;

/// Where alignment stands.
#[derive(Debug)]
pub(super) enum Aligning {
    /// It begins with the next step.
    Asked,
    Running(JoinHandle<Option<Alignment>>),
    /// With what came of it, where it could be done.
    Done(Option<Alignment>),
}

impl Aligning {
    pub(super) fn new(choice: &CameraChoice) -> Self {
        let is_asked = match choice {
            CameraChoice::Given(terms) => terms.any(),
            CameraChoice::Try(candidates) => !candidates.is_empty(),
        };
        if is_asked { Self::Asked } else { Self::Done(None) }
    }

    pub(super) fn result(&self) -> Option<&Alignment> {
        match self {
            Self::Done(result) => result.as_ref(),
            Self::Asked | Self::Running(_) => None,
        }
    }

    pub(super) fn is_done(&self) -> bool {
        matches!(self, Self::Done(_))
    }

    fn fix(&self, camera: &str) -> Option<&CameraFix> {
        self.result()?.fixes.get(camera)
    }

    /// The keyframe with what alignment found; the same where that is nothing.
    pub(super) fn corrected(&self, keyframe: &Arc<Keyframe>) -> Arc<Keyframe> {
        match self.fix(&keyframe.camera) {
            Some(fix) => Arc::new(fix.corrected(keyframe)),
            None => keyframe.clone(),
        }
    }

    /// The camera of a keyframe with what alignment found and then what was learned with the splats.
    pub(super) fn posed_lens(&self, keyframe: &Keyframe, learned: Option<&CameraFix>) -> PosedLens {
        let posed = |keyframe: &Keyframe| learned.map_or_else(|| PosedLens::of(keyframe), |fix| fix.apply(keyframe));
        match self.fix(&keyframe.camera) {
            Some(fix) => PosedLens {
                color_from_depth: keyframe.depth.as_ref().map(|depth| fix.color_from_depth(keyframe, depth)),
                ..posed(&fix.corrected(&Keyframe { depth: None, ..keyframe.clone() }))
            },
            None => posed(keyframe),
        }
    }
}

/// Aligns on threads of its own: training, which makes images smaller on all processors, is not to wait for it.
fn beside_training(keyframes: &[Arc<Keyframe>], choice: &CameraChoice) -> Option<Alignment> {
    let n_processors = std::thread::available_parallelism().map_or(1, usize::from);
    match rayon::ThreadPoolBuilder::new().num_threads((3 * n_processors).div_ceil(4)).build() {
        Ok(pool) => pool.install(|| align::align(keyframes, choice)),
        Err(_) => align::align(keyframes, choice),
    }
}

impl SplatTrainer {
    /// Steps that may be taken before alignment is due.
    pub(super) fn steps_to_alignment(&self) -> u64 {
        if self.aligning.is_done() { u64::MAX } else { self.aligned_at().saturating_sub(self.step).max(1) }
    }

    fn aligned_at(&self) -> u64 {
        let usual = if self.gpu.is_software() { TAKEN_AT_ON_SOFTWARE } else { TAKEN_AT };
        usual.min(self.options.n_planned_steps / 4).max(1)
    }

    /// Begins alignment, or takes its result.
    pub(super) fn align_when_due(&mut self) -> Result<(), Error> {
        if matches!(self.aligning, Aligning::Asked) {
            let views = self.views.iter().map(|view| view.keyframe.clone());
            let held_back = self.trials.held_back.iter().map(|held_back| held_back.keyframe.clone());
            let keyframes: Vec<Arc<Keyframe>> = views.chain(held_back).collect();
            let choice = self.options.align.clone();
            self.aligning = Aligning::Running(std::thread::spawn(move || beside_training(&keyframes, &choice)));
        }
        if self.step < self.aligned_at() || self.aligning.is_done() {
            return Ok(());
        }
        if let Aligning::Running(thread) = std::mem::replace(&mut self.aligning, Aligning::Done(None)) {
            let result = thread.join().map_err(|_| Error::AlignmentPanicked)?;
            for line in result.iter().flat_map(Alignment::lines) {
                log::info!("{line}");
            }
            let is_any = result.as_ref().is_some_and(Alignment::is_any);
            self.aligning = Aligning::Done(result);
            if is_any {
                self.begin_anew()?;
            }
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
