//! The neural field as a [`Method`].

mod checkpoint;
mod images;

use super::carve;
use super::extent::Extent;
use super::field_trainer::{Compiled, FieldTrainer, STEPS_PER_SUBMIT};
use super::options::{NerfBudget, NerfOptions};
use super::rays::{self, RayImage, RaySampling};
use super::sizes::Sizes;
use crate::align::Alignment;
use crate::checkpoint::PendingCheckpoint;
use crate::gpu::{Gpu, PassTiming, PendingRead};
use crate::method::submit_millis;
use crate::splat::{CalibratedCamera, Camera, CameraCorrection, EMBEDDING_DIM, ParamSet, projections};
use crate::{Error, Keyframe, Method, Picture, Progress, RenderRequest, Restartable, Split, TrialReport};
use images::Trials;
use kinematics::Stamp;
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

/// Nearest place that rays look at, in units of the scene's radius.
const NEAR_DISTANCE: f32 = 0.03;
/// Cells of the occupancy become finer after one of so many of the planned steps: before a trial, which compares fields of one size.
const REFINE_DIVISOR: u64 = 10;
/// On a processor a picture of 640x480 takes tens of seconds before much is learned: of depth every ninth pixel tells enough.
const SOFTWARE_DEPTH_STRIDE: u32 = 3;

/// A neural field that learns from keyframes: a hash grid and two small networks, drawn along rays.
#[derive(Debug)]
pub struct NerfModel {
    gpu: Arc<Gpu>,
    options: NerfOptions,
    images: Vec<RayImage>,
    field: Option<(Extent, FieldTrainer)>,
    /// For all fields that come.
    compiled: Option<Arc<Compiled>>,
    /// Keyframes came or went since the extent was looked at.
    is_extent_stale: bool,
    /// Images whose depth was told to the field: the first so many.
    n_hinted: usize,
    in_flight: Option<InFlight>,
    /// What is learned of images along with the field.
    learned_params: ParamSet,
    trials: Trials,
    /// Images that are learned from when all trials are over.
    validation_images: Vec<RayImage>,
    /// Of the saved field this one came from.
    loaded_corrections: BTreeMap<String, CameraCorrection>,
    /// What is known about cameras, since the last step.
    corrections: Option<BTreeMap<String, CameraCorrection>>,
    step: u64,
    /// Steps of trials that were taken back.
    n_discarded_steps: u64,
    step_millis: f64,
    /// Whether pictures are requested.
    is_watched: bool,
}

#[derive(Debug)]
struct InFlight {
    batch: PendingRead,
    n_steps: u64,
    since: Instant,
}

impl NerfModel {
    /// A model that has seen nothing.
    pub fn new(gpu: Arc<Gpu>, options: NerfOptions) -> Result<Self, Error> {
        Ok(Self {
            gpu,
            learned_params: images::given(&options.cameras),
            trials: Trials::of(&options.cameras),
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
            in_flight: None,
            step: 0,
            step_millis: 0.0,
            is_watched: false,
        })
    }

    /// How it was asked to learn.
    pub fn options(&self) -> &NerfOptions {
        &self.options
    }

    /// Where the scene lies; `None` before the first keyframe is learned from.
    pub fn extent(&self) -> Option<&Extent> {
        self.field.as_ref().map(|(extent, _)| extent)
    }

    /// What was learned about each camera; empty where nothing is.
    fn camera_corrections(&mut self) -> Result<&BTreeMap<String, CameraCorrection>, Error> {
        if self.corrections.is_none() {
            self.finish_in_flight()?;
            self.corrections = Some(self.learned_corrections()?);
        }
        Ok(self.corrections.as_ref().filter(|corrections| !corrections.is_empty()).unwrap_or(&self.loaded_corrections))
    }

    fn nerf_budget(&self) -> NerfBudget {
        self.options.nerf_budget.unwrap_or(if self.gpu.is_software() { NerfBudget::SMALL } else { NerfBudget::FULL })
    }

    /// Makes a field where there is none, or where the scene has outgrown it, with cells as fine as are due. False where there is nothing
    /// to learn from.
    fn begin(&mut self) -> Result<bool, Error> {
        if self.images.is_empty() {
            return Ok(false);
        }
        if std::mem::take(&mut self.is_extent_stale) || self.field.is_none() {
            self.images.par_iter().for_each(|image| {
                image.depth_m();
            });
            self.fit_extent()?;
            self.hint()?;
        }
        self.refine_cells_when_due()?;
        Ok(true)
    }

    /// What the images ask for.
    fn sizes(&self) -> Result<(Extent, Sizes), Error> {
        let keyframes = || self.images.iter().map(|image| &*image.keyframe);
        let extent = Extent::of(keyframes());
        let sizes =
            Sizes::choose(&self.options, self.nerf_budget(), self.gpu.max_binding_bytes(), keyframes(), &extent)?;
        Ok((extent, sizes))
    }

    /// The kernels, compiled once.
    fn compiled(&mut self) -> Result<Arc<Compiled>, Error> {
        if let Some(compiled) = &self.compiled {
            return Ok(compiled.clone());
        }
        let compiled = Arc::new(Compiled::new(&self.gpu, &self.nerf_budget())?);
        self.compiled = Some(compiled.clone());
        Ok(compiled)
    }

    fn fit_extent(&mut self) -> Result<(), Error> {
        let (extent, sizes) = self.sizes()?;
        if self.field.as_ref().is_some_and(|(known, _)| !known.is_outgrown_by(&extent)) {
            return Ok(());
        }
        log::debug!("nerf: {extent:?}, {sizes:?}");
        self.finish_in_flight()?;
        self.abort_trials()?;
        self.field = None; // Its memory is free before the next one takes some.
        let compiled = self.compiled()?;
        self.field = Some((extent, FieldTrainer::new(&self.gpu, &self.options, sizes, compiled)?));
        self.n_hinted = 0;
        Ok(())
    }

    /// Tells the field what new images say about where something is, where any of them has depth, and in what light they begin.
    fn hint(&mut self) -> Result<(), Error> {
        self.initialize_embeddings()?;
        let Some((extent, field_trainer)) = &mut self.field else { return Ok(()) };
        if field_trainer.sizes.has_depth {
            let keyframes: Vec<&Keyframe> = self.images[self.n_hinted..].iter().map(|image| &*image.keyframe).collect();
            field_trainer.hint(&self.gpu, &carve::hints(&keyframes, extent, &field_trainer.march()))?;
        }
        self.n_hinted = self.images.len();
        Ok(())
    }

    /// Steps until cells become finer.
    fn steps_to_finer_cells(&self) -> u64 {
        let is_refinement_due = self.field.as_ref().is_some_and(|(_, field_trainer)| field_trainer.sizes.can_refine);
        if is_refinement_due { self.refinement_step().saturating_sub(self.step).max(1) } else { u64::MAX }
    }

    fn refinement_step(&self) -> u64 {
        (self.options.n_planned_steps / REFINE_DIVISOR).max(1)
    }

    /// Coarse cells are soon visited, fine ones tell better what is empty.
    fn refine_cells_when_due(&mut self) -> Result<(), Error> {
        let is_refinement_due = self.step >= self.refinement_step();
        if !is_refinement_due || !self.field.as_ref().is_some_and(|(_, field_trainer)| field_trainer.sizes.can_refine) {
            return Ok(());
        }
        self.finish_in_flight()?;
        let Some((_, field_trainer)) = &mut self.field else { return Ok(()) };
        field_trainer.refine_cells(&self.gpu)
    }

    /// Waits for the submit in flight.
    fn finish_in_flight(&mut self) -> Result<(), Error> {
        let Some(in_flight) = self.in_flight.take() else { return Ok(()) };
        in_flight.batch.finish::<u32>(&self.gpu)?;
        let millis = in_flight.since.elapsed().as_secs_f64() * 1e3 / in_flight.n_steps.max(1) as f64;
        self.step_millis = if self.step_millis == 0.0 { millis } else { 0.8 * self.step_millis + 0.2 * millis };
        Ok(())
    }

    /// Lists the next step as the `slot_ix`-th of a submit.
    fn record(&mut self, slot_ix: usize) -> Result<(), Error> {
        let learned_params = self.params_learned_now();
        let Some((extent, field_trainer)) = &mut self.field else { return Ok(()) };
        if learned_params.any() {
            field_trainer.allocate_images(&self.gpu, self.images.len(), learned_params)?;
        }
        self.corrections = None;
        let n_rays = field_trainer.sizes.nerf_budget.n_rays;
        let draw = RaySampling { seed: self.options.seed, step: self.step, n_rays, begin: NEAR_DISTANCE };
        let rays = rays::draw(&self.images, extent, &draw);
        field_trainer.record_step(&self.gpu, &self.options, slot_ix, self.step, &rays, learned_params)?;
        self.step += 1;
        Ok(())
    }

    /// Steps of a submit that take no longer than it may.
    fn steps_per_submit(&self) -> u64 {
        if self.step_millis == 0.0 || self.gpu.is_software() {
            return 1;
        }
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped")]
        let n = (submit_millis(self.is_watched) / self.step_millis).clamp(1.0, STEPS_PER_SUBMIT as f64) as u64;
        n
    }

    fn draw(
        &mut self,
        request: &RenderRequest,
        camera: &Camera,
        embedding: [f64; EMBEDDING_DIM],
    ) -> Result<Picture, Error> {
        let RenderRequest { background_srgb, depth, .. } = *request;
        let Some((extent, field_trainer)) = &mut self.field else {
            return Ok(Picture::empty(camera.size_px, background_srgb, depth));
        };
        field_trainer.draw(
            &self.gpu,
            &extent.camera_in_scene_units(camera),
            background_srgb,
            extent.radius_m,
            embedding,
            depth,
        )
    }
}

impl Restartable for NerfModel {
    fn restart(&mut self) -> Result<(), Error> {
        self.finish_in_flight()?;
        let compiled = self.compiled.take();
        let is_watched = self.is_watched;
        *self = Self { compiled, is_watched, ..Self::new(self.gpu.clone(), self.options.clone())? };
        Ok(())
    }

    fn learned_correction(&mut self, camera: &str) -> Result<Option<CameraCorrection>, Error> {
        Ok(self.camera_corrections()?.get(camera).cloned())
    }
}

impl Method for NerfModel {
    fn depth_stride(&self) -> u32 {
        if self.gpu.is_software() { SOFTWARE_DEPTH_STRIDE } else { 1 }
    }

    fn push(&mut self, keyframe: Arc<Keyframe>) -> Result<(), Error> {
        if keyframe.split == Split::Test {
            return Ok(());
        }
        keyframe.check()?;
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
        let is_match = |image: &RayImage| image.keyframe.camera.as_ref() == camera && image.keyframe.stamp == stamp;
        self.validation_images.retain(|image| !is_match(image));
        if let Some(ix) = self.images.iter().position(is_match) {
            self.finish_in_flight()?;
            self.abort_trials()?;
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
        self.begin()?; // Images that were held back have joined, before the next step and not after so many as fit into a submit.
        let max_steps = self.steps_to_finer_cells().min(self.steps_to_trial());
        let n_steps = n.min(self.steps_per_submit()).min(max_steps);
        let since = Instant::now();
        for slot_ix in 0..n_steps {
            self.record(usize::try_from(slot_ix).expect("few steps"))?;
        }
        let Some((_, field_trainer)) = &mut self.field else { return Err(Error::DeviceLost) };
        let batch = field_trainer.submit(&self.gpu);
        self.finish_in_flight()?; // The submit before; this one runs meanwhile.
        self.in_flight = Some(InFlight { batch, n_steps, since });
        if n_steps == n {
            self.finish_in_flight()?; // The caller stops here.
        }
        Ok(n_steps)
    }

    fn is_idle(&self) -> bool {
        self.images.is_empty()
    }

    fn primitive(&self) -> &'static str {
        "entry"
    }

    fn n_total_steps(&mut self) -> Result<u64, Error> {
        self.finish_in_flight()?;
        Ok(self.step + self.n_discarded_steps)
    }

    /// Nothing can be drawn before something was learned.
    fn seed(&mut self) -> Result<(), Error> {
        Ok(())
    }

    fn prepare(&mut self) -> Result<(), Error> {
        self.compiled().map(drop)
    }

    fn render(&mut self, request: &RenderRequest) -> Result<Picture, Error> {
        // Whoever looks must not decide with which keyframes the field begins.
        self.finish_in_flight()?;
        let embedding = self.embedding_of(request.appearance_of.as_ref())?;
        projections::render(request, |camera| self.draw(request, camera, embedding))
    }

    fn set_watched(&mut self, watched: bool) {
        self.is_watched = watched;
    }

    fn calibrated_camera(&mut self, keyframe: &Keyframe) -> Result<CalibratedCamera, Error> {
        let corrections = self.camera_corrections()?;
        let correction = corrections.get(keyframe.camera.as_ref());
        Ok(correction.map_or_else(|| CalibratedCamera::of(keyframe), |correction| correction.apply(keyframe)))
    }

    fn profile_step(&mut self) -> Result<Vec<PassTiming>, Error> {
        self.finish_in_flight()?;
        if !self.begin()? {
            return Ok(Vec::new());
        }
        self.record(0)?;
        let Some((_, field_trainer)) = &mut self.field else { return Err(Error::DeviceLost) };
        field_trainer.submit_timed(&self.gpu)
    }

    fn alignment(&self) -> Option<&Alignment> {
        None
    }

    fn progress(&self) -> Progress {
        let field = self.field.as_ref().map(|(_, field_trainer)| field_trainer);
        Progress {
            step: self.step,
            primitives: field.map_or(0, |field_trainer| field_trainer.field.n_entries.into()),
            bytes: field.map_or(0, FieldTrainer::bytes),
            step_millis: self.step_millis,
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
