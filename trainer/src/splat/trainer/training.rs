//! The model in training, and everything that a training step needs. Steps are submitted to the
//! GPU, and their results are applied later.

use super::lazy_pipelines::LazyPipelines;
use super::learning_rates;
use super::model::{TrainedModel, n_splats_u32};
use super::optimizer::{Optimizer, StepContext};
use super::recorder::Recorder;
use super::renderer::Renderer;
use super::seeding::Seeding;
use super::view_set::ViewSet;
use crate::Error;
use crate::model_options::ModelOptions;
use crate::splat::few_images::Scarcity;
use crate::splat::kernels::TrainPipelines;
use crate::splat::options::SplatOptions;
use crate::splat::params::status;
use crate::splat::schedule::Schedule;
use crate::splat::seed;
use crate::splat::snapshot::Snapshot;
use crate::splat::work_counts::WorkCounts;
use calibration::CameraCorrection;
use gpu::{Gpu, PassTiming};
use keyframe::Keyframe;
use model_files::splat::arrays::SplatArrays;
use numbers::f32_of;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Instant;

/// Maximum number of steps per submit. A submit also ends at its time limit, so this number matters
/// only for very short steps. More steps keep more images in memory at once, and repeat more work
/// after an overflow.
const MAX_STEPS_PER_SUBMIT: u64 = 64;
/// Number of images prepared and uploaded together while a viewer requests pictures. A larger
/// number would delay the pictures too much.
const VIEWS_AT_ONCE_WATCHED: u64 = 4;

/// The model in training. It does not depend on trials. Trials change it through its functions.
#[derive(Debug)]
pub(super) struct Training {
    pub(super) options: ModelOptions<SplatOptions>,
    pub(super) recorder: Recorder,
    pub(super) model: TrainedModel,
    pub(super) renderer: Renderer,
    pub(super) optimizer: Optimizer,
    pub(super) schedule: Schedule,
    pub(super) views: ViewSet,
    pub(super) seeding: Seeding,
    /// Background loaded with a saved model.
    pub(super) saved_background_srgb: [f32; 3],
    skipped: SkippedSteps,
}

impl Training {
    /// Training without splats and views.
    pub(super) fn new(
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
            saved_background_srgb: [0.0; 3],
            skipped: SkippedSteps::default(),
            recorder: Recorder::new(gpu),
            options,
        })
    }

    /// The training pipelines. Waits until they are compiled.
    pub(super) fn learn(&mut self) -> Result<Arc<TrainPipelines>, Error> {
        self.optimizer.pipelines.wait(&self.recorder.gpu)
    }

    /// Adds a training keyframe that arrives at the current step.
    pub(super) fn add_arrival(&mut self, keyframe: Arc<Keyframe>) -> Result<(), Error> {
        self.schedule.extend_for_arrival();
        self.add_view(keyframe)
    }

    /// Adds a training keyframe without extending the schedule.
    pub(super) fn add_view(&mut self, keyframe: Arc<Keyframe>) -> Result<(), Error> {
        // The steps of a failed submit are repeated, and must be repeated on the same views.
        self.finish_in_flight()?;
        self.seeding.push(keyframe.clone());
        self.views.push(keyframe);
        Ok(())
    }

    /// Adds splats, up to the limit.
    pub(super) fn add(&mut self, arrays: &SplatArrays) -> Result<(), Error> {
        self.model
            .add(&mut self.recorder, &mut self.renderer, arrays)
    }

    /// Seeds discs at the uncovered depth readings of the keyframes that arrived since the last
    /// call. At the limit, the result depends on how keyframes are divided between calls.
    pub(super) fn seed_from_depth(&mut self) -> Result<(), Error> {
        let discs = self.seeding.discs_from_depth(&self.views);
        self.add_seeds(discs.as_slice())
    }

    /// Adds the splats of new images. At the limit, other splats make room for them.
    fn add_seeds(&mut self, seeds: &[SplatArrays]) -> Result<(), Error> {
        let n_seeds = seeds.iter().map(SplatArrays::n_splats).sum();
        // Before the first step, no splat is less important than another.
        if self.schedule.step > 0 {
            self.make_room(n_splats_u32(n_seeds))?;
        }
        seeds.iter().try_for_each(|seeds| self.add(seeds))
    }

    /// Removes splats if `n_new` splats would exceed the limit.
    ///
    /// In a live run, growth may reach the limit while the images show only the first places. Later
    /// places would then get no splats.
    pub(super) fn make_room(&mut self, n_new: u32) -> Result<(), Error> {
        let n_removed = self.model.n_to_remove(n_new);
        if n_removed == 0 {
            return Ok(());
        }
        self.finish_in_flight()?;
        let learn = self.learn()?;
        self.model
            .remove_faintest(&mut self.recorder, &learn, n_removed)
    }

    /// Seeds the areas that depth does not cover. If any keyframe has depth, discs are used.
    /// Otherwise, discs are used on surfaces that several images show, and a random cloud where
    /// there are none. If initial points are given, balls at these points and a random cloud are
    /// used.
    pub(super) fn prepare_model(&mut self) -> Result<(), Error> {
        // Depth comes first, because discs without depth readings take their depths from the discs
        // with depth.
        let mut seeds: Vec<SplatArrays> = Vec::new();
        seeds.extend(self.seeding.discs_from_depth(&self.views));
        let unseeded = self.seeding.take_unseeded();
        if self.seeding.scene.has_depth {
            let seeding = &mut self.seeding;
            let discs = unseeded.iter();
            seeds.extend(discs.filter_map(|keyframe| seeding.discs_without_depth(keyframe)));
        } else if self.seeding.points.is_none() && !unseeded.is_empty() {
            seeds.extend(self.seeds_from_images(&unseeded));
        }
        self.add_seeds(&seeds)?;
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
            let n_cloud = n_max.min(self.seeding.random_splats() as usize);
            let focus = seed::common_focus(&keyframes);
            let cloud = seed::random_cloud(&keyframes, focus, self.options.common.seed, n_cloud);
            // Structure from motion finds no points where images have no texture. A random cloud is
            // therefore added, so that there are at least as many splats as without points.
            let n_random = cloud.n_splats().saturating_sub(balls.n_splats());
            self.add(&balls)?;
            self.add(&cloud.filtered(|ix| ix < n_random))?;
        }
        Ok(())
    }

    /// Seeds for the keyframes that arrived without depth, from what they and other images show.
    fn seeds_from_images(&mut self, arrived: &[Arc<Keyframe>]) -> Vec<SplatArrays> {
        let (mut seeds, poor) = self.seeding.discs_from_images(arrived, &self.views);
        let all: Vec<&Keyframe> = self.views.keyframes().map(AsRef::as_ref).collect();
        let poor: Vec<&Keyframe> = poor.iter().map(AsRef::as_ref).collect();
        let n_before = all.len() - arrived.len();
        // Another seed for each arrival, so that no two clouds are alike.
        let seed = self.options.common.seed ^ n_before as u64;
        let n_random = self.seeding.random_splats() as usize;
        let n_max = seed::random_left(n_random, n_before).min(self.options.cap() as usize);
        seeds.push(seed::random_cloud(
            &poor,
            seed::common_focus(&all),
            seed,
            n_max,
        ));
        seeds
    }

    /// Queues at most `n` steps in one submit, see [`Method::step`](crate::Method::step). Returns
    /// their number. The model must have splats and views.
    pub(super) fn submit_steps(
        &mut self,
        learn: &TrainPipelines,
        n: u64,
        n_validation: usize,
    ) -> Result<u64, Error> {
        let n_steps = self.n_steps_of_submit(n);
        self.model
            .splats
            .set_active_degree(&self.recorder.gpu, self.schedule.active_degree());
        self.write_settings(n_validation);
        let since = Instant::now();
        self.prepare_images(n_steps)?;
        for step in self.schedule.step..self.schedule.step + n_steps {
            self.record_step(learn, step)?;
        }
        let counters = self.optimizer.submit(&mut self.recorder);
        self.schedule.step += n_steps;
        // This waits for the previous submit while the new submit runs, so that the GPU never
        // idles.
        let failed = self.finish_in_flight()?;
        // After a failure, the failure flag also turns this submit into a no-op. Its steps are
        // repeated, so its counters are not needed.
        if !failed {
            self.optimizer.submits.begin(counters, n_steps, since);
        }
        Ok(n_steps)
    }

    /// Takes one step with timestamps around every pass.
    pub(super) fn profile(&mut self, n_validation: usize) -> Result<Vec<PassTiming>, Error> {
        self.finish_in_flight()?;
        self.prepare_model()?;
        let learn = self.learn()?;
        self.write_settings(n_validation);
        self.record_step(&learn, self.schedule.step)?;
        let timings = self.recorder.passes.submit_timed(&self.recorder.gpu)?;
        // The scratch buffers still hold the lists of this step.
        let place = self.views.of_step(self.schedule.step);
        let image_buffers = self.optimizer.image_buffers()?;
        let counts = WorkCounts::read(
            &self.recorder.gpu,
            self.renderer.scratch()?,
            image_buffers,
            self.model.splats.n_splats,
            self.views.size_px(place),
        )?;
        log::info!("splat: {counts}");
        self.schedule.step += 1;
        Ok(timings)
    }

    /// If a change of the splat count is due, replaces dead splats and adds splats up to
    /// `max_splats`.
    pub(super) fn grow_when_due(
        &mut self,
        learn: &TrainPipelines,
        max_splats: u32,
    ) -> Result<(), Error> {
        if !self.schedule.is_growth_due() {
            return Ok(());
        }
        self.finish_in_flight()?;
        // If the submit failed, the change is due again once its steps are repeated.
        if !self.schedule.is_growth_due() {
            return Ok(());
        }
        self.schedule.last_growth_step = self.schedule.step;
        let key = growth_key(self.options.common.seed, self.schedule.step);
        let n_new = self.n_new_splats(max_splats);
        self.model
            .grow(&mut self.recorder, &mut self.renderer, learn, n_new, key)
    }

    /// Number of splats to add at a change of the splat count.
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "saturates, then limited"
    )]
    fn n_new_splats(&self, max_splats: u32) -> u32 {
        let n_splats = self.model.splats.n_splats;
        let n_new = (f64::from(n_splats) * self.options.specific.growth_frac).ceil() as u32;
        n_new.min(max_splats.saturating_sub(n_splats))
    }

    /// Number of steps of the next submit. The submit stays within its time limit and does not pass
    /// a step at which the splat count or the SH degree may change.
    fn n_steps_of_submit(&self, n_requested: u64) -> u64 {
        // Before the first measurement, the duration of a step is unknown.
        let by_time = self.optimizer.submits.n_steps_in_limit().unwrap_or(1);
        n_requested
            .min(by_time.clamp(1, MAX_STEPS_PER_SUBMIT))
            .min(self.schedule.steps_to_next_change())
    }

    /// Whether there are few images.
    fn scarcity(&self, n_validation: usize) -> Scarcity {
        Scarcity::of_images(self.views.len() + n_validation)
    }

    /// Background of pictures.
    pub(super) fn background_srgb(&self, n_validation: usize) -> [f32; 3] {
        // A loaded model has no images, so it keeps the background with which it was saved.
        if self.views.is_empty() {
            self.saved_background_srgb
        } else {
            self.scarcity(n_validation)
                .background_srgb(self.views.mean_srgb())
        }
    }

    /// Uploads the settings of the next steps.
    fn write_settings(&self, n_validation: usize) {
        let Self {
            options,
            recorder: Recorder { gpu, .. },
            model,
            optimizer,
            schedule,
            views,
            seeding,
            ..
        } = self;
        if !model.cameras.set.is_empty() {
            model
                .cameras
                .write_rule(gpu, schedule.completed_frac(), seeding.scene.size_m);
        }
        let n_splats = model.splats.n_splats;
        optimizer.set_n_splats(gpu, n_splats);
        // `drop_frac` and the background use `completed_frac`, which changes only at growth steps.
        // The result therefore does not depend on how many steps a submit holds.
        let scarcity = self.scarcity(n_validation);
        let drop_frac = scarcity.drop_frac(options.specific.drop_frac, schedule.completed_frac());
        optimizer.write_drop_frac(gpu, f32_of(drop_frac));
        optimizer.write_counter(gpu, status::DROP_SEED, growth_key(options.common.seed, 0));
        optimizer.write_supervision(gpu, &options.specific, scarcity, views.mean_srgb());
        optimizer.write_rule(
            gpu,
            &learning_rates::rule(options, schedule, &seeding.scene, views.len(), n_splats),
        );
    }

    /// Uploads the missing images of the next `n` steps. On a GPU, prepares images of later steps
    /// as well, which keeps all CPU cores busy and avoids waiting for images in each step.
    fn prepare_images(&mut self, n: u64) -> Result<(), Error> {
        // On a software adapter, preparing more images would take CPU cores from training.
        let n_at_once = if self.recorder.gpu.is_software() {
            0
        } else if self.optimizer.submits.is_watched() {
            VIEWS_AT_ONCE_WATCHED
        } else {
            MAX_STEPS_PER_SUBMIT
        };
        let step = self.schedule.step;
        self.views
            .prepare_steps(&mut self.recorder, step..step + n, n_at_once)
    }

    /// Records the passes of one step.
    fn record_step(&mut self, learn: &TrainPipelines, step: u64) -> Result<(), Error> {
        let place = self.views.of_step(step);
        // `submit_steps` has prepared the images of its steps, but `profile` has not.
        self.views
            .ensure_level(&mut self.recorder, place, self.schedule.step)?;
        self.reserve_view(self.views.size_px(place))?;
        let Self {
            recorder: Recorder { gpu, passes },
            model,
            renderer,
            optimizer,
            views,
            ..
        } = self;
        let context = StepContext {
            gpu,
            learn,
            renderer,
            model,
        };
        optimizer.record_step(&context, passes, views.ready_level(place)?)
    }

    /// Allocates the buffers for training on images of this size.
    pub(super) fn reserve_view(&mut self, size_px: [u32; 2]) -> Result<(), Error> {
        let capacity = self.model.splats.capacity;
        self.optimizer
            .reserve_view(&mut self.recorder, &mut self.renderer, capacity, size_px)
    }

    /// Waits for the submit in flight and applies its counters. Returns whether a buffer was too
    /// small for the submit.
    pub(super) fn finish_in_flight(&mut self) -> Result<bool, Error> {
        let Some(counters) = self.optimizer.submits.finish(&self.recorder.gpu)? else {
            return Ok(false);
        };
        self.optimizer
            .log_non_finite(counters[status::N_NON_FINITE].into());
        let grown = self
            .renderer
            .grow_scratch(&mut self.recorder, &counters, true);
        if matches!(grown, Ok(false)) {
            return Ok(false);
        }
        // The step counter on the GPU stops at the first step that did not fit. All later steps
        // were no-ops, so training continues there.
        let failed_step = u64::from(counters[status::STEP]);
        self.schedule.step = failed_step;
        match grown {
            Err(error) if error.is_out_of_memory() => self.skip_step(error)?,
            grown => _ = grown?,
        }
        self.optimizer.clear_failure(&self.recorder.gpu);
        Ok(true)
    }

    /// Skips the next step, because the buffers for its image cannot be allocated, and stops
    /// growing, because more splats need even larger buffers.
    ///
    /// # Errors
    ///
    /// Returns the given error if the steps of all images were skipped.
    fn skip_step(&mut self, error: Error) -> Result<(), Error> {
        self.model.stop_growing(&error);
        // Every image is used at least once within two rounds.
        let step = self.schedule.step;
        if self.skipped.add(step) > 2 * self.views.len() as u64 {
            return Err(error);
        }
        self.schedule.step = step + 1;
        let next_step = u32::try_from(step + 1).unwrap_or(u32::MAX);
        self.optimizer
            .write_counter(&self.recorder.gpu, status::STEP, next_step);
        Ok(())
    }

    /// The current splats.
    pub(super) fn arrays(&mut self) -> Result<SplatArrays, Error> {
        self.seed_from_depth()?;
        self.finish_in_flight()?;
        self.model.splats.read(&self.recorder.gpu)
    }

    /// Current corrections of each camera, including the corrections of a running trial. They apply
    /// to keyframes that alignment has already corrected.
    pub(super) fn learned_corrections(&self) -> Result<BTreeMap<String, CameraCorrection>, Error> {
        let cameras = &self.model.cameras;
        if cameras.set.is_empty() {
            return Ok(BTreeMap::new());
        }
        cameras.corrections(
            &self.recorder.gpu,
            cameras.set,
            &cameras.params,
            self.seeding.scene.size_m,
        )
    }

    /// Copies the state. Every keyframe must have been seeded.
    pub(super) fn snapshot(&self) -> Result<Snapshot, Error> {
        let gpu = &self.recorder.gpu;
        let splats = &self.model.splats;
        let cameras = &self.model.cameras;
        Ok(Snapshot {
            // Resizing to the same size copies the buffers.
            splats: splats.resized(gpu, splats.capacity, splats.sh_degree)?,
            cameras: (cameras.set, cameras.copy(gpu)?),
            schedule: self.schedule,
            scene: self.seeding.scene.clone(),
        })
    }

    /// Continues from a snapshot.
    pub(super) fn restore_snapshot(&mut self, snapshot: Snapshot) -> Result<(), Error> {
        self.recorder.passes.clear_bindings();
        self.model.splats = snapshot.splats;
        self.model
            .cameras
            .restore_snapshot(&self.recorder.gpu, snapshot.cameras)?;
        self.schedule = snapshot.schedule;
        self.seeding.scene = snapshot.scene;
        // Kernels derive learning rates and random numbers from their own step counter.
        let step = u32::try_from(self.schedule.step).unwrap_or(u32::MAX);
        self.optimizer
            .write_counter(&self.recorder.gpu, status::STEP, step);
        Ok(())
    }
}

/// Steps that were skipped one after another.
#[derive(Debug, Default)]
struct SkippedSteps {
    last: u64,
    n_consecutive: u64,
}

impl SkippedSteps {
    /// Adds a step. Returns the number of consecutive skipped steps up to this step.
    fn add(&mut self, step: u64) -> u64 {
        // This is logged once per run of skipped steps, because the number is at least 1 after the
        // first skipped step.
        if self.n_consecutive == 0 {
            log::warn!("images that need too much GPU memory are skipped in training");
        }
        let is_next = step == self.last + 1;
        self.n_consecutive = if is_next { self.n_consecutive + 1 } else { 1 };
        self.last = step;
        self.n_consecutive
    }
}

/// Random seed for one change of the splat count.
#[expect(clippy::cast_possible_truncation, reason = "bits of a hash")]
pub(super) fn growth_key(seed: u64, step: u64) -> u32 {
    // The constant is 2^32 divided by the golden ratio (Knuth's multiplicative hash). It gives
    // consecutive steps keys that differ in many bits.
    (step as u32).wrapping_mul(0x9e37_79b9) ^ seed as u32
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Method;
    use crate::splat::SplatTrainer;
    use crate::splat::training_tests::{keyframes, n_keyframes, options, request, train};
    use crate::splat::trials::CountPolicy;
    use gpu::GpuOptions;
    use gpu::testing::{test_gpu, test_gpu_with};
    use keyframe::Split;
    use model_files::splat::cloud::synthetic_cloud;

    const N_COVERING: u32 = 2000;

    /// A trainer whose GPU has too little memory for 2000 splats that cover the whole image, and
    /// its keyframes.
    fn with_little_memory() -> (SplatTrainer, Vec<Arc<Keyframe>>) {
        const MAX_BINDING_BYTES: u64 = 1_600_000; // Slightly more than the initial buffers.
        let gpu = test_gpu_with(&GpuOptions {
            max_binding_bytes: Some(MAX_BINDING_BYTES),
            ..GpuOptions::default()
        });
        let keyframes = n_keyframes(&gpu, 10, true);
        let mut trainer = SplatTrainer::new(
            gpu,
            options().with(|options| options.specific.coarse_steps = Some([0, 0])),
        )
        .unwrap();
        keyframes
            .iter()
            .for_each(|keyframe| trainer.push(keyframe.clone()).unwrap());
        train(&mut trainer, 3);
        let training = &mut trainer.training;
        training.finish_in_flight().unwrap();
        let learn = training.learn().unwrap();
        let n_more = N_COVERING - training.model.splats.n_splats;
        training
            .model
            .grow(
                &mut training.recorder,
                &mut training.renderer,
                &learn,
                n_more,
                0,
            )
            .unwrap();
        (trainer, keyframes)
    }

    /// Moves 2000 splats in front of a camera, so close that each covers the image.
    fn cover(trainer: &mut SplatTrainer, keyframe: &Keyframe, log_scale: f32) {
        const N: usize = N_COVERING as usize;
        let training = &trainer.training;
        assert_eq!(training.model.splats.n_splats, N_COVERING);
        let center = keyframe.world_from_camera * nalgebra::Point3::new(0.0, 0.0, 0.3);
        let [x, y, z] = numbers::f32s_of(center.coords.into());
        let (gpu, splats) = (&training.recorder.gpu, &training.model.splats);
        gpu.write(&splats.means, 0, bytemuck::cast_slice(&[[x, y, z, 0.0]; N]));
        gpu.write(
            &splats.shapes,
            0,
            bytemuck::cast_slice(&[[log_scale, log_scale, log_scale, -3.0]; N]),
        );
    }

    #[test]
    fn few_images_limit_the_number_of_splats() {
        const N_SPLATS: usize = 7900;
        let n_new = |count: CountPolicy| {
            let gpu = test_gpu();
            let options = options().with(|options| {
                options.specific.count = count;
                options.specific.max_splats = 100_000;
            });
            let cloud = synthetic_cloud(N_SPLATS, 1);
            let mut trainer = SplatTrainer::from_arrays(gpu.clone(), options, &cloud).unwrap();
            let only = keyframes(&gpu, true)
                .into_iter()
                .find(|keyframe| keyframe.split == Split::Train);
            trainer.push(only.unwrap()).unwrap();
            trainer.training.n_new_splats(trainer.max_splats())
        };
        assert_eq!(
            (n_new(CountPolicy::Tested), n_new(CountPolicy::ToCap)),
            (100, 790)
        );
    }

    #[test]
    fn image_that_needs_too_much_memory_is_skipped() {
        let (mut trainer, keyframes) = with_little_memory();
        let covered = keyframes
            .iter()
            .find(|keyframe| keyframe.split == Split::Train)
            .unwrap();
        cover(&mut trainer, covered, 0.05_f32.ln());
        let n_splats = trainer.training.model.splats.n_splats;
        train(&mut trainer, 40);
        assert_eq!(trainer.n_total_steps().unwrap(), 43);
        assert!(
            trainer.training.skipped.n_consecutive > 0,
            "the buffers were large enough for all images"
        );
        assert!(
            trainer.training.model.is_full() && trainer.training.model.splats.n_splats == n_splats,
            "the model still grows"
        );
        assert!(
            trainer.arrays().unwrap().checked().is_ok(),
            "a parameter is not finite"
        );
        // Pictures need no gradients, so even the covered view can be drawn.
        trainer.render(&request(covered.world_from_camera)).unwrap();
    }

    #[test]
    fn training_fails_if_no_image_fits_into_memory() {
        let (mut trainer, keyframes) = with_little_memory();
        cover(&mut trainer, &keyframes[0], 100.0_f32.ln());
        let error = (0..100)
            .find_map(|_| trainer.step(1).err())
            .expect("all images are skipped");
        assert!(error.is_out_of_memory(), "{error}");
    }
}
