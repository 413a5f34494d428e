//! The state of a field on the way, and a field in a folder.

use super::NerfModel;
use super::images::{Saved, Trials};
use crate::checkpoint::{Array, Checkpoint, PendingCheckpoint};
use crate::gpu::{Buffer, Gpu, PendingRead};
use crate::nerf::extent::Extent;
use crate::nerf::learner::Learner;
use crate::nerf::options::NerfOptions;
use crate::nerf::params::{TERM_STRIDE, Term};
use crate::nerf::rays::RayImage;
use crate::nerf::sizes::Sizes;
use crate::seen::{self, Seen};
use crate::splat::{TermSet, read_about};
use crate::{Error, Keyframe, Method, Part};
use serde::{Deserialize, Serialize};
use std::path::Path;
use std::sync::Arc;

const METHOD: &str = "nerf";
/// What is learned of images.
const TERMS: &str = "terms";
/// The field: a checkpoint of what pictures need.
const FIELD: &str = "field.nerf";

/// All but the arrays.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct State {
    options: NerfOptions,
    step: u64,
    images: Vec<Seen>,
    is_extent_due: bool,
    n_hinted: usize,
    /// Where there is a field.
    field: Option<(Extent, Sizes)>,
    /// Of images, along with the field.
    learned: TermSet,
    are_trials_over: bool,
    parts: Vec<Part>,
    n_taken_back: u64,
    /// How many images there is room for in what is learned of them.
    n_terms: Option<u32>,
}

fn written(state: &State) -> Result<serde_json::Value, Error> {
    serde_json::to_value(state).map_err(|error| bad_state(error.to_string()))
}

fn bad_state(reason: String) -> Error {
    Error::CheckpointState { reason }
}

impl Saved {
    /// How many images there is room for in what is learned of them.
    fn n_terms(&self) -> Option<u32> {
        let terms = self.arrays.iter().find(|array| array.name == TERMS)?;
        u32::try_from(terms.bytes.len() / (TERM_STRIDE * size_of::<Term>())).ok()
    }
}

impl Learner {
    /// What pictures need, by name.
    fn drawn(&self) -> Vec<(String, &Buffer)> {
        [("grid", &self.field.grid), ("occupied", &self.occupancy.occupied), ("weights", &self.field.weights)]
            .map(|(name, buffer)| (name.to_owned(), buffer))
            .to_vec()
    }

    /// All that decides how it goes on, by name.
    fn learned(&self) -> Vec<(String, &Buffer)> {
        let mut all = self.drawn();
        all.extend(
            [
                ("grid_moments", &self.moments.grid),
                ("weight_moments", &self.moments.weights),
                ("scales", &self.slopes.scales),
                ("counts", &self.slopes.counts),
                ("steps", &self.moments.steps),
                ("pace", &self.moments.pace),
                ("thickness", &self.occupancy.thickness),
            ]
            .map(|(name, buffer)| (name.to_owned(), buffer)),
        );
        all.extend(self.images.iter().map(|images| (TERMS.to_owned(), &images.terms)));
        all
    }
}

/// Buffers on their way to the host.
fn begin_read(gpu: &Gpu, buffers: Vec<(String, &Buffer)>) -> Vec<(String, PendingRead)> {
    let read = |buffer: &Buffer| {
        gpu.begin_read(buffer, usize::try_from(buffer.bytes() / 4).expect("a buffer fits into memory"))
    };
    buffers.into_iter().map(|(name, buffer)| (name, read(buffer))).collect()
}

fn finish(gpu: &Gpu, reads: Vec<(String, PendingRead)>) -> Result<Vec<Array>, Error> {
    reads.into_iter().map(|(name, read)| Ok(Array { name, bytes: read.finish(gpu)? })).collect()
}

impl NerfModel {
    /// Whether a folder holds a saved field.
    pub fn is_saved_in(folder: &Path) -> bool {
        folder.join(FIELD).is_file()
    }

    fn state(&self) -> Result<State, Error> {
        Ok(State {
            options: NerfOptions { effort: Some(self.effort()), ..self.options.clone() },
            step: self.step,
            images: self.images.iter().map(|image| Seen::of(&image.keyframe)).collect(),
            is_extent_due: self.is_extent_due,
            n_hinted: self.n_hinted,
            field: self.field.as_ref().map(|(extent, learner)| (*extent, learner.sizes.clone())),
            learned: self.learned,
            are_trials_over: self.trials.are_over(),
            parts: self.trials.ended.clone(),
            n_taken_back: self.n_taken_back,
            n_terms: self.field.as_ref().and_then(|(_, learner)| Some(learner.images.as_ref()?.n_images)),
        })
    }

    /// The field as it is; what was sent must be done.
    pub(super) fn saved(&self) -> Result<Saved, Error> {
        let reads = self.field.as_ref().map_or(Vec::new(), |(_, learner)| begin_read(&self.gpu, learner.learned()));
        let (step, n_hinted, learned) = (self.step, self.n_hinted, self.learned);
        Ok(Saved { arrays: finish(&self.gpu, reads)?, step, n_hinted, learned })
    }

    /// Makes the field what it was; what was sent must be done.
    pub(super) fn put_back(&mut self, saved: &Saved) -> Result<(), Error> {
        (self.step, self.learned) = (saved.step, saved.learned);
        self.n_hinted = saved.n_hinted.min(self.images.len());
        self.is_extent_due |= self.n_hinted < self.images.len(); // Their hints are added again.
        self.fixes = None;
        let Some((_, learner)) = &mut self.field else { return Ok(()) };
        match saved.n_terms() {
            Some(n_terms) => learner.hold_images(&self.gpu, n_terms as usize, saved.learned)?,
            None => learner.forget_images(),
        }
        for (name, buffer) in learner.learned() {
            if let Some(array) = saved.arrays.iter().find(|array| array.name == name) {
                self.gpu.write(buffer, 0, &array.bytes);
            }
        }
        Ok(())
    }

    /// In the midst of a trial the state from before it, with which the trial begins again.
    pub(super) fn take_checkpoint(&mut self) -> Result<PendingCheckpoint, Error> {
        self.settle()?;
        let (gpu, mut state) = (self.gpu.clone(), self.state()?);
        if let Some(before) = self.trials.before() {
            (state.step, state.learned, state.n_terms) = (before.step, before.learned, before.n_terms());
            state.n_hinted = before.n_hinted.min(self.images.len());
            state.is_extent_due |= state.n_hinted < self.images.len();
            let (state, arrays) = (written(&state)?, before.arrays.clone());
            return Ok(PendingCheckpoint::new(move || Ok(Checkpoint::new(METHOD, state, arrays))));
        }
        let state = written(&state)?;
        let reads = self.field.as_ref().map_or(Vec::new(), |(_, learner)| begin_read(&gpu, learner.learned()));
        Ok(PendingCheckpoint::new(move || Ok(Checkpoint::new(METHOD, state, finish(&gpu, reads)?))))
    }

    /// The model that a checkpoint holds with some of its buffers, without keyframes.
    fn of_state(
        gpu: Arc<Gpu>,
        checkpoint: &Checkpoint,
        buffers: impl Fn(&Learner) -> Vec<(String, &Buffer)>,
    ) -> Result<(Self, State), Error> {
        if checkpoint.method != METHOD {
            return Err(bad_state(format!("it is of the method {:?}", checkpoint.method)));
        }
        let state: State =
            serde_json::from_value(checkpoint.state.clone()).map_err(|error| bad_state(error.to_string()))?;
        let mut model = Self::new(gpu, state.options.clone())?;
        if let Some((extent, sizes)) = &state.field {
            sizes.check()?;
            let compiled = model.compiled()?;
            let mut learner = Learner::new(&model.gpu, &model.options, sizes.clone(), compiled)?;
            if let Some(n_terms) = state.n_terms {
                learner.hold_images(&model.gpu, n_terms as usize, state.learned)?;
            }
            for (name, buffer) in buffers(&learner) {
                model.gpu.write(buffer, 0, checkpoint.array(&name, buffer.bytes())?);
            }
            model.field = Some((*extent, learner));
        }
        model.step = state.step;
        model.n_taken_back = state.n_taken_back;
        model.learned = state.learned;
        model.trials = Trials::of(&state.options.cameras).after(state.parts.clone(), state.are_trials_over);
        Ok((model, state))
    }

    /// Goes on from a checkpoint as if learning had not stopped. What it had learned from must be among `keyframes`; the
    /// others come back, to be pushed or kept for testing.
    pub fn resume(
        gpu: Arc<Gpu>,
        checkpoint: &Checkpoint,
        keyframes: &[Arc<Keyframe>],
    ) -> Result<(Self, Vec<Arc<Keyframe>>), Error> {
        let (mut model, state) = Self::of_state(gpu, checkpoint, Learner::learned)?;
        let (images, rest) = seen::matched(&state.images, keyframes, Arc::clone)?;
        model.images = images.into_iter().map(RayImage::new).collect();
        model.is_extent_due = state.is_extent_due;
        model.n_hinted = state.n_hinted.min(model.images.len());
        Ok((model, rest))
    }

    /// A saved field, to be drawn.
    pub fn load(gpu: Arc<Gpu>, folder: &Path) -> Result<Self, Error> {
        let checkpoint = Checkpoint::read(&folder.join(FIELD))?;
        let mut model = Self::of_state(gpu, &checkpoint, Learner::drawn)?.0;
        model.loaded_fixes = read_about(&folder.join("model.json"))?.cameras;
        Ok(model)
    }

    pub(super) fn write_folder(&mut self, folder: &Path) -> Result<(), Error> {
        self.settle()?;
        let refused = |path: &Path, source| Error::Write { path: path.to_owned(), source };
        std::fs::create_dir_all(folder).map_err(|source| refused(folder, source))?;
        let reads = self.field.as_ref().map_or(Vec::new(), |(_, learner)| begin_read(&self.gpu, learner.drawn()));
        let (state, arrays) = (written(&self.state()?)?, finish(&self.gpu, reads)?);
        let cameras = self.camera_fixes()?.clone();
        Checkpoint::new(METHOD, state, arrays).write(&folder.join(FIELD))?;
        let sizes = self.field.as_ref().map(|(_, learner)| &learner.sizes);
        let about = serde_json::json!({
            "method": METHOD,
            "steps": self.step,
            "entries": self.progress().primitives,
            "levels": sizes.map(|sizes| &sizes.n_cells),
            "extent": self.extent(),
            "cameras": cameras,
        });
        let path = folder.join("model.json");
        std::fs::write(&path, format!("{about:#}\n")).map_err(|source| refused(&path, source))
    }
}
