//! The splat trainer: implements [`Method`] by combining the modules for training and drawing.

mod checkpoint;
mod lazy_pipelines;
mod learning_rates;
mod model;
mod model_size;
mod optimizer;
mod products;
mod recalibration;
mod recorder;
mod renderer;
mod saved_arrays;
mod scoring;
mod seeding;
mod training;
mod trial_runner;
mod view_set;

use super::bounds::bounds;
use super::chunks::{Chunker, MAX_SH_DEGREE};
use super::few_images::Scarcity;
use super::floaters::floaters;
use super::kernels::TrainPipelines;
use super::options::SplatOptions;
use super::params::Camera;
#[cfg(test)]
use super::params::status;
use super::schedule::Schedule;
use super::seed;
use super::trials::{SplatTrials, ValidationImage};
use crate::floaters::PendingFloaters;
use crate::model_chunks::PendingChunks;
use crate::model_metadata::{METADATA_FILE, read_metadata};
use crate::model_options::{MethodOptions, ModelOptions};
use crate::packing::{Format, Output};
use crate::pending::PendingCheckpoint;
use crate::{
    Bounds, CorrectedKeyframe, Error, Method, Packing, Picture, Progress, Projection,
    QueuedPicture, RenderRequest, Rendered,
};
use calibration::{Alignment, CameraCorrection, Trial, TrialReport};
use gpu::{Gpu, PassTiming};
use keyframe::{Keyframe, Split};
use kinematics::Stamp;
use lazy_pipelines::LazyPipelines;
use model::TrainedModel;
use model_files::splat::arrays::SplatArrays;
use model_files::splat::file::IN_FOLDER;
use model_files::splat::ply;
use model_files::{Edits, InitialPoints};
use optimizer::Optimizer;
use parking_lot::Mutex;
use recorder::Recorder;
use renderer::{DrawnView, Renderer};
use seeding::Seeding;
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;
use training::SkippedSteps;
use view_set::ViewSet;

/// Trains 3D Gaussian splats on keyframes.
#[derive(Debug)]
pub struct SplatTrainer {
    options: ModelOptions<SplatOptions>,
    recorder: Recorder,
    model: TrainedModel,
    renderer: Renderer,
    optimizer: Optimizer,
    schedule: Schedule,
    views: ViewSet,
    seeding: Seeding,
    trials: SplatTrials,
    skipped: SkippedSteps,
    /// Camera corrections loaded with a saved model.
    saved_corrections: BTreeMap<String, CameraCorrection>,
    /// Background loaded with a saved model.
    saved_background_srgb: [f32; 3],
    /// Encodes versions of the model for viewers, on another thread.
    chunker: Arc<Mutex<Chunker>>,
}

impl SplatTrainer {
    /// Creates an empty model. Drawing works immediately; the training pipelines are compiled on
    /// another thread.
    pub fn new(gpu: Arc<Gpu>, options: ModelOptions<SplatOptions>) -> Result<Self, Error> {
        let pipelines = LazyPipelines::start(&gpu);
        Self::with_pipelines(gpu, options, pipelines)
    }

    fn with_pipelines(
        gpu: Arc<Gpu>,
        options: ModelOptions<SplatOptions>,
        pipelines: LazyPipelines,
    ) -> Result<Self, Error> {
        // Software adapters get coarser images, fewer seeds and less image memory by default.
        let is_software = gpu.is_software();
        Ok(Self {
            renderer: Renderer::new(&gpu)?,
            model: TrainedModel::new(&gpu, &options)?,
            optimizer: Optimizer::new(&gpu, &options, pipelines)?,
            schedule: Schedule::new(options.common.n_planned_steps),
            views: ViewSet::new(&options, is_software),
            seeding: Seeding::new(&options, is_software),
            trials: SplatTrials::new(
                &options.common.cameras,
                options.specific.count,
                options.specific.trial_steps,
            ),
            skipped: SkippedSteps::default(),
            saved_corrections: BTreeMap::new(),
            saved_background_srgb: [0.0; 3],
            chunker: Arc::default(),
            recorder: Recorder::new(gpu),
            options,
        })
    }

    /// Creates a model from existing splats, for drawing or further training. The training
    /// pipelines are compiled at the first step.
    pub fn from_arrays(
        gpu: Arc<Gpu>,
        options: ModelOptions<SplatOptions>,
        arrays: &SplatArrays,
    ) -> Result<Self, Error> {
        let options = options.with(|options| options.specific.sh_degree = arrays.sh_degree);
        let mut trainer = Self::with_pipelines(gpu, options, LazyPipelines::OnDemand)?;
        trainer.add(arrays)?;
        Ok(trainer)
    }

    /// Loads the camera corrections and the background of a saved model from its `model.json`.
    pub fn with_saved_metadata(mut self, folder: &Path) -> Result<Self, Error> {
        let metadata = read_metadata(folder)?;
        for difference in
            metadata.differences(self.progress().primitives, self.options.specific.sh_degree)
        {
            log::warn!("{}: {difference}", folder.display());
        }
        self.saved_corrections = metadata.cameras;
        self.saved_background_srgb = metadata.background_srgb;
        Ok(self)
    }

    /// The current splats.
    pub fn arrays(&mut self) -> Result<SplatArrays, Error> {
        self.seed_from_depth()?;
        self.finish_in_flight()?;
        self.model.splats.read(&self.recorder.gpu)
    }

    /// The options.
    pub fn options(&self) -> &ModelOptions<SplatOptions> {
        &self.options
    }

    /// Number of gradients dropped because they were not finite.
    pub fn n_non_finite(&self) -> u64 {
        self.optimizer.n_non_finite
    }

    /// Results of the finished trials.
    pub fn trials(&self) -> &[Trial] {
        &self.trials.finished
    }

    /// Number of training and validation images. During a trial, validation images that arrive do
    /// not count, because both halves must have the same number at each step.
    fn n_images(&self) -> usize {
        let n_validation = match self.trials.running_trial() {
            Some(trial) => trial.scored.len(),
            None => self.trials.validation.len(),
        };
        self.views.len() + n_validation
    }

    fn learn(&mut self) -> Result<Arc<TrainPipelines>, Error> {
        self.optimizer.pipelines.wait(&self.recorder.gpu)
    }

    /// Adds a training keyframe that arrives at the current step.
    fn add_arrival(&mut self, keyframe: Arc<Keyframe>) -> Result<(), Error> {
        self.schedule.extend_for_arrival();
        self.add_view(keyframe)
    }

    fn add_view(&mut self, keyframe: Arc<Keyframe>) -> Result<(), Error> {
        // The steps of a failed submit are repeated, and must be repeated on the same views.
        self.finish_in_flight()?;
        self.seeding.push(keyframe.clone());
        self.views.push(keyframe);
        Ok(())
    }

    /// Adds splats, up to the limit.
    fn add(&mut self, arrays: &SplatArrays) -> Result<(), Error> {
        self.model
            .add(&mut self.recorder, &mut self.renderer, arrays)
    }

    /// Seeds discs at the uncovered depth readings of the keyframes that arrived since the last
    /// call.
    fn seed_from_depth(&mut self) -> Result<(), Error> {
        match self.seeding.discs_from_depth(&self.views) {
            Some(discs) => self.add(&discs),
            None => Ok(()),
        }
    }

    /// Seeds the areas that depth does not cover. Uses discs if any keyframe has depth; otherwise
    /// balls at the initial points, if there are any, and a random cloud.
    fn prepare_training(&mut self) -> Result<(), Error> {
        // Depth comes first, because the other discs take their depths from its discs.
        self.seed_from_depth()?;
        for keyframe in self.seeding.take_unseeded() {
            if let Some(discs) = self.seeding.discs_without_depth(&keyframe) {
                self.add(&discs)?;
            }
        }
        if !self.model.cameras.set.is_empty() {
            self.views
                .assign_lenses(&self.recorder.gpu, &mut self.model.cameras)?;
        }
        // No keyframe has depth, or no reading is usable.
        if self.model.splats.n_splats == 0 && !self.views.is_empty() {
            let keyframes: Vec<&Keyframe> = self.views.keyframes().map(AsRef::as_ref).collect();
            let n_max = self.options.cap() as usize;
            let points = self.seeding.points.as_deref();
            let balls = points
                .map(|points| seed::balls(points, &keyframes, n_max))
                .unwrap_or_default();
            let cloud = seed::random_cloud(&keyframes, self.options.common.seed, n_max);
            // Structure from motion finds no points where images have no texture. Therefore, there
            // are at least as many splats as without points.
            let n_random = cloud.n_splats().saturating_sub(balls.n_splats());
            self.add(&balls)?;
            self.add(&cloud.filtered(|ix| ix < n_random))?;
        }
        Ok(())
    }

    /// Draws one pinhole view of the displayed splats.
    fn draw_view(
        &mut self,
        camera: &Camera,
        background_srgb: [f32; 3],
        output: Output,
    ) -> Result<Option<Rendered>, Error> {
        let splats = self.trials.displayed(&self.model.splats);
        self.renderer.picture(
            &mut self.recorder,
            DrawnView {
                splats,
                camera,
                background_srgb,
            },
            output,
        )
    }

    /// Starts to draw and pack a view, on any adapter.
    pub(super) fn queue_view(
        &mut self,
        camera: &Camera,
        background_srgb: [f32; 3],
        packing: Packing,
    ) -> Result<QueuedPicture, Error> {
        self.seed_from_depth()?;
        let splats = self.trials.displayed(&self.model.splats);
        self.renderer.queue(
            &mut self.recorder,
            DrawnView {
                splats,
                camera,
                background_srgb,
            },
            packing,
        )
    }
}

impl Method for SplatTrainer {
    fn push(&mut self, keyframe: Arc<Keyframe>) -> Result<(), Error> {
        // A failed submit may reduce the step count, and the step of the arrival must be exact.
        self.finish_in_flight()?;
        if keyframe.split == Split::Test {
            return Ok(());
        }
        // Its seeds would not be finite, and its steps would be wasted, because non-finite
        // gradients are dropped.
        if !keyframe.is_finite() {
            log::warn!(
                "skipping the image of camera {:?} at {} ns: its pose, intrinsics or velocity is not finite",
                keyframe.camera,
                keyframe.stamp.0
            );
            return Ok(());
        }
        // Once the trials have ended, nothing needs validation, and the image is used for training.
        if keyframe.split == Split::Validation && self.trials.holds_validation() {
            self.trials.validation.push(ValidationImage {
                keyframe,
                image: None,
            });
            return Ok(());
        }
        // Both halves of a trial train on the same keyframes at the same steps.
        if self.trials.defer_arrival(&keyframe, self.schedule.step) {
            return Ok(());
        }
        self.add_live_arrival(keyframe)
    }

    fn remove(&mut self, camera: &str, stamp: Stamp) -> Result<(), Error> {
        self.finish_in_flight()?; // The step of the removal must be exact.
        let is_removed =
            |keyframe: &Keyframe| keyframe.camera.as_ref() == camera && keyframe.stamp == stamp;
        self.views.retain(|keyframe| !is_removed(keyframe));
        self.seeding.remove(is_removed);
        self.trials.remove(is_removed);
        // Bindings keep the buffers of removed images alive.
        self.recorder.passes.clear_bindings();
        Ok(())
    }

    fn set_initial_points(&mut self, points: &Arc<InitialPoints>) -> bool {
        self.seeding.points = Some(points.clone());
        true
    }

    fn step(&mut self, n: u64) -> Result<u64, Error> {
        self.train(n)
    }

    fn is_idle(&self) -> bool {
        false // Training continues as long as there are keyframes.
    }

    fn n_total_steps(&mut self) -> Result<u64, Error> {
        self.finish_in_flight()?;
        Ok(self.schedule.step + self.trials.n_reverted_steps)
    }

    fn background_srgb(&self) -> [f32; 3] {
        // A loaded model has no images, so it keeps the background with which it was saved.
        if self.views.is_empty() {
            self.saved_background_srgb
        } else {
            Scarcity::of_images(self.n_images()).background_srgb(self.views.mean_srgb())
        }
    }

    fn seed(&mut self) -> Result<(), Error> {
        self.seed_from_depth()
    }

    fn prepare(&mut self) -> Result<(), Error> {
        self.learn().map(drop)
    }

    fn profile_step(&mut self) -> Result<Vec<PassTiming>, Error> {
        self.profile()
    }

    fn render(&mut self, request: &RenderRequest) -> Result<Picture, Error> {
        self.seed_from_depth()?;
        Rendered::picture(request, |camera, output| {
            self.draw_view(camera, request.background_srgb, output)
        })
    }

    fn render_packed(
        &mut self,
        request: &RenderRequest,
        packing: Packing,
    ) -> Result<Rendered, Error> {
        self.seed_from_depth()?;
        Rendered::of(request, Format::Packed(packing), |camera, output| {
            self.draw_view(camera, request.background_srgb, output)
        })
    }

    fn queue_packed(
        &mut self,
        request: &RenderRequest,
        packing: Packing,
    ) -> Result<QueuedPicture, Error> {
        // Only single views can be queued. A panorama is composed of several, so it is drawn to
        // the end here.
        let Projection::Pinhole {
            focal_px,
            principal_px,
        } = request.projection
        else {
            return self
                .render_packed(request, packing)
                .map(QueuedPicture::ready);
        };
        if !self
            .renderer
            .may_pack(&mut self.recorder, packing, request.size_px)?
        {
            return self
                .render_packed(request, packing)
                .map(QueuedPicture::ready);
        }
        let camera = Camera::from_request(request, focal_px, principal_px);
        self.queue_view(&camera, request.background_srgb, packing)
    }

    fn queue_chunks(
        &mut self,
        only_changed: bool,
        edits: &Arc<Edits>,
    ) -> Result<Option<PendingChunks>, Error> {
        let splats = self.trials.displayed(&self.model.splats);
        if splats.n_splats == 0 {
            return Ok(None);
        }
        // The copy is queued between two steps. The closure waits for it and encodes it on another
        // thread, so that training continues.
        let gpu = Arc::clone(&self.recorder.gpu);
        let pending = splats.begin_read(&gpu, splats.active_degree().min(MAX_SH_DEGREE));
        let chunker = Arc::clone(&self.chunker);
        let edits = Arc::clone(edits);
        Ok(Some(PendingChunks::new(move || {
            let arrays = pending.finish(&gpu)?.without_erased(&edits);
            Ok(chunker.lock().chunks(&arrays, only_changed))
        })))
    }

    fn find_floaters(&mut self, edits: &Arc<Edits>) -> Result<PendingFloaters, Error> {
        let splats = self.trials.displayed(&self.model.splats);
        if splats.n_splats == 0 {
            return Err(Error::NoFloaters);
        }
        let gpu = Arc::clone(&self.recorder.gpu);
        let edits = Arc::clone(edits);
        let pending = splats.begin_read(&gpu, 0);
        Ok(PendingFloaters::new(move || {
            floaters(&pending.finish(&gpu)?.without_erased(&edits)).ok_or(Error::NoFloaters)
        }))
    }

    fn set_watched(&mut self, watched: bool) {
        self.optimizer.submits.set_watched(watched);
    }

    fn psnr(&mut self, request: &RenderRequest, keyframe: &Keyframe) -> Result<Option<f64>, Error> {
        self.seed_from_depth()?;
        let Projection::Pinhole {
            focal_px,
            principal_px,
        } = request.projection
        else {
            return Ok(None);
        };
        self.psnr_of_view(
            &Camera::from_request(request, focal_px, principal_px),
            request.background_srgb,
            keyframe,
        )
    }

    fn bounds(&mut self) -> Result<Option<Bounds>, Error> {
        Ok(bounds(&self.arrays()?))
    }

    /// The estimated corrections, or the loaded ones if none are estimated.
    fn camera_corrections(&mut self) -> Result<BTreeMap<String, CameraCorrection>, Error> {
        self.finish_in_flight()?;
        // Corrections belong to the displayed splats: during a trial of camera parameters, those
        // in training differ.
        let cameras = &self.model.cameras;
        let displayed = self.trials.baseline().map(|snapshot| &snapshot.cameras);
        let (set, params) = displayed.map_or((cameras.set, &cameras.params), |(set, params)| {
            (*set, params)
        });
        if set.is_empty() {
            return Ok(self.saved_corrections.clone());
        }
        cameras.corrections(&self.recorder.gpu, set, params, self.seeding.scene.size_m)
    }

    fn recalibrate(
        &mut self,
        keyframes: &[CorrectedKeyframe],
        alignment: &Alignment,
    ) -> Result<(), Error> {
        self.move_with_keyframes(keyframes, alignment)
    }

    fn pause_growth(&mut self, is_paused: bool) -> Result<bool, Error> {
        // Both halves of a comparison must grow alike.
        let is_compared = self.trials.running_trial().is_some();
        if self.model.is_growth_paused == is_paused || is_compared {
            return Ok(false);
        }
        self.finish_in_flight()?; // A failed submit may reduce the step count.
        self.model.is_growth_paused = is_paused;
        Ok(true)
    }

    fn progress(&self) -> Progress {
        let displayed = self.trials.displayed(&self.model.splats);
        Progress {
            step: self.schedule.step,
            primitives: displayed.n_splats.into(),
            bytes: displayed.bytes(),
            step_millis: self.optimizer.submits.step_millis(),
        }
    }

    fn report(&self) -> Vec<TrialReport> {
        self.trials.finished.iter().map(Trial::report).collect()
    }

    fn save(&mut self, folder: &Path) -> Result<(), Error> {
        self.finish_in_flight()?;
        // A change whose trial has not ended is not proven, so it is not saved.
        self.cancel_trial()?;
        let arrays = self.arrays()?;
        std::fs::create_dir_all(folder).map_err(|source| Error::Write {
            path: folder.to_owned(),
            source,
        })?;
        ply::write(&folder.join(IN_FOLDER), &arrays)?;
        let metadata = serde_json::json!({
            "method": SplatOptions::METHOD,
            "steps": self.schedule.step,
            "splats": arrays.n_splats(),
            "sh_degree": arrays.sh_degree,
            "seed": self.options.common.seed,
            "trials": self.report(),
            "cameras": self.camera_corrections()?,
            "background_srgb": self.background_srgb(),
        });
        let path = folder.join(METADATA_FILE);
        files::write(&path, format!("{metadata:#}\n"))
            .map_err(|source| Error::Write { path, source })
    }

    fn checkpoint(&mut self) -> Result<PendingCheckpoint, Error> {
        self.take_checkpoint()
    }
}

/// Accessors for tests.
#[cfg(test)]
impl SplatTrainer {
    pub(super) fn assume_step_millis(&mut self, millis: f64) {
        self.optimizer.submits.assume_step_millis(millis);
    }

    /// Creates the splats with which training starts.
    pub(super) fn prepare_for_test(&mut self) {
        self.prepare_training().unwrap();
    }

    /// Limits the GPU memory for images, as on a software adapter.
    pub(super) fn limit_image_bytes(&mut self, max_bytes: u64) {
        self.views.limit_image_bytes(max_bytes);
    }

    pub(super) fn image_bytes(&self) -> u64 {
        self.views.image_bytes()
    }

    pub(super) fn n_steps_on_gpu(&self) -> u64 {
        self.recorder
            .gpu
            .read::<u32>(&self.optimizer.status, status::LEN)
            .unwrap()[status::STEP]
            .into()
    }

    /// Number of seeded positions.
    pub(super) fn n_seeds(&self) -> usize {
        self.seeding.scene.seeder.n_seeds()
    }

    pub(super) fn n_views_of(&self, keyframe: &Keyframe) -> usize {
        self.views
            .keyframes()
            .filter(|other| other.stamp == keyframe.stamp)
            .count()
    }
}
