//! The neural radiance field as a [`Method`].

mod checkpoint;
mod images;

use super::carve;
use super::extent::Extent;
use super::field_trainer::{Compiled, FieldTrainer, STEPS_PER_SUBMIT};
use super::options::NerfOptions;
use super::rays::{self, RayImage, RaySampling};
use super::sizes::Sizes;
use crate::corrected_keyframe::replacement;
use crate::model_options::{CommonOptions, ModelOptions};
use crate::packing::{Format, Output};
use crate::pending::PendingCheckpoint;
use crate::view::Camera;
use crate::{
    Bounds, CorrectedKeyframe, Error, Method, Packing, Picture, Progress, RenderRequest, Rendered,
};
use calibration::Alignment;
use calibration::TrialReport;
use calibration::{CameraCorrection, EMBEDDING_DIM, ParamSet};
use gpu::{Gpu, PassTiming, Submits};
use images::Trials;
use keyframe::{Keyframe, Split};
use kinematics::Stamp;
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::ops::Range;
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

/// Distance at which rays begin, in units of the scene radius. If rays began closer to the camera,
/// the field could explain single images by fog in front of their cameras.
const NEAR_DISTANCE: f32 = 0.03;
/// Occupancy cells are refined after this fraction (1 / divisor) of the planned steps. This is
/// before the first trial, because trials compare fields of the same size. With refined cells from
/// the start, the PSNR was 18.0 instead of 25.1 dB after 1 s. Without refinement, the static arm
/// reached 30.0 instead of 31.7 dB after 8 s (`docs/benchmarks/2026-11-23-nerf.md`).
const REFINE_DIVISOR: u64 = 10;
/// Depth stride on a software adapter, where a 640x480 picture takes tens of seconds early in
/// training. Every ninth pixel is enough for depth.
const SOFTWARE_DEPTH_STRIDE: u32 = 3;

/// A neural radiance field trained on keyframes: a hash grid and two small networks, rendered along
/// rays.
#[derive(Debug)]
pub struct NerfModel {
    gpu: Arc<Gpu>,
    options: ModelOptions<NerfOptions>,
    images: Vec<RayImage>,
    field: Option<(Extent, FieldTrainer)>,
    /// Shared by all fields that this model creates.
    compiled: Option<Arc<Compiled>>,
    /// Whether keyframes were added since the extent was last computed.
    is_extent_stale: bool,
    /// Number of leading images whose hints were applied to the field.
    n_hinted: usize,
    submits: Submits,
    /// Image parameters that are optimized together with the field.
    learned_params: ParamSet,
    trials: Trials,
    /// Validation images, used for training after all trials are finished.
    validation_images: Vec<RayImage>,
    /// Camera corrections of a loaded field.
    loaded_corrections: BTreeMap<String, CameraCorrection>,
    /// Camera corrections after the last step. `None` if they must be recomputed.
    corrections: Option<BTreeMap<String, CameraCorrection>>,
    step: u64,
    /// Steps of rejected trials.
    n_discarded_steps: u64,
}

impl NerfModel {
    /// A model without keyframes.
    pub fn new(gpu: Arc<Gpu>, options: ModelOptions<NerfOptions>) -> Result<Self, Error> {
        Ok(Self {
            gpu,
            learned_params: images::image_params_of_set(options.common.cameras.always()),
            trials: Trials::of(&options.common.cameras),
            options,
            images: Vec::new(),
            validation_images: Vec::new(),
            loaded_corrections: BTreeMap::new(),
            corrections: None,
            n_discarded_steps: 0,
            field: None,
            compiled: None,
            is_extent_stale: false,
            n_hinted: 0,
            submits: Submits::default(),
            step: 0,
        })
    }

    /// Options of this model.
    pub fn options(&self) -> &ModelOptions<NerfOptions> {
        &self.options
    }

    /// Extent of the scene. `None` before training starts.
    pub fn extent(&self) -> Option<&Extent> {
        self.field.as_ref().map(|(extent, _)| extent)
    }

    /// Correction of each camera. It is empty if no corrections are optimized or loaded.
    fn current_corrections(&mut self) -> Result<&BTreeMap<String, CameraCorrection>, Error> {
        if self.corrections.is_none() {
            self.finish_in_flight()?;
            self.corrections = Some(self.learned_corrections()?);
        }
        Ok(self
            .corrections
            .as_ref()
            .filter(|corrections| !corrections.is_empty())
            .unwrap_or(&self.loaded_corrections))
    }

    /// Creates a field if there is none or if the scene has outgrown it, and refines its cells when
    /// due. Returns whether there are images to train on.
    fn begin(&mut self) -> Result<bool, Error> {
        if self.images.is_empty() {
            return Ok(false);
        }
        if std::mem::take(&mut self.is_extent_stale) || self.field.is_none() {
            // Depth is reprojected here on all cores. Otherwise, the first ray of an image would
            // cause it, on a single core.
            self.images.par_iter().for_each(|image| {
                image.depth_m();
            });
            self.fit_extent()?;
            self.hint()?;
        }
        self.refine_cells_when_due()?;
        Ok(true)
    }

    /// Returns the kernels, compiling them on first use.
    fn compiled(&mut self) -> Result<Arc<Compiled>, Error> {
        if let Some(compiled) = &self.compiled {
            return Ok(compiled.clone());
        }
        let nerf_budget = self
            .options
            .specific
            .budget_or_default(self.gpu.is_software());
        let compiled = Arc::new(Compiled::new(&self.gpu, &nerf_budget)?);
        self.compiled = Some(compiled.clone());
        Ok(compiled)
    }

    /// Creates a field for the extent of the current images, if there is none or if they have
    /// outgrown it.
    fn fit_extent(&mut self) -> Result<(), Error> {
        let keyframes = || self.images.iter().map(|image| &*image.keyframe);
        let extent = Extent::of(keyframes());
        let sizes = Sizes::choose(
            &self.options,
            self.options
                .specific
                .budget_or_default(self.gpu.is_software()),
            self.gpu.max_binding_bytes(),
            keyframes(),
            &extent,
        )?;
        if self
            .field
            .as_ref()
            .is_some_and(|(known, _)| !known.is_outgrown_by(&extent))
        {
            return Ok(());
        }
        log::debug!("nerf: {extent:?}, {sizes:?}");
        // Snapshots of a trial have the sizes of the old field. Its memory is freed before the next
        // field is allocated.
        self.finish_in_flight()?;
        self.abort_trials()?;
        self.field = None;
        let compiled = self.compiled()?;
        self.field = Some((
            extent,
            FieldTrainer::new(&self.gpu, &self.options, sizes, compiled)?,
        ));
        self.n_hinted = 0;
        Ok(())
    }

    /// Applies occupancy hints of new images, if any image has depth, and initializes their
    /// appearance embeddings.
    fn hint(&mut self) -> Result<(), Error> {
        // The embeddings are initialized first, while `n_hinted` still separates the known images
        // from the new images.
        self.initialize_embeddings()?;
        self.hint_images(self.n_hinted..self.images.len())?;
        if self.field.is_some() {
            self.n_hinted = self.images.len();
        }
        Ok(())
    }

    fn hint_images(&mut self, images: Range<usize>) -> Result<(), Error> {
        let Some((extent, field_trainer)) = &mut self.field else {
            return Ok(());
        };
        if field_trainer.sizes.has_depth {
            let keyframes: Vec<&Keyframe> = self.images[images]
                .iter()
                .map(|image| &*image.keyframe)
                .collect();
            field_trainer.hint(
                &self.gpu,
                &carve::hints(&keyframes, extent, &field_trainer.march()),
            )?;
        }
        Ok(())
    }

    /// Steps until the cells are refined.
    fn steps_to_finer_cells(&self) -> u64 {
        let is_refinement_due = self
            .field
            .as_ref()
            .is_some_and(|(_, field_trainer)| field_trainer.sizes.can_refine);
        if is_refinement_due {
            refinement_step(&self.options.common)
                .saturating_sub(self.step)
                .max(1)
        } else {
            u64::MAX
        }
    }

    /// Refines the cells when due. Coarse cells need fewer updates at first. Later, fine cells
    /// separate empty space better.
    fn refine_cells_when_due(&mut self) -> Result<(), Error> {
        let is_refinement_due = self.step >= refinement_step(&self.options.common);
        if !is_refinement_due
            || !self
                .field
                .as_ref()
                .is_some_and(|(_, field_trainer)| field_trainer.sizes.can_refine)
        {
            return Ok(());
        }
        self.finish_in_flight()?;
        let Some((_, field_trainer)) = &mut self.field else {
            return Ok(());
        };
        field_trainer.refine_cells(&self.gpu)
    }

    /// Waits for the submit in flight.
    fn finish_in_flight(&mut self) -> Result<(), Error> {
        self.submits.finish(&self.gpu)?;
        Ok(())
    }

    /// Records the next step as the `slot_ix`-th of a submit.
    fn record(&mut self, slot_ix: usize) -> Result<(), Error> {
        let learned_params = self.current_params();
        let Some((extent, field_trainer)) = &mut self.field else {
            return Ok(());
        };
        // New images may have arrived since the last step.
        if !learned_params.is_empty() {
            field_trainer.allocate_images(&self.gpu, self.images.len(), learned_params)?;
        }
        self.corrections = None;
        let n_rays = field_trainer.sizes.nerf_budget.n_rays;
        let draw = RaySampling {
            seed: self.options.common.seed,
            step: self.step,
            n_rays,
            begin: NEAR_DISTANCE,
        };
        let rays = rays::draw(&self.images, extent, &draw);
        field_trainer.record_step(
            &self.gpu,
            &self.options,
            slot_ix,
            self.step,
            &rays,
            learned_params,
        )?;
        self.step += 1;
        Ok(())
    }

    /// Number of steps that fit into the time limit of a submit.
    fn steps_per_submit(&self) -> u64 {
        // On a software adapter, a step takes longer than the limit. Until the first submit was
        // timed, the duration of a step is unknown, so each step is submitted alone.
        match self.submits.n_steps_in_limit() {
            Some(n) if !self.gpu.is_software() => n.clamp(1, STEPS_PER_SUBMIT as u64),
            _ => 1,
        }
    }

    fn draw(
        &mut self,
        request: &RenderRequest,
        camera: &Camera,
        embedding: [f64; EMBEDDING_DIM],
        output: Output,
    ) -> Result<Option<Rendered>, Error> {
        let background_srgb = request.background_srgb;
        let Some((extent, field_trainer)) = &mut self.field else {
            return Ok(Rendered::empty(camera.size_px, background_srgb, output));
        };
        field_trainer.draw(
            &self.gpu,
            &extent.camera_in_scene_units(camera),
            background_srgb,
            extent,
            embedding,
            output,
        )
    }
}

impl Method for NerfModel {
    fn depth_stride(&self) -> u32 {
        if self.gpu.is_software() {
            SOFTWARE_DEPTH_STRIDE
        } else {
            1
        }
    }

    fn push(&mut self, keyframe: Arc<Keyframe>) -> Result<(), Error> {
        if keyframe.split == Split::Test {
            return Ok(());
        }
        keyframe.check()?;
        // Validation keyframes decide trials. Afterwards, they are training images like all others.
        let is_validation = keyframe.split == Split::Validation && !self.trials.are_finished();
        let image = RayImage::new(keyframe);
        if is_validation {
            self.validation_images.push(image);
        } else {
            self.images.push(image);
            self.is_extent_stale = true;
        }
        Ok(())
    }

    fn remove(&mut self, camera: &str, stamp: Stamp) -> Result<(), Error> {
        let is_match = |image: &RayImage| {
            image.keyframe.camera.as_ref() == camera && image.keyframe.stamp == stamp
        };
        self.validation_images.retain(|image| !is_match(image));
        if let Some(ix) = self.images.iter().position(is_match) {
            self.finish_in_flight()?;
            self.abort_trials()?;
            // Parameters on the GPU are in the order of the images.
            self.images.remove(ix);
            self.n_hinted -= usize::from(ix < self.n_hinted);
            self.corrections = None;
            if let Some((_, field_trainer)) = &mut self.field {
                field_trainer.remove_image(&self.gpu, ix)?;
            }
        }
        Ok(())
    }

    fn step(&mut self, n: u64) -> Result<u64, Error> {
        if n == 0 || !self.begin()? {
            self.finish_in_flight()?;
            return Ok(0);
        }
        self.advance_trials_when_due()?;
        // Validation images may have become training images. They are used from the next step on.
        self.begin()?;
        // A submit ends where the host has to change the field.
        let max_steps = self
            .steps_to_finer_cells()
            .min(self.trials.steps_left(self.step, &self.options.common));
        let n_steps = n.min(self.steps_per_submit()).min(max_steps);
        let since = Instant::now();
        for slot_ix in 0..n_steps {
            self.record(usize::try_from(slot_ix).expect("few steps"))?;
        }
        let Some((_, field_trainer)) = &mut self.field else {
            return Err(no_field());
        };
        // This waits for the previous submit while the new submit runs.
        let batch = field_trainer.submit(&self.gpu);
        self.finish_in_flight()?;
        self.submits.begin(batch, n_steps, since);
        // The caller expects `n` completed steps.
        if n_steps == n {
            self.finish_in_flight()?;
        }
        Ok(n_steps)
    }

    fn is_idle(&self) -> bool {
        self.images.is_empty()
    }

    fn n_total_steps(&mut self) -> Result<u64, Error> {
        self.finish_in_flight()?;
        Ok(self.step + self.n_discarded_steps)
    }

    fn prepare(&mut self) -> Result<(), Error> {
        self.compiled().map(drop)
    }

    fn render(&mut self, request: &RenderRequest) -> Result<Picture, Error> {
        // Rendering must not create a field, because the times of pictures would then determine its
        // initial keyframes.
        self.finish_in_flight()?;
        let corrections = self.current_corrections()?;
        let embedding = images::embedding_of(corrections, request.appearance_of.as_ref());
        Rendered::picture(request, |camera, output| {
            self.draw(request, camera, embedding, output)
        })
    }

    fn render_packed(
        &mut self,
        request: &RenderRequest,
        packing: Packing,
    ) -> Result<Rendered, Error> {
        self.finish_in_flight()?;
        let corrections = self.current_corrections()?;
        let embedding = images::embedding_of(corrections, request.appearance_of.as_ref());
        Rendered::of(request, Format::Packed(packing), |camera, output| {
            self.draw(request, camera, embedding, output)
        })
    }

    fn set_watched(&mut self, watched: bool) {
        self.submits.set_watched(watched);
    }

    fn bounds(&mut self) -> Result<Option<Bounds>, Error> {
        Ok(self.extent().map(|extent| Bounds {
            center_m: extent.center_m,
            radius_m: extent.radius_m,
            outer_radius_m: extent.radius_m,
        }))
    }

    fn camera_corrections(&mut self) -> Result<BTreeMap<String, CameraCorrection>, Error> {
        Ok(self.current_corrections()?.clone())
    }

    /// Continues with the corrected images. Pose corrections of single images start again at zero.
    fn recalibrate(&mut self, keyframes: &[CorrectedKeyframe], _: &Alignment) -> Result<(), Error> {
        // The halves of a trial must be trained on the same images, so a running trial starts
        // again.
        self.finish_in_flight()?;
        self.undo_trial()?;
        let corrected = replacement(keyframes);
        for image in self.images.iter_mut().chain(&mut self.validation_images) {
            let mut keyframe = image.keyframe.clone();
            corrected(&mut keyframe);
            *image = RayImage::new(keyframe);
        }
        self.is_extent_stale = true;
        self.corrections = None;
        if let Some((_, field_trainer)) = &mut self.field {
            field_trainer.reset_image_params_except(
                &self.gpu,
                self.learned_params - ParamSet::IMAGE_POSES,
            )?;
        }
        self.hint_images(0..self.n_hinted)
    }

    fn profile_step(&mut self) -> Result<Vec<PassTiming>, Error> {
        self.finish_in_flight()?;
        if !self.begin()? {
            return Ok(Vec::new());
        }
        self.record(0)?;
        let Some((_, field_trainer)) = &mut self.field else {
            return Err(no_field());
        };
        field_trainer.submit_timed(&self.gpu)
    }

    fn progress(&self) -> Progress {
        let field = self.field.as_ref().map(|(_, field_trainer)| field_trainer);
        Progress {
            step: self.step,
            primitives: field.map_or(0, |field_trainer| field_trainer.field.n_entries.into()),
            bytes: field.map_or(0, FieldTrainer::bytes),
            step_millis: self.submits.step_millis(),
        }
    }

    fn report(&self) -> Vec<TrialReport> {
        self.trials.finished.clone()
    }

    fn save(&mut self, folder: &Path) -> Result<(), Error> {
        self.write_folder(folder)
    }

    fn checkpoint(&mut self) -> Result<PendingCheckpoint, Error> {
        self.take_checkpoint()
    }
}

/// Step at which the cells are refined.
fn refinement_step(common: &CommonOptions) -> u64 {
    (common.n_planned_steps / REFINE_DIVISOR).max(1)
}

/// The error if a step is taken before the field is created.
fn no_field() -> Error {
    Error::internal("a step was recorded before the field was created")
}
