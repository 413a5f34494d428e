//! Runs alignment in parallel with training. Alignment starts with the first training step, on its
//! own thread. Its result is applied at a fixed step.

use crate::redrawn::RedrawnKeyframes;
use crate::registration::{Alignment, CameraMovement, MovementDetector, align};
use crate::{CalibratedCamera, CameraCorrection, CameraRefinement, Error};
use background::{Task, run_in_background_pool};
use keyframe::Keyframe;
use kinematics::Stamp;
use std::collections::HashSet;
use std::sync::Arc;

/// Step at which training waits for the result and applies it.
///
/// At a later step, training would wait less for alignment, but it would train longer with wrong
/// poses. On software adapters, the step is smaller, because one training step takes as long as the
/// whole alignment there.
const ALIGNMENT_STEP: u64 = 400;
const SOFTWARE_ALIGNMENT_STEP: u64 = 50;

/// Step at which the result is applied.
pub fn alignment_step(is_software: bool, n_planned_steps: u64) -> u64 {
    let default_step = if is_software {
        SOFTWARE_ALIGNMENT_STEP
    } else {
        ALIGNMENT_STEP
    };
    // A short training must still have steps left after the result is applied.
    default_step.min(n_planned_steps / 4).max(1)
}

/// Alignment in the background. It runs once, or again whenever more keyframes are available.
#[derive(Debug)]
pub struct AlignmentTask {
    state: TaskState,
    /// The latest result. `None` until the first alignment has ended, and if alignment was not
    /// possible.
    result: Option<Alignment>,
    /// Keyframes with the corrections of the latest result, until the caller has taken them.
    redrawn: RedrawnKeyframes,
}

/// Result of an alignment, and the keyframes in which a robot is masked with its corrections.
type AlignedKeyframes = Box<(Alignment, RedrawnKeyframes)>;

#[derive(Debug)]
enum TaskState {
    /// Alignment can start.
    Requested,
    /// Alignment runs on its own thread.
    Running(Task<Option<AlignedKeyframes>>),
    /// Alignment has finished or was not requested.
    Done,
}

impl AlignmentTask {
    /// Requests alignment unless `choice` selects no parameter.
    pub fn new(choice: &CameraRefinement) -> Self {
        let is_requested = !choice.always().is_empty() || !choice.candidates().is_empty();
        Self {
            state: if is_requested {
                TaskState::Requested
            } else {
                TaskState::Done
            },
            result: None,
            redrawn: RedrawnKeyframes::default(),
        }
    }

    /// A task whose alignment has ended with this result.
    pub fn done(result: Option<Alignment>) -> Self {
        Self {
            state: TaskState::Done,
            result,
            redrawn: RedrawnKeyframes::default(),
        }
    }

    /// The latest result. `None` until the first alignment has ended, and if alignment was not
    /// possible.
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
    pub fn begin(&mut self, keyframes: &[Arc<Keyframe>], choice: &CameraRefinement) {
        // Alignment does not estimate movements of cameras, but it must apply known movements.
        // Otherwise, images before and after a movement would contradict each other.
        let choice = choice.clone();
        let known = Alignment {
            movements: self
                .result
                .as_ref()
                .map_or(Vec::new(), |result| result.movements.clone()),
            ..Alignment::default()
        };
        let originals = keyframes.to_vec();
        let work = move || run_in_background_pool(|| aligned(&originals, &choice, &known));
        self.state = TaskState::Running(Task::start("alignment", work));
    }

    /// Waits for the result. Returns whether these keyframes must be corrected differently than
    /// before. If alignment was not possible, the latest result stays.
    pub fn finish(&mut self, keyframes: &[Arc<Keyframe>]) -> Result<bool, Error> {
        let TaskState::Running(thread) = std::mem::replace(&mut self.state, TaskState::Done) else {
            return Ok(false);
        };
        let result = thread.join().map_err(|_| Error::AlignmentPanicked)?;
        for line in result.iter().flat_map(|aligned| aligned.0.lines()) {
            log::info!("{line}");
        }
        let Some(aligned) = result else {
            return Ok(false);
        };
        let (mut result, redrawn) = *aligned;
        if self
            .result
            .as_ref()
            .is_some_and(|latest| is_as_good(latest, &result, keyframes))
        {
            return Ok(false);
        }
        // Movements may have been found while alignment ran.
        if let Some(latest) = &self.result {
            result.movements.clone_from(&latest.movements);
        }
        // New corrections move the model, so keyframes are not corrected again for negligible
        // changes.
        let is_changed = match &self.result {
            None => result.has_corrections(),
            Some(latest) => keyframes
                .iter()
                .any(|keyframe| latest.differs(&result, keyframe)),
        };
        if is_changed || self.result.is_none() {
            self.redrawn = redrawn.if_valid_for(&result);
            self.result = Some(result);
        }
        Ok(is_changed)
    }

    /// Forgets the keyframes that were corrected in the background, which hold pixels. They are
    /// corrected again when they are requested.
    pub fn forget_redrawn(&mut self) {
        self.redrawn = RedrawnKeyframes::default();
    }

    /// Adds a movement of a camera to the result. See [`Alignment::add_movement`].
    pub fn add_movement(&mut self, movement: CameraMovement, first: Stamp) {
        self.forget_redrawn();
        self.result
            .get_or_insert_default()
            .add_movement(movement, first);
    }

    /// The keyframe with the corrections of alignment, if there are any.
    pub fn corrected(&self, keyframe: &Arc<Keyframe>) -> Arc<Keyframe> {
        let redrawn = self.redrawn.of(keyframe);
        redrawn.unwrap_or_else(|| {
            self.result
                .as_ref()
                .map_or_else(|| keyframe.clone(), |result| result.corrected(keyframe))
        })
    }

    /// Like [`Self::corrected`], but the mask of a robot is not drawn again, which saves time.
    pub fn moved(&self, keyframe: &Arc<Keyframe>) -> Arc<Keyframe> {
        self.result
            .as_ref()
            .map_or_else(|| keyframe.clone(), |result| result.moved(keyframe))
    }

    /// The camera of a keyframe with the corrections of alignment, followed by the corrections that
    /// were learned with the splats.
    pub fn calibrated_camera(
        &self,
        keyframe: &Keyframe,
        learned: Option<&CameraCorrection>,
    ) -> CalibratedCamera {
        self.result
            .as_ref()
            .unwrap_or(&Alignment::default())
            .camera(keyframe, learned)
    }
}

/// Aligns uncorrected keyframes. `None` if alignment is not possible.
///
/// * `known`: the known movements of cameras.
fn aligned(
    originals: &[Arc<Keyframe>],
    choice: &CameraRefinement,
    known: &Alignment,
) -> Option<AlignedKeyframes> {
    let moved: Vec<_> = originals
        .iter()
        .map(|keyframe| known.with_movements(keyframe))
        .collect();
    let alignment = align(&moved, choice)?;
    let with_movements = Alignment {
        movements: known.movements.clone(),
        ..alignment.clone()
    };
    let redrawn = RedrawnKeyframes::new(&with_movements, originals);
    Some(Box::new((alignment, redrawn)))
}

/// Accuracy of extrinsics that were estimated from color: 0.1 degrees and 3 mm.
const COLOR_ACCURACY_RAD: f64 = 1.75e-3;
const COLOR_ACCURACY_M: f64 = 3e-3;

/// Whether the latest corrections are as good as newer corrections. Without depth, this is the case
/// if both agree within their accuracy, or if the newer estimate was rejected. Without this check,
/// the estimated poses of cameras would alternate between similar values.
fn is_as_good(latest: &Alignment, newer: &Alignment, keyframes: &[Arc<Keyframe>]) -> bool {
    if !latest.has_corrections() || keyframes.iter().any(|keyframe| keyframe.depth.is_some()) {
        return false;
    }
    !newer.has_corrections()
        || keyframes
            .iter()
            .all(|keyframe| agrees(latest, newer, keyframe))
}

/// Whether two corrections of a keyframe agree within the accuracy of estimates from color.
fn agrees(latest: &Alignment, newer: &Alignment, keyframe: &Keyframe) -> bool {
    let [latest, newer] = [latest, newer].map(|alignment| alignment.camera(keyframe, None));
    let motion = latest.world_from_camera.inverse() * newer.world_from_camera;
    // Changes of the lens are compared as the angles by which they move a pixel.
    let has_same_lens = (0..2).all(|axis| {
        let focal = (latest.focal_px[axis] / newer.focal_px[axis]).ln().abs();
        let principal =
            (latest.principal_px[axis] - newer.principal_px[axis]).abs() / newer.focal_px[axis];
        focal.max(principal) < COLOR_ACCURACY_RAD
    });
    let is_same_pose = motion.rotation.angle() < COLOR_ACCURACY_RAD
        && motion.translation.vector.norm() < COLOR_ACCURACY_M;
    is_same_pose && has_same_lens
}

/// Detects camera movements in the background. Its keyframes already have the corrections of
/// alignment.
#[derive(Debug)]
pub struct MovementTask {
    worker: Worker,
    /// Keyframes to test, in order of arrival.
    pending: Vec<Arc<Keyframe>>,
    /// Stamps of all keyframes so far, by camera.
    known: HashSet<(Arc<str>, Stamp)>,
}

/// Where the detector is.
#[derive(Debug)]
enum Worker {
    /// The detector has not yet been created from its reference keyframes.
    New(Vec<Arc<Keyframe>>),
    Idle(MovementDetector),
    Running(Task<(MovementDetector, Option<CameraMovement>)>),
    /// A movement was found.
    Done,
}

/// Tests keyframes until a movement is found. Later keyframes are compared with new references.
fn tested(
    mut detector: MovementDetector,
    keyframes: &[Arc<Keyframe>],
) -> (MovementDetector, Option<CameraMovement>) {
    let movement = keyframes
        .iter()
        .find_map(|keyframe| detector.push(keyframe));
    (detector, movement)
}

impl MovementTask {
    /// Creates a task that compares later keyframes with `references`.
    pub fn new(references: Vec<Arc<Keyframe>>) -> Self {
        Self {
            worker: Worker::New(references),
            pending: Vec::new(),
            known: HashSet::new(),
        }
    }

    /// Adds a keyframe to test. A revised keyframe replaces the one before if that was not tested
    /// yet, and is not tested again otherwise, because an image must not count twice.
    pub fn push(&mut self, keyframe: Arc<Keyframe>) {
        if self
            .known
            .insert((Arc::clone(&keyframe.camera), keyframe.stamp))
        {
            self.pending.push(keyframe);
            return;
        }
        let mut pending = self.pending.iter_mut();
        if let Some(before) =
            pending.find(|of| of.camera == keyframe.camera && of.stamp == keyframe.stamp)
        {
            *before = keyframe;
        }
    }

    /// Starts testing the pending keyframes on a background thread, unless one is already running.
    pub fn begin(&mut self) {
        if self.pending.is_empty() {
            return;
        }
        // The detector moves to the thread and comes back with its result. The thread also creates
        // the detector, because creating it prepares all references.
        let detector: Box<dyn FnOnce() -> MovementDetector + Send> =
            match std::mem::replace(&mut self.worker, Worker::Done) {
                Worker::New(references) => Box::new(move || MovementDetector::new(&references)),
                Worker::Idle(detector) => Box::new(move || detector),
                busy => return self.worker = busy,
            };
        let keyframes = std::mem::take(&mut self.pending);
        let test = move || tested(detector(), &keyframes);
        self.worker = Worker::Running(Task::start("movement", || run_in_background_pool(test)));
    }

    /// Returns a movement if one was found. With `wait`, tests all keyframes first.
    pub fn poll(&mut self, wait: bool) -> Result<Option<CameraMovement>, Error> {
        loop {
            if wait {
                self.begin();
            }
            match std::mem::replace(&mut self.worker, Worker::Done) {
                Worker::Running(thread) if wait || thread.is_finished() => {
                    let (detector, movement) =
                        thread.join().map_err(|_| Error::AlignmentPanicked)?;
                    // The references of this detector are outdated, so it is dropped.
                    if movement.is_some() {
                        return Ok(movement);
                    }
                    self.worker = Worker::Idle(detector);
                }
                other => {
                    self.worker = other;
                    return Ok(None);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenes::{Miscalibration, capture};
    use kinematics::Transform;

    #[test]
    fn a_revised_keyframe_is_tested_once() {
        let keyframes = capture(&Miscalibration::none());
        let [references, later] = [&keyframes[..2], &keyframes[2..5]];
        let mut task = MovementTask::new(references.to_vec());
        later.iter().for_each(|of| task.push(Arc::clone(of)));
        let revision = Transform::translation(0.002, 0.0, 0.0);
        let revised = |of: &Keyframe| {
            Arc::new(Keyframe {
                world_from_camera: revision * of.world_from_camera,
                ..of.clone()
            })
        };
        task.push(revised(&later[1]));
        assert_eq!(task.pending.len(), 3);
        assert_eq!(
            task.pending[1].world_from_camera,
            revision * later[1].world_from_camera
        );
        assert!(task.poll(true).expect("no panic").is_none());
        task.push(revised(&later[2]));
        assert!(task.pending.is_empty(), "it was tested before");
    }
}
