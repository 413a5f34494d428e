//! The distance field as a [`Method`]: one step fuses one keyframe.

mod budget;
mod checkpoint;
mod meshing;
mod saving;

use super::block::{Blocks, GridCoord};
use super::bounds::bounds;
use super::buffers::FieldBuffers;
use super::capacity::{self, BYTES_PER_BLOCK, BYTES_PER_CHUNK, Capacity};
use super::chosen_grid::VoxelGrid;
use super::kernels::Pipelines;
use super::mesh::Mesher;
use super::mesh_buffers::MeshBuffers;
use super::options::TsdfOptions;
use super::params::{DepthView, status};
use super::passes::{self, Canvas, KeyframeSlot};
use crate::checkpoint::PendingCheckpoint;
use crate::gpu::{Gpu, PassTiming, Passes, PendingRead};
use crate::keyframe_signature::KeyframeSignature;
use crate::method::submit_millis;
use crate::model_options::ModelOptions;
use crate::view::{Camera, projections};
use crate::{Bounds, Error, Method, Picture, Progress, Projection, RenderRequest, Restartable};
use calibration::Alignment;
use calibration::CalibratedCamera;
use calibration::TrialReport;
use keyframe::{Keyframe, Split};
use kinematics::Stamp;
use std::collections::{BTreeSet, VecDeque};
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

/// Maximum number of keyframes per submit: their images are on the GPU at once.
const KEYFRAMES_PER_SUBMIT: usize = 4;
/// Initial capacity.
const INITIAL_CAPACITY: Capacity = Capacity { n_blocks: 4096, n_chunks: 512 };
/// Minimum number of blocks that the budget must allow: the voxel size is chosen so that one image takes a tenth of
/// them.
const MIN_BLOCKS: u32 = 256;
/// Minimum budget: the initial table and the minimum number of blocks.
pub(super) const MIN_BYTES: u64 =
    INITIAL_CAPACITY.n_chunks as u64 * BYTES_PER_CHUNK + MIN_BLOCKS as u64 * BYTES_PER_BLOCK;

/// A colored distance field built from keyframes with depth.
///
/// Each keyframe is fused once, in the order they are pushed. Keyframes without depth are ignored.
#[derive(Debug)]
pub struct TsdfModel {
    gpu: Arc<Gpu>,
    options: ModelOptions<TsdfOptions>,
    pipelines: Pipelines,
    voxel_grid: Option<VoxelGrid>,
    field: Option<FieldBuffers>,
    slots: Vec<KeyframeSlot>,
    canvas: Option<Canvas>,
    passes: Passes,
    /// Keyframes not confirmed as fused yet, in order. The first ones may be in flight.
    pending: VecDeque<Arc<Keyframe>>,
    fused: Vec<KeyframeSignature>,
    /// Pending keyframes of a loaded checkpoint that were not provided.
    unmatched: Vec<KeyframeSignature>,
    in_flight: Option<InFlight>,
    /// Blocks that do not fit on the GPU.
    host_blocks: Blocks,
    /// Blocks that changed since the mesh was updated, in addition to those flagged on the GPU.
    stale: BTreeSet<GridCoord>,
    mesher: Mesher,
    mesh_buffers: Option<MeshBuffers>,
    n_resident: u32,
    n_skipped: u64,
    n_outside: u32,
    /// Counter of fused depth images when the GPU was last read.
    n_fused_on_gpu: u32,
    step: u64,
    step_millis: f64,
    /// Whether pictures are requested.
    is_watched: bool,
}

#[derive(Debug)]
struct InFlight {
    status: PendingRead,
    n_keyframes: usize,
    since: Instant,
}

impl TsdfModel {
    /// An empty model. Fails if `max_bytes` is below the minimum.
    pub fn new(gpu: Arc<Gpu>, options: ModelOptions<TsdfOptions>) -> Result<Self, Error> {
        match options.common.max_bytes {
            Some(max_bytes) if max_bytes < MIN_BYTES => {
                Err(Error::BudgetTooSmall { model: "distance field", max_bytes, min_bytes: MIN_BYTES })
            }
            _ => Self::without_budget_check(gpu, options),
        }
    }

    /// An empty model. If `max_bytes` is below the minimum, it skips depth images that do not fit.
    pub(super) fn without_budget_check(gpu: Arc<Gpu>, options: ModelOptions<TsdfOptions>) -> Result<Self, Error> {
        Ok(Self {
            pipelines: Pipelines::new(&gpu)?,
            voxel_grid: None,
            field: None,
            slots: Vec::new(),
            canvas: None,
            passes: Passes::default(),
            pending: VecDeque::new(),
            fused: Vec::new(),
            unmatched: Vec::new(),
            in_flight: None,
            host_blocks: Blocks::new(),
            stale: BTreeSet::new(),
            mesher: Mesher::default(),
            mesh_buffers: None,
            n_resident: 0,
            n_skipped: 0,
            n_outside: 0,
            n_fused_on_gpu: 0,
            step: 0,
            step_millis: 0.0,
            is_watched: false,
            gpu,
            options,
        })
    }

    /// Options of this model.
    pub fn options(&self) -> &ModelOptions<TsdfOptions> {
        &self.options
    }

    /// Voxel size and related settings; `None` before the first depth image.
    pub fn voxel_grid(&self) -> Option<&VoxelGrid> {
        self.voxel_grid.as_ref()
    }

    /// Number of keyframes that were skipped because they observe more blocks than fit into memory.
    pub fn n_skipped(&self) -> u64 {
        self.n_skipped
    }

    /// Number of readings whose surface was too far out for block coordinates.
    pub fn n_outside(&self) -> u32 {
        self.n_outside
    }

    /// Number of blocks in host memory.
    pub fn n_host_blocks(&self) -> usize {
        self.host_blocks.len()
    }

    /// All blocks, ordered by their coordinates.
    pub fn blocks(&mut self) -> Result<Blocks, Error> {
        self.finish_in_flight()?;
        let mut blocks = self.host_blocks.clone();
        if let Some(field) = &self.field {
            blocks.extend(field.read_all(&self.gpu, &self.pipelines)?);
        }
        Ok(blocks)
    }

    /// Maximum number of blocks on the GPU, in addition to the table.
    fn max_blocks(&self) -> u32 {
        self.max_blocks_with_table(self.field.as_ref().map_or(INITIAL_CAPACITY, |field| field.capacity).n_chunks)
    }

    fn max_blocks_with_table(&self, n_chunks: u32) -> u32 {
        let table_bytes = u64::from(n_chunks) * BYTES_PER_CHUNK;
        let n_blocks_in = |bytes: u64| bytes.saturating_sub(table_bytes) / BYTES_PER_BLOCK;
        let by_bytes = self.options.common.max_bytes.map_or(u64::MAX, n_blocks_in);
        capacity::max_blocks(&self.gpu).min(u32::try_from(by_bytes).unwrap_or(u32::MAX)).max(1)
    }

    /// Chooses the voxel size from the first depth image with valid readings and discards earlier ones. Returns whether
    /// there was one.
    fn begin(&mut self) -> Result<bool, Error> {
        // The size of one binding limits the field like a budget does.
        let max_bytes = Some(u64::from(self.max_blocks()) * BYTES_PER_BLOCK);
        while self.voxel_grid.is_none() {
            let Some(first) = self.pending.front() else { return Ok(false) };
            let chosen_grid =
                first.depth.as_ref().and_then(|depth| VoxelGrid::choose(&self.options.specific, max_bytes, depth));
            if let Some(voxel_grid) = chosen_grid {
                let n_blocks = INITIAL_CAPACITY.n_blocks.min(self.max_blocks());
                self.field =
                    Some(FieldBuffers::new(&self.gpu, &voxel_grid, Capacity { n_blocks, ..INITIAL_CAPACITY })?);
                self.voxel_grid = Some(voxel_grid);
            } else {
                self.skip_first();
            }
        }
        Ok(!self.pending.is_empty())
    }

    /// Fuses one keyframe if none was fused yet, so that there is something to render. It fuses no more, so that
    /// rendering does not train.
    fn fuse_one(&mut self) -> Result<(), Error> {
        while self.step == 0 && !self.pending.is_empty() {
            self.step(1)?;
        }
        Ok(())
    }

    /// Number of keyframes in a submit that stays within the time limit.
    fn keyframes_per_submit(&self) -> usize {
        if !self.is_watched || self.step_millis == 0.0 {
            return KEYFRAMES_PER_SUBMIT;
        }
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped")]
        let n = (submit_millis(true) / self.step_millis).clamp(1.0, KEYFRAMES_PER_SUBMIT as f64) as usize;
        n
    }

    /// Marks the first pending keyframe as fused.
    fn skip_first(&mut self) {
        if let Some(keyframe) = self.pending.pop_front() {
            self.fused.push(KeyframeSignature::of(&keyframe));
            self.step += 1;
        }
    }

    /// Records the passes of a pending keyframe.
    fn record(&mut self, pending_ix: usize, slot_ix: usize) -> Result<(), Error> {
        let (Some(voxel_grid), Some(keyframe)) = (&self.voxel_grid, self.pending.get(pending_ix)) else {
            return Ok(());
        };
        let Some(depth_view) = DepthView::of(keyframe, voxel_grid) else { return Ok(()) };
        let [n_depth, n_color] = [depth_view.depth_size_px, depth_view.color_size_px]
            .map(|[width, height]| u64::from(width) * u64::from(height));
        if self.slots.get(slot_ix).is_none_or(|slot| !slot.holds(n_depth, n_color)) {
            self.passes.clear_bindings();
            let slot = KeyframeSlot::new(&self.gpu, n_depth, n_color)?;
            self.slots.truncate(slot_ix);
            self.slots.push(slot);
        }
        let slot = &mut self.slots[slot_ix];
        slot.upload(&self.gpu, keyframe, &depth_view);
        if let Some(field) = &self.field {
            passes::fuse(&self.gpu, &mut self.passes, &self.pipelines, field, slot);
        }
        Ok(())
    }

    /// Waits for the submit in flight and applies its counters. Returns whether the buffers overflowed.
    fn finish_in_flight(&mut self) -> Result<bool, Error> {
        let Some(in_flight) = self.in_flight.take() else { return Ok(false) };
        let counters: Vec<u32> = in_flight.status.finish(&self.gpu)?;
        let millis = in_flight.since.elapsed().as_secs_f64() * 1e3 / in_flight.n_keyframes.max(1) as f64;
        self.step_millis = if self.step_millis == 0.0 { millis } else { 0.8 * self.step_millis + 0.2 * millis };
        self.apply_counters(&counters)
    }

    /// Counts fused keyframes. If the buffers overflowed, grows them and returns true.
    fn apply_counters(&mut self, counters: &[u32]) -> Result<bool, Error> {
        for _ in 0..counters[status::N_FUSED].wrapping_sub(self.n_fused_on_gpu) {
            self.skip_first();
        }
        self.n_fused_on_gpu = counters[status::N_FUSED];
        self.n_outside = counters[status::N_OUTSIDE];
        self.n_resident = counters[status::N_BLOCKS];
        let failed = counters[status::STOPPED] != 0;
        if failed {
            self.grow(counters)?;
            self.n_resident = self.field.as_ref().map_or(Ok(0), |field| field.n_blocks(&self.gpu))?;
        }
        Ok(failed)
    }

    /// Grows a field that overflowed, on the GPU or by moving blocks to host memory.
    fn grow(&mut self, counters: &[u32]) -> Result<(), Error> {
        let (Some(voxel_grid), Some(field)) = (&self.voxel_grid, &self.field) else { return Ok(()) };
        let mut capacity = field.capacity;
        if counters[status::TABLE_FULL] != 0 {
            capacity.n_chunks *= 2;
        }
        let (n_blocks_needed, n_blocks_allowed) =
            (counters[status::N_BLOCKS], self.max_blocks_with_table(capacity.n_chunks));
        if n_blocks_needed > capacity.n_blocks {
            let n_blocks_target = n_blocks_needed.max(capacity.n_blocks.saturating_add(capacity.n_blocks / 2));
            capacity.n_blocks = n_blocks_target.min(n_blocks_allowed).max(capacity.n_blocks);
        }
        if capacity != field.capacity {
            log::debug!("tsdf: grown to {capacity:?}");
            let resized = field.resized(&self.gpu, &self.pipelines, voxel_grid, capacity)?;
            self.passes.clear_bindings();
            self.field = Some(resized);
        }
        if n_blocks_needed > n_blocks_allowed { self.evict(n_blocks_needed - n_blocks_allowed) } else { Ok(()) }
    }

    /// Renders one pinhole view.
    fn draw_view(&mut self, camera: &Camera, background_srgb: [f32; 3], depth: bool) -> Result<Picture, Error> {
        if !self.record_picture(camera, background_srgb)? {
            return Ok(Picture::empty(camera.size_px, background_srgb, depth));
        }
        let canvas = self.canvas.as_ref().ok_or(Error::DeviceLost)?;
        let read = self.passes.submit_reading(
            &self.gpu,
            &Picture::buffers(camera.size_px, &canvas.pixels, depth.then_some(&canvas.depths)),
        );
        read.finish_with(&self.gpu, |parts| Picture::from_parts(camera.size_px, parts))
    }

    /// GPU time of a pinhole picture, milliseconds, without reading it back; `None` if the adapter has no timestamps.
    pub fn profile_picture(&mut self, request: &RenderRequest) -> Result<Option<f64>, Error> {
        self.finish_in_flight()?;
        let Projection::Pinhole { focal_px, principal_px } = request.projection else { return Ok(None) };
        if !self.record_picture(&Camera::from_request(request, focal_px, principal_px), request.background_srgb)? {
            return Ok(None);
        }
        self.passes.submit_timed_total(&self.gpu)
    }

    /// Records the passes of a picture. Returns false if there is nothing to render.
    fn record_picture(&mut self, camera: &Camera, background_srgb: [f32; 3]) -> Result<bool, Error> {
        let [width, height] = camera.size_px;
        let n = u64::from(width) * u64::from(height);
        let Some(voxel_grid) = self.voxel_grid.clone().filter(|_| self.field.is_some()) else { return Ok(false) };
        let in_field = in_field(camera, &voxel_grid);
        self.load_visible(&in_field)?;
        if self.canvas.as_ref().is_none_or(|canvas| canvas.n_pixels < n) {
            self.passes.clear_bindings();
            self.canvas = None;
            self.canvas = Some(Canvas::new(&self.gpu, n)?);
        }
        let (Some(field), Some(canvas)) = (&self.field, &self.canvas) else { return Err(Error::DeviceLost) };
        canvas.set_view(&self.gpu, &in_field.view(), background_srgb);
        passes::draw(&self.gpu, &mut self.passes, &self.pipelines, field, canvas, camera.size_px);
        Ok(true)
    }
}

/// The camera and its crop box in the field's frame.
fn in_field(camera: &Camera, voxel_grid: &VoxelGrid) -> Camera {
    let field_from_world = voxel_grid.field_from_world();
    let mut camera = camera.clone();
    camera.world_from_camera = field_from_world * camera.world_from_camera;
    if let Some(crop) = &mut camera.crop {
        crop.world_from_box = field_from_world * crop.world_from_box;
    }
    camera
}

impl Restartable for TsdfModel {
    fn restart(&mut self) -> Result<(), Error> {
        self.finish_in_flight()?;
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

    /// Removes a keyframe that was not fused yet. Fused keyframes stay, because their contribution to the sums is
    /// unknown; they fade as later keyframes observe the same place.
    fn remove(&mut self, camera: &str, stamp: Stamp) -> Result<(), Error> {
        self.finish_in_flight()?;
        self.pending.retain(|keyframe| keyframe.camera.as_ref() != camera || keyframe.stamp != stamp);
        Ok(())
    }

    fn step(&mut self, n: u64) -> Result<u64, Error> {
        let before = self.step;
        if !self.begin()? {
            self.finish_in_flight()?;
            return Ok(self.step - before);
        }
        if !self.host_blocks.is_empty() {
            self.finish_in_flight()?;
            return self.step_with_host_blocks(n);
        }
        let n_in_flight = self.in_flight.as_ref().map_or(0, |in_flight| in_flight.n_keyframes);
        let n_left = (self.pending.len() - n_in_flight.min(self.pending.len())) as u64;
        let n_asked = n.saturating_sub(n_in_flight as u64); // `progress` does not include keyframes in flight.
        let n_keyframes = usize::try_from(n_asked.min(n_left)).unwrap_or(usize::MAX).min(self.keyframes_per_submit());
        if n_keyframes == 0 {
            self.finish_in_flight()?;
            return Ok(self.step - before);
        }
        let since = Instant::now();
        for ix in 0..n_keyframes {
            self.record(n_in_flight + ix, ix)?;
        }
        let field = self.field.as_ref().ok_or(Error::DeviceLost)?;
        let status = self.passes.submit_reading(&self.gpu, &[(&field.status, 4 * status::LEN)]);
        let failed = self.finish_in_flight()?; // Waits for the previous submit while this one runs.
        if !failed {
            self.in_flight = Some(InFlight { status, n_keyframes, since });
        } // Otherwise the new submit found the failure too and did nothing.
        if n_keyframes as u64 == n_asked || n_keyframes as u64 == n_left {
            self.finish_in_flight()?; // The caller expects a correct count.
        }
        Ok(n_keyframes as u64)
    }

    fn is_idle(&self) -> bool {
        self.pending.is_empty()
    }

    fn n_total_steps(&mut self) -> Result<u64, Error> {
        self.finish_in_flight()?;
        Ok(self.step)
    }

    fn seed(&mut self) -> Result<(), Error> {
        self.finish_in_flight()?;
        self.fuse_one()
    }

    fn prepare(&mut self) -> Result<(), Error> {
        Ok(())
    }

    fn render(&mut self, request: &RenderRequest) -> Result<Picture, Error> {
        self.finish_in_flight()?;
        self.fuse_one()?;
        projections::render(request, |camera| self.draw_view(camera, request.background_srgb, request.depth))
    }

    fn set_watched(&mut self, watched: bool) {
        self.is_watched = watched;
    }

    fn bounds(&mut self) -> Result<Option<Bounds>, Error> {
        let Some(voxel_grid) = self.voxel_grid.clone() else { return Ok(None) };
        Ok(bounds(self.blocks()?.keys(), &voxel_grid))
    }

    fn calibrated_camera(&mut self, keyframe: &Keyframe) -> Result<CalibratedCamera, Error> {
        Ok(CalibratedCamera::of(keyframe))
    }

    fn profile_step(&mut self) -> Result<Vec<PassTiming>, Error> {
        self.finish_in_flight()?;
        if !self.begin()? {
            return Ok(Vec::new());
        }
        self.record(0, 0)?;
        let timings = self.passes.submit_timed(&self.gpu)?;
        let field = self.field.as_ref().ok_or(Error::DeviceLost)?;
        let counters = field.counters(&self.gpu)?;
        self.apply_counters(&counters)?;
        Ok(timings)
    }

    fn alignment(&self) -> Option<&Alignment> {
        None
    }

    fn progress(&self) -> Progress {
        Progress {
            step: self.step,
            primitives: u64::from(self.n_resident) + self.host_blocks.len() as u64,
            bytes: self.field.as_ref().map_or(0, |field| field.bytes(self.n_resident.into())),
            step_millis: self.step_millis,
        }
    }

    fn report(&self) -> Vec<TrialReport> {
        Vec::new()
    }

    fn save(&mut self, folder: &Path) -> Result<(), Error> {
        self.write_folder(folder)
    }

    fn checkpoint(&mut self) -> Result<PendingCheckpoint, Error> {
        self.take_checkpoint()
    }
}
