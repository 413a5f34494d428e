//! Checkpoints of a splat model in training. They contain all state that affects further training,
//! without rounding.

use super::SplatTrainer;
use super::saved_arrays::{CAMERA_PARAMS, PendingArrays, invalid_state, read_seeds, read_splats};
use super::training::Training;
use crate::Error;
use crate::keyframe_signature::{self, KeyframeSignature};
use crate::model_options::{MethodOptions, ModelOptions};
use crate::pending::PendingCheckpoint;
use crate::splat::buffers::SplatBuffers;
use crate::splat::camera_params::CameraSlots;
use crate::splat::options::SplatOptions;
use crate::splat::params::status;
use crate::splat::schedule::Schedule;
use crate::splat::snapshot::{ObservedScene, Snapshot};
use crate::splat::trials::{Arrival, RemainingTrials, RunningTrial, SplatTrials};
use calibration::{Candidate, ParamSet, Trial};
use gpu::Gpu;
use keyframe::Keyframe;
use kinematics::Stamp;
use model_files::checkpoint::Checkpoint;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::sync::Arc;

const METHOD: &str = SplatOptions::METHOD;
/// Name prefix of the arrays of [`RunningTrial::other`].
const OTHER: &str = "other_";

/// Everything in a checkpoint except the arrays.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct SavedState {
    /// Options, with defaults replaced by the values chosen for the adapter.
    options: ModelOptions<SplatOptions>,
    step: u64,
    model: ModelState,
    n_non_finite: u32,
    /// Whether memory was too small for more splats.
    #[serde(default)]
    is_full: bool,
    #[serde(default)]
    is_growth_paused: bool,
    /// Training views. Their order determines the training order.
    views: Vec<KeyframeSignature>,
    /// Indices of the views that have not been seeded yet.
    unseeded: Vec<usize>,
    /// Parameter slots of cameras and images.
    slots: CameraSlots,
    remaining_trials: RemainingTrials,
    finished_trials: Vec<Trial>,
    /// The running trial, if any.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    trial: Option<TrialState>,
}

/// The state that a trial may restore, without the arrays and the step.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct ModelState {
    schedule_start: u64,
    last_growth_step: u64,
    n_splats: u32,
    capacity: u32,
    sh_degree: u32,
    active_degree: u32,
    scene_size_m: f64,
    has_depth: bool,
    n_seeds: u64,
    /// Camera parameters being optimized.
    params: ParamSet,
}

/// A running trial. [`SavedState::model`] is the state in training. `other` is the state in
/// [`RunningTrial::other`].
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct TrialState {
    candidate: Candidate,
    until: u64,
    scored: Vec<ImageKey>,
    /// Scores of the first half, once it has ended.
    baseline_scores: Option<Vec<(ImageKey, f64)>>,
    arrivals: Vec<ArrivalState>,
    other_step: u64,
    other: ModelState,
    n_other_param_bytes: u64,
}

/// Removes the state of searches for the number of splats, which earlier versions stored. Runs of
/// these versions continue without a search.
fn remove_obsolete(state: &mut Value) {
    remove_fields(Some(&mut *state), &["growth_search"]);
    remove_fields(state.pointer_mut("/remaining_trials"), &["doubling"]);
    remove_fields(
        state.pointer_mut("/options/specific/trial_steps"),
        &[
            "first_doubling",
            "doubling_half",
            "search",
            "search_pause",
            "comparison",
        ],
    );
    let finished = state.pointer_mut("/finished_trials");
    if let Some(trials) = finished.and_then(Value::as_array_mut) {
        trials.retain(|trial| trial.pointer("/candidate/doubled").is_none());
    }
}

fn remove_fields(object: Option<&mut Value>, names: &[&str]) {
    if let Some(fields) = object.and_then(Value::as_object_mut) {
        for name in names {
            fields.remove(*name);
        }
    }
}

/// Camera name and stamp in nanoseconds.
type ImageKey = (String, i64);

/// A keyframe that arrived in the first half of a trial. The second half adds it at the same step.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct ArrivalState {
    step: u64,
    image: KeyframeSignature,
}

fn image((camera, stamp): &(Arc<str>, Stamp)) -> ImageKey {
    (camera.to_string(), stamp.0)
}

fn id((camera, nanos): ImageKey) -> (Arc<str>, Stamp) {
    (camera.into(), Stamp(nanos))
}

impl ModelState {
    fn of(
        splats: &SplatBuffers,
        params: ParamSet,
        schedule: &Schedule,
        scene: &ObservedScene,
    ) -> Self {
        Self {
            schedule_start: schedule.start,
            last_growth_step: schedule.last_growth_step,
            n_splats: splats.n_splats,
            capacity: splats.capacity,
            sh_degree: splats.sh_degree,
            active_degree: splats.active_degree(),
            scene_size_m: scene.size_m,
            has_depth: scene.has_depth,
            n_seeds: scene.seeder.n_seeds() as u64,
            params,
        }
    }

    fn splats(
        &self,
        gpu: &Gpu,
        checkpoint: &Checkpoint,
        prefix: &str,
    ) -> Result<SplatBuffers, Error> {
        read_splats(
            gpu,
            checkpoint,
            prefix,
            [
                self.n_splats,
                self.capacity,
                self.sh_degree,
                self.active_degree,
            ],
        )
    }

    fn schedule(&self, step: u64, n_planned_steps: u64) -> Schedule {
        Schedule {
            step,
            start: self.schedule_start,
            last_growth_step: self.last_growth_step,
            ..Schedule::new(n_planned_steps)
        }
    }

    fn scene(&self, checkpoint: &Checkpoint, prefix: &str) -> Result<ObservedScene, Error> {
        let seeder = read_seeds(checkpoint, prefix, self.n_seeds)?;
        Ok(ObservedScene {
            seeder,
            size_m: self.scene_size_m,
            has_depth: self.has_depth,
        })
    }
}

impl TrialState {
    fn of(trial: &RunningTrial) -> Self {
        let Snapshot {
            splats,
            cameras: (params, param_buffer),
            schedule,
            scene,
        } = &*trial.other;
        Self {
            candidate: trial.candidate,
            until: trial.until,
            scored: trial.scored.iter().map(image).collect(),
            baseline_scores: (trial.baseline_db.as_ref())
                .map(|scores| scores.iter().map(|(of, db)| (image(of), *db)).collect()),
            arrivals: trial
                .arrivals
                .iter()
                .map(|Arrival { step, keyframe }| ArrivalState {
                    step: *step,
                    image: KeyframeSignature::of(keyframe),
                })
                .collect(),
            other_step: schedule.step,
            other: ModelState::of(splats, *params, schedule, scene),
            n_other_param_bytes: param_buffer.bytes(),
        }
    }

    /// Restores the running trial. `keyframes` are its arrivals, in the same order.
    fn restored(
        self,
        gpu: &Gpu,
        checkpoint: &Checkpoint,
        n_planned_steps: u64,
        keyframes: &[Arc<Keyframe>],
    ) -> Result<RunningTrial, Error> {
        let params =
            checkpoint.array(&format!("{OTHER}{CAMERA_PARAMS}"), self.n_other_param_bytes)?;
        let state = Snapshot {
            splats: self.other.splats(gpu, checkpoint, OTHER)?,
            cameras: (
                self.other.params,
                gpu.storage_with("splat.camera_params", params)?,
            ),
            schedule: self.other.schedule(self.other_step, n_planned_steps),
            scene: self.other.scene(checkpoint, OTHER)?,
        };
        let arrivals = self.arrivals.iter().zip(keyframes);
        let scores = |scores: Vec<(ImageKey, f64)>| {
            scores.into_iter().map(|(of, db)| (id(of), db)).collect()
        };
        Ok(RunningTrial {
            candidate: self.candidate,
            until: self.until,
            other: Box::new(state),
            scored: self.scored.into_iter().map(id).collect(),
            arrivals: arrivals
                .map(|(at, keyframe)| Arrival {
                    step: at.step,
                    keyframe: keyframe.clone(),
                })
                .collect(),
            baseline_db: self.baseline_scores.map(scores),
            // Deferred keyframes are not in the checkpoint. They are pushed again after resuming,
            // and then deferred again.
            deferred: Vec::new(),
        })
    }
}

/// The keyframes of a checkpoint that were found among the keyframes of a run.
struct SavedKeyframes {
    /// The training views, in their order.
    views: Vec<Arc<Keyframe>>,
    /// The arrivals of the running trial, in their order.
    arrivals: Vec<Arc<Keyframe>>,
    /// The views that have not been seeded yet.
    unseeded: Vec<Arc<Keyframe>>,
    /// Keyframes that the checkpoint does not contain.
    untrained: Vec<Arc<Keyframe>>,
}

impl SavedKeyframes {
    fn find(state: &SavedState, keyframes: &[Arc<Keyframe>]) -> Result<Self, Error> {
        let arrivals: Vec<&KeyframeSignature> = state
            .trial
            .iter()
            .flat_map(|trial| &trial.arrivals)
            .map(|arrival| &arrival.image)
            .collect();
        // In the first half of a trial, its arrivals are views. In the second half, they are added
        // at a later step.
        let is_second_half = state
            .trial
            .as_ref()
            .is_some_and(|trial| trial.baseline_scores.is_some());
        let (arrived, yet_to_arrive) = if is_second_half {
            (Vec::new(), arrivals)
        } else {
            (arrivals, Vec::new())
        };
        let known: Vec<KeyframeSignature> =
            state.views.iter().chain(yet_to_arrive).cloned().collect();
        let (mut views, untrained) = keyframe_signature::match_keyframes(&known, keyframes)?;
        let yet_to_arrive = views.split_off(state.views.len());
        // Arrivals that are views must be the same keyframes as these, because keyframes are later
        // compared by pointer.
        let arrived = arrived
            .into_iter()
            .map(|image| {
                let ix = state.views.iter().position(|view| view == image)?;
                views.get(ix).cloned()
            })
            .collect::<Option<Vec<_>>>()
            .ok_or_else(|| {
                invalid_state("a view that arrived during a trial is missing".to_owned())
            })?;
        let unseeded = state
            .unseeded
            .iter()
            .map(|ix| views.get(*ix).cloned())
            .collect::<Option<Vec<_>>>()
            .ok_or_else(|| invalid_state("a view is missing".to_owned()))?;
        Ok(Self {
            arrivals: [arrived, yet_to_arrive].concat(),
            views,
            unseeded,
            untrained,
        })
    }
}

/// Captures the state after all queued steps. This call only copies the model within GPU memory.
/// [`PendingCheckpoint::finish`] copies it to the host and may run on any thread.
pub(super) fn take(
    training: &mut Training,
    trials: &SplatTrials,
) -> Result<PendingCheckpoint, Error> {
    // Keyframes that wait for seeding are not part of a checkpoint, and the step count must be
    // exact.
    training.seed_from_depth()?;
    training.finish_in_flight()?;
    let gpu = &training.recorder.gpu;
    let cameras = &training.model.cameras;
    let (splats, schedule) = (&training.model.splats, &training.schedule);
    let scene = &training.seeding.scene;
    let state = SavedState {
        // Defaults that depend on the adapter are stored as values, so that training continues in
        // the same way on another adapter.
        options: training.options.clone().with(|options| {
            let resolution = training.views.resolution();
            options.specific.coarse_steps = Some(resolution.coarse_steps);
            options.specific.max_coarse_px = Some(resolution.max_coarse_px);
            options.specific.random_splats = Some(training.seeding.random_splats());
            options.specific.seeds_per_image = Some(training.seeding.seeds_per_image());
        }),
        step: schedule.step,
        model: ModelState::of(splats, cameras.set, schedule, scene),
        n_non_finite: u32::try_from(training.optimizer.n_non_finite).unwrap_or(u32::MAX),
        views: training
            .views
            .keyframes()
            .map(|keyframe| KeyframeSignature::of(keyframe))
            .collect(),
        unseeded: training
            .seeding
            .unseeded()
            .iter()
            .filter_map(|keyframe| training.views.position(keyframe))
            .collect(),
        slots: cameras.slots(),
        remaining_trials: trials.remaining_trials(),
        is_full: training.model.is_full(),
        is_growth_paused: training.model.is_growth_paused,
        finished_trials: trials.finished.clone(),
        trial: trials.running_trial().map(TrialState::of),
    };
    let state = serde_json::to_value(state).map_err(|error| Error::CheckpointState {
        reason: error.to_string(),
    })?;
    // The copies for reading back are queued now, so that the arrays belong to this step. Training
    // may change the buffers before the reads are finished.
    let params = (&cameras.params, cameras.used_bytes());
    let mut halves = vec![PendingArrays::begin(gpu, "", splats, &scene.seeder, params)];
    if let Some(RunningTrial { other, .. }) = trials.running_trial() {
        let params = (&other.cameras.1, other.cameras.1.bytes());
        halves.push(PendingArrays::begin(
            gpu,
            OTHER,
            &other.splats,
            &other.scene.seeder,
            params,
        ));
    }
    let gpu = gpu.clone();
    Ok(PendingCheckpoint::new(move || {
        let mut arrays = Vec::new();
        halves
            .into_iter()
            .try_for_each(|half| half.finish(&gpu, &mut arrays))?;
        Ok(Checkpoint::new(METHOD, state, arrays))
    }))
}

/// See [`SplatTrainer::resume`].
pub(super) fn resume(
    gpu: Arc<Gpu>,
    checkpoint: &Checkpoint,
    keyframes: &[Arc<Keyframe>],
) -> Result<(SplatTrainer, Vec<Arc<Keyframe>>), Error> {
    if checkpoint.method != METHOD {
        return Err(invalid_state(format!(
            "it was written by the method {:?}, expected {METHOD:?}",
            checkpoint.method
        )));
    }
    let mut state = checkpoint.state.clone();
    remove_obsolete(&mut state);
    let state: SavedState =
        serde_json::from_value(state).map_err(|error| invalid_state(error.to_string()))?;
    let SavedKeyframes {
        views,
        arrivals,
        unseeded,
        untrained,
    } = SavedKeyframes::find(&state, keyframes)?;
    // The kernels count steps in 32 bits.
    let step = u32::try_from(state.step)
        .map_err(|_| invalid_state(format!("step {} does not fit into 32 bits", state.step)))?;

    let mut trainer = SplatTrainer::new(gpu, state.options)?;
    let SplatTrainer {
        training, trials, ..
    } = &mut trainer;
    let gpu = &training.recorder.gpu;
    training.model.splats = state.model.splats(gpu, checkpoint, "")?;
    training.optimizer.write_counter(gpu, status::STEP, step);
    training
        .optimizer
        .write_counter(gpu, status::N_NON_FINITE, state.n_non_finite);
    training.optimizer.n_non_finite = state.n_non_finite.into();

    training
        .model
        .cameras
        .restore(gpu, &state.slots, state.model.params, checkpoint)?;
    trials.restore(state.remaining_trials, state.finished_trials);
    training.model.set_full(state.is_full);
    training.model.is_growth_paused = state.is_growth_paused;
    let n_planned_steps = training.options.common.n_planned_steps;
    if let Some(trial) = state.trial {
        trials.restore_trial(trial.restored(gpu, checkpoint, n_planned_steps, &arrivals)?);
    }
    training.views.replace(views);
    training
        .seeding
        .restore(state.model.scene(checkpoint, "")?, unseeded);
    training.schedule = state.model.schedule(state.step, n_planned_steps);
    Ok((trainer, untrained))
}
