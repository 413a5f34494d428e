//! Alignment beside training: begun with the first step on a thread of its own, taken at a fixed step.

use super::{Alignment, align};
use crate::splat::{CameraChoice, CameraFix, PosedLens};
use crate::{Error, Keyframe};
use std::sync::Arc;
use std::thread::JoinHandle;

/// The step at which the result is taken, waiting for it where needed: on a processor steps are as dear as alignment.
const TAKEN_AT: u64 = 400;
const TAKEN_AT_ON_SOFTWARE: u64 = 50;

/// The step at which the result is taken.
pub(crate) fn taken_at(is_software: bool, n_planned_steps: u64) -> u64 {
    let usual = if is_software { TAKEN_AT_ON_SOFTWARE } else { TAKEN_AT };
    usual.min(n_planned_steps / 4).max(1)
}

/// Where alignment stands.
#[derive(Debug)]
pub(crate) enum Aligning {
    /// It begins with the next step.
    Asked,
    Running(JoinHandle<Option<Alignment>>),
    /// With what came of it, where it could be done.
    Done(Option<Alignment>),
}

impl Aligning {
    pub(crate) fn new(choice: &CameraChoice) -> Self {
        let is_asked = match choice {
            CameraChoice::Given(terms) => terms.any(),
            CameraChoice::Try(candidates) => !candidates.is_empty(),
        };
        if is_asked { Self::Asked } else { Self::Done(None) }
    }

    pub(crate) fn result(&self) -> Option<&Alignment> {
        match self {
            Self::Done(result) => result.as_ref(),
            Self::Asked | Self::Running(_) => None,
        }
    }

    pub(crate) fn is_asked(&self) -> bool {
        matches!(self, Self::Asked)
    }

    pub(crate) fn is_done(&self) -> bool {
        matches!(self, Self::Done(_))
    }

    /// Begins, on a thread of its own.
    pub(crate) fn begin(&mut self, keyframes: Vec<Arc<Keyframe>>, choice: &CameraChoice) {
        let choice = choice.clone();
        *self = Self::Running(std::thread::spawn(move || beside_training(|| align(&keyframes, &choice))));
    }

    /// Waits for what was begun, and says whether keyframes are to be corrected.
    pub(crate) fn finish(&mut self) -> Result<bool, Error> {
        let Self::Running(thread) = std::mem::replace(self, Self::Done(None)) else { return Ok(false) };
        let result = thread.join().map_err(|_| Error::AlignmentPanicked)?;
        for line in result.iter().flat_map(Alignment::lines) {
            log::info!("{line}");
        }
        let is_any = result.as_ref().is_some_and(Alignment::is_any);
        *self = Self::Done(result);
        Ok(is_any)
    }

    fn fix(&self, camera: &str) -> Option<&CameraFix> {
        self.result()?.fixes.get(camera)
    }

    /// The keyframe with what alignment found; the same where that is nothing.
    pub(crate) fn corrected(&self, keyframe: &Arc<Keyframe>) -> Arc<Keyframe> {
        match self.fix(&keyframe.camera) {
            Some(fix) => Arc::new(fix.corrected(keyframe)),
            None => keyframe.clone(),
        }
    }

    /// The camera of a keyframe with what alignment found and then what was learned with the splats.
    pub(crate) fn posed_lens(&self, keyframe: &Keyframe, learned: Option<&CameraFix>) -> PosedLens {
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

/// Works on threads of its own: training, which makes images smaller on all processors, is not to wait for it.
pub fn beside_training<T: Send>(work: impl FnOnce() -> T + Send) -> T {
    let n_processors = std::thread::available_parallelism().map_or(1, usize::from);
    match rayon::ThreadPoolBuilder::new().num_threads((3 * n_processors).div_ceil(4)).build() {
        Ok(pool) => pool.install(work),
        Err(_) => work(),
    }
}
