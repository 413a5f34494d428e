//! Runs alignment in parallel with training. Alignment starts with the first training step, on its own thread; its
//! result is applied at a fixed step.

use crate::registration::{Alignment, align};
use crate::{CalibratedCamera, CameraCorrection, CameraRefinement, Error};
use keyframe::Keyframe;
use std::sync::Arc;
use std::thread::JoinHandle;

/// Step at which training waits for the result and applies it. It is smaller on software adapters, where a step takes
/// as long as alignment.
const ALIGNMENT_STEP: u64 = 400;
const SOFTWARE_ALIGNMENT_STEP: u64 = 50;

/// Step at which the result is applied.
pub fn alignment_step(is_software: bool, n_planned_steps: u64) -> u64 {
    let default_step = if is_software { SOFTWARE_ALIGNMENT_STEP } else { ALIGNMENT_STEP };
    default_step.min(n_planned_steps / 4).max(1)
}

/// Alignment in the background, once or several times with more keyframes.
#[derive(Debug)]
pub struct AlignmentTask {
    state: TaskState,
    /// The latest result; `None` before the first end, or if alignment was not possible.
    result: Option<Alignment>,
}

#[derive(Debug)]
enum TaskState {
    /// Alignment can start.
    Requested,
    /// Alignment runs on its own thread.
    Running(JoinHandle<Option<Alignment>>),
    /// Alignment has finished or was not requested.
    Done,
}

impl AlignmentTask {
    /// Requests alignment unless `choice` selects no parameter.
    pub fn new(choice: &CameraRefinement) -> Self {
        let is_requested = !choice.always().is_empty() || !choice.candidates().is_empty();
        Self { state: if is_requested { TaskState::Requested } else { TaskState::Done }, result: None }
    }

    /// Alignment that ended with this result.
    pub fn done(result: Option<Alignment>) -> Self {
        Self { state: TaskState::Done, result }
    }

    /// The latest result; `None` before the first end, or if alignment was not possible.
    pub fn result(&self) -> Option<&Alignment> {
        self.result.as_ref()
    }

    /// Whether alignment has not started yet.
    pub fn is_requested(&self) -> bool {
        matches!(self.state, TaskState::Requested)
    }

    /// Whether alignment has ended or was not requested.
    pub fn is_done(&self) -> bool {
        matches!(self.state, TaskState::Done)
    }

    /// Whether alignment has ended and its result was not taken yet.
    pub fn has_result(&self) -> bool {
        matches!(&self.state, TaskState::Running(thread) if thread.is_finished())
    }

    /// Requests another alignment. Its result replaces the latest one.
    pub fn request_again(&mut self) {
        self.state = TaskState::Requested;
    }

    /// Starts alignment of uncorrected keyframes on its own thread.
    pub fn begin(&mut self, keyframes: Vec<Arc<Keyframe>>, choice: &CameraRefinement) {
        let choice = choice.clone();
        self.state =
            TaskState::Running(std::thread::spawn(move || run_in_background_pool(|| align(&keyframes, &choice))));
    }

    /// Waits for the result. Returns whether these keyframes must be corrected differently than before. If alignment
    /// was not possible, the latest result stays.
    pub fn finish(&mut self, keyframes: &[Arc<Keyframe>]) -> Result<bool, Error> {
        let TaskState::Running(thread) = std::mem::replace(&mut self.state, TaskState::Done) else { return Ok(false) };
        let result = thread.join().map_err(|_| Error::AlignmentPanicked)?;
        for line in result.iter().flat_map(Alignment::lines) {
            log::info!("{line}");
        }
        let Some(result) = result else { return Ok(false) };
        let is_changed = match &self.result {
            None => result.has_corrections(),
            Some(latest) => keyframes.iter().any(|keyframe| latest.differs(&result, keyframe)),
        };
        if is_changed || self.result.is_none() {
            self.result = Some(result);
        }
        Ok(is_changed)
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

    /// The camera of a keyframe with the corrections of alignment, followed by the corrections that were learned with
    /// the splats.
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

/// Runs `work` in a separate thread pool. In the global pool, training, which downscales images on all processors,
/// would wait for it.
pub fn run_in_background_pool<T: Send>(work: impl FnOnce() -> T + Send) -> T {
    let n_processors = std::thread::available_parallelism().map_or(1, usize::from);
    match rayon::ThreadPoolBuilder::new().num_threads((3 * n_processors).div_ceil(4)).build() {
        Ok(pool) => pool.install(work),
        Err(_) => work(),
    }
}
