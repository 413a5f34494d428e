//! The state of a splat model in training: all that decides how it goes on, bit for bit.

use super::SplatTrainer;
use crate::align::{Aligning, Alignment};
use crate::checkpoint::{Array, Checkpoint, PendingCheckpoint};
use crate::gpu::{Gpu, PendingRead};
use crate::seen::{self, Seen};
use crate::splat::buffers::{N_PLANED, SplatBuffers};
use crate::splat::camera_terms::{CameraSlots, TermSet};
use crate::splat::options::SplatOptions;
use crate::splat::params::status;
use crate::splat::seed::Seeder;
use crate::splat::trials::{Trial, Untried};
use crate::splat::views::TrainView;
use crate::{Error, Keyframe};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

const METHOD: &str = "splat";
/// Names of the arrays, in the order of [`SplatBuffers::planes`].
const ARRAYS: [&str; N_PLANED] =
    ["means", "rotations", "shapes", "sh_dc", "sh_rest", "moments", "sh_dc_moments", "sh_rest_moments", "error_sums"];
const SEED_PLACES: &str = "seed_places";
const SEED_CELLS: &str = "seed_cells";
const CAMERA_TERMS: &str = "camera_terms";

/// All but the arrays.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct State {
    /// As they were settled for the adapter.
    options: SplatOptions,
    step: u64,
    schedule_start: u64,
    grown_at: u64,
    n_poisoned: u32,
    n_splats: u32,
    capacity: u32,
    sh_degree: u32,
    active_degree: u32,
    scene_size_m: f64,
    has_depth: bool,
    n_seeds: u64,
    /// What is learned from, in order: the order decides which view comes when.
    views: Vec<Seen>,
    /// Which of them wait to be given splats.
    unseeded: Vec<usize>,
    /// Where the terms of cameras and images lie.
    slots: CameraSlots,
    /// What is learned about cameras, and what is still to be tried.
    terms: TermSet,
    untried: Untried,
    tried: Vec<Trial>,
    /// Whether alignment is settled, and what it found; views are told as it corrected them.
    is_aligned: bool,
    alignment: Option<Alignment>,
}

impl SplatTrainer {
    /// Takes the state as it is after every step queued so far. The model is only copied within the GPU here;
    /// [`PendingCheckpoint::finish`], on any thread, brings it to the host.
    pub(super) fn take_checkpoint(&mut self) -> Result<PendingCheckpoint, Error> {
        self.seed_from_depth()?;
        self.settle()?;
        // A trial that has not ended is forgotten: it begins anew where training goes on.
        let undecided = self.trials.instead();
        let (splats, step, grown_at) = undecided
            .map_or((&self.splats, self.step, self.grown_at), |state| (&state.splats, state.step, state.grown_at));
        let (terms, term_buffer) =
            undecided.map_or((self.cameras.set, &self.cameras.terms), |state| (state.cameras.0, &state.cameras.1));
        let place = |keyframe: &Arc<Keyframe>| self.views.iter().position(|view| Arc::ptr_eq(&view.keyframe, keyframe));
        let state = State {
            options: SplatOptions {
                coarse_steps: Some(self.coarse_steps),
                seeds_per_image: Some(self.seeds_per_image),
                ..self.options.clone()
            },
            step,
            schedule_start: self.schedule_start,
            grown_at,
            n_poisoned: u32::try_from(self.n_poisoned).unwrap_or(u32::MAX),
            n_splats: splats.n_splats,
            capacity: splats.capacity,
            sh_degree: splats.sh_degree,
            active_degree: splats.active_degree(),
            scene_size_m: self.scene_size_m,
            has_depth: self.has_depth,
            n_seeds: self.seeder.n_seeds() as u64,
            views: self.views.iter().map(|view| Seen::of(&view.keyframe)).collect(),
            unseeded: self.unseeded.iter().filter_map(place).collect(),
            slots: self.cameras.slots(),
            terms,
            untried: self.trials.untried(),
            tried: self.trials.ended.clone(),
            is_aligned: self.aligning.is_done(),
            alignment: self.aligning.result().cloned(),
        };
        let state =
            serde_json::to_value(state).map_err(|error| Error::CheckpointState { reason: error.to_string() })?;
        let planes = splats.planes().map(|(buffer, n_planes, bytes)| Planes {
            read: begin_read(&self.gpu, buffer, n_planes, bytes, splats),
            n_planes: n_planes as usize,
            used_bytes: splats.n_splats as usize * to_usize(bytes),
            stride_bytes: splats.capacity as usize * to_usize(bytes),
        });
        let term_words = to_usize(self.cameras.used_bytes().min(term_buffer.bytes()) / 4);
        let terms = (term_words > 0).then(|| self.gpu.begin_read(term_buffer, term_words));
        let (gpu, seeds) = (self.gpu.clone(), self.seeder.remembered());
        Ok(PendingCheckpoint::new(move || {
            let mut arrays = Vec::new();
            for (name, planes) in ARRAYS.into_iter().zip(planes) {
                arrays.push(Array { name: name.to_owned(), bytes: planes.finish(&gpu)? });
            }
            let (places, cells) = seeds.into_bytes();
            arrays.push(Array { name: SEED_PLACES.to_owned(), bytes: places });
            arrays.push(Array { name: SEED_CELLS.to_owned(), bytes: cells });
            let terms: Vec<u8> = terms.map_or(Ok(Vec::new()), |read| read.finish(&gpu))?;
            arrays.push(Array { name: CAMERA_TERMS.to_owned(), bytes: terms });
            Ok(Checkpoint::new(METHOD, state, arrays))
        }))
    }

    /// Goes on from a checkpoint as if training had not stopped. What it had learned from must be among `keyframes`; the
    /// others come back, to be pushed or kept for testing.
    pub fn resume(
        gpu: Arc<Gpu>,
        checkpoint: &Checkpoint,
        keyframes: &[Arc<Keyframe>],
    ) -> Result<(Self, Vec<Arc<Keyframe>>), Error> {
        if checkpoint.method != METHOD {
            return Err(bad_state(format!("it is of the method {:?}", checkpoint.method)));
        }
        let state: State =
            serde_json::from_value(checkpoint.state.clone()).map_err(|error| bad_state(error.to_string()))?;
        let aligning = if state.is_aligned {
            Aligning::Done(state.alignment.clone())
        } else {
            Aligning::new(&state.options.align)
        };
        let (views, rest) = seen::matched(&state.views, keyframes, |keyframe| aligning.corrected(keyframe))?;
        let n_splats = state.n_splats;
        if n_splats > state.capacity || state.active_degree > state.sh_degree || state.sh_degree > 3 {
            return Err(bad_state(format!("{n_splats} splats of degree {} do not fit", state.active_degree)));
        }
        let unseeded = state.unseeded.iter().map(|ix| views.get(*ix).cloned());
        let unseeded = unseeded.collect::<Option<Vec<_>>>().ok_or_else(|| bad_state("a view is missing".to_owned()))?;
        let step = u32::try_from(state.step).map_err(|_| bad_state(format!("step {}", state.step)))?;

        let mut trainer = Self::new(gpu, state.options)?;
        trainer.splats = SplatBuffers::new(&trainer.gpu, state.capacity, state.sh_degree)?;
        for (name, (buffer, n_planes, bytes)) in ARRAYS.into_iter().zip(trainer.splats.planes()) {
            let used_bytes = u64::from(n_splats) * bytes;
            let array = checkpoint.array(name, u64::from(n_planes) * used_bytes)?;
            for plane in 0..u64::from(n_planes) {
                let from = to_usize(plane * used_bytes);
                let at = plane * u64::from(state.capacity) * bytes;
                trainer.gpu.write(buffer, at, &array[from..from + to_usize(used_bytes)]);
            }
        }
        trainer.splats.set_active_degree(&trainer.gpu, state.active_degree);
        trainer.splats.set_n(&trainer.gpu, n_splats);
        trainer.tell_n();
        for (ix, value) in [(status::STEP, step), (status::N_POISONED, state.n_poisoned)] {
            trainer.gpu.write(&trainer.learn_status, 4 * ix as u64, &value.to_le_bytes());
        }
        let places = checkpoint.array(SEED_PLACES, state.n_seeds * Seeder::PLACE_BYTES)?;
        trainer.seeder = Seeder::of_bytes(places, checkpoint.array(SEED_CELLS, state.n_seeds * Seeder::CELL_BYTES)?);
        trainer.cameras.restore(&trainer.gpu, &state.slots, state.terms, checkpoint)?;
        trainer.trials.restore(state.untried, state.tried);
        trainer.views = views.into_iter().map(TrainView::new).collect();
        trainer.aligning = aligning;
        trainer.unseeded = unseeded;
        trainer.scene_size_m = state.scene_size_m;
        trainer.has_depth = state.has_depth;
        trainer.step = state.step;
        trainer.schedule_start = state.schedule_start;
        trainer.grown_at = state.grown_at;
        trainer.n_poisoned = state.n_poisoned.into();
        Ok((trainer, rest))
    }
}

/// One buffer on its way to the host.
struct Planes {
    read: Option<PendingRead>,
    n_planes: usize,
    used_bytes: usize,
    stride_bytes: usize,
}

impl Planes {
    /// The used part of every plane, one after the other.
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

fn begin_read(
    gpu: &Gpu,
    buffer: &crate::gpu::Buffer,
    n_planes: u32,
    bytes: u64,
    splats: &SplatBuffers,
) -> Option<PendingRead> {
    if n_planes == 0 || splats.n_splats == 0 {
        return None;
    }
    let n = u64::from(n_planes - 1) * u64::from(splats.capacity) + u64::from(splats.n_splats);
    Some(gpu.begin_read(buffer, to_usize(n * bytes / 4)))
}

fn bad_state(reason: String) -> Error {
    Error::CheckpointState { reason }
}

fn to_usize(n_bytes: u64) -> usize {
    usize::try_from(n_bytes).expect("a buffer fits into memory")
}
