//! The distance field as a [`Method`]. One step fuses one keyframe.

mod checkpoint;
mod drawing;
mod field_store;
mod frustum;
mod fusion;
mod keyframe_queue;
mod meshing;
mod saving;

use super::block::Blocks;
use super::bounds::bounds;
use super::capacity::{self, BYTES_PER_BLOCK, BYTES_PER_CHUNK};
use super::chosen_grid::VoxelGrid;
use super::kernels::Pipelines;
use super::mesh;
use super::options::TsdfOptions;
use super::params::status;
use super::passes::Canvas;
use crate::Bounds;
use crate::floaters::PendingFloaters;
use crate::model_chunks::PendingChunks;
use crate::model_options::ModelOptions;
use crate::packing::{Format, Reader};
use crate::pending::PendingCheckpoint;
use crate::view::ErasedSpace;
use crate::{
    CorrectedKeyframe, Error, Method, Packing, Picture, Progress, RenderRequest, Rendered,
};
use calibration::Alignment;
use field_store::{FieldStore, INITIAL_CAPACITY};
use frustum::ViewFrustum;
use fusion::Fusion;
use gpu::{Gpu, PassTiming, Passes};
use keyframe::{Keyframe, Split};
use keyframe_queue::KeyframeQueue;
use kinematics::Stamp;
use meshing::Meshing;
use model_files::Edits;
use model_files::mesh::Mesh;
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

/// Minimum number of blocks that the budget must allow. The voxel size is chosen so that one image
/// takes a tenth of the budget.
const MIN_BLOCKS: u32 = 256;
/// Minimum budget, which is enough for the initial table and the minimum number of blocks.
pub(super) const MIN_BYTES: u64 =
    INITIAL_CAPACITY.n_chunks as u64 * BYTES_PER_CHUNK + MIN_BLOCKS as u64 * BYTES_PER_BLOCK;

/// A colored distance field built from keyframes with depth.
///
/// Each keyframe is fused once, in the order in which the keyframes are pushed. Keyframes without
/// depth are ignored.
#[derive(Debug)]
pub struct TsdfModel {
    gpu: Arc<Gpu>,
    options: ModelOptions<TsdfOptions>,
    pipelines: Pipelines,
    passes: Passes,
    queue: KeyframeQueue,
    /// `None` before the first depth image.
    store: Option<FieldStore>,
    fusion: Fusion,
    canvas: Option<Canvas>,
    erased: ErasedSpace,
    reader: Reader,
    meshing: Meshing,
}

impl TsdfModel {
    /// An empty model. Fails if `max_bytes` is below the minimum.
    pub fn new(gpu: Arc<Gpu>, options: ModelOptions<TsdfOptions>) -> Result<Self, Error> {
        match options.common.max_bytes {
            Some(max_bytes) if max_bytes < MIN_BYTES => Err(Error::BudgetTooSmall {
                model: "distance field",
                max_bytes,
                min_bytes: MIN_BYTES,
            }),
            _ => Self::without_budget_check(gpu, options),
        }
    }

    /// An empty model. If `max_bytes` is below the minimum, it skips depth images that do not fit.
    pub(super) fn without_budget_check(
        gpu: Arc<Gpu>,
        options: ModelOptions<TsdfOptions>,
    ) -> Result<Self, Error> {
        Ok(Self {
            pipelines: Pipelines::new(&gpu)?,
            passes: Passes::default(),
            queue: KeyframeQueue::default(),
            store: None,
            fusion: Fusion::new(),
            canvas: None,
            erased: ErasedSpace::none(&gpu)?,
            reader: Reader::default(),
            meshing: Meshing::default(),
            gpu,
            options,
        })
    }

    /// Options of this model.
    pub fn options(&self) -> &ModelOptions<TsdfOptions> {
        &self.options
    }

    /// Voxel size and related settings. `None` before the first depth image.
    pub fn voxel_grid(&self) -> Option<&VoxelGrid> {
        self.store.as_ref().map(|store| &store.voxel_grid)
    }

    /// Number of keyframes that were skipped because they observe more blocks than fit into memory.
    pub fn n_skipped(&self) -> u64 {
        self.queue.n_skipped
    }

    /// Number of readings whose surface is outside the range of block coordinates.
    pub fn n_outside(&self) -> u32 {
        self.fusion.n_outside
    }

    /// Number of blocks in host memory.
    pub fn n_host_blocks(&self) -> usize {
        self.store
            .as_ref()
            .map_or(0, |store| store.host_blocks.len())
    }

    /// All blocks, ordered by their coordinates.
    pub fn blocks(&mut self) -> Result<Blocks, Error> {
        self.finish_in_flight()?;
        self.store.as_ref().map_or(Ok(Blocks::new()), |store| {
            store.blocks(&self.gpu, &self.pipelines)
        })
    }

    /// The current surface in world coordinates. Only blocks that changed since the last call are
    /// meshed.
    pub fn mesh(&mut self) -> Result<Mesh, Error> {
        self.mesh_without(&Edits::default())
    }

    /// [`Self::mesh`] without the triangles whose centers are in erased space.
    pub fn mesh_without(&mut self, edits: &Edits) -> Result<Mesh, Error> {
        self.update_mesh()?;
        Ok(self.voxel_grid().map_or_else(Mesh::default, |voxel_grid| {
            mesh::joined(self.meshing.blocks(), voxel_grid, edits)
        }))
    }

    /// Meshes the blocks that changed since the last call and reads their triangles back, without
    /// joining them into one mesh. Returns the number of blocks.
    pub fn update_mesh(&mut self) -> Result<usize, Error> {
        self.finish_in_flight()?;
        let Some(store) = &mut self.store else {
            return Ok(0);
        };
        self.meshing.update(&self.gpu, &self.pipelines, store)
    }

    /// GPU time of meshing the blocks that changed since the last [`Self::update_mesh`]. The blocks
    /// stay marked as changed, and nothing is read back. The list is empty if the adapter has no
    /// timestamps, or if blocks are in host memory.
    pub fn profile_mesh(&mut self) -> Result<Vec<PassTiming>, Error> {
        self.finish_in_flight()?;
        match self
            .store
            .as_ref()
            .filter(|store| store.host_blocks.is_empty())
        {
            Some(store) => self
                .meshing
                .profile(&self.gpu, &self.pipelines, &store.buffers),
            None => Ok(Vec::new()),
        }
    }

    /// Chooses the voxel size from the first depth image with valid readings and discards earlier
    /// images. Returns whether there was such an image.
    fn begin(&mut self) -> Result<bool, Error> {
        // The maximum size of a binding limits the field, just like a budget. The voxel size must
        // suit this limit.
        let max_blocks = capacity::max_blocks_within(
            &self.gpu,
            self.options.common.max_bytes,
            INITIAL_CAPACITY.n_chunks,
        );
        let max_bytes = Some(u64::from(max_blocks) * BYTES_PER_BLOCK);
        while self.store.is_none() {
            let Some(first) = self.queue.pending.front() else {
                return Ok(false);
            };
            // An image without valid readings, such as the first image of a sensor that is
            // starting, contains no information about the scene.
            match first
                .depth
                .as_ref()
                .and_then(|depth| VoxelGrid::choose(&self.options.specific, max_bytes, depth))
            {
                Some(grid) => {
                    self.store = Some(FieldStore::new(
                        &self.gpu,
                        grid,
                        self.options.common.max_bytes,
                    )?)
                }
                None => self.queue.complete_first(),
            }
        }
        Ok(!self.queue.pending.is_empty())
    }

    /// Fuses one keyframe if none was fused yet, so that there is something to render. Only one
    /// keyframe is fused, because rendering must not train the model.
    fn fuse_one(&mut self) -> Result<(), Error> {
        while self.queue.step() == 0 && !self.queue.pending.is_empty() {
            self.step(1)?;
        }
        Ok(())
    }

    /// Records the passes of a pending keyframe.
    fn record(&mut self, pending_ix: usize, slot_ix: usize) -> Result<(), Error> {
        let (Some(store), Some(keyframe)) = (&self.store, self.queue.pending.get(pending_ix))
        else {
            return Ok(());
        };
        self.fusion.record(
            &self.gpu,
            &mut self.passes,
            &self.pipelines,
            store,
            keyframe,
            slot_ix,
        )
    }

    /// Fuses the first pending keyframe after loading the blocks that it could change.
    fn step_with_host_blocks(&mut self, n: u64) -> Result<u64, Error> {
        // Only one keyframe is fused at a time. The host determines which blocks the next keyframe
        // needs, and these blocks may have to replace other blocks.
        if n == 0 || self.queue.pending.is_empty() {
            return Ok(0);
        }
        if !self.load_blocks_of_first()? {
            // The next image needs different blocks, so it may fit.
            self.skip_first();
            return Ok(1);
        }
        self.record(0, 0)?;
        self.passes.submit(&self.gpu);
        let counters = self
            .store
            .as_ref()
            .ok_or_else(no_blocks)?
            .buffers
            .counters(&self.gpu)?;
        self.apply_counters(&counters)?;
        Ok(1)
    }

    /// Loads the blocks that the first pending keyframe could change. Returns whether they fit.
    fn load_blocks_of_first(&mut self) -> Result<bool, Error> {
        let (Some(store), Some(keyframe)) = (&mut self.store, self.queue.pending.front()) else {
            return Ok(true);
        };
        let Some(frustum) = ViewFrustum::of_depth(keyframe, &store.voxel_grid) else {
            return Ok(true);
        };
        store.load_visible(&self.gpu, &self.pipelines, &frustum, false)
    }

    /// Skips the first pending keyframe because it observes more blocks than fit.
    fn skip_first(&mut self) {
        if let Some(store) = &self.store {
            self.queue.skip_first(store.max_blocks(&self.gpu));
        }
    }

    /// Waits for the submit in flight and applies its counters. Returns whether the buffers
    /// overflowed.
    fn finish_in_flight(&mut self) -> Result<bool, Error> {
        match self.fusion.submits.finish(&self.gpu)? {
            Some(counters) => self.apply_counters(&counters),
            None => Ok(false),
        }
    }

    /// Counts fused keyframes. If the buffers overflowed, grows them and returns true.
    fn apply_counters(&mut self, counters: &[u32]) -> Result<bool, Error> {
        // The GPU decides which keyframes were fused. After an overflow, later keyframes of the
        // same submit are not fused, so they stay pending.
        for _ in 0..self.fusion.apply_counters(counters) {
            self.queue.complete_first();
        }
        let Some(store) = &mut self.store else {
            return Ok(false);
        };
        store.n_resident = counters[status::N_BLOCKS];
        let failed = counters[status::STOPPED] != 0;
        if failed {
            self.grow(counters)?;
        }
        Ok(failed)
    }

    /// Grows a field that overflowed. It grows on the GPU, or blocks move to host memory before the
    /// next depth image. Skips the image if neither is possible.
    fn grow(&mut self, counters: &[u32]) -> Result<(), Error> {
        let Some(store) = &mut self.store else {
            return Ok(());
        };
        // Cached bindings would keep the buffers that were replaced.
        let n_excess = store.grow(&self.gpu, &self.pipelines, counters)?;
        self.passes.clear_bindings();
        // Only blocks that the failed image does not observe may be evicted. Otherwise, the image
        // would need them again at once.
        if n_excess > 0
            && let Some(keyframe) = self.queue.pending.front()
            && let Some(frustum) = ViewFrustum::of_depth(keyframe, &store.voxel_grid)
            && !store.evict(&self.gpu, &self.pipelines, &frustum, n_excess)?
        {
            self.queue.skip_first(store.max_blocks(&self.gpu));
        }
        store.n_resident = store.buffers.n_blocks(&self.gpu)?;
        Ok(())
    }
}

impl Method for TsdfModel {
    fn push(&mut self, keyframe: Arc<Keyframe>) -> Result<(), Error> {
        // A keyframe without depth contains no surface. This is not an error, because often only
        // some cameras of a rig have depth.
        if keyframe.split == Split::Test || keyframe.depth.is_none() {
            return Ok(());
        }
        keyframe.check()?;
        self.queue.pending.push_back(keyframe);
        Ok(())
    }

    /// Removes a keyframe that was not fused yet. The contribution of fused keyframes stays,
    /// because it is not stored separately. It fades as later keyframes observe the same place.
    fn remove(&mut self, camera: &str, stamp: Stamp) -> Result<(), Error> {
        self.finish_in_flight()?;
        self.queue.remove(camera, stamp);
        Ok(())
    }

    fn step(&mut self, n: u64) -> Result<u64, Error> {
        let before = self.queue.step();
        if !self.begin()? {
            self.finish_in_flight()?;
            return Ok(self.queue.step() - before);
        }
        // If some blocks are in host memory, the host must first load the blocks that the image
        // could change.
        if self.n_host_blocks() > 0 {
            self.finish_in_flight()?;
            return self.step_with_host_blocks(n);
        }

        // Otherwise, the next submit is recorded while the previous submit runs. Keyframes in
        // flight are still pending, but must not be recorded again.
        let n_in_flight =
            usize::try_from(self.fusion.submits.n_steps_in_flight()).expect("few keyframes");
        let n_left = self.queue.pending.len().saturating_sub(n_in_flight) as u64;
        // `progress` does not include keyframes in flight.
        let n_asked = n.saturating_sub(n_in_flight as u64);
        let n_per_submit = self.fusion.keyframes_per_submit();
        let n_keyframes = usize::try_from(n_asked.min(n_left))
            .unwrap_or(usize::MAX)
            .min(n_per_submit);
        if n_keyframes == 0 {
            self.finish_in_flight()?;
            return Ok(self.queue.step() - before);
        }

        let since = Instant::now();
        for ix in 0..n_keyframes {
            self.record(n_in_flight + ix, ix)?;
        }
        let field = &self.store.as_ref().ok_or_else(no_blocks)?.buffers;
        let counters = self
            .passes
            .submit_reading(&self.gpu, &[(&field.status, 4 * status::LEN)]);

        // This waits for the previous submit while the new submit runs. If the previous submit
        // overflowed, the new submit had no effect, and its counters need not be read.
        let failed = self.finish_in_flight()?;
        if !failed {
            self.fusion
                .submits
                .begin(counters, n_keyframes as u64, since);
        }
        // At the end, the caller expects a correct count.
        if n_keyframes as u64 == n_asked || n_keyframes as u64 == n_left {
            self.finish_in_flight()?;
        }
        Ok(n_keyframes as u64)
    }

    fn is_idle(&self) -> bool {
        self.queue.pending.is_empty()
    }

    fn bounds(&mut self) -> Result<Option<Bounds>, Error> {
        let Some(voxel_grid) = self.voxel_grid().cloned() else {
            return Ok(None);
        };
        Ok(bounds(self.blocks()?.keys(), &voxel_grid))
    }

    fn n_total_steps(&mut self) -> Result<u64, Error> {
        self.finish_in_flight()?;
        Ok(self.queue.step())
    }

    fn seed(&mut self) -> Result<(), Error> {
        self.finish_in_flight()?;
        self.fuse_one()
    }

    fn render(&mut self, request: &RenderRequest) -> Result<Picture, Error> {
        self.finish_in_flight()?;
        self.fuse_one()?;
        Rendered::picture(request, |camera, output| {
            self.draw_view(camera, request.background_srgb, output)
        })
    }

    fn render_packed(
        &mut self,
        request: &RenderRequest,
        packing: Packing,
    ) -> Result<Rendered, Error> {
        self.finish_in_flight()?;
        self.fuse_one()?;
        Rendered::of(request, Format::Packed(packing), |camera, output| {
            self.draw_view(camera, request.background_srgb, output)
        })
    }

    fn queue_chunks(
        &mut self,
        only_changed: bool,
        edits: &Arc<Edits>,
    ) -> Result<Option<PendingChunks>, Error> {
        self.update_mesh()?;
        let Some(voxel_grid) = self.voxel_grid().cloned() else {
            return Ok(None);
        };
        // Encoding takes CPU time, so it is left to the thread that waits for the result.
        let chunks = self.meshing.take_chunks(&voxel_grid, edits, only_changed);
        Ok(Some(PendingChunks::new(move || {
            Ok(chunks.encode(&voxel_grid))
        })))
    }

    fn find_floaters(&mut self, edits: &Arc<Edits>) -> Result<PendingFloaters, Error> {
        self.update_mesh()?;
        let voxel_grid = self.voxel_grid().cloned().ok_or(Error::NoFloaters)?;
        // Blocks are shared, so the copy is cheap, and fusion may go on while another thread
        // searches.
        let blocks = self.meshing.blocks().clone();
        let edits = Arc::clone(edits);
        Ok(PendingFloaters::new(move || {
            let mesh = mesh::joined(&blocks, &voxel_grid, &edits);
            mesh::floaters(&mesh, voxel_grid.voxel_m).ok_or(Error::NoFloaters)
        }))
    }

    fn write_for_others(&mut self, folder: &Path, edits: &Edits) -> Result<(), Error> {
        self.write_meshes(folder, edits).map(drop)
    }

    fn set_watched(&mut self, watched: bool) {
        self.fusion.submits.set_watched(watched);
    }

    /// Fuses all keyframes again, because the contribution of a single keyframe to the sums is
    /// unknown.
    fn recalibrate(&mut self, keyframes: &[CorrectedKeyframe], _: &Alignment) -> Result<(), Error> {
        self.finish_in_flight()?;
        let is_watched = self.fusion.submits.is_watched();
        *self = Self::new(self.gpu.clone(), self.options.clone())?;
        self.set_watched(is_watched);
        keyframes
            .iter()
            .try_for_each(|keyframe| self.push(keyframe.after.clone()))
    }

    fn profile_step(&mut self) -> Result<Vec<PassTiming>, Error> {
        self.finish_in_flight()?;
        if !self.begin()? {
            return Ok(Vec::new());
        }
        self.record(0, 0)?;
        let timings = self.passes.submit_timed(&self.gpu)?;
        let counters = self
            .store
            .as_ref()
            .ok_or_else(no_blocks)?
            .buffers
            .counters(&self.gpu)?;
        self.apply_counters(&counters)?;
        Ok(timings)
    }

    fn progress(&self) -> Progress {
        Progress {
            step: self.queue.step(),
            primitives: self.store.as_ref().map_or(0, FieldStore::n_blocks),
            bytes: self
                .store
                .as_ref()
                .map_or(0, |store| store.buffers.bytes(store.n_resident.into())),
            step_millis: self.fusion.submits.step_millis(),
        }
    }

    fn save(&mut self, folder: &Path) -> Result<(), Error> {
        self.write_folder(folder)
    }

    fn checkpoint(&mut self) -> Result<PendingCheckpoint, Error> {
        self.take_checkpoint()
    }
}

/// The error if a keyframe is fused before the blocks are allocated.
fn no_blocks() -> Error {
    Error::internal("a keyframe was fused before the blocks were allocated")
}
