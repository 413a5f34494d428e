//! Alignment in parallel with training: starts with the first step on its own thread; the result is applied at a
//! fixed step.

use crate::registration::{Alignment, align};
use crate::{CalibratedCamera, CameraCorrection, CameraRefinement, Error};
use keyframe::Keyframe;
use std::sync::Arc;
use std::thread::JoinHandle;

/// Step at which the result is applied, after waiting for it if necessary. It is smaller on software adapters, where
/// steps are as expensive as alignment.
const ALIGNMENT_STEP: u64 = 400;
const SOFTWARE_ALIGNMENT_STEP: u64 = 50;

/// Step at which the result is applied.
pub fn alignment_step(is_software: bool, n_planned_steps: u64) -> u64 {
    let default_step = if is_software { SOFTWARE_ALIGNMENT_STEP } else { ALIGNMENT_STEP };
    default_step.min(n_planned_steps / 4).max(1)
}

/// State of the alignment.
#[derive(Debug)]
pub enum AlignmentTask {
    /// Starts with the next step.
    Requested,
    /// Runs on its own thread.
    Running(JoinHandle<Option<Alignment>>),
    /// Finished, with the result if alignment was possible.
    Done(Option<Alignment>),
}

impl AlignmentTask {
    /// Requests alignment unless `choice` selects no parameter.
    pub fn new(choice: &CameraRefinement) -> Self {
        let is_requested = !choice.always().is_empty() || !choice.candidates().is_empty();
        if is_requested { Self::Requested } else { Self::Done(None) }
    }

    /// The result; `None` before the end, or if alignment was not possible.
    pub fn result(&self) -> Option<&Alignment> {
        match self {
            Self::Done(result) => result.as_ref(),
            Self::Requested | Self::Running(_) => None,
        }
    }

    /// Whether alignment has not started yet.
    pub fn is_requested(&self) -> bool {
        matches!(self, Self::Requested)
    }

    /// Whether alignment has ended or was not requested.
    pub fn is_done(&self) -> bool {
        matches!(self, Self::Done(_))
    }

    /// Starts alignment on its own thread.
    pub fn begin(&mut self, keyframes: Vec<Arc<Keyframe>>, choice: &CameraRefinement) {
        let choice = choice.clone();
        *self = Self::Running(std::thread::spawn(move || run_in_background_pool(|| align(&keyframes, &choice))));
    }

    /// Waits for the result. Returns whether keyframes must be corrected.
    pub fn finish(&mut self) -> Result<bool, Error> {
        let Self::Running(thread) = std::mem::replace(self, Self::Done(None)) else { return Ok(false) };
        let result = thread.join().map_err(|_| Error::AlignmentPanicked)?;
        for line in result.iter().flat_map(Alignment::lines) {
            log::info!("{line}");
        }
        let has_corrections = result.as_ref().is_some_and(Alignment::has_corrections);
        *self = Self::Done(result);
        Ok(has_corrections)
    }

    fn correction(&self, camera: &str) -> Option<&CameraCorrection> {
        self.result()?.corrections.get(camera)
    }

    /// The keyframe with the corrections of alignment, if there are any.
    pub fn corrected(&self, keyframe: &Arc<Keyframe>) -> Arc<Keyframe> {
        match self.correction(&keyframe.camera) {
            Some(correction) => Arc::new(correction.corrected(keyframe)),
            None => keyframe.clone(),
        }
    }

    /// The camera of a keyframe with the corrections of alignment, then those estimated with the splats.
    pub fn calibrated_camera(&self, keyframe: &Keyframe, learned: Option<&CameraCorrection>) -> CalibratedCamera {
        let posed = |keyframe: &Keyframe| {
            learned.map_or_else(|| CalibratedCamera::of(keyframe), |correction| correction.apply(keyframe))
        };
        match self.correction(&keyframe.camera) {
            Some(correction) => CalibratedCamera {
                color_from_depth: keyframe.depth.as_ref().map(|depth| correction.color_from_depth(keyframe, depth)),
                ..posed(&correction.corrected(&Keyframe { depth: None, ..keyframe.clone() }))
            },
            None => posed(keyframe),
        }
    }
}

/// Runs `work` in a thread pool of its own, so that training, which downscales images on all processors, does not
/// wait for it.
pub fn run_in_background_pool<T: Send>(work: impl FnOnce() -> T + Send) -> T {
    let n_processors = std::thread::available_parallelism().map_or(1, usize::from);
    match rayon::ThreadPoolBuilder::new().num_threads((3 * n_processors).div_ceil(4)).build() {
        Ok(pool) => pool.install(work),
        Err(_) => work(),
    }
}
