//! The distance field as a [`Method`]: a step fuses a keyframe.

mod budget;
mod checkpoint;
mod meshing;
mod saving;

use super::block::{Blocks, Place};
use super::buffers::{self, Capacity, FieldBuffers};
use super::chosen::Lattice;
use super::kernels::Pipelines;
use super::marching::MeshBuffers;
use super::mesh::Mesher;
use super::options::TsdfOptions;
use super::params::{DepthFrame, status};
use super::passes::{self, Canvas, FrameSlot};
use crate::align::Alignment;
use crate::checkpoint::PendingCheckpoint;
use crate::gpu::{Gpu, PassTiming, Passes, PendingRead};
use crate::method::submit_millis;
use crate::seen::Seen;
use crate::splat::{Camera, PosedLens, projections};
use crate::{Error, Keyframe, Method, Part, Picture, Progress, Projection, RenderRequest, Renewable, Split};
use kinematics::Stamp;
use std::collections::{BTreeSet, VecDeque};
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

/// Most keyframes of a submit: their images lie on the GPU at once.
const FRAMES_PER_SUBMIT: usize = 4;
/// Room at the start.
const FIRST_CAPACITY: Capacity = Capacity { n_blocks: 4096, n_chunks: 512 };
/// Fewer blocks show no scene: voxels are chosen so that one image takes a tenth of them.
const FEWEST_BLOCKS: u32 = 256;
/// The table at the start, and the fewest blocks.
pub(super) const LEAST_BYTES: u64 =
    FIRST_CAPACITY.n_chunks as u64 * buffers::BYTES_PER_CHUNK + FEWEST_BLOCKS as u64 * buffers::BYTES_PER_BLOCK;

/// A colored distance field built from keyframes with depth.
///
/// Each keyframe is fused once, in the order they are pushed in; keyframes without depth say nothing and are passed over.
#[derive(Debug)]
pub struct TsdfModel {
    gpu: Arc<Gpu>,
    options: TsdfOptions,
    pipelines: Pipelines,
    lattice: Option<Lattice>,
    field: Option<FieldBuffers>,
    slots: Vec<FrameSlot>,
    canvas: Option<Canvas>,
    passes: Passes,
    /// Not known to be fused, in order; the first of them may be in flight.
    pending: VecDeque<Arc<Keyframe>>,
    fused: Vec<Seen>,
    /// Keyframes that a loaded state waits for; nobody may bring them.
    to_match: Vec<Seen>,
    in_flight: Option<InFlight>,
    /// Blocks that found no room on the GPU.
    waiting: Blocks,
    /// Blocks that changed since the mesh was made, besides those that the GPU has flags for.
    due: BTreeSet<Place>,
    mesher: Mesher,
    mesh_buffers: Option<MeshBuffers>,
    n_resident: u32,
    n_refused: u64,
    n_outside: u32,
    /// Frames the GPU had counted when it was last asked.
    n_on_gpu: u32,
    step: u64,
    step_millis: f64,
    /// Whether pictures are requested.
    is_watched: bool,
}

#[derive(Debug)]
struct InFlight {
    status: PendingRead,
    n_frames: usize,
    since: Instant,
}

impl TsdfModel {
    /// An empty model; refused where it may not even have the memory of the smallest.
    pub fn new(gpu: Arc<Gpu>, options: TsdfOptions) -> Result<Self, Error> {
        match options.max_bytes {
            Some(max_bytes) if max_bytes < LEAST_BYTES => {
                Err(Error::BudgetTooSmall { model: "distance field", max_bytes, least_bytes: LEAST_BYTES })
            }
            _ => Self::within_any_budget(gpu, options),
        }
    }

    /// An empty model; where it may have less memory than the smallest it leaves out what it finds no room for.
    pub(super) fn within_any_budget(gpu: Arc<Gpu>, options: TsdfOptions) -> Result<Self, Error> {
        Ok(Self {
            pipelines: Pipelines::new(&gpu)?,
            lattice: None,
            field: None,
            slots: Vec::new(),
            canvas: None,
            passes: Passes::default(),
            pending: VecDeque::new(),
            fused: Vec::new(),
            to_match: Vec::new(),
            in_flight: None,
            waiting: Blocks::new(),
            due: BTreeSet::new(),
            mesher: Mesher::default(),
            mesh_buffers: None,
            n_resident: 0,
            n_refused: 0,
            n_outside: 0,
            n_on_gpu: 0,
            step: 0,
            step_millis: 0.0,
            is_watched: false,
            gpu,
            options,
        })
    }

    /// How it was asked to be built.
    pub fn options(&self) -> &TsdfOptions {
        &self.options
    }

    /// How finely the scene is divided; `None` before the first depth.
    pub fn lattice(&self) -> Option<&Lattice> {
        self.lattice.as_ref()
    }

    /// Keyframes that showed more at once than the memory allowed holds; they were left out.
    pub fn n_refused(&self) -> u64 {
        self.n_refused
    }

    /// Readings whose surface lay further out than blocks have places for.
    pub fn n_outside(&self) -> u32 {
        self.n_outside
    }

    /// Blocks that wait in host memory.
    pub fn n_waiting(&self) -> usize {
        self.waiting.len()
    }

    /// All blocks, in order of their places.
    pub fn blocks(&mut self) -> Result<Blocks, Error> {
        self.settle()?;
        let mut blocks = self.waiting.clone();
        if let Some(field) = &self.field {
            blocks.extend(field.read_all(&self.gpu, &self.pipelines)?);
        }
        Ok(blocks)
    }

    /// Most blocks the GPU may hold beside the table that finds them.
    fn most_blocks(&self) -> u32 {
        self.most_blocks_beside(self.field.as_ref().map_or(FIRST_CAPACITY, |field| field.capacity).n_chunks)
    }

    fn most_blocks_beside(&self, n_chunks: u32) -> u32 {
        let table_bytes = u64::from(n_chunks) * buffers::BYTES_PER_CHUNK;
        let of_blocks = |bytes: u64| bytes.saturating_sub(table_bytes) / buffers::BYTES_PER_BLOCK;
        let by_bytes = self.options.max_bytes.map_or(u64::MAX, of_blocks);
        buffers::most_blocks(&self.gpu).min(u32::try_from(by_bytes).unwrap_or(u32::MAX)).max(1)
    }

    /// Settles voxels by the first depth image that shows something; those before it are done with. False where none does.
    fn begin(&mut self) -> Result<bool, Error> {
        // What one binding holds is a limit as good as any.
        let max_bytes = Some(u64::from(self.most_blocks()) * buffers::BYTES_PER_BLOCK);
        let options = TsdfOptions { max_bytes, ..self.options.clone() };
        while self.lattice.is_none() {
            let Some(first) = self.pending.front() else { return Ok(false) };
            let chosen = first.depth.as_ref().and_then(|depth| Lattice::choose(&options, depth));
            if let Some(lattice) = chosen {
                let n_blocks = FIRST_CAPACITY.n_blocks.min(self.most_blocks());
                self.field = Some(FieldBuffers::new(&self.gpu, &lattice, Capacity { n_blocks, ..FIRST_CAPACITY })?);
                self.lattice = Some(lattice);
            } else {
                self.pass_over();
            }
        }
        Ok(!self.pending.is_empty())
    }

    /// Fuses one keyframe where none was: then there is something to show. No more than that, or looking would count as learning.
    fn fuse_first(&mut self) -> Result<(), Error> {
        while self.step == 0 && !self.pending.is_empty() {
            self.step(1)?;
        }
        Ok(())
    }

    /// Number of keyframes in a submit that stays within the time limit.
    fn frames_per_submit(&self) -> usize {
        if !self.is_watched || self.step_millis == 0.0 {
            return FRAMES_PER_SUBMIT;
        }
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped")]
        let n = (submit_millis(true) / self.step_millis).clamp(1.0, FRAMES_PER_SUBMIT as f64) as usize;
        n
    }

    /// Takes the first pending keyframe for done.
    fn pass_over(&mut self) {
        if let Some(keyframe) = self.pending.pop_front() {
            self.fused.push(Seen::of(&keyframe));
            self.step += 1;
        }
    }

    /// Lists the passes of a pending keyframe.
    fn record(&mut self, pending_ix: usize, slot_ix: usize) -> Result<(), Error> {
        let (Some(lattice), Some(keyframe)) = (&self.lattice, self.pending.get(pending_ix)) else { return Ok(()) };
        let Some(frame) = DepthFrame::of(keyframe, lattice) else { return Ok(()) };
        let [n_depth, n_color] =
            [frame.depth_size_px, frame.color_size_px].map(|[width, height]| u64::from(width) * u64::from(height));
        if self.slots.get(slot_ix).is_none_or(|slot| !slot.holds(n_depth, n_color)) {
            self.passes.forget_bindings();
            let slot = FrameSlot::new(&self.gpu, n_depth, n_color)?;
            self.slots.truncate(slot_ix);
            self.slots.push(slot);
        }
        let slot = &mut self.slots[slot_ix];
        slot.upload(&self.gpu, keyframe, &frame);
        if let Some(field) = &self.field {
            passes::fuse(&self.gpu, &mut self.passes, &self.pipelines, field, slot);
        }
        Ok(())
    }

    /// Waits for the submit in flight and takes note of what it did; says whether something found no room.
    fn settle(&mut self) -> Result<bool, Error> {
        let Some(in_flight) = self.in_flight.take() else { return Ok(false) };
        let counters: Vec<u32> = in_flight.status.finish(&self.gpu)?;
        let millis = in_flight.since.elapsed().as_secs_f64() * 1e3 / in_flight.n_frames.max(1) as f64;
        self.step_millis = if self.step_millis == 0.0 { millis } else { 0.8 * self.step_millis + 0.2 * millis };
        self.take_note(&counters)
    }

    /// Counts what was fused; makes room where there was none and says so.
    fn take_note(&mut self, counters: &[u32]) -> Result<bool, Error> {
        for _ in 0..counters[status::N_FRAMES].wrapping_sub(self.n_on_gpu) {
            self.pass_over();
        }
        self.n_on_gpu = counters[status::N_FRAMES];
        self.n_outside = counters[status::N_OUTSIDE];
        self.n_resident = counters[status::N_BLOCKS];
        let failed = counters[status::STOPPED] != 0;
        if failed {
            self.make_room(counters)?;
            self.n_resident = self.field.as_ref().map_or(Ok(0), |field| field.n_blocks(&self.gpu))?;
        }
        Ok(failed)
    }

    /// Gives a field that was too small more room, on the GPU or by sending blocks to wait.
    fn make_room(&mut self, counters: &[u32]) -> Result<(), Error> {
        let (Some(lattice), Some(field)) = (&self.lattice, &self.field) else { return Ok(()) };
        let mut capacity = field.capacity;
        if counters[status::TABLE_FULL] != 0 {
            capacity.n_chunks *= 2;
        }
        let (need, most) = (counters[status::N_BLOCKS], self.most_blocks_beside(capacity.n_chunks));
        if need > capacity.n_blocks {
            let wanted = need.max(capacity.n_blocks.saturating_add(capacity.n_blocks / 2));
            capacity.n_blocks = wanted.min(most).max(capacity.n_blocks);
        }
        if capacity != field.capacity {
            log::debug!("tsdf: room for {capacity:?}");
            let resized = field.resized(&self.gpu, &self.pipelines, lattice, capacity)?;
            self.passes.forget_bindings();
            self.field = Some(resized);
        }
        if need > most { self.send_away(need - most) } else { Ok(()) }
    }

    /// Draws one pinhole view.
    fn draw_view(&mut self, camera: &Camera, background_srgb: [f32; 3], depth: bool) -> Result<Picture, Error> {
        if !self.record_picture(camera, background_srgb)? {
            return Ok(Picture::empty(camera.size_px, background_srgb, depth));
        }
        let canvas = self.canvas.as_ref().ok_or(Error::DeviceLost)?;
        let read = self.passes.submit_reading(
            &self.gpu,
            &Picture::buffers(camera.size_px, &canvas.pixels, depth.then_some(&canvas.depths)),
        );
        read.finish_with(&self.gpu, |parts| Picture::of_parts(camera.size_px, parts))
    }

    /// GPU time of a pinhole picture, milliseconds, without bringing it to the host; `None` where the adapter tells none.
    pub fn profile_picture(&mut self, request: &RenderRequest) -> Result<Option<f64>, Error> {
        self.settle()?;
        let Projection::Pinhole { focal_px, principal_px } = request.projection else { return Ok(None) };
        if !self.record_picture(&Camera::of_request(request, focal_px, principal_px), request.background_srgb)? {
            return Ok(None);
        }
        self.passes.submit_spanned(&self.gpu)
    }

    /// Lists what a picture takes; false where there is nothing to draw.
    fn record_picture(&mut self, camera: &Camera, background_srgb: [f32; 3]) -> Result<bool, Error> {
        let [width, height] = camera.size_px;
        let n = u64::from(width) * u64::from(height);
        let Some(lattice) = self.lattice.clone().filter(|_| self.field.is_some()) else { return Ok(false) };
        let in_field = in_field(camera, &lattice);
        self.bring_for(&in_field)?;
        if self.canvas.as_ref().is_none_or(|canvas| canvas.n_pixels < n) {
            self.passes.forget_bindings();
            self.canvas = None;
            self.canvas = Some(Canvas::new(&self.gpu, n)?);
        }
        let (Some(field), Some(canvas)) = (&self.field, &self.canvas) else { return Err(Error::DeviceLost) };
        canvas.aim(&self.gpu, &in_field.view(), background_srgb);
        passes::draw(&self.gpu, &mut self.passes, &self.pipelines, field, canvas, camera.size_px);
        Ok(true)
    }
}

/// The camera, and what it is cropped to, in the field's frame.
fn in_field(camera: &Camera, lattice: &Lattice) -> Camera {
    let field_from_world = lattice.field_from_world();
    let mut camera = camera.clone();
    camera.world_from_camera = field_from_world * camera.world_from_camera;
    if let Some(crop) = &mut camera.crop {
        crop.world_from_box = field_from_world * crop.world_from_box;
    }
    camera
}

impl Renewable for TsdfModel {
    fn begin_anew(&mut self) -> Result<(), Error> {
        self.settle()?;
        *self = Self { is_watched: self.is_watched, ..Self::new(self.gpu.clone(), self.options.clone())? };
        Ok(())
    }
}

impl Method for TsdfModel {
    fn push(&mut self, keyframe: Arc<Keyframe>) -> Result<(), Error> {
        if keyframe.split == Split::Test || keyframe.depth.is_none() {
            return Ok(());
        }
        keyframe.check()?;
        self.pending.push_back(keyframe);
        Ok(())
    }

    /// A keyframe that was not fused yet is forgotten. What was fused stays: sums do not tell who gave what; it fades as
    /// others look at the same place.
    fn remove(&mut self, camera: &str, stamp: Stamp) -> Result<(), Error> {
        self.settle()?;
        self.pending.retain(|keyframe| keyframe.camera.as_ref() != camera || keyframe.stamp != stamp);
        Ok(())
    }

    fn step(&mut self, n: u64) -> Result<u64, Error> {
        let before = self.step;
        if !self.begin()? {
            self.settle()?;
            return Ok(self.step - before);
        }
        if !self.waiting.is_empty() {
            self.settle()?;
            return self.step_within_budget(n);
        }
        let n_in_flight = self.in_flight.as_ref().map_or(0, |in_flight| in_flight.n_frames);
        let n_left = (self.pending.len() - n_in_flight.min(self.pending.len())) as u64;
        let n_asked = n.saturating_sub(n_in_flight as u64); // `progress` does not know of those in flight.
        let n_frames = usize::try_from(n_asked.min(n_left)).unwrap_or(usize::MAX).min(self.frames_per_submit());
        if n_frames == 0 {
            self.settle()?;
            return Ok(self.step - before);
        }
        let since = Instant::now();
        for ix in 0..n_frames {
            self.record(n_in_flight + ix, ix)?;
        }
        let field = self.field.as_ref().ok_or(Error::DeviceLost)?;
        let status = self.passes.submit_reading(&self.gpu, &[(&field.status, 4 * status::LEN)]);
        let failed = self.settle()?; // The submit before; this one runs meanwhile.
        if !failed {
            self.in_flight = Some(InFlight { status, n_frames, since });
        } // Else this one found the failure too and did nothing.
        if n_frames as u64 == n_asked || n_frames as u64 == n_left {
            self.settle()?; // The caller stops here: the count must be true.
        }
        Ok(n_frames as u64)
    }

    fn is_idle(&self) -> bool {
        self.pending.is_empty()
    }

    fn primitive(&self) -> &'static str {
        "block"
    }

    fn n_taken(&mut self) -> Result<u64, Error> {
        self.settle()?;
        Ok(self.step)
    }

    fn seed(&mut self) -> Result<(), Error> {
        self.settle()?;
        self.fuse_first()
    }

    fn prepare(&mut self) -> Result<(), Error> {
        Ok(())
    }

    fn render(&mut self, request: &RenderRequest) -> Result<Picture, Error> {
        self.settle()?;
        self.fuse_first()?;
        projections::render(request, |camera| self.draw_view(camera, request.background_srgb, request.depth))
    }

    fn set_watched(&mut self, watched: bool) {
        self.is_watched = watched;
    }

    fn posed_lens(&mut self, keyframe: &Keyframe) -> Result<PosedLens, Error> {
        Ok(PosedLens::of(keyframe))
    }

    fn profile_step(&mut self) -> Result<Vec<PassTiming>, Error> {
        self.settle()?;
        if !self.begin()? {
            return Ok(Vec::new());
        }
        self.record(0, 0)?;
        let timings = self.passes.submit_timed(&self.gpu)?;
        let field = self.field.as_ref().ok_or(Error::DeviceLost)?;
        let counters = field.counters(&self.gpu)?;
        self.take_note(&counters)?;
        Ok(timings)
    }

    fn alignment(&self) -> Option<&Alignment> {
        None
    }

    fn progress(&self) -> Progress {
        Progress {
            step: self.step,
            primitives: u64::from(self.n_resident) + self.waiting.len() as u64,
            bytes: self.field.as_ref().map_or(0, |field| field.bytes(self.n_resident.into())),
            step_millis: self.step_millis,
        }
    }

    fn report(&self) -> Vec<Part> {
        Vec::new()
    }

    fn save(&mut self, folder: &Path) -> Result<(), Error> {
        self.write_folder(folder)
    }

    fn checkpoint(&mut self) -> Result<PendingCheckpoint, Error> {
        self.take_checkpoint()
    }
}
