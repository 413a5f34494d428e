//! Checkpoints of a splat model in training. They contain all state that affects further training, bit for bit.

use super::SplatTrainer;
use crate::Error;
use crate::checkpoint::{Array, Checkpoint, PendingCheckpoint};
use crate::gpu::{Buffer, Gpu, PendingRead};
use crate::keyframe_signature::{self, KeyframeSignature};
use crate::model_options::{MethodOptions, ModelOptions};
use crate::splat::buffers::{N_PLANAR_BUFFERS, SplatBuffers};
use crate::splat::camera_params::CameraSlots;
use crate::splat::options::SplatOptions;
use crate::splat::params::status;
use crate::splat::seed::{SeedSnapshot, Seeder};
use crate::splat::snapshot::{Seeding, Snapshot};
use crate::splat::trials::{Arrival, RemainingTrials, RunningTrial, Scores};
use crate::splat::views::TrainView;
use calibration::ParamSet;
use calibration::{Alignment, AlignmentTask};
use calibration::{Candidate, Trial};
use keyframe::Keyframe;
use kinematics::Stamp;
use serde::{Deserialize, Serialize};
use std::sync::Arc;

const METHOD: &str = SplatOptions::METHOD;
/// Names of the arrays, in the order of [`SplatBuffers::planes`].
const ARRAYS: [&str; N_PLANAR_BUFFERS] =
    ["means", "rotations", "shapes", "sh_dc", "sh_rest", "moments", "sh_dc_moments", "sh_rest_moments", "error_sums"];
const SEED_POSITIONS: &str = "seed_positions";
const SEED_CELLS: &str = "seed_cells";
const CAMERA_PARAMS: &str = "camera_params";
/// Prefix of the array names of the other state of a trial in progress.
const OTHER: &str = "other_";

/// The state except for the arrays.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct SavedState {
    /// Options with the values chosen for the adapter.
    options: ModelOptions<SplatOptions>,
    step: u64,
    schedule_start: u64,
    last_growth_step: u64,
    n_non_finite: u32,
    n_splats: u32,
    capacity: u32,
    sh_degree: u32,
    active_degree: u32,
    scene_size_m: f64,
    has_depth: bool,
    n_seeds: u64,
    /// Training views in order, which determines the order of training.
    views: Vec<KeyframeSignature>,
    /// Indices of the views that wait for their splats.
    unseeded: Vec<usize>,
    /// Slots of the parameters of cameras and images.
    slots: CameraSlots,
    /// Camera parameters being optimized, and the trials that remain.
    params: ParamSet,
    remaining_trials: RemainingTrials,
    finished_trials: Vec<Trial>,
    /// Whether alignment is finished, and its result. The signatures of the views are those of corrected keyframes.
    is_aligned: bool,
    alignment: Option<Alignment>,
    /// A trial in progress.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    trial: Option<TrialState>,
}

/// A trial in progress. The half in training is the state above; the arrays of the other state have a prefix.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct TrialState {
    candidate: Candidate,
    until: u64,
    scored: Vec<ImageKey>,
    /// Scores of the first half, once it is finished.
    baseline_scores: Option<Vec<(ImageKey, f64)>>,
    arrivals: Vec<ArrivalState>,
    other: OtherHalf,
}

/// Camera name and stamp in nanoseconds.
type ImageKey = (String, i64);

/// A keyframe that arrived in the first half of a trial. In the second half it is not a view until it arrives again.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct ArrivalState {
    step: u64,
    image: KeyframeSignature,
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct OtherHalf {
    step: u64,
    schedule_start: u64,
    last_growth_step: u64,
    n_splats: u32,
    capacity: u32,
    sh_degree: u32,
    active_degree: u32,
    scene_size_m: f64,
    has_depth: bool,
    n_seeds: u64,
    params: ParamSet,
    n_param_bytes: u64,
}

fn image((camera, stamp): &(Arc<str>, Stamp)) -> ImageKey {
    (camera.to_string(), stamp.0)
}

fn id((camera, nanos): ImageKey) -> (Arc<str>, Stamp) {
    (camera.into(), Stamp(nanos))
}

impl TrialState {
    fn of(trial: &RunningTrial, baseline_db: Option<&Scores>) -> Self {
        let Snapshot { splats, cameras: (params, param_buffer), step, last_growth_step, seeding } = &*trial.other;
        Self {
            candidate: trial.candidate,
            until: trial.until,
            scored: trial.scored.iter().map(image).collect(),
            baseline_scores: baseline_db.map(|scores| scores.iter().map(|(of, db)| (image(of), *db)).collect()),
            arrivals: trial
                .arrivals
                .iter()
                .map(|Arrival { step, keyframe }| ArrivalState { step: *step, image: KeyframeSignature::of(keyframe) })
                .collect(),
            other: OtherHalf {
                step: *step,
                schedule_start: seeding.schedule_start,
                last_growth_step: *last_growth_step,
                n_splats: splats.n_splats,
                capacity: splats.capacity,
                sh_degree: splats.sh_degree,
                active_degree: splats.active_degree(),
                scene_size_m: seeding.scene_size_m,
                has_depth: seeding.has_depth,
                n_seeds: seeding.seeder.n_seeds() as u64,
                params: *params,
                n_param_bytes: param_buffer.bytes(),
            },
        }
    }

    /// Restores the trial with its other state and the keyframes that arrived.
    fn restored(
        self,
        gpu: &Gpu,
        checkpoint: &Checkpoint,
        keyframes: &[Arc<Keyframe>],
    ) -> Result<(RunningTrial, Option<Scores>), Error> {
        let other = self.other;
        let size = [other.n_splats, other.capacity, other.sh_degree, other.active_degree];
        let state = Snapshot {
            splats: read_splats(gpu, checkpoint, OTHER, size)?,
            cameras: (
                other.params,
                gpu.storage_with(
                    "splat.camera_params",
                    checkpoint.array(&format!("{OTHER}{CAMERA_PARAMS}"), other.n_param_bytes)?,
                )?,
            ),
            step: other.step,
            last_growth_step: other.last_growth_step,
            seeding: Seeding {
                seeder: read_seeds(checkpoint, OTHER, other.n_seeds)?,
                scene_size_m: other.scene_size_m,
                has_depth: other.has_depth,
                schedule_start: other.schedule_start,
            },
        };
        let arrivals = self.arrivals.iter().zip(keyframes);
        let trial = RunningTrial {
            candidate: self.candidate,
            until: self.until,
            other: Box::new(state),
            scored: self.scored.into_iter().map(id).collect(),
            arrivals: arrivals.map(|(at, keyframe)| Arrival { step: at.step, keyframe: keyframe.clone() }).collect(),
        };
        let scores = self.baseline_scores.map(|scores| scores.into_iter().map(|(of, db)| (id(of), db)).collect());
        Ok((trial, scores))
    }
}

/// Reads splats of size `[n_splats, capacity, sh_degree, active_degree]` from the arrays with this prefix.
fn read_splats(
    gpu: &Gpu,
    checkpoint: &Checkpoint,
    prefix: &str,
    [n_splats, capacity, sh_degree, active_degree]: [u32; 4],
) -> Result<SplatBuffers, Error> {
    if n_splats > capacity || active_degree > sh_degree || sh_degree > 3 {
        return Err(invalid_state(format!(
            "{n_splats} splats of degree {active_degree} do not fit a capacity of {capacity} and degree {sh_degree}"
        )));
    }
    let mut splats = SplatBuffers::new(gpu, capacity, sh_degree)?;
    for (name, (buffer, n_planes, bytes)) in ARRAYS.into_iter().zip(splats.planes()) {
        let used_bytes = u64::from(n_splats) * bytes;
        let array = checkpoint.array(&format!("{prefix}{name}"), u64::from(n_planes) * used_bytes)?;
        for plane in 0..u64::from(n_planes) {
            let from = to_usize(plane * used_bytes);
            let at = plane * u64::from(capacity) * bytes;
            gpu.write(buffer, at, &array[from..from + to_usize(used_bytes)]);
        }
    }
    splats.set_active_degree(gpu, active_degree);
    splats.set_n_splats(gpu, n_splats);
    Ok(splats)
}

fn read_seeds(checkpoint: &Checkpoint, prefix: &str, n_seeds: u64) -> Result<Seeder, Error> {
    let array = |name: &str, bytes: u64| {
        let n_bytes =
            n_seeds.checked_mul(bytes).ok_or_else(|| invalid_state(format!("{n_seeds} seeds are too many")))?;
        checkpoint.array(&format!("{prefix}{name}"), n_bytes)
    };
    Ok(Seeder::from_bytes(array(SEED_POSITIONS, Seeder::POSITION_BYTES)?, array(SEED_CELLS, Seeder::CELL_BYTES)?))
}

/// The arrays of one state of the model while they are copied to the host.
struct PendingArrays {
    prefix: &'static str,
    planes: Vec<Planes>,
    seeds: SeedSnapshot,
    params: Option<PendingRead>,
}

impl PendingArrays {
    fn begin(gpu: &Gpu, prefix: &'static str, splats: &SplatBuffers, seeder: &Seeder, params: (&Buffer, u64)) -> Self {
        let planes = splats.planes().map(|(buffer, n_planes, bytes)| Planes {
            read: begin_read(gpu, buffer, n_planes, bytes, splats),
            n_planes: n_planes as usize,
            used_bytes: splats.n_splats as usize * to_usize(bytes),
            stride_bytes: splats.capacity as usize * to_usize(bytes),
        });
        let (buffer, n_bytes) = params;
        Self {
            prefix,
            planes: planes.into(),
            seeds: seeder.snapshot(),
            params: (n_bytes > 0).then(|| gpu.begin_read(buffer, to_usize(n_bytes / 4))),
        }
    }

    fn finish(self, gpu: &Gpu, arrays: &mut Vec<Array>) -> Result<(), Error> {
        let mut add = |name: &str, bytes| arrays.push(Array { name: format!("{}{name}", self.prefix), bytes });
        for (name, planes) in ARRAYS.into_iter().zip(self.planes) {
            add(name, planes.finish(gpu)?);
        }
        let (positions, cells) = self.seeds.into_bytes();
        add(SEED_POSITIONS, positions);
        add(SEED_CELLS, cells);
        add(CAMERA_PARAMS, self.params.map_or(Ok(Vec::new()), |read| read.finish(gpu))?);
        Ok(())
    }
}

impl SplatTrainer {
    /// Captures the state after all steps queued so far. The model is only copied within the GPU here;
    /// [`PendingCheckpoint::finish`] copies it to the host, on any thread.
    pub(super) fn take_checkpoint(&mut self) -> Result<PendingCheckpoint, Error> {
        self.seed_from_depth()?;
        self.finish_in_flight()?;
        let splats = &self.splats;
        let position_of =
            |keyframe: &Arc<Keyframe>| self.views.iter().position(|view| Arc::ptr_eq(&view.keyframe, keyframe));
        let state = SavedState {
            options: self.options.clone().with(|options| {
                options.specific.coarse_steps = Some(self.coarse_steps);
                options.specific.seeds_per_image = Some(self.seeds_per_image);
            }),
            step: self.step,
            schedule_start: self.schedule_start,
            last_growth_step: self.last_growth_step,
            n_non_finite: u32::try_from(self.n_non_finite).unwrap_or(u32::MAX),
            n_splats: splats.n_splats,
            capacity: splats.capacity,
            sh_degree: splats.sh_degree,
            active_degree: splats.active_degree(),
            scene_size_m: self.scene_size_m,
            has_depth: self.has_depth,
            n_seeds: self.seeder.n_seeds() as u64,
            views: self.views.iter().map(|view| KeyframeSignature::of(&view.keyframe)).collect(),
            unseeded: self.unseeded.iter().filter_map(position_of).collect(),
            slots: self.cameras.slots(),
            params: self.cameras.set,
            remaining_trials: self.trials.remaining_trials(),
            finished_trials: self.trials.finished.clone(),
            is_aligned: self.alignment_task.is_done(),
            alignment: self.alignment_task.result().cloned(),
            trial: self.trials.running_trial().map(|(trial, baseline_db)| TrialState::of(trial, baseline_db)),
        };
        let state =
            serde_json::to_value(state).map_err(|error| Error::CheckpointState { reason: error.to_string() })?;
        let params = (&self.cameras.params, self.cameras.used_bytes());
        let mut halves = vec![PendingArrays::begin(&self.gpu, "", splats, &self.seeder, params)];
        if let Some((RunningTrial { other, .. }, _)) = self.trials.running_trial() {
            let params = (&other.cameras.1, other.cameras.1.bytes());
            halves.push(PendingArrays::begin(&self.gpu, OTHER, &other.splats, &other.seeding.seeder, params));
        }
        let gpu = self.gpu.clone();
        Ok(PendingCheckpoint::new(move || {
            let mut arrays = Vec::new();
            halves.into_iter().try_for_each(|half| half.finish(&gpu, &mut arrays))?;
            Ok(Checkpoint::new(METHOD, state, arrays))
        }))
    }

    /// Resumes from a checkpoint as if training had not been interrupted. All keyframes that were trained on must be
    /// among `keyframes`. Returns the other keyframes, to be pushed or kept for testing.
    ///
    /// # Errors
    ///
    /// Fails if the checkpoint is invalid, if keyframes are missing or differ, or if the GPU has too little memory.
    pub fn resume(
        gpu: Arc<Gpu>,
        checkpoint: &Checkpoint,
        keyframes: &[Arc<Keyframe>],
    ) -> Result<(Self, Vec<Arc<Keyframe>>), Error> {
        if checkpoint.method != METHOD {
            return Err(invalid_state(format!(
                "it was written by the method {:?}, expected {METHOD:?}",
                checkpoint.method
            )));
        }
        let state: SavedState =
            serde_json::from_value(checkpoint.state.clone()).map_err(|error| invalid_state(error.to_string()))?;
        let alignment_task = if state.is_aligned {
            AlignmentTask::Done(state.alignment.clone())
        } else {
            AlignmentTask::new(&state.options.common.align)
        };
        // In the second half of a trial, some keyframes have yet to arrive again; in the first half, they are views.
        let arrivals = || state.trial.iter().flat_map(|trial| &trial.arrivals).map(|arrival| &arrival.image);
        let is_second_half = state.trial.as_ref().is_some_and(|trial| trial.baseline_scores.is_some());
        let yet_to_arrive = arrivals().filter(|_| is_second_half);
        let known: Vec<KeyframeSignature> = state.views.iter().chain(yet_to_arrive).cloned().collect();
        let (mut views, untrained) =
            keyframe_signature::match_keyframes(&known, keyframes, |keyframe| alignment_task.corrected(keyframe))?;
        let yet_to_arrive = views.split_off(state.views.len());
        let arrived =
            arrivals().filter(|_| !is_second_half).map(|image| state.views.iter().position(|view| view == image));
        let arrived = arrived.map(|ix| views.get(ix?).cloned()).collect::<Option<Vec<_>>>();
        let arrived =
            arrived.ok_or_else(|| invalid_state("a view that arrived during a trial is missing".to_owned()))?;
        let arrivals = [arrived, yet_to_arrive].concat();
        let unseeded = state.unseeded.iter().map(|ix| views.get(*ix).cloned());
        let unseeded =
            unseeded.collect::<Option<Vec<_>>>().ok_or_else(|| invalid_state("a view is missing".to_owned()))?;
        let step = u32::try_from(state.step)
            .map_err(|_| invalid_state(format!("step {} does not fit into 32 bits", state.step)))?;

        let mut trainer = Self::new(gpu, state.options)?;
        let size = [state.n_splats, state.capacity, state.sh_degree, state.active_degree];
        trainer.splats = read_splats(&trainer.gpu, checkpoint, "", size)?;
        trainer.write_n_splats();
        for (ix, value) in [(status::STEP, step), (status::N_NON_FINITE, state.n_non_finite)] {
            trainer.gpu.write(&trainer.train_status, 4 * ix as u64, &value.to_le_bytes());
        }
        trainer.seeder = read_seeds(checkpoint, "", state.n_seeds)?;
        trainer.cameras.restore(&trainer.gpu, &state.slots, state.params, checkpoint)?;
        trainer.trials.restore(state.remaining_trials, state.finished_trials);
        if let Some(trial) = state.trial {
            let (trial, baseline_db) = trial.restored(&trainer.gpu, checkpoint, &arrivals)?;
            trainer.trials.restore_trial(trial, baseline_db);
        }
        trainer.views = views.into_iter().map(TrainView::new).collect();
        trainer.alignment_task = alignment_task;
        trainer.unseeded = unseeded;
        trainer.scene_size_m = state.scene_size_m;
        trainer.has_depth = state.has_depth;
        trainer.step = state.step;
        trainer.schedule_start = state.schedule_start;
        trainer.last_growth_step = state.last_growth_step;
        trainer.n_non_finite = state.n_non_finite.into();
        Ok((trainer, untrained))
    }
}

/// One buffer while it is copied to the host.
struct Planes {
    read: Option<PendingRead>,
    n_planes: usize,
    used_bytes: usize,
    stride_bytes: usize,
}

impl Planes {
    /// The used parts of all planes, concatenated.
    fn finish(self, gpu: &Gpu) -> Result<Vec<u8>, Error> {
        let Some(read) = self.read else { return Ok(Vec::new()) };
        let all: Vec<u8> = read.finish(gpu)?;
        if self.n_planes == 1 {
            return Ok(all);
        }
        let plane = |ix: usize| &all[ix * self.stride_bytes..][..self.used_bytes];
        Ok((0..self.n_planes).flat_map(plane).copied().collect())
    }
}

fn begin_read(gpu: &Gpu, buffer: &Buffer, n_planes: u32, bytes: u64, splats: &SplatBuffers) -> Option<PendingRead> {
    if n_planes == 0 || splats.n_splats == 0 {
        return None;
    }
    let n = u64::from(n_planes - 1) * u64::from(splats.capacity) + u64::from(splats.n_splats);
    Some(gpu.begin_read(buffer, to_usize(n * bytes / 4)))
}

fn invalid_state(reason: String) -> Error {
    Error::CheckpointState { reason }
}

fn to_usize(n_bytes: u64) -> usize {
    usize::try_from(n_bytes).expect("a buffer fits into memory")
}
