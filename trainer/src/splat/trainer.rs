//! The splat model as a [`Method`]: seeding, training steps, growth and rendering.
#![expect(clippy::cast_possible_truncation, reason = "counts derived from caps that are u32, and bits of a seed")]

mod alignment_task;
mod checkpoint;
mod model_size;
mod scoring;

use super::arrays::SplatArrays;
use super::bounds::bounds;
use super::buffers::{ImageBuffers, Scratch, ScratchSize, SplatBuffers, n_bins, n_sh_rest, n_tiles};
use super::camera_params::CameraParams;
use super::file::IN_FOLDER;
use super::kernels::{DrawPipelines, TrainPipelines};
use super::options::SplatOptions;
use super::params::{Camera, Growth, Rule, Supervision, View, status};
use super::passes::{self, GrowthBuffers, Target, ViewPasses};
use super::ply;
use super::seed::{self, Density, Seeder};
use super::snapshot::{Seeding, Snapshot};
use super::trials::{Due, SecondHalf, SplatTrials, TrialContext, TrialEnd, ValidationImage};
use super::views::{self, Keep, Level, LevelImages, Order, TrainView};
use crate::checkpoint::PendingCheckpoint;
use crate::gpu::{Buffer, Gpu, PassTiming, Passes, PendingRead, Pipeline, f32_of};
use crate::method::submit_millis;
use crate::model_metadata::{METADATA_FILE, read_metadata};
use crate::model_options::{MethodOptions, ModelOptions};
use crate::view::projections;
use crate::{Bounds, Error, Method, Picture, Progress, Projection, RenderRequest};
use calibration::TrialReport;
use calibration::{Alignment, AlignmentTask};
use calibration::{CalibratedCamera, CameraCorrection, ParamSet};
use calibration::{CameraRefinement, Candidate, Trial};
use keyframe::{Keyframe, Split};
use kinematics::Stamp;
use kinematics::quantile::{Rank, quantile};
use rayon::prelude::*;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Instant;

/// Steps between changes of the splat count; the next constant is the step of the first change.
const GROWTH_PERIOD: u64 = 100;
const GROWTH_START: u64 = 200;
/// Fraction of the planned steps after which the splat count stays constant.
const GROWTH_END_FRAC: f64 = 0.75;
/// Steps between increases of the active degree of spherical harmonics.
const SH_PERIOD: u64 = 300;
/// Maximum number of steps per submit.
const MAX_STEPS_PER_SUBMIT: u64 = 64;
/// Maximum bytes of images on a software adapter, which shares the host memory that already holds all keyframes.
const SOFTWARE_IMAGE_BYTES: u64 = 256 << 20;
/// Number of images uploaded together when all views are processed in turn.
const VIEWS_AT_ONCE: usize = 16;
/// Number of images prepared and uploaded together while pictures are requested. A larger number would delay pictures
/// too much.
const VIEWS_AT_ONCE_WATCHED: u64 = 4;
/// Readings further than this from the rendered depth are treated as outliers.
const DEPTH_CLIP_M: f64 = 0.2;

/// Maximum share of the splat limit that the seeds of one image may take, so that other images get some, too.
const SEED_SHARE: f64 = 1.0 / 8.0;
/// Minimum number of pixels per seed. With more seeds, the first steps take longer than they gain.
const PX_PER_SEED: f64 = 48.0;
/// Standard deviation of a child's position within its parent, in standard deviations of the parent.
const CHILD_SPREAD: f32 = 0.5;
/// Maximum costs of opacity and size relative to the color loss.
const MAX_COST: f64 = 0.1;

/// Trains 3D Gaussian splats on keyframes.
#[derive(Debug)]
pub struct SplatTrainer {
    gpu: Arc<Gpu>,
    options: ModelOptions<SplatOptions>,
    draw: DrawPipelines,
    train: TrainPipelineState,
    splats: SplatBuffers,
    scratch: Option<(ScratchSize, Scratch)>,
    training_buffers: Option<ImageBuffers>,
    drawing_buffers: Option<ImageBuffers>,
    train_status: Buffer,
    draw_status: Buffer,
    draw_view: Buffer,
    rule: Buffer,
    supervision: Buffer,
    plain: Buffer,
    cameras: CameraParams,
    /// Corrections of the saved model that this one was loaded from.
    saved_corrections: BTreeMap<String, CameraCorrection>,
    alignment_task: AlignmentTask,
    trials: SplatTrials,
    passes: Passes,
    seeder: Seeder,
    /// Keyframes whose depth has not been used for seeding yet.
    pending: Vec<Arc<Keyframe>>,
    /// Keyframes without dense depth that arrived since the last step.
    unseeded: Vec<Arc<Keyframe>>,
    seeds_per_image: f64,
    coarse_steps: [u64; 2],
    views: Vec<TrainView>,
    /// Maximum bytes of the views' images on the GPU, unless a submit needs more.
    max_image_bytes: u64,
    /// Number of requests for images, for evicting the least recently used ones.
    n_image_requests: u64,
    order: Order,
    scene_size_m: f64,
    has_depth: bool,
    step: u64,
    /// Steps of trials that were reverted.
    n_reverted_steps: u64,
    /// Step at which the planned steps begin; late keyframes move it forward.
    schedule_start: u64,
    last_growth_step: u64,
    /// Whether the GPU has no memory left for more splats.
    is_full: bool,
    n_non_finite: u64,
    in_flight: Option<InFlight>,
    idle_since: Instant,
    step_millis: f64,
    /// Whether pictures are requested.
    is_watched: bool,
    /// Image buffer of the last comparison, for reuse.
    compared: Option<Buffer>,
}

/// The parts of a picture that are read back.
#[derive(Clone, Copy, Debug)]
enum RequestedParts<'a> {
    Nothing,
    Color,
    ColorAndDepth,
    /// The sums of `score.wgsl` for a comparison with an image.
    Comparison {
        score: &'a Pipeline,
        image: &'a Buffer,
    },
}

/// Whether the training pipelines are compiled.
#[derive(Debug)]
enum TrainPipelineState {
    OnDemand,
    Compiling(Compiling),
    Ready(Arc<TrainPipelines>),
    Failed,
}

/// Pipelines being compiled on a thread. Dropping it waits for the thread, because NVIDIA's driver corrupts the heap
/// if a process exits while the driver compiles.
#[derive(Debug)]
struct Compiling(Option<JoinHandle<Result<TrainPipelines, Error>>>);

impl Compiling {
    fn start(gpu: &Arc<Gpu>) -> Self {
        let gpu = gpu.clone();
        Self(Some(std::thread::spawn(move || TrainPipelines::new(&gpu))))
    }

    fn finish(&mut self) -> Result<TrainPipelines, Error> {
        self.0.take().and_then(|thread| thread.join().ok()).unwrap_or(Err(Error::DeviceLost))
    }
}

impl Drop for Compiling {
    fn drop(&mut self) {
        let _ = self.finish();
    }
}

/// The resources of one training step.
struct PreparedView<'a> {
    view: ViewPasses<'a>,
    level: &'a Level,
    /// Present if camera parameters are optimized.
    lens: Option<&'a Buffer>,
}

#[derive(Debug)]
struct InFlight {
    status: PendingRead,
    n_steps: u64,
    since: Instant,
}

impl SplatTrainer {
    /// Creates an empty model. It can draw at once; the training pipelines are compiled on another thread.
    pub fn new(gpu: Arc<Gpu>, options: ModelOptions<SplatOptions>) -> Result<Self, Error> {
        let train = TrainPipelineState::Compiling(Compiling::start(&gpu));
        Self::with_pipelines(gpu, options, train)
    }

    fn with_pipelines(
        gpu: Arc<Gpu>,
        options: ModelOptions<SplatOptions>,
        train: TrainPipelineState,
    ) -> Result<Self, Error> {
        let draw = DrawPipelines::new(&gpu)?;
        let zeros = [0u8; 4 * status::LEN];
        let software = gpu.is_software();
        Ok(Self {
            draw,
            train,
            splats: SplatBuffers::new(&gpu, 1, options.specific.sh_degree)?,
            scratch: None,
            training_buffers: None,
            drawing_buffers: None,
            train_status: gpu.storage_with("splat.train_status", &zeros)?,
            draw_status: gpu.storage_with("splat.draw_status", &zeros)?,
            draw_view: gpu.uniform_with("splat.draw_view", &<View as bytemuck::Zeroable>::zeroed()),
            rule: gpu.uniform_with("splat.rule", &<Rule as bytemuck::Zeroable>::zeroed()),
            supervision: gpu.uniform_with(
                "splat.supervision",
                &Supervision {
                    background_srgb: [0.0; 4],
                    dssim_frac: f32_of(options.specific.dssim_frac),
                    depth_weight: f32_of(options.specific.depth_per_m),
                    depth_clip_m: f32_of(DEPTH_CLIP_M),
                    random_background: f32_of(options.specific.random_background),
                },
            ),
            plain: gpu.uniform_with("splat.background", &<Supervision as bytemuck::Zeroable>::zeroed()),
            cameras: CameraParams::new(
                &gpu,
                match &options.common.cameras {
                    CameraRefinement::Always(params) => *params,
                    CameraRefinement::Try(_) => ParamSet::empty(),
                },
            )?,
            saved_corrections: BTreeMap::new(),
            alignment_task: AlignmentTask::new(&options.common.align),
            trials: SplatTrials::new(&options.common.cameras, options.specific.count),
            passes: Passes::default(),
            seeder: Seeder::default(),
            pending: Vec::new(),
            unseeded: Vec::new(),
            seeds_per_image: options
                .specific
                .seeds_per_image
                .unwrap_or(if software { 4_000.0 } else { 20_000.0 })
                .min(f64::from(options.cap()) * SEED_SHARE),
            coarse_steps: options.specific.coarse_steps.unwrap_or(if software { [500, 4000] } else { [150, 400] }),
            views: Vec::new(),
            max_image_bytes: if software { SOFTWARE_IMAGE_BYTES } else { u64::MAX },
            n_image_requests: 0,
            order: Order::new(options.common.seed),
            scene_size_m: 1.0,
            has_depth: false,
            step: 0,
            n_reverted_steps: 0,
            schedule_start: 0,
            last_growth_step: 0,
            is_full: false,
            n_non_finite: 0,
            in_flight: None,
            idle_since: Instant::now(),
            step_millis: 0.0,
            is_watched: false,
            compared: None,
            gpu,
            options,
        })
    }

    /// Creates a model of given splats, for drawing or training. The training pipelines are compiled at the first
    /// step.
    pub fn from_arrays(
        gpu: Arc<Gpu>,
        options: ModelOptions<SplatOptions>,
        arrays: &SplatArrays,
    ) -> Result<Self, Error> {
        let options = options.with(|options| options.specific.sh_degree = arrays.sh_degree);
        let mut trainer = Self::with_pipelines(gpu, options, TrainPipelineState::OnDemand)?;
        trainer.add(arrays)?;
        Ok(trainer)
    }

    /// Loads the camera corrections of a saved model from its `model.json`.
    pub fn with_saved_corrections(mut self, folder: &Path) -> Result<Self, Error> {
        let metadata = read_metadata(folder)?;
        self.saved_corrections = metadata.cameras;
        self.alignment_task = AlignmentTask::Done(metadata.alignment);
        Ok(self)
    }

    /// The current splats.
    pub fn arrays(&mut self) -> Result<SplatArrays, Error> {
        self.seed_from_depth()?;
        self.finish_in_flight()?;
        self.splats.read(&self.gpu)
    }

    /// The options.
    pub fn options(&self) -> &ModelOptions<SplatOptions> {
        &self.options
    }

    /// Estimated corrections of each camera; empty if none are estimated.
    pub fn camera_corrections(&mut self) -> Result<BTreeMap<String, CameraCorrection>, Error> {
        self.finish_in_flight()?;
        let displayed = self.trials.baseline().map(|snapshot| &snapshot.cameras);
        let (set, params) = displayed.map_or((self.cameras.set, &self.cameras.params), |(set, params)| (*set, params));
        if set.is_empty() {
            return Ok(self.saved_corrections.clone());
        }
        self.cameras.corrections(&self.gpu, set, params, self.scene_size_m)
    }

    /// Current corrections of each camera, including a running trial's, for keyframes that alignment has already
    /// corrected.
    fn learned_corrections(&self) -> Result<CameraCorrections, Error> {
        let (set, params) = (self.cameras.set, &self.cameras.params);
        if !set.is_empty() {
            self.cameras.corrections(&self.gpu, set, params, self.scene_size_m)
        } else {
            Ok(CameraCorrections::new())
        }
    }

    #[cfg(test)]
    pub(super) fn assume_step_millis(&mut self, millis: f64) {
        self.step_millis = millis;
    }

    /// Limits the bytes of images on the GPU, as on a software adapter.
    #[cfg(test)]
    pub(super) fn limit_image_bytes(&mut self, max_bytes: u64) {
        self.max_image_bytes = max_bytes;
    }

    #[cfg(test)]
    pub(super) fn image_bytes(&self) -> u64 {
        self.views.iter().map(TrainView::image_bytes).sum()
    }

    #[cfg(test)]
    pub(super) fn n_steps_on_gpu(&self) -> u64 {
        self.gpu.read::<u32>(&self.train_status, status::LEN).unwrap()[status::STEP].into()
    }

    /// Number of positions that are seeded.
    #[cfg(test)]
    pub(super) fn n_seeds(&self) -> usize {
        self.seeder.n_seeds()
    }

    #[cfg(test)]
    pub(super) fn n_views_of(&self, keyframe: &Keyframe) -> usize {
        self.views.iter().filter(|view| view.keyframe.stamp == keyframe.stamp).count()
    }

    /// Number of gradients dropped because they were not finite.
    pub fn n_non_finite(&self) -> u64 {
        self.n_non_finite
    }

    fn train_pipelines(&mut self) -> Result<Arc<TrainPipelines>, Error> {
        if let TrainPipelineState::Ready(ready) = &self.train {
            return Ok(ready.clone());
        }
        let ready = Arc::new(match std::mem::replace(&mut self.train, TrainPipelineState::Failed) {
            TrainPipelineState::Compiling(mut thread) => thread.finish()?,
            TrainPipelineState::OnDemand => TrainPipelines::new(&self.gpu)?,
            TrainPipelineState::Ready(_) | TrainPipelineState::Failed => return Err(Error::DeviceLost),
        });
        self.train = TrainPipelineState::Ready(ready.clone());
        Ok(ready)
    }

    /// Adds splats, up to the limit.
    fn add(&mut self, arrays: &SplatArrays) -> Result<(), Error> {
        let n_new = arrays.n_splats().min((self.options.cap() - self.splats.n_splats.min(self.options.cap())) as usize);
        if n_new == 0 {
            return Ok(());
        }
        let n_after = self.splats.n_splats + u32::try_from(n_new).expect("the cap is a u32");
        let n_new = (self.reserve_up_to(n_after)? - self.splats.n_splats) as usize;
        if n_new == 0 {
            return Ok(());
        }
        let kept = if n_new == arrays.n_splats() { arrays.clone() } else { spread_out(arrays, n_new) };
        self.splats.append(&self.gpu, &kept);
        self.write_n_splats();
        Ok(())
    }

    /// Ensures capacity for `n_splats`. If the GPU has no memory for them, returns the smaller number that fits.
    fn reserve_up_to(&mut self, n_splats: u32) -> Result<u32, Error> {
        if self.is_full {
            return Ok(n_splats.min(self.splats.capacity));
        }
        match self.reserve(n_splats) {
            Ok(()) => Ok(n_splats),
            Err(error) if error.is_out_of_memory() && self.splats.n_splats > 0 => {
                self.is_full = true;
                log::warn!("the model stops growing at {} splats: {error}", self.splats.n_splats);
                Ok(n_splats.min(self.splats.capacity))
            }
            Err(error) => Err(error),
        }
    }

    fn reserve(&mut self, n_splats: u32) -> Result<(), Error> {
        if n_splats > self.splats.capacity {
            let capacity =
                n_splats.max(self.splats.capacity.saturating_mul(3) / 2).min(self.options.cap().max(n_splats));
            // Resized before the model itself, because every model that fits must also be drawable.
            let have = self.scratch.as_ref().map(|(size, _)| *size);
            if let Some(have) = have {
                let n_entries = have.n_entries.max(2 * capacity);
                let n_slots = if have.n_slots > 0 { have.n_slots.max(4 * capacity) } else { 0 };
                self.ensure_scratch(ScratchSize { n_splats: capacity, n_entries, n_slots, ..have })?;
            }
            self.splats = self.splats.resized(&self.gpu, capacity, self.splats.sh_degree)?;
            self.passes.clear_bindings();
        }
        Ok(())
    }

    fn write_n_splats(&self) {
        for status in [&self.train_status, &self.draw_status] {
            self.write_n_splats_to(status, self.splats.n_splats);
        }
    }

    fn write_n_splats_to(&self, status: &Buffer, n_splats: u32) {
        self.gpu.write(status, 4 * u64::from(status::N_SPLATS), bytemuck::bytes_of(&n_splats));
    }

    /// The splats that viewers see: during a trial, those without the change.
    fn displayed(&self) -> &SplatBuffers {
        self.trials.baseline().map_or(&self.splats, |snapshot| &snapshot.splats)
    }

    fn density(&self) -> Density {
        Density { max_discs: self.seeds_per_image, px_per_disc: PX_PER_SEED }
    }

    /// Adds discs at new depth readings of the keyframes that arrived since the last call.
    fn seed_from_depth(&mut self) -> Result<(), Error> {
        let pending = std::mem::take(&mut self.pending);
        if pending.is_empty() {
            return Ok(());
        }
        self.measure_scene();
        let discs = self.seeder.discs(&pending, self.density());
        self.add(&discs)?;
        self.unseeded.extend(pending.into_iter().filter(|keyframe| keyframe.lacks_dense_depth()));
        Ok(())
    }

    /// Adds splats for areas that depth does not cover: discs for keyframes without depth, or a random cloud if there
    /// is no depth at all.
    fn prepare_training(&mut self) -> Result<(), Error> {
        self.seed_from_depth()?;
        for keyframe in std::mem::take(&mut self.unseeded) {
            if self.has_depth {
                let discs = self.seeder.discs_without_depth(&keyframe, self.density(), self.scene_size_m);
                self.add(&discs)?;
            }
        }
        if !self.cameras.set.is_empty() {
            for view in &mut self.views {
                view.assign_lens(&self.gpu, &mut self.cameras)?;
            }
        }
        if self.splats.n_splats == 0 && !self.views.is_empty() {
            let keyframes: Vec<&Keyframe> = self.views.iter().map(|view| view.keyframe.as_ref()).collect();
            let cloud = seed::random_cloud(&keyframes, self.options.common.seed, self.options.cap() as usize);
            self.add(&cloud)?;
        }
        Ok(())
    }

    /// Measures the scale of the scene for the learning rate of the means, from the spread of the cameras or their
    /// median depth.
    fn measure_scene(&mut self) {
        let keyframes: Vec<&Keyframe> = self.views.iter().map(|view| view.keyframe.as_ref()).collect();
        let centers: Vec<_> = keyframes.iter().map(|keyframe| keyframe.world_from_camera.translation.vector).collect();
        let middle = centers.iter().sum::<nalgebra::Vector3<f64>>() / centers.len().max(1) as f64;
        let spread = centers.iter().map(|center| (center - middle).norm()).fold(0.0, f64::max);
        let mut depths: Vec<f64> = self.views.iter().filter_map(|view| view.median_depth_m).collect();
        let median_depth_m = quantile(&mut depths, 0.5, Rank::Upper).unwrap_or(spread);
        self.scene_size_m = (1.1 * spread).max(0.5 * median_depth_m).max(1e-3);
    }

    fn write_rule(&self) {
        if !self.cameras.set.is_empty() {
            // The first step of a submit depends on timing. Values that are set once per submit must not depend on
            // it.
            let step = self.step - self.step % GROWTH_PERIOD;
            let completed =
                step.saturating_sub(self.schedule_start) as f64 / self.options.common.n_planned_steps.max(1) as f64;
            self.cameras.write_rule(&self.gpu, completed, self.scene_size_m);
        }
        let size = f32_of(self.scene_size_m);
        let cost = (self.options.specific.cost_images / self.views.len().max(1) as f64).powi(2).min(MAX_COST);
        let cost = f32_of(cost / f64::from(self.splats.n_splats.max(1)));
        let rule = Rule {
            mean_rate_m: 1.6e-4 * size,
            log_scale_rate: 5e-3,
            rotation_rate: 1e-3,
            opacity_rate: 5e-2,
            sh_dc_rate: 2.5e-3,
            sh_rest_rate: 2.5e-3 / 20.0,
            noise: f32_of(self.options.specific.noise),
            final_mean_rate_frac: 0.01,
            betas: [0.9, 0.999],
            epsilon: 1e-15,
            n_planned_steps: f32_of(self.options.common.n_planned_steps as f64),
            schedule_start: f32_of(self.schedule_start as f64),
            opacity_cost: cost,
            scale_cost: cost,
            log_scale_range: [(1e-5 * size).ln(), (2.0 * size).ln()],
            seed: (self.options.common.seed ^ (self.options.common.seed >> 32)) as u32,
            update_all: u32::from(!self.has_depth),
            unused: 0,
        };
        self.gpu.write(&self.rule, 0, bytemuck::bytes_of(&rule));
    }

    /// Uploads the missing images of the next `n` steps.
    fn prepare_levels(&mut self, n: u64) -> Result<(), Error> {
        let mut requested = self.upcoming_levels(n);
        let all_there = requested.iter().all(|(view_ix, level)| self.views[*view_ix].has_level(*level));
        if !all_there && !self.gpu.is_software() {
            // Enough images to use all processors, and so that the time of a step does not include that of its
            // images.
            requested =
                self.upcoming_levels(n.max(if self.is_watched { VIEWS_AT_ONCE_WATCHED } else { MAX_STEPS_PER_SUBMIT }));
        }
        self.make_levels(&requested)
    }

    /// Views and levels of the next `n` steps.
    fn upcoming_levels(&mut self, n: u64) -> BTreeSet<(usize, usize)> {
        let mut upcoming_levels = BTreeSet::new();
        for step in self.step..self.step + n {
            let view_ix = self.order.pick(step, self.views.len());
            upcoming_levels.insert((view_ix, self.views[view_ix].clamped(level_at(step, self.coarse_steps))));
        }
        upcoming_levels
    }

    /// Uploads the missing ones of these levels of views, using all processors. Other images may be evicted.
    fn make_levels(&mut self, requested: &BTreeSet<(usize, usize)>) -> Result<(), Error> {
        let missing: Vec<(usize, usize)> =
            requested.iter().copied().filter(|(view_ix, level)| !self.views[*view_ix].has_level(*level)).collect();
        if !missing.is_empty() {
            let made: Vec<LevelImages> = missing
                .par_iter()
                .map(|(view_ix, level)| LevelImages::new(&self.views[*view_ix].keyframe, *level))
                .collect();
            let new_bytes = made.iter().map(LevelImages::bytes).sum();
            let keep = Keep {
                needed: requested,
                coarsest: level_at(self.step, self.coarse_steps),
                max_bytes: self.max_image_bytes.saturating_sub(new_bytes),
            };
            let mut dropped = views::drop_levels(&mut self.views, keep);
            if !dropped.is_empty() && !self.passes.is_empty() {
                self.passes.submit(&self.gpu); // The recorded passes use the images that are replaced.
            }
            for ((view_ix, level), images) in missing.into_iter().zip(&made) {
                let same_size = dropped.iter().position(|level| level.size_px == images.size_px());
                let reused = same_size.map(|ix| dropped.swap_remove(ix));
                self.views[view_ix].upload(&self.gpu, level, images, reused)?;
            }
            if !dropped.is_empty() {
                self.passes.clear_bindings();
            }
        }
        self.n_image_requests += 1;
        for (view_ix, level) in requested {
            self.views[*view_ix].mark_used(*level, self.n_image_requests);
        }
        Ok(())
    }

    /// Records the passes of one step.
    fn record_step(&mut self, pipelines: &TrainPipelines, step: u64) -> Result<(), Error> {
        let view_ix = self.order.pick(step, self.views.len());
        let level_ix = self.make_ready(view_ix, level_at(step, self.coarse_steps))?;
        let mut list = std::mem::take(&mut self.passes);
        let listed = self.list_step(&mut list, pipelines, (view_ix, level_ix));
        self.passes = list;
        listed
    }

    fn list_step(
        &self,
        list: &mut Passes,
        pipelines: &TrainPipelines,
        view_level: (usize, usize),
    ) -> Result<(), Error> {
        let PreparedView { view, level, lens } = self.prepared_view(list, pipelines, view_level)?;
        let target = Target {
            image: &level.image,
            depth: &level.depth,
            supervision: &self.supervision,
            gains: &self.cameras.gains,
            ssim: self.options.specific.dssim_frac > 0.0,
        };
        view.draw(list, &self.draw);
        view.compare(list, pipelines, &target);
        view.backward(list, pipelines);
        if let Some(lens) = lens {
            view.update(list, &pipelines.update_with_camera, &self.rule, true);
            self.cameras.refine(&view, list, pipelines, lens);
        } else {
            view.update(list, &pipelines.update, &self.rule, false);
        }
        list.dispatch(&self.gpu, &pipelines.advance, 1, &[("status", &self.train_status)]);
        Ok(())
    }

    /// Prepares images and buffers for training on a view, `2^level` times smaller or at its smallest level. Returns
    /// the level used.
    fn make_ready(&mut self, view_ix: usize, level: u32) -> Result<usize, Error> {
        let level_ix = self.views[view_ix].clamped(level);
        if !self.views[view_ix].has_level(level_ix) {
            self.make_levels(&BTreeSet::from([(view_ix, level_ix)]))?;
        }
        self.make_space(view_ix, level_ix)?;
        Ok(level_ix)
    }

    /// Allocates the buffers for training on a view at a level, without its images.
    fn make_space(&mut self, view_ix: usize, level_ix: usize) -> Result<(), Error> {
        let size_px = self.views[view_ix].size_at(level_ix);
        self.make_scratch(size_px, true)?;
        ensure_image_buffers(&self.gpu, &mut self.training_buffers, &mut self.passes, size_px, true)
    }

    /// A prepared view and level with its current camera parameters; records the pass that computes the view.
    fn prepared_view(
        &self,
        list: &mut Passes,
        pipelines: &TrainPipelines,
        (view_ix, level_ix): (usize, usize),
    ) -> Result<PreparedView<'_>, Error> {
        let (lens, level) = self.views[view_ix].ready_level(level_ix)?;
        let lens = lens.filter(|_| !self.cameras.set.is_empty());
        let (Some((_, scratch)), Some(image_buffers)) = (&self.scratch, &self.training_buffers) else {
            return Err(Error::DeviceLost);
        };
        if let Some(lens) = lens {
            self.cameras.correct(&self.gpu, list, pipelines, &level.view, lens);
        }
        let view = ViewPasses {
            gpu: &self.gpu,
            splats: &self.splats,
            scratch,
            image_buffers,
            status: &self.train_status,
            view: if lens.is_some() { &self.cameras.corrected } else { &level.view },
            size_px: level.size_px,
        };
        Ok(PreparedView { view, level, lens })
    }

    /// Ensures that a view of this size can be drawn, or trained on.
    fn make_scratch(&mut self, size_px: [u32; 2], for_training: bool) -> Result<(), Error> {
        let n_splats = self.splats.capacity.max(self.displayed().capacity);
        let n_entries = (2 * n_splats).max(1 << 14);
        let n_slots = if for_training { 2 * n_entries } else { 0 };
        self.ensure_scratch(ScratchSize { n_splats, n_entries, n_slots, n_bins: n_bins(size_px) })
    }

    fn ensure_scratch(&mut self, need: ScratchSize) -> Result<(), Error> {
        let have = self.scratch.as_ref().map(|(size, _)| *size);
        let fits = have.is_some_and(|have| {
            have.n_splats >= need.n_splats
                && have.n_entries >= need.n_entries
                && have.n_slots >= need.n_slots
                && have.n_bins >= need.n_bins
        });
        if fits {
            return Ok(());
        }
        let have = have.unwrap_or(need);
        let size = ScratchSize {
            n_splats: need.n_splats.max(have.n_splats),
            n_entries: need.n_entries.max(have.n_entries),
            n_slots: need.n_slots.max(have.n_slots),
            n_bins: need.n_bins.max(have.n_bins),
        };
        self.passes.submit(&self.gpu); // The recorded passes use the old buffers.
        self.passes.clear_bindings();
        let had = self.scratch.take().map(|(size, _)| size);
        let made = Scratch::new(&self.gpu, &self.draw, size);
        if made.is_err()
            && let Some(had) = had
        {
            self.scratch = Some((had, Scratch::new(&self.gpu, &self.draw, had)?));
        }
        self.scratch = Some((size, made?));
        Ok(())
    }

    /// Grows the buffers after a failed submit. Returns whether it had failed.
    fn grow_scratch(&mut self, counters: &[u32]) -> Result<bool, Error> {
        if counters[status::FAILED] == 0 {
            return Ok(false);
        }
        let Some((size, _)) = self.scratch else { return Ok(false) };
        let larger = |need: u32, have: u32| if need > have { need.saturating_add(need / 2) } else { have };
        let need = ScratchSize {
            n_entries: larger(counters[status::NEED_ENTRIES], size.n_entries),
            n_slots: if size.n_slots == 0 { 0 } else { larger(counters[status::NEED_SLOTS], size.n_slots) },
            ..size
        };
        log::debug!("splat: intersections need {need:?}");
        self.ensure_scratch(need)?;
        Ok(true)
    }

    /// Waits for the submit in flight and records its results. Returns whether a buffer was too small for it.
    fn finish_in_flight(&mut self) -> Result<bool, Error> {
        let Some(in_flight) = self.in_flight.take() else { return Ok(false) };
        let counters: Vec<u32> = in_flight.status.finish(&self.gpu)?;
        let completed = Instant::now();
        let began = in_flight.since.max(self.idle_since); // The previous submit was still running then.
        self.idle_since = completed;
        let millis = (completed - began).as_secs_f64() * 1e3 / in_flight.n_steps.max(1) as f64;
        self.step_millis = if self.step_millis == 0.0 { millis } else { 0.8 * self.step_millis + 0.2 * millis };
        self.log_non_finite(counters[status::N_NON_FINITE].into());
        let failed = self.grow_scratch(&counters)?;
        if failed {
            self.step = u64::from(counters[status::STEP]);
            self.gpu.write(&self.train_status, 4 * status::FAILED as u64, &[0; 12]);
        }
        Ok(failed)
    }

    /// Records the number of non-finite gradients; logs a warning at the first ones and at each doubling.
    fn log_non_finite(&mut self, n_non_finite: u64) {
        if n_non_finite.checked_ilog2() > self.n_non_finite.checked_ilog2() {
            log::warn!("dropped {n_non_finite} non-finite gradients of splats so far");
        }
        self.n_non_finite = n_non_finite;
    }

    /// Step at which growth ends.
    fn growth_end(&self) -> u64 {
        let end = self.schedule_start + (GROWTH_END_FRAC * self.options.common.n_planned_steps as f64) as u64;
        end.next_multiple_of(GROWTH_PERIOD) // Submits end at these steps.
    }

    /// Changes the splat count when due: replaces dead splats, and adds splats up to the limit.
    fn grow_when_due(&mut self, pipelines: &TrainPipelines) -> Result<(), Error> {
        let due = self.step >= GROWTH_START
            && self.step < self.growth_end()
            && self.step.is_multiple_of(GROWTH_PERIOD)
            && self.last_growth_step != self.step;
        if !due {
            return Ok(());
        }
        self.finish_in_flight()?;
        if !self.step.is_multiple_of(GROWTH_PERIOD) {
            return Ok(()); // The submit failed; the change is due again once its steps are repeated.
        }
        self.last_growth_step = self.step;
        let n_before = self.splats.n_splats;
        let more = if self.trials.may_grow() && !self.is_full {
            (f64::from(n_before) * self.options.specific.growth_frac).ceil() as u32
        } else {
            0
        };
        let n_after = (n_before + more).min(self.options.cap()).max(n_before);
        let n_after = self.reserve_up_to(n_after)?.max(n_before);
        let growth = Growth {
            n_before,
            n_after,
            key: (self.step as u32).wrapping_mul(0x9e37_79b9) ^ self.options.common.seed as u32,
            capacity: self.splats.capacity,
            n_sh_rest: n_sh_rest(self.splats.sh_degree),
            child_spread: CHILD_SPREAD,
            min_opacity: 0.005,
            unused: 0.0,
        };
        let buffers = match self.growth_buffers(&growth) {
            Err(error) if error.is_out_of_memory() => {
                if !std::mem::replace(&mut self.is_full, true) {
                    log::warn!("the model stops growing at {n_before} splats: {error}");
                }
                return Ok(());
            }
            buffers => buffers?,
        };
        passes::grow(&self.gpu, &mut self.passes, pipelines, &self.splats, &buffers, &growth);
        self.passes.submit(&self.gpu);
        self.passes.clear_bindings();
        self.splats.set_n_splats(&self.gpu, n_after);
        self.write_n_splats();
        Ok(())
    }

    fn growth_buffers(&self, growth: &Growth) -> Result<GrowthBuffers, Error> {
        let words = |name: &str, n: u32| self.gpu.storage(name, 4 * u64::from(n));
        Ok(GrowthBuffers {
            growth: self.gpu.uniform_with("splat.growth", growth),
            weights: words("splat.weights", growth.n_before)?,
            cumulative: words("splat.cumulative", growth.n_before)?,
            block_weights: words("splat.block_weights", growth.n_before.div_ceil(256))?,
            n_children: words("splat.n_children", growth.n_before)?,
            parents: words("splat.parents", growth.n_after)?,
        })
    }

    fn snapshot(&self) -> Result<Snapshot, Error> {
        Ok(Snapshot {
            splats: self.splats.resized(&self.gpu, self.splats.capacity, self.splats.sh_degree)?,
            cameras: (self.cameras.set, self.cameras.copy(&self.gpu)?),
            step: self.step,
            last_growth_step: self.last_growth_step,
            seeding: Seeding {
                seeder: self.seeder.clone(),
                scene_size_m: self.scene_size_m,
                has_depth: self.has_depth,
                schedule_start: self.schedule_start,
            },
        })
    }

    fn restore_snapshot(&mut self, snapshot: Snapshot) -> Result<(), Error> {
        self.passes.clear_bindings();
        self.n_reverted_steps = self.n_reverted_steps.wrapping_add(self.step).wrapping_sub(snapshot.step);
        (self.splats, self.step, self.last_growth_step) = (snapshot.splats, snapshot.step, snapshot.last_growth_step);
        self.cameras.restore_snapshot(&self.gpu, snapshot.cameras)?;
        let Seeding { seeder, scene_size_m, has_depth, schedule_start } = snapshot.seeding;
        (self.seeder, self.scene_size_m, self.has_depth) = (seeder, scene_size_m, has_depth);
        self.schedule_start = schedule_start;
        self.write_n_splats();
        let step = u32::try_from(self.step).unwrap_or(u32::MAX);
        self.gpu.write(&self.train_status, 4 * status::STEP as u64, bytemuck::bytes_of(&step));
        Ok(())
    }

    fn trial_context(&self) -> TrialContext {
        TrialContext {
            step: self.step,
            n_splats: self.splats.n_splats,
            is_mature: self.step >= self.growth_end(),
            sh_degree: self.splats.sh_degree,
        }
    }

    /// Starts, advances and ends trials. All consequences of the end of a trial are applied at the same step, because
    /// the end of the next submit depends on timing.
    fn try_when_due(&mut self) -> Result<(), Error> {
        while self.trials.due(self.trial_context()) != Due::Nothing {
            self.finish_in_flight()?; // A failed submit may reduce the step count.
            match self.trials.due(self.trial_context()) {
                Due::Nothing => {}
                Due::Begin(candidate) => match self.snapshot() {
                    Ok(snapshot) => self.trials.begin(candidate, snapshot, self.views.len()),
                    Err(error) => self.end_trials_without_memory(error)?,
                },
                Due::BeginSecondHalf => self.start_second_half()?,
                Due::Arrival => {
                    if let Some(keyframe) = self.trials.next_arrival() {
                        self.add_keyframe(keyframe)?;
                        self.prepare_training()?;
                    }
                }
                Due::Gains => self.try_gains()?,
                Due::End => {
                    let variant_db = self.score_validation()?;
                    if let Some(finished) = self.trials.end(&variant_db) {
                        self.end_trial(finished)?;
                        self.prepare_training()?;
                    }
                }
                Due::ReleaseValidation => self.release_validation()?,
            }
        }
        Ok(())
    }

    fn release_validation(&mut self) -> Result<(), Error> {
        for keyframe in self.trials.finish() {
            self.add_view(keyframe)?;
        }
        self.prepare_training()
    }

    /// Ends all trials, which need copies of the model, if there is no memory for them. Training continues.
    fn end_trials_without_memory(&mut self, error: Error) -> Result<(), Error> {
        if !error.is_out_of_memory() {
            return Err(error);
        }
        log::warn!("model changes are no longer tested: {error}");
        self.release_validation()
    }

    /// Restores the state at the beginning of a trial and applies the change.
    fn start_second_half(&mut self) -> Result<(), Error> {
        let baseline_db = self.score_validation()?;
        let snapshot = match self.snapshot() {
            Ok(snapshot) => snapshot,
            Err(error) => return self.end_trials_without_memory(error),
        };
        let Some(SecondHalf { from, candidate, arrived }) = self.trials.begin_second_half(snapshot, baseline_db) else {
            return Ok(());
        };
        self.restore_snapshot(from)?;
        self.views.retain(|view| !arrived.iter().any(|keyframe| Arc::ptr_eq(keyframe, &view.keyframe)));
        match candidate {
            Candidate::Cameras(params) => self.cameras.enable(params),
            Candidate::Halved { to, .. } => self.keep_most_contributing(to)?,
            Candidate::ShDegree { to, .. } => self.lower_degree(to)?,
        }
        self.prepare_training()
    }

    /// Ends a trial: restores the state without the change if it was rejected, then adds the keyframes that arrived
    /// meanwhile.
    fn end_trial(&mut self, TrialEnd { restored, seeded, deferred }: TrialEnd) -> Result<(), Error> {
        if let Some(snapshot) = restored {
            self.restore_snapshot(snapshot)?;
            self.views.extend(seeded.into_iter().map(TrainView::new));
        }
        deferred.into_iter().try_for_each(|keyframe| self.add_keyframe(keyframe))
    }

    /// Adds a training keyframe at the current step.
    fn add_keyframe(&mut self, keyframe: Arc<Keyframe>) -> Result<(), Error> {
        // At least half of the schedule remains for a late keyframe, so that learning rates are large enough and
        // growth continues.
        self.schedule_start =
            self.schedule_start.max(self.step.saturating_sub(self.options.common.n_planned_steps / 2));
        self.add_view(keyframe)
    }

    fn add_view(&mut self, keyframe: Arc<Keyframe>) -> Result<(), Error> {
        self.finish_in_flight()?;
        self.has_depth |= keyframe.depth.is_some();
        self.pending.push(keyframe.clone());
        self.views.push(TrainView::new(keyframe));
        Ok(())
    }

    /// Results of the finished trials.
    pub fn trials(&self) -> &[Trial] {
        &self.trials.finished
    }

    /// Draws one pinhole view.
    fn draw_view(&mut self, camera: &Camera, background_srgb: [f32; 3], depth: bool) -> Result<Picture, Error> {
        let requested = if depth { RequestedParts::ColorAndDepth } else { RequestedParts::Color };
        self.draw_reading(camera, background_srgb, true, requested, |parts| Picture::from_parts(camera.size_px, parts))
    }

    /// Draws one pinhole view into the drawing buffers, either of the displayed splats or of those in training.
    fn draw_into_buffers(&mut self, camera: &Camera, background_srgb: [f32; 3], displayed: bool) -> Result<(), Error> {
        self.draw_reading(camera, background_srgb, displayed, RequestedParts::Nothing, |_| ())
    }

    /// Draws one pinhole view into the drawing buffers and passes the bytes of the requested parts to `take`. The
    /// same read returns counters that show whether all intersections fitted; if not, the view is drawn again.
    fn draw_reading<R>(
        &mut self,
        camera: &Camera,
        background_srgb: [f32; 3],
        displayed: bool,
        requested: RequestedParts<'_>,
        take: impl Fn(&[&[u8]]) -> R,
    ) -> Result<R, Error> {
        let size_px = camera.size_px;
        self.gpu.write(&self.draw_view, 0, bytemuck::bytes_of(&camera.view()));
        let [red, green, blue] = background_srgb;
        let background = Supervision { background_srgb: [red, green, blue, 0.0], ..bytemuck::Zeroable::zeroed() };
        self.gpu.write(&self.plain, 0, bytemuck::bytes_of(&background));
        loop {
            self.make_scratch(size_px, false)?;
            ensure_image_buffers(&self.gpu, &mut self.drawing_buffers, &mut self.passes, size_px, false)?;
            let mut list = std::mem::take(&mut self.passes);
            let (Some((_, scratch)), Some(image_buffers)) = (&self.scratch, &self.drawing_buffers) else {
                return Err(Error::DeviceLost);
            };
            let splats = if displayed { self.displayed() } else { &self.splats };
            self.write_n_splats_to(&self.draw_status, splats.n_splats);
            let (gpu, status, view) = (&self.gpu, &self.draw_status, &self.draw_view);
            let passes = ViewPasses { gpu, splats, scratch, image_buffers, status, view, size_px };
            passes.draw(&mut list, &self.draw);
            passes.finish(&mut list, &self.draw, &self.plain);
            let mut read = vec![(status, 4 * status::LEN)];
            match requested {
                RequestedParts::Nothing => {}
                RequestedParts::Color => read.extend(Picture::buffers(size_px, &image_buffers.pixels, None)),
                RequestedParts::ColorAndDepth => {
                    read.extend(Picture::buffers(size_px, &image_buffers.pixels, Some(&image_buffers.depths)))
                }
                RequestedParts::Comparison { score, image } => {
                    let n_groups = scoring::compare(gpu, &mut list, score, (view, image_buffers), size_px, image);
                    read.push((&image_buffers.products, scoring::PRODUCTS_BYTES * n_groups as usize));
                }
            }
            let read = list.submit_reading(&self.gpu, &read);
            self.passes = list;
            let (counters, taken) = read.finish_with(&self.gpu, |parts| {
                let counters: Vec<u32> = bytemuck::pod_collect_to_vec(parts[0]);
                let taken = (counters[status::FAILED] == 0).then(|| take(&parts[1..]));
                (counters, taken)
            })?;
            if let Some(taken) = taken {
                return Ok(taken);
            }
            if !self.grow_scratch(&counters)? {
                return Err(Error::DeviceLost);
            }
            self.gpu.write(&self.draw_status, 4 * status::FAILED as u64, &[0; 12]);
        }
    }
}

impl Method for SplatTrainer {
    fn push(&mut self, keyframe: Arc<Keyframe>) -> Result<(), Error> {
        self.finish_in_flight()?; // Makes the step of its arrival exact.
        if keyframe.split == Split::Test {
            return Ok(());
        }
        if !keyframe.is_finite() {
            log::warn!(
                "skipping the image of camera {:?} at {} ns: its pose, intrinsics or velocity is not finite",
                keyframe.camera,
                keyframe.stamp.0
            );
            return Ok(());
        }
        let keyframe = self.alignment_task.corrected(&keyframe);
        if keyframe.split == Split::Validation && self.trials.holds_validation() {
            self.trials.validation.push(ValidationImage { keyframe, image: None });
            return Ok(());
        }
        // Both halves of a trial train on the same keyframes at the same steps.
        if self.trials.defer_arrival(&keyframe, self.step) {
            return Ok(());
        }
        self.add_keyframe(keyframe)
    }

    fn remove(&mut self, camera: &str, stamp: Stamp) -> Result<(), Error> {
        self.finish_in_flight()?; // Makes the step of its removal exact.
        self.views.retain(|view| view.keyframe.camera.as_ref() != camera || view.keyframe.stamp != stamp);
        let is_removed = |keyframe: &Keyframe| keyframe.camera.as_ref() == camera && keyframe.stamp == stamp;
        self.trials.remove(is_removed);
        self.pending.retain(|keyframe| !is_removed(keyframe));
        self.unseeded.retain(|keyframe| !is_removed(keyframe));
        self.passes.clear_bindings();
        Ok(())
    }

    fn step(&mut self, n: u64) -> Result<u64, Error> {
        if self.views.is_empty() {
            return Ok(0);
        }
        self.prepare_training()?;
        if self.splats.n_splats == 0 {
            return Ok(0);
        }
        let pipelines = self.train_pipelines()?;
        self.align_when_due()?;
        self.try_when_due()?;
        self.grow_when_due(&pipelines)?;
        let max_millis = submit_millis(self.is_watched);
        let by_time = if self.step_millis > 0.0 { (max_millis / self.step_millis) as u64 } else { 1 };
        let to_next_change = GROWTH_PERIOD - self.step % GROWTH_PERIOD; // Growth and degrees change at these steps.
        let n_requested = n;
        let n = n
            .min(by_time.clamp(1, MAX_STEPS_PER_SUBMIT))
            .min(to_next_change)
            .min(self.trials.steps_left(self.step))
            .min(self.steps_to_alignment());
        self.splats.set_active_degree(&self.gpu, u32::try_from(self.step / SH_PERIOD).unwrap_or(3).min(3));
        self.write_rule();
        let since = Instant::now();
        self.prepare_levels(n)?;
        for step in self.step..self.step + n {
            self.record_step(&pipelines, step)?;
        }
        let status = self.passes.submit_reading(&self.gpu, &[(&self.train_status, 4 * status::LEN)]);
        self.step += n;
        let failed = self.finish_in_flight()?; // The previous submit; this one runs meanwhile.
        if !failed {
            self.in_flight = Some(InFlight { status, n_steps: n, since });
        } // Otherwise this submit failed, too: its steps are repeated, so do not wait for it.
        if n == n_requested {
            self.finish_in_flight()?; // The caller stops here, so the step count must be exact.
        }
        Ok(n)
    }

    fn is_idle(&self) -> bool {
        false // There are always steps to take, or it is not known yet that there are none.
    }

    fn n_total_steps(&mut self) -> Result<u64, Error> {
        self.finish_in_flight()?;
        Ok(self.step.wrapping_add(self.n_reverted_steps))
    }

    fn seed(&mut self) -> Result<(), Error> {
        self.seed_from_depth()
    }

    fn prepare(&mut self) -> Result<(), Error> {
        self.train_pipelines().map(drop)
    }

    fn profile_step(&mut self) -> Result<Vec<PassTiming>, Error> {
        self.finish_in_flight()?;
        self.prepare_training()?;
        let pipelines = self.train_pipelines()?;
        self.write_rule();
        self.record_step(&pipelines, self.step)?;
        let timings = self.passes.submit_timed(&self.gpu)?;
        self.step += 1;
        Ok(timings)
    }

    fn render(&mut self, request: &RenderRequest) -> Result<Picture, Error> {
        self.seed_from_depth()?;
        projections::render(request, |camera| self.draw_view(camera, request.background_srgb, request.depth))
    }

    fn set_watched(&mut self, watched: bool) {
        self.is_watched = watched;
    }

    fn psnr(&mut self, request: &RenderRequest, keyframe: &Keyframe) -> Result<Option<f64>, Error> {
        self.seed_from_depth()?;
        let Projection::Pinhole { focal_px, principal_px } = request.projection else { return Ok(None) };
        self.psnr_of_view(&Camera::from_request(request, focal_px, principal_px), request.background_srgb, keyframe)
    }

    fn bounds(&mut self) -> Result<Option<Bounds>, Error> {
        Ok(bounds(&self.arrays()?))
    }

    fn calibrated_camera(&mut self, keyframe: &Keyframe) -> Result<CalibratedCamera, Error> {
        let learned = self.camera_corrections()?;
        Ok(self.alignment_task.calibrated_camera(keyframe, learned.get(keyframe.camera.as_ref())))
    }

    fn alignment(&self) -> Option<&Alignment> {
        self.alignment_task.result()
    }

    fn progress(&self) -> Progress {
        Progress {
            step: self.step,
            primitives: self.displayed().n_splats.into(),
            bytes: self.displayed().bytes(),
            step_millis: self.step_millis,
        }
    }

    fn report(&self) -> Vec<TrialReport> {
        self.trials.finished.iter().map(Trial::report).collect()
    }

    fn save(&mut self, folder: &Path) -> Result<(), Error> {
        self.finish_in_flight()?;
        if let Some(finished) = self.trials.cancel() {
            log::info!("training stopped during a trial: saved the model without the change");
            self.end_trial(finished)?;
        }
        let arrays = self.arrays()?;
        std::fs::create_dir_all(folder).map_err(|source| Error::Write { path: folder.to_owned(), source })?;
        ply::write(&folder.join(IN_FOLDER), &arrays)?;
        let metadata = serde_json::json!({
            "method": SplatOptions::METHOD,
            "steps": self.step,
            "splats": arrays.n_splats(),
            "sh_degree": arrays.sh_degree,
            "seed": self.options.common.seed,
            "trials": self.report(),
            "alignment": self.alignment_task.result(),
            "cameras": self.camera_corrections()?,
        });
        let path = folder.join(METADATA_FILE);
        std::fs::write(&path, format!("{metadata:#}\n")).map_err(|source| Error::Write { path, source })
    }

    fn checkpoint(&mut self) -> Result<PendingCheckpoint, Error> {
        self.take_checkpoint()
    }
}

/// Camera corrections by name.
type CameraCorrections = BTreeMap<String, CameraCorrection>;

/// The corrected camera of a keyframe; [`CalibratedCamera::of`] is the uncorrected one.
fn corrected_camera(corrections: &CameraCorrections, keyframe: &Keyframe) -> CalibratedCamera {
    corrections
        .get(keyframe.camera.as_ref())
        .map_or_else(|| CalibratedCamera::of(keyframe), |correction| correction.apply(keyframe))
}

fn ensure_image_buffers(
    gpu: &Gpu,
    image_buffers: &mut Option<ImageBuffers>,
    passes: &mut Passes,
    size_px: [u32; 2],
    for_training: bool,
) -> Result<(), Error> {
    let (n_pixels, n_tiles) = (size_px[0] * size_px[1], n_tiles(size_px));
    if image_buffers
        .as_ref()
        .is_none_or(|image_buffers| image_buffers.n_pixels < n_pixels || image_buffers.n_tiles < n_tiles)
    {
        let have =
            image_buffers.as_ref().map_or((0, 0), |image_buffers| (image_buffers.n_pixels, image_buffers.n_tiles));
        passes.submit(gpu);
        passes.clear_bindings();
        *image_buffers = None;
        *image_buffers = Some(ImageBuffers::new(gpu, n_pixels.max(have.0), n_tiles.max(have.1), for_training)?);
    }
    Ok(())
}

/// Resolution level at a step: images are smaller than full size by this power of two.
fn level_at(step: u64, coarse_steps: [u64; 2]) -> u32 {
    match step {
        step if step < coarse_steps[0] => 2,
        step if step < coarse_steps[1] => 1,
        _ => 0,
    }
}

/// Picks `n` of the splats, evenly over their list.
fn spread_out(arrays: &SplatArrays, n: usize) -> SplatArrays {
    let picks: Vec<usize> = (0..n).map(|ix| ix * arrays.n_splats() / n).collect();
    let n_coeffs = arrays.n_coefficients();
    SplatArrays {
        means: picks.iter().map(|ix| arrays.means[*ix]).collect(),
        log_scales: picks.iter().map(|ix| arrays.log_scales[*ix]).collect(),
        rotations_wxyz: picks.iter().map(|ix| arrays.rotations_wxyz[*ix]).collect(),
        opacity_logits: picks.iter().map(|ix| arrays.opacity_logits[*ix]).collect(),
        sh: picks.iter().flat_map(|ix| arrays.sh[ix * n_coeffs..(ix + 1) * n_coeffs].iter().copied()).collect(),
        sh_degree: arrays.sh_degree,
    }
}
