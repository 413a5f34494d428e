//! The neural field as a [`Method`].

mod checkpoint;
mod images;

use super::carve;
use super::extent::Extent;
use super::learner::{Compiled, Learner, STEPS_PER_SUBMIT};
use super::options::{Effort, NerfOptions};
use super::rays::{self, Draw, RayImage};
use super::sizes::Sizes;
use crate::align::Alignment;
use crate::checkpoint::PendingCheckpoint;
use crate::gpu::{Gpu, PassTiming, PendingRead};
use crate::method::submit_millis;
use crate::splat::{Camera, CameraFix, N_CODE, PosedLens, TermSet, projections};
use crate::{Error, Keyframe, Method, Part, Picture, Progress, RenderRequest, Renewable, Split};
use images::Trials;
use kinematics::Stamp;
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

/// Nearest place that rays look at, in units of the scene's radius.
const BEGIN: f32 = 0.03;
/// Cells of the occupancy become finer after one of so many of the planned steps: before a trial, which compares fields of one size.
const FINER_AT_SHARE: u64 = 10;
/// On a processor a picture of 640x480 takes tens of seconds before much is learned: of depth every ninth pixel tells enough.
const SOFTWARE_DEPTH_STRIDE: u32 = 3;

/// A neural field that learns from keyframes: a hash grid and two small networks, drawn along rays.
#[derive(Debug)]
pub struct NerfModel {
    gpu: Arc<Gpu>,
    options: NerfOptions,
    images: Vec<RayImage>,
    field: Option<(Extent, Learner)>,
    /// For all fields that come.
    compiled: Option<Arc<Compiled>>,
    /// Keyframes came or went since the extent was looked at.
    is_extent_due: bool,
    /// Images whose depth was told to the field: the first so many.
    n_hinted: usize,
    in_flight: Option<InFlight>,
    /// What is learned of images along with the field.
    learned: TermSet,
    trials: Trials,
    /// Images that are learned from when all trials are over.
    held_back: Vec<RayImage>,
    /// Of the saved field this one came from.
    loaded_fixes: BTreeMap<String, CameraFix>,
    /// What is known about cameras, since the last step.
    fixes: Option<BTreeMap<String, CameraFix>>,
    step: u64,
    /// Steps of trials that were taken back.
    n_taken_back: u64,
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
            learned: images::given(&options.cameras),
            trials: Trials::of(&options.cameras),
            options,
            images: Vec::new(),
            held_back: Vec::new(),
            loaded_fixes: BTreeMap::new(),
            fixes: None,
            n_taken_back: 0,
            field: None,
            compiled: None,
            is_extent_due: false,
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
    fn camera_fixes(&mut self) -> Result<&BTreeMap<String, CameraFix>, Error> {
        if self.fixes.is_none() {
            self.settle()?;
            self.fixes = Some(self.learned_fixes()?);
        }
        Ok(self.fixes.as_ref().filter(|fixes| !fixes.is_empty()).unwrap_or(&self.loaded_fixes))
    }

    fn effort(&self) -> Effort {
        self.options.effort.unwrap_or(if self.gpu.is_software() { Effort::SMALL } else { Effort::FULL })
    }

    /// Makes a field where there is none, or where the scene has outgrown it, with cells as fine as are due. False where there is nothing
    /// to learn from.
    fn begin(&mut self) -> Result<bool, Error> {
        if self.images.is_empty() {
            return Ok(false);
        }
        if std::mem::take(&mut self.is_extent_due) || self.field.is_none() {
            self.images.par_iter().for_each(|image| {
                image.depth_m();
            });
            self.fit_extent()?;
            self.hint()?;
        }
        self.refine_when_due()?;
        Ok(true)
    }

    /// What the images ask for.
    fn sizes(&self) -> Result<(Extent, Sizes), Error> {
        let keyframes = || self.images.iter().map(|image| &*image.keyframe);
        let extent = Extent::of(keyframes());
        let sizes = Sizes::choose(&self.options, self.effort(), self.gpu.max_binding_bytes(), keyframes(), &extent)?;
        Ok((extent, sizes))
    }

    /// The kernels, compiled once.
    fn compiled(&mut self) -> Result<Arc<Compiled>, Error> {
        if let Some(compiled) = &self.compiled {
            return Ok(compiled.clone());
        }
        let compiled = Arc::new(Compiled::new(&self.gpu, &self.effort())?);
        self.compiled = Some(compiled.clone());
        Ok(compiled)
    }

    fn fit_extent(&mut self) -> Result<(), Error> {
        let (extent, sizes) = self.sizes()?;
        if self.field.as_ref().is_some_and(|(known, _)| !known.is_outgrown_by(&extent)) {
            return Ok(());
        }
        log::debug!("nerf: {extent:?}, {sizes:?}");
        self.settle()?;
        self.give_up_trials()?;
        self.field = None; // Its memory is free before the next one takes some.
        let compiled = self.compiled()?;
        self.field = Some((extent, Learner::new(&self.gpu, &self.options, sizes, compiled)?));
        self.n_hinted = 0;
        Ok(())
    }

    /// Tells the field what new images say about where something is, where any of them has depth, and in what light they begin.
    fn hint(&mut self) -> Result<(), Error> {
        self.begin_codes()?;
        let Some((extent, learner)) = &mut self.field else { return Ok(()) };
        if learner.sizes.has_depth {
            let keyframes: Vec<&Keyframe> = self.images[self.n_hinted..].iter().map(|image| &*image.keyframe).collect();
            learner.hint(&self.gpu, &carve::hints(&keyframes, extent, &learner.march()))?;
        }
        self.n_hinted = self.images.len();
        Ok(())
    }

    /// Steps until cells become finer.
    fn steps_to_finer_cells(&self) -> u64 {
        let is_due = self.field.as_ref().is_some_and(|(_, learner)| learner.sizes.refines);
        if is_due { self.finer_at().saturating_sub(self.step).max(1) } else { u64::MAX }
    }

    fn finer_at(&self) -> u64 {
        (self.options.n_planned_steps / FINER_AT_SHARE).max(1)
    }

    /// Coarse cells are soon visited, fine ones tell better what is empty.
    fn refine_when_due(&mut self) -> Result<(), Error> {
        let is_due = self.step >= self.finer_at();
        if !is_due || !self.field.as_ref().is_some_and(|(_, learner)| learner.sizes.refines) {
            return Ok(());
        }
        self.settle()?;
        let Some((_, learner)) = &mut self.field else { return Ok(()) };
        learner.refine_cells(&self.gpu)
    }

    /// Waits for the submit in flight.
    fn settle(&mut self) -> Result<(), Error> {
        let Some(in_flight) = self.in_flight.take() else { return Ok(()) };
        in_flight.batch.finish::<u32>(&self.gpu)?;
        let millis = in_flight.since.elapsed().as_secs_f64() * 1e3 / in_flight.n_steps.max(1) as f64;
        self.step_millis = if self.step_millis == 0.0 { millis } else { 0.8 * self.step_millis + 0.2 * millis };
        Ok(())
    }

    /// Lists the next step as the `slot_ix`-th of a submit.
    fn record(&mut self, slot_ix: usize) -> Result<(), Error> {
        let learned = self.learned_now();
        let Some((extent, learner)) = &mut self.field else { return Ok(()) };
        if learned.any() {
            learner.hold_images(&self.gpu, self.images.len(), learned)?;
        }
        self.fixes = None;
        let n_rays = learner.sizes.effort.n_rays;
        let draw = Draw { seed: self.options.seed, step: self.step, n_rays, begin: BEGIN };
        let rays = rays::draw(&self.images, extent, &draw);
        learner.record_step(&self.gpu, &self.options, slot_ix, self.step, &rays, learned)?;
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

    fn draw(&mut self, request: &RenderRequest, camera: &Camera, code: [f64; N_CODE]) -> Result<Picture, Error> {
        let RenderRequest { background_srgb, depth, .. } = *request;
        let Some((extent, learner)) = &mut self.field else {
            return Ok(Picture::empty(camera.size_px, background_srgb, depth));
        };
        learner.draw(&self.gpu, &extent.camera_in_units(camera), background_srgb, extent.radius_m, code, depth)
    }
}

impl Renewable for NerfModel {
    fn begin_anew(&mut self) -> Result<(), Error> {
        self.settle()?;
        let compiled = self.compiled.take();
        let is_watched = self.is_watched;
        *self = Self { compiled, is_watched, ..Self::new(self.gpu.clone(), self.options.clone())? };
        Ok(())
    }

    fn learned_fix(&mut self, camera: &str) -> Result<Option<CameraFix>, Error> {
        Ok(self.camera_fixes()?.get(camera).cloned())
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
        let is_held_back = keyframe.split == Split::Selection && !self.trials.are_over();
        let image = RayImage::new(keyframe);
        if is_held_back {
            self.held_back.push(image);
        } else {
            self.images.push(image);
            self.is_extent_due = true;
        }
        Ok(())
    }

    fn remove(&mut self, camera: &str, stamp: Stamp) -> Result<(), Error> {
        let is_meant = |image: &RayImage| image.keyframe.camera.as_ref() == camera && image.keyframe.stamp == stamp;
        self.held_back.retain(|image| !is_meant(image));
        if let Some(ix) = self.images.iter().position(is_meant) {
            self.settle()?;
            self.give_up_trials()?;
            self.images.remove(ix);
            self.n_hinted -= usize::from(ix < self.n_hinted);
            self.fixes = None;
            if let Some((_, learner)) = &mut self.field {
                learner.forget_image(&self.gpu, ix)?;
            }
        }
        Ok(())
    }

    fn step(&mut self, n: u64) -> Result<u64, Error> {
        if n == 0 || !self.begin()? {
            self.settle()?;
            return Ok(0);
        }
        self.try_when_due()?;
        self.begin()?; // Images that were held back have joined, before the next step and not after so many as fit into a submit.
        let most = self.steps_to_finer_cells().min(self.steps_to_trial());
        let n_steps = n.min(self.steps_per_submit()).min(most);
        let since = Instant::now();
        for slot_ix in 0..n_steps {
            self.record(usize::try_from(slot_ix).expect("few steps"))?;
        }
        let Some((_, learner)) = &mut self.field else { return Err(Error::DeviceLost) };
        let batch = learner.submit(&self.gpu);
        self.settle()?; // The submit before; this one runs meanwhile.
        self.in_flight = Some(InFlight { batch, n_steps, since });
        if n_steps == n {
            self.settle()?; // The caller stops here.
        }
        Ok(n_steps)
    }

    fn is_idle(&self) -> bool {
        self.images.is_empty()
    }

    fn primitive(&self) -> &'static str {
        "entry"
    }

    fn n_taken(&mut self) -> Result<u64, Error> {
        self.settle()?;
        Ok(self.step + self.n_taken_back)
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
        self.settle()?;
        let code = self.code_of(request.light_of.as_ref())?;
        projections::render(request, |camera| self.draw(request, camera, code))
    }

    fn set_watched(&mut self, watched: bool) {
        self.is_watched = watched;
    }

    fn posed_lens(&mut self, keyframe: &Keyframe) -> Result<PosedLens, Error> {
        let fixes = self.camera_fixes()?;
        let fix = fixes.get(keyframe.camera.as_ref());
        Ok(fix.map_or_else(|| PosedLens::of(keyframe), |fix| fix.apply(keyframe)))
    }

    fn profile_step(&mut self) -> Result<Vec<PassTiming>, Error> {
        self.settle()?;
        if !self.begin()? {
            return Ok(Vec::new());
        }
        self.record(0)?;
        let Some((_, learner)) = &mut self.field else { return Err(Error::DeviceLost) };
        learner.submit_timed(&self.gpu)
    }

    fn alignment(&self) -> Option<&Alignment> {
        None
    }

    fn progress(&self) -> Progress {
        let field = self.field.as_ref().map(|(_, learner)| learner);
        Progress {
            step: self.step,
            primitives: field.map_or(0, |learner| learner.field.n_entries.into()),
            bytes: field.map_or(0, Learner::bytes),
            step_millis: self.step_millis,
        }
    }

    fn report(&self) -> Vec<Part> {
        self.trials.ended.clone()
    }

    fn save(&mut self, folder: &Path) -> Result<(), Error> {
        self.write_folder(folder)
    }

    fn checkpoint(&mut self) -> Result<PendingCheckpoint, Error> {
        self.take_checkpoint()
    }
}
