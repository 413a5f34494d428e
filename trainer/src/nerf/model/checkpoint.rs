//! Checkpoints of a field, and saved fields in folders.

use super::NerfModel;
use super::images::{FieldSnapshot, Trials};
use crate::keyframe_signature::{self, KeyframeSignature};
use crate::model_metadata::{METADATA_FILE, read_metadata};
use crate::model_options::{MethodOptions, ModelOptions};
use crate::nerf::extent::Extent;
use crate::nerf::field_trainer::FieldTrainer;
use crate::nerf::files::FIELD_FILE;
use crate::nerf::options::NerfOptions;
use crate::nerf::params::{IMAGE_PARAM_STRIDE, ImageParam};
use crate::nerf::rays::RayImage;
use crate::nerf::sizes::Sizes;
use crate::pending::PendingCheckpoint;
use crate::{Error, Method};
use calibration::ParamSet;
use calibration::TrialReport;
use gpu::{Buffer, Gpu, PendingRead};
use keyframe::Keyframe;
use model_files::checkpoint::{Array, Checkpoint};
use serde::{Deserialize, Serialize};
use std::path::Path;
use std::sync::Arc;

const METHOD: &str = NerfOptions::METHOD;
/// Name of the array of image parameters.
const IMAGE_PARAMS: &str = "image_params";

/// The state without its arrays.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct NerfState {
    options: ModelOptions<NerfOptions>,
    step: u64,
    images: Vec<KeyframeSignature>,
    is_extent_stale: bool,
    n_hinted: usize,
    /// `None` before a field exists.
    field: Option<(Extent, Sizes)>,
    /// Image parameters that are optimized together with the field.
    learned_params: ParamSet,
    are_trials_finished: bool,
    trials: Vec<TrialReport>,
    n_discarded_steps: u64,
    /// Number of images that the parameter array can hold.
    image_capacity: Option<u32>,
}

fn to_json(state: &NerfState) -> Result<serde_json::Value, Error> {
    serde_json::to_value(state).map_err(|error| invalid_state(error.to_string()))
}

fn invalid_state(reason: String) -> Error {
    Error::CheckpointState { reason }
}

fn write_error(path: &Path, source: std::io::Error) -> Error {
    Error::Write {
        path: path.to_owned(),
        source,
    }
}

impl FieldSnapshot {
    /// Number of images that the parameter array can hold.
    fn image_capacity(&self) -> Option<u32> {
        let image_params = self
            .arrays
            .iter()
            .find(|array| array.name == IMAGE_PARAMS)?;
        u32::try_from(image_params.bytes.len() / (IMAGE_PARAM_STRIDE * size_of::<ImageParam>()))
            .ok()
    }
}

impl FieldTrainer {
    /// Buffers needed for rendering, by name.
    fn render_buffers(&self) -> Vec<(String, &Buffer)> {
        [
            ("grid", &self.field.grid),
            ("occupied", &self.occupancy.occupied),
            ("weights", &self.field.weights),
        ]
        .map(|(name, buffer)| (name.to_owned(), buffer))
        .to_vec()
    }

    /// Buffers needed to continue training, by name.
    fn training_buffers(&self) -> Vec<(String, &Buffer)> {
        // Gradients are not stored, because they are zero between steps.
        let mut all = self.render_buffers();
        all.extend(
            [
                ("grid_moments", &self.moments.grid),
                ("weight_moments", &self.moments.weights),
                ("scales", &self.gradients.scales),
                ("counts", &self.gradients.counts),
                ("steps", &self.moments.steps),
                ("step_scale", &self.moments.step_scale),
                ("cell_occupancy", &self.occupancy.cell_occupancy),
            ]
            .map(|(name, buffer)| (name.to_owned(), buffer)),
        );
        all.extend(
            self.images
                .iter()
                .map(|images| (IMAGE_PARAMS.to_owned(), &images.image_params)),
        );
        all
    }
}

/// Starts reading buffers back to the host.
fn begin_read(gpu: &Gpu, buffers: Vec<(String, &Buffer)>) -> Vec<(String, PendingRead)> {
    buffers
        .into_iter()
        .map(|(name, buffer)| {
            let n_words = usize::try_from(buffer.bytes() / 4).expect("a buffer fits into memory");
            (name, gpu.begin_read(buffer, n_words))
        })
        .collect()
}

fn finish(gpu: &Gpu, reads: Vec<(String, PendingRead)>) -> Result<Vec<Array>, Error> {
    reads
        .into_iter()
        .map(|(name, read)| {
            Ok(Array {
                name,
                bytes: read.finish(gpu)?,
            })
        })
        .collect()
}

impl NerfModel {
    fn state(&self) -> Result<NerfState, Error> {
        Ok(NerfState {
            // The state contains the sizes in use, because another adapter would choose other
            // sizes.
            options: self.options.clone().with(|options| {
                let nerf_budget = options.specific.budget_or_default(self.gpu.is_software());
                options.specific.nerf_budget = Some(nerf_budget);
            }),
            step: self.step,
            images: self
                .images
                .iter()
                .map(|image| KeyframeSignature::of(&image.keyframe))
                .collect(),
            is_extent_stale: self.is_extent_stale,
            n_hinted: self.n_hinted,
            field: self
                .field
                .as_ref()
                .map(|(extent, field_trainer)| (*extent, field_trainer.sizes.clone())),
            learned_params: self.learned_params,
            are_trials_finished: self.trials.are_finished(),
            trials: self.trials.finished.clone(),
            n_discarded_steps: self.n_discarded_steps,
            image_capacity: self
                .field
                .as_ref()
                .and_then(|(_, field_trainer)| Some(field_trainer.images.as_ref()?.n_images)),
        })
    }

    /// Snapshot of the field. No submit may be in flight.
    pub(super) fn snapshot(&self) -> Result<FieldSnapshot, Error> {
        let reads = self
            .field
            .as_ref()
            .map_or(Vec::new(), |(_, field_trainer)| {
                begin_read(&self.gpu, field_trainer.training_buffers())
            });
        Ok(FieldSnapshot {
            arrays: finish(&self.gpu, reads)?,
            step: self.step,
            n_hinted: self.n_hinted,
            learned_params: self.learned_params,
        })
    }

    /// Restores a snapshot. No submit may be in flight.
    pub(super) fn restore(&mut self, snapshot: &FieldSnapshot) -> Result<(), Error> {
        self.step = snapshot.step;
        self.learned_params = snapshot.learned_params;
        // Images may have arrived since. Their hints are added again.
        self.n_hinted = snapshot.n_hinted.min(self.images.len());
        self.is_extent_stale |= self.n_hinted < self.images.len();
        self.corrections = None;
        let Some((_, field_trainer)) = &mut self.field else {
            return Ok(());
        };
        // The buffer of image parameters may have been created or enlarged since.
        match snapshot.image_capacity() {
            Some(image_capacity) => field_trainer.allocate_images(
                &self.gpu,
                image_capacity as usize,
                snapshot.learned_params,
            )?,
            None => field_trainer.drop_images(),
        }
        for (name, buffer) in field_trainer.training_buffers() {
            if let Some(array) = snapshot.arrays.iter().find(|array| array.name == name) {
                self.gpu.write(buffer, 0, &array.bytes);
            }
        }
        Ok(())
    }

    /// During a trial, saves the state from before the trial. The trial restarts after resuming.
    pub(super) fn take_checkpoint(&mut self) -> Result<PendingCheckpoint, Error> {
        self.finish_in_flight()?;
        let gpu = self.gpu.clone();
        let mut state = self.state()?;
        if let Some(before) = self.trials.before() {
            state.step = before.step;
            state.learned_params = before.learned_params;
            state.image_capacity = before.image_capacity();
            state.n_hinted = before.n_hinted.min(self.images.len());
            state.is_extent_stale |= state.n_hinted < self.images.len();
            let state = to_json(&state)?;
            let arrays = before.arrays.clone();
            return Ok(PendingCheckpoint::new(move || {
                Ok(Checkpoint::new(METHOD, state, arrays))
            }));
        }
        let state = to_json(&state)?;
        // The copies are queued now, before later steps. Waiting for the copies is deferred.
        let reads = self
            .field
            .as_ref()
            .map_or(Vec::new(), |(_, field_trainer)| {
                begin_read(&gpu, field_trainer.training_buffers())
            });
        Ok(PendingCheckpoint::new(move || {
            Ok(Checkpoint::new(METHOD, state, finish(&gpu, reads)?))
        }))
    }

    /// Restores a model from a checkpoint with the given subset of buffers, without keyframes.
    fn of_state(
        gpu: Arc<Gpu>,
        checkpoint: &Checkpoint,
        buffers: impl Fn(&FieldTrainer) -> Vec<(String, &Buffer)>,
    ) -> Result<(Self, NerfState), Error> {
        if checkpoint.method != METHOD {
            return Err(invalid_state(format!(
                "it was written by method {:?}",
                checkpoint.method
            )));
        }
        let state: NerfState = serde_json::from_value(checkpoint.state.clone())
            .map_err(|error| invalid_state(error.to_string()))?;
        let mut model = Self::new(gpu, state.options.clone())?;
        if let Some((extent, sizes)) = &state.field {
            // Buffers have the sizes in the state, and each array must have the size of its buffer.
            sizes.check()?;
            let compiled = model.compiled()?;
            let mut field_trainer =
                FieldTrainer::new(&model.gpu, &model.options, sizes.clone(), compiled)?;
            if let Some(image_capacity) = state.image_capacity {
                field_trainer.allocate_images(
                    &model.gpu,
                    image_capacity as usize,
                    state.learned_params,
                )?;
            }
            for (name, buffer) in buffers(&field_trainer) {
                model
                    .gpu
                    .write(buffer, 0, checkpoint.array(&name, buffer.bytes())?);
            }
            model.field = Some((*extent, field_trainer));
        }
        model.step = state.step;
        model.n_discarded_steps = state.n_discarded_steps;
        model.learned_params = state.learned_params;
        model.trials = Trials::of(&state.options.common.cameras)
            .after(state.trials.clone(), state.are_trials_finished);
        Ok((model, state))
    }

    /// Resumes training exactly where the checkpoint was taken. `keyframes` must include all
    /// keyframes that the model was trained on. Also returns the other keyframes, to be pushed or
    /// kept for testing.
    pub fn resume(
        gpu: Arc<Gpu>,
        checkpoint: &Checkpoint,
        keyframes: &[Arc<Keyframe>],
    ) -> Result<(Self, Vec<Arc<Keyframe>>), Error> {
        let (mut model, state) = Self::of_state(gpu, checkpoint, FieldTrainer::training_buffers)?;
        // The images are in the order of their parameters on the GPU.
        let (images, rest) = keyframe_signature::match_keyframes(&state.images, keyframes)?;
        model.images = images.into_iter().map(RayImage::new).collect();
        model.is_extent_stale = state.is_extent_stale;
        model.n_hinted = state.n_hinted.min(model.images.len());
        Ok((model, rest))
    }

    /// Loads a saved field for rendering.
    pub fn load(gpu: Arc<Gpu>, folder: &Path) -> Result<Self, Error> {
        let checkpoint = Checkpoint::read(&folder.join(FIELD_FILE))?;
        let mut model = Self::of_state(gpu, &checkpoint, FieldTrainer::render_buffers)?.0;
        model.loaded_corrections = read_metadata(folder)?.cameras;
        Ok(model)
    }

    pub(super) fn write_folder(&mut self, folder: &Path) -> Result<(), Error> {
        self.finish_in_flight()?;
        std::fs::create_dir_all(folder).map_err(|source| write_error(folder, source))?;
        let reads = self
            .field
            .as_ref()
            .map_or(Vec::new(), |(_, field_trainer)| {
                begin_read(&self.gpu, field_trainer.render_buffers())
            });
        let state = to_json(&self.state()?)?;
        let arrays = finish(&self.gpu, reads)?;
        let cameras = self.camera_corrections()?;
        Checkpoint::new(METHOD, state, arrays).write(&folder.join(FIELD_FILE))?;
        let sizes = self
            .field
            .as_ref()
            .map(|(_, field_trainer)| &field_trainer.sizes);
        let description = serde_json::json!({
            "method": METHOD,
            "steps": self.step,
            "entries": self.progress().primitives,
            "levels": sizes.map(|sizes| &sizes.n_cells),
            "extent": self.extent(),
            "cameras": cameras,
        });
        let path = folder.join(METADATA_FILE);
        files::write(&path, format!("{description:#}\n"))
            .map_err(|source| write_error(&path, source))
    }
}
