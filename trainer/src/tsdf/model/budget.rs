//! Keeps blocks that do not fit on the GPU in host memory until a camera observes them again.
//!
//! Before a depth image is fused, every block it could change is loaded back. The field therefore equals, bit for bit,
//! one with unlimited memory.

use super::super::block::{Blocks, GridCoord};
use super::super::chosen_grid::VoxelGrid;
use super::super::params::DepthView;
use super::TsdfModel;
use crate::Error;
use crate::view::Camera;
use kinematics::Transform;
use nalgebra::{Point3, Vector3};
use std::collections::BTreeSet;

/// Fraction of the pool that is freed at once, so that not every image evicts blocks.
const EVICTED_FRAC: f64 = 0.125;
/// Added to the radius of a block, voxels: the test on the GPU rounds differently.
const SLACK_VOXELS: f64 = 0.5;

/// Approximate view frustum of a camera.
struct ViewFrustum {
    camera_from_field: Transform,
    center_m: Point3<f64>,
    focal_px: [f64; 2],
    principal_px: [f64; 2],
    size_px: [f64; 2],
    far_m: f64,
    block_m: f64,
}

impl ViewFrustum {
    fn new(
        field_from_camera: &Transform,
        lens: [[f64; 2]; 2],
        size_px: [u32; 2],
        far_m: f64,
        voxel_grid: &VoxelGrid,
    ) -> Self {
        Self {
            camera_from_field: field_from_camera.inverse(),
            center_m: field_from_camera.translation.vector.into(),
            focal_px: lens[0],
            principal_px: lens[1],
            size_px: size_px.map(f64::from),
            far_m,
            block_m: 8.0 * voxel_grid.voxel_m,
        }
    }

    fn center_of_block_m(&self, block: GridCoord) -> Point3<f64> {
        (Vector3::from(block.map(|along| f64::from(along) + 0.5)) * self.block_m).into()
    }

    /// Conservative: true at least for all blocks that the kernel `find_visible` lists.
    fn may_be_visible(&self, block: GridCoord) -> bool {
        let center = self.camera_from_field * self.center_of_block_m(block);
        let radius_m = self.block_m * (7.0 + SLACK_VOXELS) / 8.0;
        let is_inside_sides = (0..2).all(|axis| {
            let (focal, low) = (self.focal_px[axis], self.principal_px[axis]);
            let high = self.size_px[axis] - low;
            focal * center[axis] + low * center.z >= -radius_m * focal.hypot(low)
                && high * center.z - focal * center[axis] >= -radius_m * focal.hypot(high)
        });
        is_inside_sides && center.z >= -radius_m && center.z <= self.far_m + radius_m
    }

    fn distance_m(&self, block: GridCoord) -> f64 {
        (self.center_of_block_m(block) - self.center_m).norm()
    }
}

impl TsdfModel {
    fn next_frustum(&self) -> Option<ViewFrustum> {
        let (voxel_grid, keyframe) = (self.voxel_grid.as_ref()?, self.pending.front()?);
        let depth = keyframe.depth.as_ref()?;
        let field_from_depth = voxel_grid.field_from_world() * depth.world_from_camera;
        let far_m = voxel_grid.max_depth_m + voxel_grid.scale_m;
        DepthView::of(keyframe, voxel_grid)?;
        Some(ViewFrustum::new(
            &field_from_depth,
            [depth.focal_px, depth.principal_px],
            depth.size_px,
            far_m,
            voxel_grid,
        ))
    }

    /// Frees slots for at least `n` more blocks before the next depth image; skips the image if that is not possible.
    pub(super) fn evict(&mut self, n: u32) -> Result<(), Error> {
        let Some(frustum) = self.next_frustum() else { return Ok(()) };
        let n_spare = f64::from(self.max_blocks()) * EVICTED_FRAC;
        let n_sent = self.swap_blocks(&frustum, n as usize, n_spare, Blocks::new())?;
        if n_sent < n as usize {
            self.n_skipped += 1;
            log::warn!(
                "tsdf: skipped an image that observes more than the {} blocks that fit into memory",
                self.max_blocks()
            );
            self.skip_first();
        }
        Ok(())
    }

    /// Loads the blocks that the next depth image could change, and fuses it.
    pub(super) fn step_with_host_blocks(&mut self, n: u64) -> Result<u64, Error> {
        let before = self.step;
        let n = n.min(self.pending.len() as u64).min(1);
        if n == 0 {
            return Ok(0);
        }
        if let Some(frustum) = self.next_frustum() {
            self.load_blocks(&frustum, false)?;
        }
        if self.step != before {
            return Ok(n); // The image was skipped; the next one needs other blocks.
        }
        self.record(0, 0)?;
        self.passes.submit(&self.gpu);
        let counters = self.field.as_ref().ok_or(Error::DeviceLost)?.counters(&self.gpu)?;
        self.apply_counters(&counters)?;
        Ok(n)
    }

    /// Loads the blocks that a picture shows, nearest first if not all fit.
    pub(super) fn load_visible(&mut self, camera: &Camera) -> Result<(), Error> {
        let Some(voxel_grid) = self.voxel_grid.as_ref().filter(|_| !self.host_blocks.is_empty()) else { return Ok(()) };
        let lens = [camera.focal_px, camera.principal_px];
        let frustum = ViewFrustum::new(&camera.world_from_camera, lens, camera.size_px, camera.far_m, voxel_grid);
        self.load_blocks(&frustum, true)
    }

    /// Loads visible blocks from host memory. If not all fit: loads some if `allows_partial`, otherwise skips the next
    /// depth image.
    fn load_blocks(&mut self, frustum: &ViewFrustum, allows_partial: bool) -> Result<(), Error> {
        let mut visible_host_blocks: Vec<GridCoord> =
            self.host_blocks.keys().copied().filter(|block| frustum.may_be_visible(*block)).collect();
        if visible_host_blocks.is_empty() {
            return Ok(());
        }
        visible_host_blocks.sort_by(|a, b| frustum.distance_m(*a).total_cmp(&frustum.distance_m(*b)));
        let Some(field) = &self.field else { return Ok(()) };
        let n_observed =
            field.block_coords(&self.gpu)?.into_iter().filter(|block| frustum.may_be_visible(*block)).count();
        let n_free_slots = field.capacity.n_blocks as usize - n_observed.min(field.capacity.n_blocks as usize);
        if visible_host_blocks.len() > n_free_slots && !allows_partial {
            self.n_skipped += 1;
            log::warn!(
                "tsdf: skipped an image that observes more than the {} blocks that fit into memory",
                self.max_blocks()
            );
            self.skip_first();
            return Ok(());
        }
        visible_host_blocks.truncate(n_free_slots);
        let added: Blocks = visible_host_blocks
            .into_iter()
            .filter_map(|block| Some((block, self.host_blocks.remove(&block)?)))
            .collect();
        let n_free = field.capacity.n_blocks as usize - field.n_blocks(&self.gpu)? as usize;
        let n = added.len().saturating_sub(n_free);
        self.swap_blocks(frustum, n, 0.0, added).map(drop)
    }

    /// Evicts up to `n + n_spare` blocks outside the frustum to host memory, farthest first; then adds `added`. Returns
    /// how many were evicted.
    fn swap_blocks(&mut self, frustum: &ViewFrustum, n: usize, n_spare: f64, added: Blocks) -> Result<usize, Error> {
        let Some(field) = &mut self.field else { return Ok(0) };
        self.stale.extend(field.take_changed(&self.gpu)?);
        let block_coords = field.block_coords(&self.gpu)?;
        let mut invisible_slots: Vec<(u32, GridCoord)> = (0..)
            .zip(&block_coords)
            .map(|(slot, block_coord)| (slot, *block_coord))
            .filter(|(_, block)| !frustum.may_be_visible(*block))
            .collect();
        invisible_slots
            .sort_by(|(_, a), (_, b)| frustum.distance_m(*b).total_cmp(&frustum.distance_m(*a)).then_with(|| a.cmp(b)));
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a fraction of a u32")]
        invisible_slots.truncate(n + n_spare as usize);
        let evicted: BTreeSet<u32> = invisible_slots.iter().map(|(slot, _)| *slot).collect();
        let slots: Vec<u32> = evicted.iter().copied().collect();
        let blocks = field.read(&self.gpu, &self.pipelines, &slots)?;
        self.host_blocks.extend(slots.iter().map(|slot| block_coords[*slot as usize]).zip(blocks));
        field.swap_blocks(&self.gpu, &self.pipelines, &slots, &added)?;
        self.n_resident = field.n_blocks(&self.gpu)?;
        Ok(slots.len())
    }
}
