//! Determines the blocks that a camera may observe.

use crate::tsdf::block::GridCoord;
use crate::tsdf::chosen_grid::VoxelGrid;
use crate::tsdf::params::DepthView;
use crate::view::Camera;
use keyframe::Keyframe;
use kinematics::Transform;
use nalgebra::{Point3, Vector3};

/// Margin added to the radius of a block, voxels, because the test on the GPU rounds differently.
const SLACK_VOXELS: f64 = 0.5;

/// Approximate view frustum of a camera.
pub(super) struct ViewFrustum {
    camera_from_field: Transform,
    center_m: Point3<f64>,
    focal_px: [f64; 2],
    principal_px: [f64; 2],
    size_px: [f64; 2],
    far_m: f64,
    block_m: f64,
}

impl ViewFrustum {
    /// The frustum of a keyframe's depth camera. `None` if its depth image changes no block.
    pub(super) fn of_depth(keyframe: &Keyframe, voxel_grid: &VoxelGrid) -> Option<Self> {
        let depth = keyframe.depth.as_ref()?;
        // This is the same condition as for recording the passes. Without a depth view, nothing is
        // fused.
        DepthView::of(keyframe, voxel_grid)?;
        Some(Self::new(
            &(voxel_grid.field_from_world() * depth.world_from_camera),
            [depth.focal_px, depth.principal_px],
            depth.size_px,
            // Fusion also changes voxels behind the reading, up to the truncation.
            voxel_grid.max_depth_m + voxel_grid.scale_m,
            voxel_grid,
        ))
    }

    /// The frustum of a camera whose pose is in the field's frame.
    pub(super) fn of_camera(camera: &Camera, voxel_grid: &VoxelGrid) -> Self {
        let lens = [camera.focal_px, camera.principal_px];
        Self::new(
            &camera.world_from_camera,
            lens,
            camera.size_px,
            camera.far_m,
            voxel_grid,
        )
    }

    fn new(
        field_from_camera: &Transform,
        [focal_px, principal_px]: [[f64; 2]; 2],
        size_px: [u32; 2],
        far_m: f64,
        voxel_grid: &VoxelGrid,
    ) -> Self {
        Self {
            camera_from_field: field_from_camera.inverse(),
            center_m: field_from_camera.translation.vector.into(),
            focal_px,
            principal_px,
            size_px: size_px.map(f64::from),
            far_m,
            block_m: 8.0 * voxel_grid.voxel_m,
        }
    }

    fn center_of_block_m(&self, block: GridCoord) -> Point3<f64> {
        (Vector3::from(block.map(|along| f64::from(along) + 0.5)) * self.block_m).into()
    }

    /// Whether a block may be visible. The result is true at least for all blocks that the kernel
    /// `find_visible` lists.
    pub(super) fn may_be_visible(&self, block: GridCoord) -> bool {
        let center = self.camera_from_field * self.center_of_block_m(block);
        // Half the diagonal of a block is 4 sqrt(3) = 6.93 voxels, rounded up to 7.
        let radius_m = self.block_m * (7.0 + SLACK_VOXELS) / 8.0;
        let is_inside_sides = (0..2).all(|axis| {
            // The side planes pass through the camera and the borders of the image. Their normals
            // are not unit vectors, so the radius is multiplied by their length.
            let focal = self.focal_px[axis];
            let low = self.principal_px[axis];
            let high = self.size_px[axis] - low;
            focal * center[axis] + low * center.z >= -radius_m * focal.hypot(low)
                && high * center.z - focal * center[axis] >= -radius_m * focal.hypot(high)
        });
        is_inside_sides && center.z >= -radius_m && center.z <= self.far_m + radius_m
    }

    /// Distance of a block from the camera.
    pub(super) fn distance_m(&self, block: GridCoord) -> f64 {
        (self.center_of_block_m(block) - self.center_m).norm()
    }
}
