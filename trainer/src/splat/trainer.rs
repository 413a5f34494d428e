//! The splat trainer. It implements [`Method`] by combining the modules for training and drawing.

mod checkpoint;
mod gains;
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
use super::few_images;
use super::floaters::floaters;
use super::options::SplatOptions;
use super::params::Camera;
#[cfg(test)]
use super::params::status;
use super::trials::{CountPolicy, SplatTrials, ValidationImage};
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
use model_files::checkpoint::Checkpoint;
use model_files::splat::arrays::SplatArrays;
use model_files::splat::file::IN_FOLDER;
use model_files::splat::ply;
use model_files::{Edits, InitialPoints};
use parking_lot::Mutex;
use renderer::DrawnView;
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;
use training::Training;
use trial_runner::TrialRunner;

/// Trains 3D Gaussian splats on keyframes.
#[derive(Debug)]
pub struct SplatTrainer {
    training: Training,
    trials: SplatTrials,
    /// Camera corrections loaded with a saved model.
    saved_corrections: BTreeMap<String, CameraCorrection>,
    /// Encodes versions of the model for viewers, on another thread.
    chunker: Arc<Mutex<Chunker>>,
}

impl SplatTrainer {
    /// Creates an empty model. Drawing works immediately. The training pipelines are compiled on
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
        Ok(Self {
            trials: SplatTrials::new(
                &options.common.cameras,
                options.specific.count,
                options.specific.trial_steps,
            ),
            training: Training::new(gpu, options, pipelines)?,
            saved_corrections: BTreeMap::new(),
            chunker: Arc::default(),
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
        trainer.training.add(arrays)?;
        Ok(trainer)
    }

    /// Loads the camera corrections and the background of a saved model from its `model.json`.
    pub fn with_saved_metadata(mut self, folder: &Path) -> Result<Self, Error> {
        let metadata = read_metadata(folder)?;
        let sh_degree = self.options().specific.sh_degree;
        for difference in metadata.differences(self.progress().primitives, sh_degree) {
            log::warn!("{}: {difference}", folder.display());
        }
        self.saved_corrections = metadata.cameras;
        self.training.saved_background_srgb = metadata.background_srgb;
        Ok(self)
    }

    /// Resumes training from a checkpoint as if it had not been interrupted. `keyframes` must
    /// include all training keyframes of the checkpoint. Returns the remaining keyframes, to be
    /// pushed or kept for testing.
    ///
    /// # Errors
    ///
    /// Fails if the checkpoint is invalid, if keyframes are missing or differ, or if the GPU has
    /// too little memory.
    pub fn resume(
        gpu: Arc<Gpu>,
        checkpoint: &Checkpoint,
        keyframes: &[Arc<Keyframe>],
    ) -> Result<(Self, Vec<Arc<Keyframe>>), Error> {
        checkpoint::resume(gpu, checkpoint, keyframes)
    }

    /// The current splats.
    pub fn arrays(&mut self) -> Result<SplatArrays, Error> {
        self.training.arrays()
    }

    /// The options.
    pub fn options(&self) -> &ModelOptions<SplatOptions> {
        &self.training.options
    }

    /// Number of gradients dropped because they were not finite.
    pub fn n_non_finite(&self) -> u64 {
        self.training.optimizer.n_non_finite
    }

    /// Results of the finished trials.
    pub fn trials(&self) -> &[Trial] {
        &self.trials.finished
    }

    /// Maximum number of splats to which the model may grow at the current step.
    fn max_splats(&self) -> u32 {
        if !self.trials.may_grow() {
            return 0;
        }
        match self.training.options.specific.count {
            CountPolicy::ToCap => u32::MAX,
            CountPolicy::Tested => {
                few_images::max_splats(self.training.views.len() + self.trials.n_validation())
            }
        }
    }

    fn trial_runner(&mut self) -> TrialRunner<'_> {
        TrialRunner {
            training: &mut self.training,
            trials: &mut self.trials,
        }
    }

    /// Draws one pinhole view of the displayed splats.
    fn draw_view(
        &mut self,
        camera: &Camera,
        background_srgb: [f32; 3],
        output: Output,
    ) -> Result<Option<Rendered>, Error> {
        let splats = self.trials.displayed(&self.training.model.splats);
        self.training.renderer.picture(
            &mut self.training.recorder,
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
        self.training.seed_from_depth()?;
        let splats = self.trials.displayed(&self.training.model.splats);
        self.training.renderer.queue(
            &mut self.training.recorder,
            DrawnView {
                splats,
                camera,
                background_srgb,
            },
            packing,
        )
    }

    /// PSNR in dB of a displayed view against a keyframe's image. `None` if their sizes differ or
    /// training has not started.
    fn psnr_of_view(
        &mut self,
        camera: &Camera,
        background_srgb: [f32; 3],
        keyframe: &Keyframe,
    ) -> Result<Option<f64>, Error> {
        // This does not wait, because the compilation of training pipelines must not delay a score.
        // The caller can score the picture on the CPU.
        let Some(learn) = self.training.optimizer.pipelines.ready() else {
            return Ok(None);
        };
        let rgba = keyframe.rgba_srgb.as_ref();
        if rgba.len() != 4 * camera.size_px[0] as usize * camera.size_px[1] as usize {
            return Ok(None);
        }
        let drawn = DrawnView {
            splats: self.trials.displayed(&self.training.model.splats),
            camera,
            background_srgb,
        };
        let products = self.training.renderer.compare_with_upload(
            &mut self.training.recorder,
            drawn,
            &learn.score,
            rgba,
        )?;
        products::psnr(&products).map(Some)
    }
}

impl Method for SplatTrainer {
    fn push(&mut self, keyframe: Arc<Keyframe>) -> Result<(), Error> {
        // A failed submit may reduce the step count, and the step of the arrival must be exact.
        self.training.finish_in_flight()?;
        if keyframe.split == Split::Test {
            return Ok(());
        }
        // A keyframe with non-finite values is dropped. Its seeds would not be finite, and its
        // steps would be wasted, because non-finite gradients are dropped.
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
        if self
            .trials
            .defer_arrival(&keyframe, self.training.schedule.step)
        {
            return Ok(());
        }
        gains::add_live_arrival(&mut self.training, &mut self.trials, keyframe)
    }

    fn remove(&mut self, camera: &str, stamp: Stamp) -> Result<(), Error> {
        self.training.finish_in_flight()?; // The step of the removal must be exact.
        let is_removed =
            |keyframe: &Keyframe| keyframe.camera.as_ref() == camera && keyframe.stamp == stamp;
        self.training.views.retain(|keyframe| !is_removed(keyframe));
        self.training.seeding.remove(is_removed);
        self.trials.remove(is_removed);
        // Bindings keep the buffers of removed images alive.
        self.training.recorder.passes.clear_bindings();
        Ok(())
    }

    fn set_initial_points(&mut self, points: &Arc<InitialPoints>) -> bool {
        self.training.seeding.points = Some(points.clone());
        true
    }

    fn step(&mut self, n: u64) -> Result<u64, Error> {
        if self.training.views.is_empty() {
            return Ok(0);
        }
        self.training.prepare_model()?;
        if self.training.model.splats.n_splats == 0 {
            return Ok(0);
        }
        let learn = self.training.learn()?;
        // Trials come before growth. A trial that starts at a growth step copies the model before
        // the growth, so that both halves grow at this step.
        self.trial_runner().run_due()?;
        let max_splats = self.max_splats();
        self.training.grow_when_due(&learn, max_splats)?;
        // The number is computed after trials and growth, because both can change the step count
        // and the next step with other work.
        let n_left = self.trials.steps_left(self.training.schedule.step);
        let n_validation = self.trials.n_validation();
        let n_steps = self
            .training
            .submit_steps(&learn, n.min(n_left), n_validation)?;
        // The caller stops here, so the step count must be exact.
        if n_steps == n {
            self.training.finish_in_flight()?;
        }
        Ok(n_steps)
    }

    fn is_idle(&self) -> bool {
        false // Training continues as long as there are keyframes.
    }

    fn n_total_steps(&mut self) -> Result<u64, Error> {
        self.training.finish_in_flight()?;
        Ok(self.training.schedule.step + self.trials.n_reverted_steps)
    }

    fn background_srgb(&self) -> [f32; 3] {
        self.training.background_srgb(self.trials.n_validation())
    }

    fn seed(&mut self) -> Result<(), Error> {
        self.training.seed_from_depth()
    }

    fn prepare(&mut self) -> Result<(), Error> {
        self.training.learn().map(drop)
    }

    fn profile_step(&mut self) -> Result<Vec<PassTiming>, Error> {
        self.training.profile(self.trials.n_validation())
    }

    fn render(&mut self, request: &RenderRequest) -> Result<Picture, Error> {
        self.training.seed_from_depth()?;
        Rendered::picture(request, |camera, output| {
            self.draw_view(camera, request.background_srgb, output)
        })
    }

    fn render_packed(
        &mut self,
        request: &RenderRequest,
        packing: Packing,
    ) -> Result<Rendered, Error> {
        self.training.seed_from_depth()?;
        Rendered::of(request, Format::Packed(packing), |camera, output| {
            self.draw_view(camera, request.background_srgb, output)
        })
    }

    fn queue_packed(
        &mut self,
        request: &RenderRequest,
        packing: Packing,
    ) -> Result<QueuedPicture, Error> {
        // Only single views can be queued. A panorama is composed of several views, so it is drawn
        // completely here.
        let Projection::Pinhole {
            focal_px,
            principal_px,
        } = request.projection
        else {
            return self
                .render_packed(request, packing)
                .map(QueuedPicture::ready);
        };
        let Training {
            recorder, renderer, ..
        } = &mut self.training;
        if !renderer.may_pack(recorder, packing, request.size_px)? {
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
        let splats = self.trials.displayed(&self.training.model.splats);
        if splats.n_splats == 0 {
            return Ok(None);
        }
        // The copy is queued between two steps. The closure waits for it and encodes it on another
        // thread, so that training continues.
        let gpu = Arc::clone(&self.training.recorder.gpu);
        let pending = splats.begin_read(&gpu, splats.active_degree().min(MAX_SH_DEGREE));
        let chunker = Arc::clone(&self.chunker);
        let edits = Arc::clone(edits);
        Ok(Some(PendingChunks::new(move || {
            let arrays = pending.finish(&gpu)?.without_hidden(&edits);
            Ok(chunker.lock().chunks(&arrays, only_changed))
        })))
    }

    fn find_floaters(&mut self, edits: &Arc<Edits>) -> Result<PendingFloaters, Error> {
        let splats = self.trials.displayed(&self.training.model.splats);
        if splats.n_splats == 0 {
            return Err(Error::NoFloaters);
        }
        let gpu = Arc::clone(&self.training.recorder.gpu);
        let edits = Arc::clone(edits);
        let pending = splats.begin_read(&gpu, 0);
        Ok(PendingFloaters::new(move || {
            floaters(&pending.finish(&gpu)?.without_erased(&edits)).ok_or(Error::NoFloaters)
        }))
    }

    fn set_watched(&mut self, watched: bool) {
        self.training.optimizer.submits.set_watched(watched);
    }

    fn psnr(&mut self, request: &RenderRequest, keyframe: &Keyframe) -> Result<Option<f64>, Error> {
        self.training.seed_from_depth()?;
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

    /// The estimated corrections, or the loaded corrections if none are estimated.
    fn camera_corrections(&mut self) -> Result<BTreeMap<String, CameraCorrection>, Error> {
        self.training.finish_in_flight()?;
        // Corrections must belong to the displayed splats. During a trial of camera parameters, the
        // corrections in training are different.
        let cameras = &self.training.model.cameras;
        let displayed = self.trials.baseline().map(|snapshot| &snapshot.cameras);
        let (set, params) = displayed.map_or((cameras.set, &cameras.params), |(set, params)| {
            (*set, params)
        });
        if set.is_empty() {
            return Ok(self.saved_corrections.clone());
        }
        cameras.corrections(
            &self.training.recorder.gpu,
            set,
            params,
            self.training.seeding.scene.size_m,
        )
    }

    fn recalibrate(
        &mut self,
        keyframes: &[CorrectedKeyframe],
        alignment: &Alignment,
    ) -> Result<(), Error> {
        self.training.finish_in_flight()?;
        self.trial_runner().abort()?;
        recalibration::move_with_keyframes(
            &mut self.training,
            &mut self.trials,
            keyframes,
            alignment,
        )
    }

    fn pause_growth(&mut self, is_paused: bool) -> Result<bool, Error> {
        // Both halves of a comparison must grow in the same way.
        let is_compared = self.trials.running_trial().is_some();
        if self.training.model.is_growth_paused == is_paused || is_compared {
            return Ok(false);
        }
        self.training.finish_in_flight()?; // A failed submit may reduce the step count.
        self.training.model.is_growth_paused = is_paused;
        Ok(true)
    }

    fn progress(&self) -> Progress {
        let displayed = self.trials.displayed(&self.training.model.splats);
        Progress {
            step: self.training.schedule.step,
            primitives: displayed.n_splats.into(),
            bytes: displayed.bytes(),
            step_millis: self.training.optimizer.submits.step_millis(),
        }
    }

    fn report(&self) -> Vec<TrialReport> {
        self.trials.finished.iter().map(Trial::report).collect()
    }

    fn save(&mut self, folder: &Path) -> Result<(), Error> {
        self.training.finish_in_flight()?;
        // A change is not saved before its trial has ended, because its benefit is unknown.
        self.trial_runner().cancel()?;
        let arrays = self.arrays()?;
        std::fs::create_dir_all(folder).map_err(|source| Error::Write {
            path: folder.to_owned(),
            source,
        })?;
        ply::write(&folder.join(IN_FOLDER), &arrays)?;
        let metadata = serde_json::json!({
            "method": SplatOptions::METHOD,
            "steps": self.training.schedule.step,
            "splats": arrays.n_splats(),
            "sh_degree": arrays.sh_degree,
            "seed": self.training.options.common.seed,
            "trials": self.report(),
            "cameras": self.camera_corrections()?,
            "background_srgb": self.background_srgb(),
        });
        let path = folder.join(METADATA_FILE);
        files::write(&path, format!("{metadata:#}\n"))
            .map_err(|source| Error::Write { path, source })
    }

    fn checkpoint(&mut self) -> Result<PendingCheckpoint, Error> {
        checkpoint::take(&mut self.training, &self.trials)
    }
}

/// Accessors for tests.
#[cfg(test)]
impl SplatTrainer {
    pub(super) fn assume_step_millis(&mut self, millis: f64) {
        self.training.optimizer.submits.assume_step_millis(millis);
    }

    /// Creates the splats with which training starts.
    pub(super) fn prepare_for_test(&mut self) {
        self.training.prepare_model().unwrap();
    }

    /// Limits the GPU memory for images, as on a software adapter.
    pub(super) fn limit_image_bytes(&mut self, max_bytes: u64) {
        self.training.views.limit_image_bytes(max_bytes);
    }

    pub(super) fn image_bytes(&self) -> u64 {
        self.training.views.image_bytes()
    }

    pub(super) fn n_steps_on_gpu(&self) -> u64 {
        self.training
            .recorder
            .gpu
            .read::<u32>(&self.training.optimizer.status, status::LEN)
            .unwrap()[status::STEP]
            .into()
    }

    /// Number of seeded positions.
    pub(super) fn n_seeds(&self) -> usize {
        self.training.seeding.scene.seeder.n_seeds()
    }

    pub(super) fn n_views_of(&self, keyframe: &Keyframe) -> usize {
        self.training
            .views
            .keyframes()
            .filter(|other| other.stamp == keyframe.stamp)
            .count()
    }
}
