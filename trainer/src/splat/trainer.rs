//! The splat model as a [`Method`]: seeds, steps, growth, pictures.
#![expect(clippy::cast_possible_truncation, reason = "counts derived from caps that are u32, and bits of a seed")]

mod aligning;
mod checkpoint;
mod scoring;
mod size;

use super::arrays::SplatArrays;
use super::buffers::{Frame, Scratch, ScratchSize, SplatBuffers, n_bins, n_sh_rest, n_tiles};
use super::camera_terms::{CameraFix, CameraTerms, PosedLens, TermSet};
use super::kernels::{DrawPipelines, LearnPipelines};
use super::options::SplatOptions;
use super::params::{Camera, Growth, Rule, Supervision, View, status};
use super::passes::{self, GrowthBuffers, Target, ViewPasses};
use super::seed::{self, Density, Seeder};
use super::trials::{CameraChoice, Candidate, Due, Ended, HeldBack, Now, Trial, Trials, Turned};
use super::views::{self, Keep, Level, LevelImages, Order, TrainView};
use crate::align::{Aligning, Alignment};
use crate::checkpoint::PendingCheckpoint;
use crate::gpu::{Buffer, Gpu, PassTiming, Passes, PendingRead, Pipeline, f32_of};
use crate::method::submit_millis;
use crate::{Error, Keyframe, Method, Part, Picture, Progress, Projection, RenderRequest, Split, ply};
use kinematics::Stamp;
use rayon::prelude::*;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Instant;

/// Steps between changes of the splat count, and before the first.
const GROWTH_PERIOD: u64 = 100;
const GROWTH_START: u64 = 200;
/// Share of the planned steps after which the count stays.
const GROWTH_END_FRAC: f64 = 0.75;
/// Steps between degrees of spherical harmonics.
const SH_PERIOD: u64 = 300;
/// Most steps of a submit.
const MAX_STEPS_PER_SUBMIT: u64 = 64;
/// Maximum bytes of images on a software adapter: its memory is the host's, which already holds all keyframes.
const SOFTWARE_IMAGE_BYTES: u64 = 256 << 20;
/// Number of images made at once when all views are needed in turn.
const VIEWS_AT_ONCE: usize = 16;
/// Views whose images are made and uploaded at once while pictures are requested: with more, a picture would wait too long.
const VIEWS_AT_ONCE_WATCHED: u64 = 4;
/// Readings further than this from the rendered depth are outliers.
const DEPTH_CLIP_M: f64 = 0.2;

/// Share of the most splats there may be that one image may take for its seeds: the others need some, too.
const SEED_SHARE: f64 = 1.0 / 8.0;
/// Pixels of an image that a seed stands for at least: with finer ones the first steps take longer than they gain.
const PX_PER_SEED: f64 = 48.0;
/// Place of a child within its parent, in standard deviations.
const CHILD_SPREAD: f32 = 0.5;
/// Most that opacity and size cost against the color loss.
const MOST_COST: f64 = 0.1;

/// 3D Gaussian splats that learn from keyframes.
#[derive(Debug)]
pub struct SplatTrainer {
    gpu: Arc<Gpu>,
    options: SplatOptions,
    draw: DrawPipelines,
    learn: Learn,
    splats: SplatBuffers,
    scratch: Option<(ScratchSize, Scratch)>,
    learn_frame: Option<Frame>,
    draw_frame: Option<Frame>,
    learn_status: Buffer,
    draw_status: Buffer,
    draw_view: Buffer,
    rule: Buffer,
    supervision: Buffer,
    plain: Buffer,
    cameras: CameraTerms,
    /// Of the saved model this one came from.
    loaded_fixes: BTreeMap<String, CameraFix>,
    aligning: Aligning,
    trials: Trials,
    passes: Passes,
    seeder: Seeder,
    /// Keyframes whose depth has not been looked at.
    pending: Vec<Arc<Keyframe>>,
    /// Keyframes without depth since the last step.
    unseeded: Vec<Arc<Keyframe>>,
    seeds_per_image: f64,
    coarse_steps: [u64; 2],
    views: Vec<TrainView>,
    /// Maximum bytes of their images on the GPU, unless a submit needs more.
    max_image_bytes: u64,
    /// How often images were requested.
    images_asked: u64,
    order: Order,
    scene_size_m: f64,
    has_depth: bool,
    step: u64,
    /// Steps of trials that were taken back.
    n_taken_back: u64,
    /// Step from which the planned steps count: late keyframes set it forward.
    schedule_start: u64,
    grown_at: u64,
    /// Whether the GPU has no memory for more splats.
    is_full: bool,
    n_poisoned: u64,
    in_flight: Option<InFlight>,
    idle_since: Instant,
    step_millis: f64,
    /// Whether pictures are requested.
    is_watched: bool,
    /// Buffer of the image of the last comparison, for reuse.
    compared: Option<Buffer>,
}

/// The parts of a picture that are read back.
#[derive(Clone, Copy, Debug)]
enum Wanted<'a> {
    Nothing,
    Color,
    ColorAndDepth,
    /// The sums of `score.wgsl` for a comparison with an image.
    Comparison {
        score: &'a Pipeline,
        image: &'a Buffer,
    },
}

#[derive(Debug)]
enum Learn {
    OnDemand,
    Compiling(Compiling),
    Ready(Arc<LearnPipelines>),
    Failed,
}

/// Pipelines being compiled on a thread. Dropping it waits for the thread: where a process ends while its driver
/// compiles, NVIDIA's corrupts the heap.
#[derive(Debug)]
struct Compiling(Option<JoinHandle<Result<LearnPipelines, Error>>>);

impl Compiling {
    fn start(gpu: &Arc<Gpu>) -> Self {
        let gpu = gpu.clone();
        Self(Some(std::thread::spawn(move || LearnPipelines::new(&gpu))))
    }

    fn finish(&mut self) -> Result<LearnPipelines, Error> {
        self.0.take().and_then(|thread| thread.join().ok()).unwrap_or(Err(Error::DeviceLost))
    }
}

impl Drop for Compiling {
    fn drop(&mut self) {
        let _ = self.finish();
    }
}

/// Everything that training changes, for restoring it later. When a state is taken, no keyframe waits for its splats.
#[derive(Debug)]
pub(crate) struct State {
    pub(super) splats: SplatBuffers,
    pub(super) cameras: (TermSet, Buffer),
    pub(super) step: u64,
    pub(super) grown_at: u64,
    pub(super) seeding: Seeding,
}

/// What an arriving keyframe changes: places that have splats, and the scale and schedule of training.
#[derive(Clone, Debug)]
pub(crate) struct Seeding {
    pub(super) seeder: Seeder,
    pub(super) scene_size_m: f64,
    pub(super) has_depth: bool,
    pub(super) schedule_start: u64,
}

/// What a step touches of the view it learns from.
struct LearnedView<'a> {
    view: ViewPasses<'a>,
    level: &'a Level,
    /// Where something is learned about its camera.
    lens: Option<&'a Buffer>,
}

#[derive(Debug)]
struct InFlight {
    status: PendingRead,
    n_steps: u64,
    since: Instant,
}

impl SplatTrainer {
    /// An empty model. Drawing works at once; what learning needs is compiled on another thread.
    pub fn new(gpu: Arc<Gpu>, options: SplatOptions) -> Result<Self, Error> {
        let learn = Learn::Compiling(Compiling::start(&gpu));
        Self::with_learn(gpu, options, learn)
    }

    fn with_learn(gpu: Arc<Gpu>, options: SplatOptions, learn: Learn) -> Result<Self, Error> {
        let draw = DrawPipelines::new(&gpu)?;
        let zeros = [0u8; 4 * status::LEN];
        let software = gpu.is_software();
        Ok(Self {
            draw,
            learn,
            splats: SplatBuffers::new(&gpu, 1, options.sh_degree)?,
            scratch: None,
            learn_frame: None,
            draw_frame: None,
            learn_status: gpu.storage_with("splat.learn_status", &zeros)?,
            draw_status: gpu.storage_with("splat.draw_status", &zeros)?,
            draw_view: gpu.uniform_with("splat.draw_view", &<View as bytemuck::Zeroable>::zeroed()),
            rule: gpu.uniform_with("splat.rule", &<Rule as bytemuck::Zeroable>::zeroed()),
            supervision: gpu.uniform_with(
                "splat.supervision",
                &Supervision {
                    background_srgb: [0.0; 4],
                    dssim_frac: f32_of(options.dssim_frac),
                    depth_weight: f32_of(options.depth_per_m),
                    depth_clip_m: f32_of(DEPTH_CLIP_M),
                    varied_background: f32_of(options.varied_background),
                },
            ),
            plain: gpu.uniform_with("splat.background", &<Supervision as bytemuck::Zeroable>::zeroed()),
            cameras: CameraTerms::new(
                &gpu,
                match &options.cameras {
                    CameraChoice::Given(terms) => *terms,
                    CameraChoice::Try(_) => TermSet::default(),
                },
            )?,
            loaded_fixes: BTreeMap::new(),
            aligning: Aligning::new(&options.align),
            trials: Trials::new(&options.cameras, options.count),
            passes: Passes::default(),
            seeder: Seeder::default(),
            pending: Vec::new(),
            unseeded: Vec::new(),
            seeds_per_image: options
                .seeds_per_image
                .unwrap_or(if software { 4_000.0 } else { 20_000.0 })
                .min(f64::from(options.cap()) * SEED_SHARE),
            coarse_steps: options.coarse_steps.unwrap_or(if software { [500, 4000] } else { [150, 400] }),
            views: Vec::new(),
            max_image_bytes: if software { SOFTWARE_IMAGE_BYTES } else { u64::MAX },
            images_asked: 0,
            order: Order::new(options.seed),
            scene_size_m: 1.0,
            has_depth: false,
            step: 0,
            n_taken_back: 0,
            schedule_start: 0,
            grown_at: 0,
            is_full: false,
            n_poisoned: 0,
            in_flight: None,
            idle_since: Instant::now(),
            step_millis: 0.0,
            is_watched: false,
            compared: None,
            gpu,
            options,
        })
    }

    /// A model of given splats, to be drawn or trained on; what learning needs is compiled at the first step.
    pub fn from_arrays(gpu: Arc<Gpu>, options: SplatOptions, arrays: &SplatArrays) -> Result<Self, Error> {
        let options = SplatOptions { sh_degree: arrays.sh_degree, ..options };
        let mut trainer = Self::with_learn(gpu, options, Learn::OnDemand)?;
        trainer.add(arrays)?;
        Ok(trainer)
    }

    /// Knows about cameras what a saved model did, see `model.json`.
    pub fn with_fixes(mut self, folder: &Path) -> Result<Self, Error> {
        let about = read_about(&folder.join("model.json"))?;
        self.loaded_fixes = about.cameras;
        self.aligning = Aligning::Done(about.alignment);
        Ok(self)
    }

    /// The splats as they are now.
    pub fn arrays(&mut self) -> Result<SplatArrays, Error> {
        self.seed_from_depth()?;
        self.settle()?;
        self.splats.read(&self.gpu)
    }

    /// How it learns.
    pub fn options(&self) -> &SplatOptions {
        &self.options
    }

    /// What was learned about each camera; empty where nothing is.
    pub fn camera_fixes(&mut self) -> Result<BTreeMap<String, CameraFix>, Error> {
        self.settle()?;
        let shown = self.trials.instead().map(|state| &state.cameras);
        let (set, terms) = shown.map_or((self.cameras.set, &self.cameras.terms), |(set, terms)| (*set, terms));
        if !set.any() {
            return Ok(self.loaded_fixes.clone());
        }
        self.cameras.fixes(&self.gpu, set, terms, self.scene_size_m)
    }

    /// What is known about each camera now, with what is being tried; of keyframes that alignment has corrected already.
    fn learned_fixes(&self) -> Result<Fixes, Error> {
        let (set, terms) = (self.cameras.set, &self.cameras.terms);
        if set.any() { self.cameras.fixes(&self.gpu, set, terms, self.scene_size_m) } else { Ok(Fixes::new()) }
    }

    #[cfg(test)]
    pub(super) fn assume_step_millis(&mut self, millis: f64) {
        self.step_millis = millis;
    }

    /// Bounds the images on the GPU, as on a software adapter.
    #[cfg(test)]
    pub(super) fn hold_images(&mut self, max_bytes: u64) {
        self.max_image_bytes = max_bytes;
    }

    #[cfg(test)]
    pub(super) fn image_bytes(&self) -> u64 {
        self.views.iter().map(TrainView::image_bytes).sum()
    }

    #[cfg(test)]
    pub(super) fn n_steps_on_gpu(&self) -> u64 {
        self.gpu.read::<u32>(&self.learn_status, status::LEN).unwrap()[status::STEP].into()
    }

    /// Number of places that count as seeded.
    #[cfg(test)]
    pub(super) fn n_seeds(&self) -> usize {
        self.seeder.n_seeds()
    }

    #[cfg(test)]
    pub(super) fn times_learned_from(&self, keyframe: &Keyframe) -> usize {
        self.views.iter().filter(|view| view.keyframe.stamp == keyframe.stamp).count()
    }

    /// Gradients that were not finite and were dropped.
    pub fn n_poisoned(&self) -> u64 {
        self.n_poisoned
    }

    fn learn(&mut self) -> Result<Arc<LearnPipelines>, Error> {
        if let Learn::Ready(ready) = &self.learn {
            return Ok(ready.clone());
        }
        let ready = Arc::new(match std::mem::replace(&mut self.learn, Learn::Failed) {
            Learn::Compiling(mut thread) => thread.finish()?,
            Learn::OnDemand => LearnPipelines::new(&self.gpu)?,
            Learn::Ready(_) | Learn::Failed => return Err(Error::DeviceLost),
        });
        self.learn = Learn::Ready(ready.clone());
        Ok(ready)
    }

    /// Adds splats, up to the cap.
    fn add(&mut self, arrays: &SplatArrays) -> Result<(), Error> {
        let n_new = arrays.n_splats().min((self.options.cap() - self.splats.n_splats.min(self.options.cap())) as usize);
        if n_new == 0 {
            return Ok(());
        }
        let n_after = self.splats.n_splats + u32::try_from(n_new).expect("the cap is a u32");
        let n_new = (self.room_for(n_after)? - self.splats.n_splats) as usize;
        if n_new == 0 {
            return Ok(());
        }
        let kept = if n_new == arrays.n_splats() { arrays.clone() } else { spread_out(arrays, n_new) };
        self.splats.append(&self.gpu, &kept);
        self.tell_n();
        Ok(())
    }

    /// Makes room for this many splats; if the GPU has no memory for them, returns how many there is room for.
    fn room_for(&mut self, n_splats: u32) -> Result<u32, Error> {
        if self.is_full {
            return Ok(n_splats.min(self.splats.capacity));
        }
        match self.make_room(n_splats) {
            Ok(()) => Ok(n_splats),
            Err(error) if error.is_of_memory() && self.splats.n_splats > 0 => {
                self.is_full = true;
                log::warn!("the model stops growing at {} splats: {error}", self.splats.n_splats);
                Ok(n_splats.min(self.splats.capacity))
            }
            Err(error) => Err(error),
        }
    }

    fn make_room(&mut self, n_splats: u32) -> Result<(), Error> {
        if n_splats > self.splats.capacity {
            let capacity =
                n_splats.max(self.splats.capacity.saturating_mul(3) / 2).min(self.options.cap().max(n_splats));
            // Before the model itself, because every model that fits must also be drawable.
            let have = self.scratch.as_ref().map(|(size, _)| *size);
            if let Some(have) = have {
                let n_entries = have.n_entries.max(2 * capacity);
                let n_slots = if have.n_slots > 0 { have.n_slots.max(4 * capacity) } else { 0 };
                self.ensure_scratch(ScratchSize { n_splats: capacity, n_entries, n_slots, ..have })?;
            }
            self.splats = self.splats.reshaped(&self.gpu, capacity, self.splats.sh_degree)?;
            self.passes.forget_bindings();
        }
        Ok(())
    }

    fn tell_n(&self) {
        for status in [&self.learn_status, &self.draw_status] {
            self.tell_n_to(status, self.splats.n_splats);
        }
    }

    fn tell_n_to(&self, status: &Buffer, n_splats: u32) {
        self.gpu.write(status, 4 * u64::from(status::N_SPLATS), bytemuck::bytes_of(&n_splats));
    }

    /// The splats that people see: while a change is being tried, those without it.
    fn shown(&self) -> &SplatBuffers {
        self.trials.instead().map_or(&self.splats, |state| &state.splats)
    }

    fn density(&self) -> Density {
        Density { n_most: self.seeds_per_image, px_each: PX_PER_SEED }
    }

    /// Gives the keyframes since the last call discs where their depth shows something new.
    fn seed_from_depth(&mut self) -> Result<(), Error> {
        let pending = std::mem::take(&mut self.pending);
        if pending.is_empty() {
            return Ok(());
        }
        self.measure_scene();
        let discs = self.seeder.discs(&pending, self.density());
        self.add(&discs)?;
        self.unseeded.extend(pending.into_iter().filter(|keyframe| keyframe.is_bare()));
        Ok(())
    }

    /// Keyframes without depth get discs where those with depth left them bare; without any depth there is a cloud.
    fn begin_learning(&mut self) -> Result<(), Error> {
        self.seed_from_depth()?;
        for keyframe in std::mem::take(&mut self.unseeded) {
            if self.has_depth {
                let discs = self.seeder.discs_without_depth(&keyframe, self.density(), self.scene_size_m);
                self.add(&discs)?;
            }
        }
        if self.cameras.set.any() {
            for view in &mut self.views {
                view.give_lens(&self.gpu, &mut self.cameras)?;
            }
        }
        if self.splats.n_splats == 0 && !self.views.is_empty() {
            let keyframes: Vec<&Keyframe> = self.views.iter().map(|view| view.keyframe.as_ref()).collect();
            let cloud = seed::random_cloud(&keyframes, self.options.seed, self.options.cap() as usize);
            self.add(&cloud)?;
        }
        Ok(())
    }

    /// How large the scene is for the learning rate of the means: the spread of the cameras, or how far they look.
    fn measure_scene(&mut self) {
        let keyframes: Vec<&Keyframe> = self.views.iter().map(|view| view.keyframe.as_ref()).collect();
        let centers: Vec<_> = keyframes.iter().map(|keyframe| keyframe.world_from_camera.translation.vector).collect();
        let middle = centers.iter().sum::<nalgebra::Vector3<f64>>() / centers.len().max(1) as f64;
        let spread = centers.iter().map(|center| (center - middle).norm()).fold(0.0, f64::max);
        let mut depths: Vec<f64> = self.views.iter().filter_map(|view| view.median_depth_m).collect();
        depths.sort_by(f64::total_cmp);
        let looks = depths.get(depths.len() / 2).copied().unwrap_or(spread);
        self.scene_size_m = (1.1 * spread).max(0.5 * looks).max(1e-3);
    }

    fn write_rule(&self) {
        if self.cameras.set.any() {
            // Where a submit begins depends on the clock, so what is told to it once must not depend on its first step.
            let step = self.step - self.step % GROWTH_PERIOD;
            let done = step.saturating_sub(self.schedule_start) as f64 / self.options.n_planned_steps.max(1) as f64;
            self.cameras.write_rule(&self.gpu, done, self.scene_size_m);
        }
        let size = f32_of(self.scene_size_m);
        let cost = (self.options.cost_images / self.views.len().max(1) as f64).powi(2).min(MOST_COST);
        let cost = f32_of(cost / f64::from(self.splats.n_splats.max(1)));
        let rule = Rule {
            mean_rate_m: 1.6e-4 * size,
            log_scale_rate: 5e-3,
            rotation_rate: 1e-3,
            opacity_rate: 5e-2,
            sh_dc_rate: 2.5e-3,
            sh_rest_rate: 2.5e-3 / 20.0,
            noise: f32_of(self.options.noise),
            final_mean_rate_frac: 0.01,
            betas: [0.9, 0.999],
            epsilon: 1e-15,
            n_planned_steps: f32_of(self.options.n_planned_steps as f64),
            schedule_start: f32_of(self.schedule_start as f64),
            opacity_cost: cost,
            scale_cost: cost,
            log_scale_range: [(1e-5 * size).ln(), (2.0 * size).ln()],
            seed: (self.options.seed ^ (self.options.seed >> 32)) as u32,
            update_all: u32::from(!self.has_depth),
            unused: 0,
        };
        self.gpu.write(&self.rule, 0, bytemuck::bytes_of(&rule));
    }

    /// Uploads the images that the next `n` steps need and that are not on the GPU.
    fn prepare_levels(&mut self, n: u64) -> Result<(), Error> {
        let mut wanted = self.looked_at(n);
        let all_there = wanted.iter().all(|(view_ix, level)| self.views[*view_ix].has_level(*level));
        if !all_there && !self.gpu.is_software() {
            // Enough at once for all processors, and for the time of a step not to be that of its images.
            wanted = self.looked_at(n.max(if self.is_watched { VIEWS_AT_ONCE_WATCHED } else { MAX_STEPS_PER_SUBMIT }));
        }
        self.make_levels(&wanted)
    }

    /// The views and levels of the next `n` steps.
    fn looked_at(&mut self, n: u64) -> BTreeSet<(usize, usize)> {
        let mut looked_at = BTreeSet::new();
        for step in self.step..self.step + n {
            let view_ix = self.order.pick(step, self.views.len());
            looked_at.insert((view_ix, self.views[view_ix].clamped(level_at(step, self.coarse_steps))));
        }
        looked_at
    }

    /// Uploads these levels of views unless they are on the GPU, using all processors; other images may be removed for them.
    fn make_levels(&mut self, wanted: &BTreeSet<(usize, usize)>) -> Result<(), Error> {
        let missing: Vec<(usize, usize)> =
            wanted.iter().copied().filter(|(view_ix, level)| !self.views[*view_ix].has_level(*level)).collect();
        if !missing.is_empty() {
            let made: Vec<LevelImages> = missing
                .par_iter()
                .map(|(view_ix, level)| LevelImages::new(&self.views[*view_ix].keyframe, *level))
                .collect();
            let new_bytes = made.iter().map(LevelImages::bytes).sum();
            let keep = Keep {
                needed: wanted,
                coarsest: level_at(self.step, self.coarse_steps),
                max_bytes: self.max_image_bytes.saturating_sub(new_bytes),
            };
            let mut dropped = views::drop_levels(&mut self.views, keep);
            if !dropped.is_empty() && !self.passes.is_empty() {
                self.passes.submit(&self.gpu); // The listed passes need the images that are replaced.
            }
            for ((view_ix, level), images) in missing.into_iter().zip(&made) {
                let same_size = dropped.iter().position(|level| level.size_px == images.size_px());
                let reused = same_size.map(|ix| dropped.swap_remove(ix));
                self.views[view_ix].upload(&self.gpu, level, images, reused)?;
            }
            if !dropped.is_empty() {
                self.passes.forget_bindings();
            }
        }
        self.images_asked += 1;
        for (view_ix, level) in wanted {
            self.views[*view_ix].touch(*level, self.images_asked);
        }
        Ok(())
    }

    /// Lists the passes of one step.
    fn record_step(&mut self, learn: &LearnPipelines, step: u64) -> Result<(), Error> {
        let view_ix = self.order.pick(step, self.views.len());
        let level_ix = self.make_ready(view_ix, level_at(step, self.coarse_steps))?;
        let mut list = std::mem::take(&mut self.passes);
        let listed = self.list_step(&mut list, learn, (view_ix, level_ix));
        self.passes = list;
        listed
    }

    fn list_step(&self, list: &mut Passes, learn: &LearnPipelines, place: (usize, usize)) -> Result<(), Error> {
        let LearnedView { view, level, lens } = self.learned_view(list, learn, place)?;
        let target = Target {
            image: &level.image,
            depth: &level.depth,
            supervision: &self.supervision,
            gains: &self.cameras.gains,
            ssim: self.options.dssim_frac > 0.0,
        };
        view.draw(list, &self.draw);
        view.compare(list, learn, &target);
        view.backward(list, learn);
        if let Some(lens) = lens {
            view.update(list, &learn.update_with_camera, &self.rule, true);
            self.cameras.refine(&view, list, learn, lens);
        } else {
            view.update(list, &learn.update, &self.rule, false);
        }
        list.dispatch(&self.gpu, &learn.advance, 1, &[("status", &self.learn_status)]);
        Ok(())
    }

    /// Makes all that a view needs to be learned from, `2^level` times smaller or as small as it gets; says how small.
    fn make_ready(&mut self, view_ix: usize, level: u32) -> Result<usize, Error> {
        let level_ix = self.views[view_ix].clamped(level);
        if !self.views[view_ix].has_level(level_ix) {
            self.make_levels(&BTreeSet::from([(view_ix, level_ix)]))?;
        }
        self.make_space(view_ix, level_ix)?;
        Ok(level_ix)
    }

    /// Makes the buffers for training on a view at a level, without its images.
    fn make_space(&mut self, view_ix: usize, level_ix: usize) -> Result<(), Error> {
        let size_px = self.views[view_ix].size_at(level_ix);
        self.make_scratch(size_px, true)?;
        ensure_frame(&self.gpu, &mut self.learn_frame, &mut self.passes, size_px, true)
    }

    /// A view and level that are ready, with its camera as it is learned now; lists what that takes.
    fn learned_view(
        &self,
        list: &mut Passes,
        learn: &LearnPipelines,
        (view_ix, level_ix): (usize, usize),
    ) -> Result<LearnedView<'_>, Error> {
        let (lens, level) = self.views[view_ix].made(level_ix)?;
        let lens = lens.filter(|_| self.cameras.set.any());
        let (Some((_, scratch)), Some(frame)) = (&self.scratch, &self.learn_frame) else {
            return Err(Error::DeviceLost);
        };
        if let Some(lens) = lens {
            self.cameras.correct(&self.gpu, list, learn, &level.view, lens);
        }
        let view = ViewPasses {
            gpu: &self.gpu,
            splats: &self.splats,
            scratch,
            frame,
            status: &self.learn_status,
            view: if lens.is_some() { &self.cameras.corrected } else { &level.view },
            size_px: level.size_px,
        };
        Ok(LearnedView { view, level, lens })
    }

    /// Makes sure that a view of this size can be drawn, or learned from.
    fn make_scratch(&mut self, size_px: [u32; 2], learn: bool) -> Result<(), Error> {
        let n_splats = self.splats.capacity.max(self.shown().capacity);
        let n_entries = (2 * n_splats).max(1 << 14);
        let n_slots = if learn { 2 * n_entries } else { 0 };
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
        self.passes.submit(&self.gpu); // What is listed holds the old buffers.
        self.passes.forget_bindings();
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

    /// Gives a failed submit larger buffers; true when there was a failure.
    fn mend(&mut self, counters: &[u32]) -> Result<bool, Error> {
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

    /// Waits for the submit in flight and takes note of what it did; says whether a buffer was too small for it.
    fn settle(&mut self) -> Result<bool, Error> {
        let Some(in_flight) = self.in_flight.take() else { return Ok(false) };
        let counters: Vec<u32> = in_flight.status.finish(&self.gpu)?;
        let done = Instant::now();
        let began = in_flight.since.max(self.idle_since); // The submit before was still running when this one was sent.
        self.idle_since = done;
        let millis = (done - began).as_secs_f64() * 1e3 / in_flight.n_steps.max(1) as f64;
        self.step_millis = if self.step_millis == 0.0 { millis } else { 0.8 * self.step_millis + 0.2 * millis };
        self.note_poisoned(counters[status::N_POISONED].into());
        let failed = self.mend(&counters)?;
        if failed {
            self.step = u64::from(counters[status::STEP]);
            self.gpu.write(&self.learn_status, 4 * status::FAILED as u64, &[0; 12]);
        }
        Ok(failed)
    }

    /// Takes note of gradients that were not finite; says so at first, and whenever there are twice as many.
    fn note_poisoned(&mut self, n_poisoned: u64) {
        if n_poisoned.checked_ilog2() > self.n_poisoned.checked_ilog2() {
            log::warn!("{n_poisoned} gradients of splats were not finite so far and were dropped");
        }
        self.n_poisoned = n_poisoned;
    }

    /// Step from which there are no more splats.
    fn last_growth(&self) -> u64 {
        let end = self.schedule_start + (GROWTH_END_FRAC * self.options.n_planned_steps as f64) as u64;
        end.next_multiple_of(GROWTH_PERIOD) // Where a submit ends.
    }

    /// Changes the splat count when it is due: dead splats get new places, and there are more of them up to the cap.
    fn grow_when_due(&mut self, learn: &LearnPipelines) -> Result<(), Error> {
        let due = self.step >= GROWTH_START
            && self.step < self.last_growth()
            && self.step.is_multiple_of(GROWTH_PERIOD)
            && self.grown_at != self.step;
        if !due {
            return Ok(());
        }
        self.settle()?;
        if !self.step.is_multiple_of(GROWTH_PERIOD) {
            return Ok(()); // The submit had failed; the change is due again when its steps are done.
        }
        self.grown_at = self.step;
        let n_before = self.splats.n_splats;
        let more = if self.trials.may_grow() && !self.is_full {
            (f64::from(n_before) * self.options.growth_frac).ceil() as u32
        } else {
            0
        };
        let n_after = (n_before + more).min(self.options.cap()).max(n_before);
        let n_after = self.room_for(n_after)?.max(n_before);
        let growth = Growth {
            n_before,
            n_after,
            key: (self.step as u32).wrapping_mul(0x9e37_79b9) ^ self.options.seed as u32,
            capacity: self.splats.capacity,
            n_sh_rest: n_sh_rest(self.splats.sh_degree),
            child_spread: CHILD_SPREAD,
            least_opacity: 0.005,
            unused: 0.0,
        };
        let buffers = match self.growth_buffers(&growth) {
            Err(error) if error.is_of_memory() => {
                if !std::mem::replace(&mut self.is_full, true) {
                    log::warn!("the model stops growing at {n_before} splats: {error}");
                }
                return Ok(());
            }
            buffers => buffers?,
        };
        passes::grow(&self.gpu, &mut self.passes, learn, &self.splats, &buffers, &growth);
        self.passes.submit(&self.gpu);
        self.passes.forget_bindings();
        self.splats.set_n(&self.gpu, n_after);
        self.tell_n();
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

    fn state(&self) -> Result<State, Error> {
        Ok(State {
            splats: self.splats.reshaped(&self.gpu, self.splats.capacity, self.splats.sh_degree)?,
            cameras: (self.cameras.set, self.cameras.copy(&self.gpu)?),
            step: self.step,
            grown_at: self.grown_at,
            seeding: Seeding {
                seeder: self.seeder.clone(),
                scene_size_m: self.scene_size_m,
                has_depth: self.has_depth,
                schedule_start: self.schedule_start,
            },
        })
    }

    fn go_back(&mut self, state: State) -> Result<(), Error> {
        self.passes.forget_bindings();
        self.n_taken_back = self.n_taken_back.wrapping_add(self.step).wrapping_sub(state.step);
        (self.splats, self.step, self.grown_at) = (state.splats, state.step, state.grown_at);
        self.cameras.go_back(&self.gpu, state.cameras)?;
        let Seeding { seeder, scene_size_m, has_depth, schedule_start } = state.seeding;
        (self.seeder, self.scene_size_m, self.has_depth) = (seeder, scene_size_m, has_depth);
        self.schedule_start = schedule_start;
        self.tell_n();
        let step = u32::try_from(self.step).unwrap_or(u32::MAX);
        self.gpu.write(&self.learn_status, 4 * status::STEP as u64, bytemuck::bytes_of(&step));
        Ok(())
    }

    fn now(&self) -> Now {
        Now {
            step: self.step,
            n_splats: self.splats.n_splats,
            is_mature: self.step >= self.last_growth(),
            sh_degree: self.splats.sh_degree,
        }
    }

    /// Begins, turns and ends trials. What follows from the end of one is done at the same step: when the next submit
    /// ends is a matter of time.
    fn try_when_due(&mut self) -> Result<(), Error> {
        while self.trials.due(self.now()) != Due::Nothing {
            self.settle()?; // Steps may turn out to be lost.
            match self.trials.due(self.now()) {
                Due::Nothing => {}
                Due::Begin(candidate) => match self.state() {
                    Ok(state) => self.trials.begin(candidate, state, self.views.len()),
                    Err(error) => self.end_trials_without_memory(error)?,
                },
                Due::Turn => self.turn_trial()?,
                Due::Arrival => {
                    if let Some(keyframe) = self.trials.next_arrival() {
                        self.welcome(keyframe)?;
                        self.begin_learning()?;
                    }
                }
                Due::Gains => self.try_gains()?,
                Due::End => {
                    let with_db = self.score_held_back()?;
                    if let Some(ended) = self.trials.end(&with_db) {
                        self.end_trial(ended)?;
                        self.begin_learning()?;
                    }
                }
                Due::Join => self.join_held_back()?,
            }
        }
        Ok(())
    }

    fn join_held_back(&mut self) -> Result<(), Error> {
        for keyframe in self.trials.settle() {
            self.learn_from(keyframe)?;
        }
        self.begin_learning()
    }

    /// Trials need copies of the model. If there is no memory for them, training continues without trials.
    fn end_trials_without_memory(&mut self, error: Error) -> Result<(), Error> {
        if !error.is_of_memory() {
            return Err(error);
        }
        log::warn!("no further trials of model changes: {error}");
        self.join_held_back()
    }

    /// Goes back to where a trial began, with the change.
    fn turn_trial(&mut self) -> Result<(), Error> {
        let without_db = self.score_held_back()?;
        let state = match self.state() {
            Ok(state) => state,
            Err(error) => return self.end_trials_without_memory(error),
        };
        let Some(Turned { from, candidate, arrived }) = self.trials.turn(state, without_db) else { return Ok(()) };
        self.go_back(from)?;
        self.views.retain(|view| !arrived.iter().any(|keyframe| Arc::ptr_eq(keyframe, &view.keyframe)));
        match candidate {
            Candidate::Cameras(terms) => self.cameras.learn_also(terms),
            Candidate::Halved { to, .. } => self.keep_most(to)?,
            Candidate::ShDegree { to, .. } => self.lower_degree(to)?,
        }
        self.begin_learning()
    }

    /// Restores the state without the change if the change is rejected, then adds the keyframes that arrived meanwhile.
    fn end_trial(&mut self, Ended { restored, seeded, deferred }: Ended) -> Result<(), Error> {
        if let Some(state) = restored {
            self.go_back(state)?;
            self.views.extend(seeded.into_iter().map(TrainView::new));
        }
        deferred.into_iter().try_for_each(|keyframe| self.welcome(keyframe))
    }

    /// Starts training on a keyframe that arrives now.
    fn welcome(&mut self, keyframe: Arc<Keyframe>) -> Result<(), Error> {
        // At least half of the schedule is ahead of a late keyframe: learning rates are still large enough, and growth continues.
        self.schedule_start = self.schedule_start.max(self.step.saturating_sub(self.options.n_planned_steps / 2));
        self.learn_from(keyframe)
    }

    fn learn_from(&mut self, keyframe: Arc<Keyframe>) -> Result<(), Error> {
        self.settle()?;
        self.has_depth |= keyframe.depth.is_some();
        self.pending.push(keyframe.clone());
        self.views.push(TrainView::new(keyframe));
        Ok(())
    }

    /// How the trials of what the model needs ended so far.
    pub fn trials(&self) -> &[Trial] {
        &self.trials.ended
    }

    /// Draws one pinhole view.
    fn draw_view(&mut self, camera: &Camera, background_srgb: [f32; 3], depth: bool) -> Result<Picture, Error> {
        let wanted = if depth { Wanted::ColorAndDepth } else { Wanted::Color };
        self.draw_reading(camera, background_srgb, true, wanted, |parts| Picture::of_parts(camera.size_px, parts))
    }

    /// Draws one pinhole view into the frame for pictures, of the splats that people see or of those that learn.
    fn draw_into_frame(&mut self, camera: &Camera, background_srgb: [f32; 3], shown: bool) -> Result<(), Error> {
        self.draw_reading(camera, background_srgb, shown, Wanted::Nothing, |_| ())
    }

    /// Draws one pinhole view into the frame for pictures and passes the bytes of the wanted parts to `take`. The same read
    /// returns counters that report whether all intersections had room; if not, the view is drawn again.
    fn draw_reading<R>(
        &mut self,
        camera: &Camera,
        background_srgb: [f32; 3],
        shown: bool,
        wanted: Wanted<'_>,
        take: impl Fn(&[&[u8]]) -> R,
    ) -> Result<R, Error> {
        let size_px = camera.size_px;
        self.gpu.write(&self.draw_view, 0, bytemuck::bytes_of(&camera.view()));
        let [red, green, blue] = background_srgb;
        let background = Supervision { background_srgb: [red, green, blue, 0.0], ..bytemuck::Zeroable::zeroed() };
        self.gpu.write(&self.plain, 0, bytemuck::bytes_of(&background));
        loop {
            self.make_scratch(size_px, false)?;
            ensure_frame(&self.gpu, &mut self.draw_frame, &mut self.passes, size_px, false)?;
            let mut list = std::mem::take(&mut self.passes);
            let (Some((_, scratch)), Some(frame)) = (&self.scratch, &self.draw_frame) else {
                return Err(Error::DeviceLost);
            };
            let splats = if shown { self.shown() } else { &self.splats };
            self.tell_n_to(&self.draw_status, splats.n_splats);
            let (gpu, status, view) = (&self.gpu, &self.draw_status, &self.draw_view);
            let passes = ViewPasses { gpu, splats, scratch, frame, status, view, size_px };
            passes.draw(&mut list, &self.draw);
            passes.finish(&mut list, &self.draw, &self.plain);
            let mut read = vec![(status, 4 * status::LEN)];
            match wanted {
                Wanted::Nothing => {}
                Wanted::Color => read.extend(Picture::buffers(size_px, &frame.pixels, None)),
                Wanted::ColorAndDepth => read.extend(Picture::buffers(size_px, &frame.pixels, Some(&frame.depths))),
                Wanted::Comparison { score, image } => {
                    let n_groups = scoring::compare(gpu, &mut list, score, (view, frame), size_px, image);
                    read.push((&frame.products, scoring::PRODUCTS_BYTES * n_groups as usize));
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
            if !self.mend(&counters)? {
                return Err(Error::DeviceLost);
            }
            self.gpu.write(&self.draw_status, 4 * status::FAILED as u64, &[0; 12]);
        }
    }
}

impl Method for SplatTrainer {
    fn push(&mut self, keyframe: Arc<Keyframe>) -> Result<(), Error> {
        self.settle()?; // The step at which it comes must be true.
        if keyframe.split == Split::Test {
            return Ok(());
        }
        if !keyframe.is_finite() {
            log::warn!(
                "the image of {} at {} ns is left out: its pose, lens or velocity is not finite",
                keyframe.camera,
                keyframe.stamp.0
            );
            return Ok(());
        }
        let keyframe = self.aligning.corrected(&keyframe);
        if keyframe.split == Split::Selection && self.trials.hold_back() {
            self.trials.held_back.push(HeldBack { keyframe, image: None });
            return Ok(());
        }
        // Both halves of a trial train on the same keyframes at the same steps.
        if self.trials.defers(&keyframe, self.step) {
            return Ok(());
        }
        self.welcome(keyframe)
    }

    fn remove(&mut self, camera: &str, stamp: Stamp) -> Result<(), Error> {
        self.settle()?; // The step at which it goes must be true.
        self.views.retain(|view| view.keyframe.camera.as_ref() != camera || view.keyframe.stamp != stamp);
        let is_it = |keyframe: &Keyframe| keyframe.camera.as_ref() == camera && keyframe.stamp == stamp;
        self.trials.remove(is_it);
        self.pending.retain(|keyframe| !is_it(keyframe));
        self.unseeded.retain(|keyframe| !is_it(keyframe));
        self.passes.forget_bindings();
        Ok(())
    }

    fn step(&mut self, n: u64) -> Result<u64, Error> {
        if self.views.is_empty() {
            return Ok(0);
        }
        self.begin_learning()?;
        if self.splats.n_splats == 0 {
            return Ok(0);
        }
        let learn = self.learn()?;
        self.align_when_due()?;
        self.try_when_due()?;
        self.grow_when_due(&learn)?;
        let most_millis = submit_millis(self.is_watched);
        let by_time = if self.step_millis > 0.0 { (most_millis / self.step_millis) as u64 } else { 1 };
        let to_change = GROWTH_PERIOD - self.step % GROWTH_PERIOD; // Growth and degrees change at multiples of it.
        let asked = n;
        let n = n
            .min(by_time.clamp(1, MAX_STEPS_PER_SUBMIT))
            .min(to_change)
            .min(self.trials.steps_left(self.step))
            .min(self.steps_to_alignment());
        self.splats.set_active_degree(&self.gpu, u32::try_from(self.step / SH_PERIOD).unwrap_or(3).min(3));
        self.write_rule();
        let since = Instant::now();
        self.prepare_levels(n)?;
        for step in self.step..self.step + n {
            self.record_step(&learn, step)?;
        }
        let status = self.passes.submit_reading(&self.gpu, &[(&self.learn_status, 4 * status::LEN)]);
        self.step += n;
        let failed = self.settle()?; // The submit before; this one runs meanwhile.
        if !failed {
            self.in_flight = Some(InFlight { status, n_steps: n, since });
        } // Else this one found the failure too and did nothing: its steps are to be done, not to be waited for.
        if n == asked {
            self.settle()?; // The caller stops here: the count must be true.
        }
        Ok(n)
    }

    fn is_idle(&self) -> bool {
        false // There is always something to learn, or it is not known yet that there is not.
    }

    fn primitive(&self) -> &'static str {
        "splat"
    }

    fn n_taken(&mut self) -> Result<u64, Error> {
        self.settle()?;
        Ok(self.step.wrapping_add(self.n_taken_back))
    }

    fn seed(&mut self) -> Result<(), Error> {
        self.seed_from_depth()
    }

    fn prepare(&mut self) -> Result<(), Error> {
        self.learn().map(drop)
    }

    fn profile_step(&mut self) -> Result<Vec<PassTiming>, Error> {
        self.settle()?;
        self.begin_learning()?;
        let learn = self.learn()?;
        self.write_rule();
        self.record_step(&learn, self.step)?;
        let timings = self.passes.submit_timed(&self.gpu)?;
        self.step += 1;
        Ok(timings)
    }

    fn render(&mut self, request: &RenderRequest) -> Result<Picture, Error> {
        self.seed_from_depth()?;
        super::projections::render(request, |camera| self.draw_view(camera, request.background_srgb, request.depth))
    }

    fn set_watched(&mut self, watched: bool) {
        self.is_watched = watched;
    }

    fn psnr(&mut self, request: &RenderRequest, keyframe: &Keyframe) -> Result<Option<f64>, Error> {
        self.seed_from_depth()?;
        let Projection::Pinhole { focal_px, principal_px } = request.projection else { return Ok(None) };
        self.psnr_of_view(&Camera::of_request(request, focal_px, principal_px), request.background_srgb, keyframe)
    }

    fn posed_lens(&mut self, keyframe: &Keyframe) -> Result<PosedLens, Error> {
        let learned = self.camera_fixes()?;
        Ok(self.aligning.posed_lens(keyframe, learned.get(keyframe.camera.as_ref())))
    }

    fn alignment(&self) -> Option<&Alignment> {
        self.aligning.result()
    }

    fn progress(&self) -> Progress {
        Progress {
            step: self.step,
            primitives: self.shown().n_splats.into(),
            bytes: self.shown().bytes(),
            step_millis: self.step_millis,
        }
    }

    fn report(&self) -> Vec<Part> {
        self.trials.ended.iter().map(Trial::part).collect()
    }

    fn save(&mut self, folder: &Path) -> Result<(), Error> {
        self.settle()?;
        if let Some(ended) = self.trials.give_up() {
            log::info!("training ends before what is being tried could be judged: saved without it");
            self.end_trial(ended)?;
        }
        let arrays = self.arrays()?;
        std::fs::create_dir_all(folder).map_err(|source| Error::Write { path: folder.to_owned(), source })?;
        ply::write(&folder.join("splats.ply"), &arrays)?;
        let about = serde_json::json!({
            "method": "splat",
            "steps": self.step,
            "splats": arrays.n_splats(),
            "sh_degree": arrays.sh_degree,
            "seed": self.options.seed,
            "trials": self.report(),
            "alignment": self.aligning.result(),
            "cameras": self.camera_fixes()?,
        });
        let path = folder.join("model.json");
        std::fs::write(&path, format!("{about:#}\n")).map_err(|source| Error::Write { path, source })
    }

    fn checkpoint(&mut self) -> Result<PendingCheckpoint, Error> {
        self.take_checkpoint()
    }
}

/// What was learned about cameras, by name.
type Fixes = BTreeMap<String, CameraFix>;

/// The camera of a keyframe as it is, where the input has it as [`PosedLens::of`].
fn fixed(fixes: &Fixes, keyframe: &Keyframe) -> PosedLens {
    fixes.get(keyframe.camera.as_ref()).map_or_else(|| PosedLens::of(keyframe), |fix| fix.apply(keyframe))
}

/// What a saved model knows about cameras.
#[derive(Default, serde::Deserialize)]
#[serde(default)]
pub(crate) struct About {
    pub(crate) cameras: BTreeMap<String, CameraFix>,
    pub(crate) alignment: Option<Alignment>,
}

/// What a saved model knows about cameras; a model without such a file, or of an earlier version, knows nothing.
pub(crate) fn read_about(path: &Path) -> Result<About, Error> {
    let refused = |reason: String| Error::SplatFile { path: path.to_owned(), reason };
    match std::fs::read(path) {
        Ok(bytes) => serde_json::from_slice(&bytes).map_err(|error| refused(error.to_string())),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(About::default()),
        Err(error) => Err(refused(error.to_string())),
    }
}

fn ensure_frame(
    gpu: &Gpu,
    frame: &mut Option<Frame>,
    passes: &mut Passes,
    size_px: [u32; 2],
    learned: bool,
) -> Result<(), Error> {
    let (n_pixels, n_tiles) = (size_px[0] * size_px[1], n_tiles(size_px));
    if frame.as_ref().is_none_or(|frame| frame.n_pixels < n_pixels || frame.n_tiles < n_tiles) {
        let have = frame.as_ref().map_or((0, 0), |frame| (frame.n_pixels, frame.n_tiles));
        passes.submit(gpu);
        passes.forget_bindings();
        *frame = None;
        *frame = Some(Frame::new(gpu, n_pixels.max(have.0), n_tiles.max(have.1), learned)?);
    }
    Ok(())
}

/// How many times smaller than full size, as a power of two, images are at a step.
fn level_at(step: u64, coarse_steps: [u64; 2]) -> u32 {
    match step {
        step if step < coarse_steps[0] => 2,
        step if step < coarse_steps[1] => 1,
        _ => 0,
    }
}

/// `n` of the splats, evenly over their list.
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
